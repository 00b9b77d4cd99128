"""Predicted standard deviations are calibrated."""

import numpy as np
import pytest
from made_skins import record

from jeit.touch import LearntSkin, Presses
from jeit.touch.learnt.regression import DeviationModel


@pytest.fixture(scope="module")
def fine():
    """A skin whose places depend on all channels: its errors are small and grow with the noise."""
    return LearntSkin.fit(Presses.create(**record(120)), method="gaussian-process")


def test_deviations_are_calibrated_for_errors_of_which_few_are_large():
    """Their root mean square would exceed nearly all of them."""
    rng = np.random.default_rng(0)
    predictions, changes, errors = rng.normal(size=(3, 1500, 2))
    errors = errors * np.where(rng.random((1500, 1)) < 0.1, 10.0, 1.0)
    spread = DeviationModel.learn(predictions[:500], changes[:500], errors[:500], np.ones(500, bool))
    for some, deviations in ((slice(500, None), spread), (slice(500), spread.held_out)):
        within = np.mean(np.abs(errors[some]) <= deviations(predictions[some], changes[some]))
        assert 0.6 < within < 0.86


def test_deviations_are_in_the_units_of_the_targets():
    rng = np.random.default_rng(0)
    predictions, changes, errors = rng.normal(size=(3, 300, 2))
    one, thousand = (
        DeviationModel.learn(unit * predictions, changes, unit * errors, np.ones(300, bool))(
            unit * predictions, changes
        )
        for unit in (1.0, 1000.0)
    )
    np.testing.assert_allclose(thousand, 1000 * one, rtol=1e-6)


@pytest.mark.parametrize("noise", [0.01, 0.03, 0.06], ids=["as learnt from", "three times", "six times"])
def test_deviations_are_calibrated_where_readings_are_noisier_than_in_training(fine, noise):
    """Only the residuals of the frames show the noise: their predictions are not unusual."""
    fresh = record(200, seed=7, noise=noise)
    touches = fine.predict(fresh["frames"], fresh["reference"])
    within = np.abs(touches.position - fresh["positions"]) <= touches.position_std
    assert 0.6 < within.mean() < 0.95


def test_deviations_of_a_frame_do_not_depend_on_other_frames(fine):
    fresh = record(5, seed=7, noise=0.06)
    together, first = (fine.predict(fresh["frames"][:n], fresh["reference"][:n]).position_std for n in (5, 1))
    np.testing.assert_allclose(together[:1], first, rtol=1e-6)
