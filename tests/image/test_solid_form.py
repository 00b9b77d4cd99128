"""Ellipsoids and columns as surfaces: closed, oriented outward, of the exact volume, in any orientation."""

import numpy as np
import pytest

from jeit.image import Inclusion, SolidForm

# Half axes of 30, 20 and 10 mm, rotated, as a right-handed and a left-handed system.
TURNED, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
AXES = np.diag([0.03, 0.02, 0.01]) @ TURNED


@pytest.mark.parametrize("hand", [1, -1])
def test_an_ellipsoid_is_closed_and_outward(hand):
    axes = AXES * np.array([[hand], [1], [1]])
    form = SolidForm((0.1, 0.2, 0.3), tuple(map(tuple, axes.tolist())), False)
    surface = form.surface()
    assert surface.enclosed == pytest.approx(4 / 3 * np.pi * 6e-6, rel=0.01)
    unit = (surface.points - [0.1, 0.2, 0.3]) @ np.linalg.inv(axes)
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1, rtol=1e-12)


@pytest.mark.parametrize("hand", [1, -1])
def test_a_column_is_closed_and_outward(hand):
    form = SolidForm((0.1, 0.2, 0.05), ((0.02 * hand, 0.02 * hand, 0.0), (-0.01, 0.01, 0.0), (0.0, 0.0, 0.05)), True)
    surface = form.surface()
    assert surface.enclosed == pytest.approx(np.pi * 4e-4 * 0.1, rel=0.01)
    assert surface.points[:, 2].min() == pytest.approx(0)
    assert surface.points[:, 2].max() == pytest.approx(0.1)


def test_inclusions_recognise_columns():
    form = SolidForm((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True)
    assert Inclusion(1, (0.0, 0.0, 0.0), 1.0, 1.0, form=form).is_column
    assert not Inclusion(1, (0.0, 0.0, 0.0), 1.0, 1.0).is_column
