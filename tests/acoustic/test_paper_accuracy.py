"""From sound to places on the simulated skin, at the accuracy of Park 2022, Fig. 3: 6.6 mm ± 3.8 mm."""

import jax
import numpy as np
import pytest

from jeit.acoustic import Intensities, Taps, calibrate_microphones, locate, tap_intensities
from jeit.acoustic.simulate import SoundingSkin, simulate_calibration_taps
from jeit.layout import grid

OUTLINE = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]
BURSTS = 10

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def trial():
    """Calibrated at 13 × 13 places every 15 mm, three taps each, and evaluated at 13 × 13 every 12.5 mm, ten bursts
    each.
    """
    skin = SoundingSkin(jax.random.key(0))
    place = np.asarray(skin.microphones)
    known = simulate_calibration_taps(skin, jax.random.key(1), grid(0.18, 0.18, 13, 13), repeats=3)
    calibration = calibrate_microphones(
        Taps(place, OUTLINE, known.positions, samples=known.samples, rate=known.rate)
    ).calibration
    tried = simulate_calibration_taps(skin, jax.random.key(2), grid(0.15, 0.15, 13, 13), repeats=BURSTS)
    each = tap_intensities(Taps(place, OUTLINE, tried.positions, samples=tried.samples, rate=tried.rate))
    intensities = Intensities(
        np.arange(169.0),
        each.power.reshape(169, BURSTS, 25).mean(axis=1),
        floor=each.floor,
        # A mean of ten windows scatters as one window of ten times the degrees of freedom.
        freedom=BURSTS * np.median(each.freedom),
        usable=each.usable.reshape(169, BURSTS, 25).all(axis=1),
        faults=each.faults,
    )
    return calibration, intensities, tried.positions[::BURSTS]


@pytest.fixture(scope="module")
def found(trial):
    calibration, intensities, _ = trial
    return {method: locate(intensities, calibration, method=method) for method in ("likelihood", "consistency")}


def errors(found, places):
    """Distances, millimetres."""
    return 1e3 * np.linalg.norm(found.position - places, axis=1)


def test_every_microphone_is_calibrated(trial):
    calibration, _, _ = trial
    assert calibration.usable.all()
    assert (np.asarray(calibration.microphone_array.noise.relative) < 0.5).all()


def test_the_papers_loss_is_as_good_as_the_paper(trial, found):
    error = errors(found["consistency"], trial[2])
    assert len(error) == 169
    assert error.mean() <= 6.6
    assert error.std() <= 3.8


def test_the_likelihood_is_a_quarter_better(trial, found):
    mine, papers = (errors(found[method], trial[2]) for method in ("likelihood", "consistency"))
    assert mine.mean() <= 0.75 * papers.mean()
    assert mine.std() <= 3.8


def test_ellipses_contain_the_truth(trial, found):
    """Although sound does not decay as modelled: the ellipses are widened by the errors of taps that were left out."""
    error = found["likelihood"].position - trial[2]
    square = np.einsum("fi,fij,fj->f", error, np.linalg.inv(found["likelihood"].covariance), error)
    assert 0.90 <= np.mean(square < 5.991) <= 0.995


def test_all_are_reported_as_touches(found):
    for one in found.values():
        assert np.mean(one.status == "touch") > 0.9
        assert one.notes == ()
        assert one.faults == ("",) * 25
