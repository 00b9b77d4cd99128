"""Microphones that are not at their given positions, and gains that changed after the calibration."""

import re

import numpy as np
import pytest
from microphone_arrays import OUTLINE, array, inside, listen, localise, models, received_power

from jeit.acoustic import Calibration, Intensities, Taps, calibrate_microphones, cramer_rao, locate
from jeit.acoustic.localisation.array_changes import GainChanges, covariance_with_gains
from jeit.acoustic.localisation.localiser import Localiser
from jeit.layout import grid

SIXTEEN, ERROR, DRIFT, CHI_SQUARE = grid(0.16, 0.16, 4, 4), 0.05, 0.1, 5.991


def calibrated(off, *, error=ERROR, **options):
    """A fit to taps at 81 places by 16 microphones that are displaced by `off` (16, 2) metres."""
    places, (a, b) = grid(0.18, 0.18, 9, 9), models(16)
    power = listen(SIXTEEN + off, a, b, places)
    power = power * np.exp(error * np.random.default_rng(0).normal(size=power.shape))
    return calibrate_microphones(Taps(SIXTEEN, OUTLINE, places, power=power), decay="inverse-square", **options)


def touches(microphone_array, places, gains, *, seed=1):
    """Intensities of touches at `places`, with the relative errors of the model, and changed gains (M,)."""
    power = received_power(microphone_array, places) * gains
    return Intensities(
        0.05 * np.arange(len(places)), power * np.exp(ERROR * np.random.default_rng(seed).normal(size=power.shape))
    )


def known(microphone_array):
    count = len(microphone_array.microphones)
    return Calibration(microphone_array, np.ones(count, bool), ("",) * count, np.zeros((2, count)), None, "array")


def drawn_gains(seed, count=16, deviation=DRIFT):
    gains = deviation * np.random.default_rng(seed).normal(size=count)
    return np.exp(gains - gains.mean())


def held(found, places):
    """Fraction of the 95 % ellipses that contain the true places."""
    error = found.position - places
    return np.mean(np.einsum("fi,fij,fj->f", error, np.linalg.inv(found.covariance), error) < CHI_SQUARE)


def test_displacements_of_microphones_are_estimated_from_taps():
    """2 mm along each coordinate, estimated to about half a millimetre, which is the effect of the noise."""
    off = 2e-3 * np.random.default_rng(3).normal(size=(16, 2))
    fit, fixed = calibrated(off), calibrated(off, place_error=0)
    assert np.sqrt(np.mean((fit.displacement - off) ** 2)) < 0.7e-3
    np.testing.assert_allclose(fit.calibration.microphone_array.microphones, SIXTEEN + fit.displacement, atol=1e-15)
    assert fit.error < 1.1 * ERROR < fixed.error
    assert (fixed.displacement == 0).all()


def test_microphones_at_their_places_are_not_displaced():
    """By less than the noise alone would: the standard deviation of the displacements is estimated too."""
    assert np.sqrt(np.mean(calibrated(np.zeros((16, 2))).displacement ** 2)) < 0.25e-3


def test_displacements_are_bounded():
    """A microphone 30 mm away is left out, and the others are as accurate as before."""
    off = np.zeros((16, 2))
    off[5] = 0.02, 0.02
    fit = calibrated(off)
    assert not fit.calibration.usable[5]
    own, median = map(float, re.findall(r"(\d+) %", fit.calibration.reasons[5]))
    relative = np.delete(fit.calibration.microphone_array.noise.relative, 5)
    assert 2 * median < own < 60
    assert median == pytest.approx(100 * np.median(relative), abs=3)
    assert np.delete(fit.calibration.usable, 5).all()
    assert np.abs(fit.displacement).max() <= 4 * 2e-3 * (1 + 1e-9)


