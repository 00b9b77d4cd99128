"""Meshes for these tests, each generated once: most tests image the same disk."""

import pickle

import pytest

from jeit.imaging import calibration, describe

MADE = {}


@pytest.fixture(scope="module", autouse=True)
def meshes_made_once():
    """No test changes a mesh: they are immutable."""
    make = calibration.body_mesh

    def made_once(*described, **named):
        key = pickle.dumps((described, named))
        if key not in MADE:
            MADE[key] = make(*described, **named)
        return MADE[key]

    with pytest.MonkeyPatch.context() as patch:
        for module in (describe, calibration):
            patch.setattr(module, "body_mesh", made_once)
        yield