@pytest.mark.parametrize("seed", [4, 5])
def test_changed_gains_are_estimated(seed):
    """Errors are as if gains were known, and 95 % ellipses contain the truth."""
    microphone_array, places = array(16, microphones=SIXTEEN, relative=ERROR), inside(60, reach=0.95)
    frames = touches(microphone_array, places, drawn_gains(seed))
    found, fixed = locate(frames, known(microphone_array)), localise(microphone_array, frames.power)["position"]
    error, before = (np.linalg.norm(one - places, axis=1) for one in (found.position, fixed))
    assert held(found, places) > 0.92
    assert (found.status == "touch").mean() > 0.97
    assert (found.status != "two touches").all()
    assert np.median(error) < 0.6 * np.median(before)
    assert error.max() < 0.01
    (note,) = found.notes
    assert note.startswith("gains have changed")
    number, change = re.search(r"most that of microphone (\d+), by (\S+) % of its intensity", note).groups()
    gain = drawn_gains(seed)[int(number)]
    assert gain == pytest.approx(1 + float(change) / 100, abs=0.04)
    assert abs(np.log(gain)) > np.abs(np.log(drawn_gains(seed))).max() - 0.04


def test_strongly_changed_gains():
    """By 25 %, so that one source explains few touches at first."""
    microphone_array, places = array(16, microphones=SIXTEEN, relative=ERROR), inside(60, reach=0.95)
    found = locate(touches(microphone_array, places, drawn_gains(6, deviation=0.25)), known(microphone_array))
    assert (found.status == "touch").mean() > 0.97
    assert held(found, places) > 0.9


def test_unchanged_gains():
    """Nothing is corrected, and places and ellipses are nearly those for exactly known gains."""
    microphone_array, places = array(16, microphones=SIXTEEN, relative=ERROR), inside(60, reach=0.95)
    frames = touches(microphone_array, places, np.ones(16))
    found, exact = locate(frames, known(microphone_array)), locate(frames, known(microphone_array), gain_drift=0)
    assert found.notes == ()
    assert np.linalg.norm(found.position - exact.position, axis=1).max() < 5e-4
    ratio = np.linalg.det(found.covariance) / np.linalg.det(exact.covariance)
    assert 1 < np.median(ratio) < 1.3**4


@pytest.mark.slow
def test_ellipses_of_a_single_touch_include_the_gains():
    """One touch contains little information about the gains: 24 recordings of one touch each, with different gains."""
    microphone_array, places = array(16, microphones=SIXTEEN, relative=ERROR), inside(24, reach=0.9)
    inner = [
        held(locate(touches(microphone_array, [place], drawn_gains(k), seed=100 + k), known(microphone_array)), [place])
        for k, place in enumerate(places)
    ]
    assert np.mean(inner) > 0.85


def test_gain_errors_widen_ellipses_along_their_effect():
    """F⁻¹ + B C Bᵀ, with B by differences of the places that exact intensities give under other gains."""
    microphone_array, place = array(9, relative=0.05), np.array([[0.013, 0.021]])
    localiser, power = Localiser.create(microphone_array, compiled=False), received_power(microphone_array, place)
    step, use = 1e-4, np.ones((1, 9), bool)
    changed = power * np.exp(step * np.concatenate([np.eye(9), -np.eye(9)]))
    position = np.asarray(localiser(changed).position)
    slope = (position[:9] - position[9:]).T / (2 * step)
    factor = np.random.default_rng(0).normal(size=(9, 3))
    changes = GainChanges(np.zeros(9), 0.01 * factor @ factor.T)
    exact = cramer_rao(microphone_array, place, 1.0)[0] + slope @ changes.covariance @ slope.T
    found = covariance_with_gains(microphone_array, power, use, localiser(power), changes)
    np.testing.assert_allclose(found[0], exact, rtol=1e-4)


@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf, "much"])
def test_bad_deviations(value):
    microphone_array = array(9)
    with pytest.raises(ValueError, match="gain_drift must be zero or positive"):
        locate(touches(microphone_array, inside(4), np.ones(9)), known(microphone_array), gain_drift=value)
    with pytest.raises(ValueError, match="place_error must be zero or positive"):
        calibrated(np.zeros((16, 2)), place_error=value)
