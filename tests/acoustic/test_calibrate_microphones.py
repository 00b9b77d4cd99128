"""Calibration from taps of unknown strength: it recovers the true models, and copes with faulty data."""

import numpy as np
import pytest
from microphone_arrays import MICROPHONES, OUTLINE, listen

from jeit.acoustic import Taps, calibrate_microphones
from jeit.acoustic.decay import DECAY_MODELS, InverseSquare
from jeit.layout import grid

PLACES = grid(0.18, 0.18, 13, 13)
MICROPHONE = MICROPHONES[25]
COUNT, NUMBER = len(MICROPHONE), len(PLACES)
SQUARED = ((PLACES[:, None] - MICROPHONE) ** 2).sum(axis=-1)


def parameters(decay, seed=0):
    rng = np.random.default_rng(seed)
    a, b = 1e-3 * np.exp(0.3 * rng.normal(size=COUNT)), 1e-3 * np.exp(0.5 * rng.normal(size=COUNT))
    length = 0.03 * np.exp(0.3 * rng.normal(size=COUNT))
    return {"inverse-square": (a, b), "exponential": (a, length), "attenuated": (a, b, length)}[decay]


def responses(decay, values, squared=SQUARED):
    """Responses f (T, M), from the formulas."""
    r = np.sqrt(squared)
    if decay == "inverse-square":
        return values[0] / (squared + values[1])
    if decay == "exponential":
        return values[0] * np.exp(-r / values[1])
    return values[0] * np.exp(-r / values[2]) / (squared + values[1])


def strengths(seed=1):
    """Strengths of taps by hand: spread over a factor of about ten."""
    return np.exp(0.7 * np.random.default_rng(seed).normal(size=NUMBER))


def scaled(decay, values, usable=slice(None)):
    """Logarithms (K, M) of the parameters at the scale of a calibration, and the logarithm of that scale."""
    logarithms = np.log(values)
    gain = logarithms[0] - (logarithms[1] if decay != "exponential" else 0)
    shift = gain[usable].mean()
    logarithms[0] -= shift
    return logarithms, shift


def calibrated(power, places=PLACES, *, decay="inverse-square", **options):
    return calibrate_microphones(Taps(MICROPHONE, OUTLINE, places, power=power), decay=decay, **options)


def logarithms_of(fit):
    return np.asarray(fit.calibration.microphone_array.decay.logarithms())


@pytest.fixture(scope="module")
def exact():
    values, loudness = parameters("inverse-square"), strengths()
    return values, loudness, loudness[:, None] * responses("inverse-square", values)


@pytest.mark.parametrize(
    ("decay", "seed"),
    [("inverse-square", 0), ("attenuated", 0), pytest.param("exponential", 0, marks=pytest.mark.slow)]
    + [pytest.param(decay, seed, marks=pytest.mark.slow) for decay in DECAY_MODELS for seed in (1, 2)],
)
def test_exact_data_give_the_parameters(decay, seed):
    """The parameters are exact to 1e-6 with unknown strengths, and the rest of the fit is consistent."""
    values, loudness = parameters(decay, seed), strengths()
    fit = calibrated(loudness[:, None] * responses(decay, values), decay=decay)
    expected, shift = scaled(decay, values)
    np.testing.assert_allclose(logarithms_of(fit), expected, atol=1e-5)
    np.testing.assert_allclose(fit.strength, loudness * np.exp(shift), rtol=1e-6)
    assert not fit.outlier.any()
    assert fit.usable.all()
    assert fit.calibration.usable.all()
    assert set(fit.calibration.reasons) == {""}
    np.testing.assert_allclose(fit.explained, 1, atol=1e-9)
    np.testing.assert_allclose(fit.distance, np.sqrt(SQUARED), atol=1e-8)
    assert float(np.log(fit.calibration.microphone_array.decay.gain).mean()) == pytest.approx(0, abs=1e-12)
    assert isinstance(fit.calibration.microphone_array.decay, DECAY_MODELS[decay])
    # No parameter is known better than to a thousandth.
    np.testing.assert_allclose(fit.calibration.microphone_array.noise.relative, 1e-3)
    np.testing.assert_array_equal(fit.calibration.microphone_array.noise.deviation, 0)


@pytest.mark.parametrize("scale", [1e-12, pytest.param(1e12, marks=pytest.mark.slow)])
def test_any_unit_of_intensity(scale, exact):
    """A class of decay models is accepted too, in place of its name."""
    values, loudness, power = exact
    fit = calibrated(scale * power, decay=InverseSquare)
    expected, shift = scaled("inverse-square", values)
    np.testing.assert_allclose(logarithms_of(fit), expected, atol=1e-5)
    np.testing.assert_allclose(fit.strength, scale * loudness * np.exp(shift), rtol=1e-6)


@pytest.fixture(scope="module")
def faulty(exact):
    """A tenth of the taps at wrong places, microphone 3 dead, microphone 7 with noise about one level."""
    values, _, power = exact
    rng = np.random.default_rng(2)
    wrong = rng.choice(NUMBER, NUMBER // 10, replace=False)
    places, power = PLACES.copy(), power.copy()
    # The wrong place is at least 4 cm from the true one, since a smaller displacement is not wrong.
    far = rng.uniform(-0.09, 0.09, (200, len(wrong), 2))
    apart = np.linalg.norm(far - PLACES[wrong], axis=-1)
    places[wrong] = far[(apart > 0.04).argmax(axis=0), np.arange(len(wrong))]
    power[:, 3] = 0
    power[:, 7] = power[:, 7].mean() * np.exp(0.3 * rng.normal(size=NUMBER))
    return values, wrong, calibrated(power, places)


def test_all_taps_at_wrong_places_are_detected(faulty):
    """All of them, and no other tap, are reported as outliers."""
    _, wrong, fit = faulty
    assert set(np.flatnonzero(fit.outlier)) == set(wrong)
    assert not fit.usable[wrong].any()


def test_faulty_data_do_not_affect_the_other_microphones(faulty):
    values, _, fit = faulty
    good = fit.calibration.usable
    assert set(np.flatnonzero(~good)) == {3, 7}
    expected = scaled("inverse-square", values, good)[0]
    np.testing.assert_allclose(logarithms_of(fit)[:, good], expected[:, good], atol=1e-6)


def test_dead_and_insensitive_microphones_are_reported_with_a_reason(faulty):
    reasons = faulty[2].calibration.reasons
    assert reasons[3] == "dead: every intensity is 0"
    assert "explains" in reasons[7] or "does not fall with distance" in reasons[7]
    assert {reasons[k] for k in range(COUNT) if k not in (3, 7)} == {""}
    assert faulty[2].explained[7] < 0.3


def test_the_scale_is_that_of_the_usable_microphones(faulty):
    calibration = faulty[2].calibration
    gain = np.asarray(calibration.microphone_array.decay.gain)[calibration.usable]
    assert float(np.log(gain).mean()) == pytest.approx(0, abs=1e-12)
    assert np.isnan(calibration.standard_errors[:, 3]).all()
    assert np.isfinite(calibration.standard_errors[:, calibration.usable]).all()


DRAWS = 6


def drawn(power, number):
    """Fits of data with 5 % noise."""
    rng = np.random.default_rng(3)
    return [calibrated(power * np.exp(0.05 * rng.normal(size=power.shape))) for _ in range(number)]


@pytest.mark.slow
def test_standard_errors_are_the_errors(exact):
    """Root mean square of z-scores. The 25 scores of a draw are correlated through the scale: 6 draws determine it to
    12 %.
    """
    fits = drawn(exact[2], DRAWS)
    errors = np.array([logarithms_of(fit) - scaled("inverse-square", exact[0])[0] for fit in fits])
    estimated = np.array([fit.calibration.standard_errors for fit in fits])
    z = np.sqrt(np.mean((errors / estimated) ** 2, axis=(0, 2)))
    assert ((z > 0.8) & (z < 1.25)).all(), z


def test_relative_noise_is_estimated(exact):
    """Hardly any additive noise is estimated where there is none: in few microphones, and little."""
    additive = []
    for fit in drawn(exact[2], 1):
        relative = np.asarray(fit.calibration.microphone_array.noise.relative)
        # From 169 taps the deviation of each is determined to 5.5 %.
        assert np.mean(relative) == pytest.approx(0.05, rel=0.05)
        assert ((relative > 0.035) & (relative < 0.065)).all()
        additive.append(np.asarray(fit.calibration.microphone_array.noise.deviation))
        assert not fit.outlier.any()
    assert np.mean(np.array(additive) > 0) < 0.05
    assert np.max(additive) < 0.05 * np.median(exact[2])


@pytest.mark.slow
def test_errors_shrink_with_the_noise(exact):
    """Errors fall in proportion to the noise, for microphones at exactly known places. The same draw is scaled by a
    tenth, so that nonlinear terms are a hundredth of the error.
    """
    values, _, power = exact
    draw = np.random.default_rng(4).normal(size=power.shape)
    expected = scaled("inverse-square", values)[0]
    large, small = (
        logarithms_of(calibrated(power * np.exp(noise * draw), place_error=0)) - expected for noise in (0.04, 0.004)
    )
    assert np.linalg.norm(small - large / 10) < 0.05 * np.linalg.norm(small)
    assert np.abs(large).max() < 0.1


def test_additive_noise_is_estimated(exact):
    """Intensities of unknown floor, some of them below zero."""
    values, _, power = exact
    deviation = 0.1 * np.median(power)
    rng = np.random.default_rng(5)
    fit = calibrated(power * np.exp(0.05 * rng.normal(size=power.shape)) + deviation * rng.normal(size=power.shape))
    noise = fit.calibration.microphone_array.noise
    assert np.median(noise.deviation) == pytest.approx(deviation, rel=0.25)
    assert np.mean(noise.relative) == pytest.approx(0.05, rel=0.25)
    z = (logarithms_of(fit) - scaled("inverse-square", values)[0]) / fit.calibration.standard_errors
    # Distant taps are lost in the noise, whose logarithm is not normal: errors are somewhat larger.
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.7
    assert fit.outlier.sum() <= 1


def test_taps_that_few_microphones_receive_are_no_outliers(exact):
    """The mean square of five residuals often exceeds two, although the noise of all taps is the same."""
    power = exact[2] * np.exp(0.05 * np.random.default_rng(3).normal(size=exact[2].shape))
    nearest = np.argsort(np.argsort(SQUARED, axis=1), axis=1) < 5
    fit = calibrated(np.where(nearest, power, np.nan))
    assert not fit.outlier.any()
    np.testing.assert_array_equal(fit.usable, nearest)
    # A quarter of the readings determine strengths and parameters, by which the residuals are smaller than the noise.
    relative = np.asarray(fit.calibration.microphone_array.noise.relative)
    assert np.sqrt(np.mean(relative**2)) == pytest.approx(0.05, rel=0.1)


def with_one(exact, k, response):
    """The exact data with another response of microphone k."""
    _, loudness, power = exact
    power = power.copy()
    power[:, k] = loudness * response
    return power


@pytest.mark.slow
def test_a_microphone_whose_b_tends_to_zero_does_not_affect_the_others(exact):
    """Its response is a / r²: b tends to zero, less than a square millimetre, and stays within bounds. The others
    remain exact.
    """
    values = exact[0]
    fit = calibrated(with_one(exact, 12, 1e-3 / (SQUARED[:, 12] + 1e-14)))
    lower = InverseSquare.bounds(np.sqrt(SQUARED.max()))[0][1]
    found = logarithms_of(fit)
    assert found[1, 12] >= lower - 1e-9
    assert found[1, 12] < 2 * np.log(1e-3)
    others = np.arange(COUNT) != 12
    assert fit.calibration.usable[others].all()
    relative = found - found[:, :1] - (np.log(values) - np.log(values)[:, :1])
    # Its tap at r = 0 does not fit and may be reported as an outlier. The other taps are exact.
    np.testing.assert_allclose(found[1, others], np.log(values[1])[others], atol=1e-4)
    np.testing.assert_allclose(relative[0, others], 0, atol=1e-4)


@pytest.mark.slow
def test_a_microphone_whose_response_does_not_depend_on_distance_is_reported(exact):
    """b tends to infinity: it is held at its bound, flagged, and not used."""
    values = exact[0]
    fit = calibrated(with_one(exact, 12, np.full(NUMBER, 0.7)))
    assert not fit.calibration.usable[12]
    assert fit.calibration.reasons[12] == "its intensity does not fall with distance"
    good = np.arange(COUNT) != 12
    assert fit.calibration.usable[good].all()
    expected = scaled("inverse-square", values, good)[0]
    # At its bound, ten array sizes away, its response still falls by about a thousandth, which affects the others
    # slightly.
    np.testing.assert_allclose(logarithms_of(fit)[:, good], expected[:, good], atol=2e-4)


def test_missing_readings_are_left_out(exact):
    """A fifth of the readings are NaN, one tap was not detected, and one reading is infinite. The rest stays exact."""
    values, loudness, power = exact
    power = power.copy()
    rng = np.random.default_rng(6)
    gone = rng.random(power.shape) < 0.2
    power[gone] = np.nan
    power[5] = np.nan
    power[6, 0] = np.inf
    fit = calibrated(power)
    expected, shift = scaled("inverse-square", values)
    np.testing.assert_allclose(logarithms_of(fit), expected, atol=1e-5)
    assert np.isnan(fit.strength[5])
    others = np.arange(NUMBER) != 5
    np.testing.assert_allclose(fit.strength[others], (loudness * np.exp(shift))[others], rtol=1e-6)
    np.testing.assert_array_equal(fit.usable, np.isfinite(power))


def test_a_microphone_that_detected_few_taps_is_reported(exact):
    _, _, power = exact
    power = power.copy()
    power[3:, 4] = np.nan
    fit = calibrated(power)
    assert not fit.calibration.usable[4]
    assert fit.calibration.reasons[4] == "it received 3 of the taps only, and 4 are needed"
    assert fit.calibration.usable.sum() == COUNT - 1


@pytest.mark.slow
def test_order_does_not_matter():
    """The order of taps and of microphones does not matter: the models agree to rounding."""
    place, places = MICROPHONES[9], PLACES[::2]
    power = listen(place, *(one[:9] for one in parameters("inverse-square")), places, strengths()[::2])
    power *= np.exp(0.05 * np.random.default_rng(7).normal(size=power.shape))
    taps, microphones = np.random.default_rng(8).permutation(len(places)), np.random.default_rng(9).permutation(9)
    plain = calibrate_microphones(Taps(place, OUTLINE, places, power=power))
    mixed = calibrate_microphones(Taps(place[microphones], OUTLINE, places[taps], power=power[taps][:, microphones]))
    np.testing.assert_allclose(logarithms_of(mixed), logarithms_of(plain)[:, microphones], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 4, 9])
def test_fewer_microphones(count):
    """Three microphones are the fewest: 169 taps give 507 readings for 175 unknowns."""
    place = MICROPHONES[count]
    a, b = parameters("inverse-square")
    power = listen(place, a[:count], b[:count], PLACES, strengths())
    fit = calibrate_microphones(Taps(place, OUTLINE, PLACES, power=power))
    expected = scaled("inverse-square", (a[:count], b[:count]))[0]
    np.testing.assert_allclose(logarithms_of(fit), expected, atol=1e-5)


@pytest.mark.slow
def test_on_a_curved_skin():
    """Distances are straight lines in space, and the microphones lie 10 mm beneath the surface."""
    radius = 0.15

    def on(chart, depth=0.0):
        angle = chart[:, 0] / radius
        return np.stack(
            [(radius - depth) * np.sin(angle), chart[:, 1], (radius - depth) * np.cos(angle) - radius], axis=1
        )

    values = tuple(one[:9] for one in parameters("inverse-square"))
    place, taps = on(MICROPHONES[9], 0.01), on(PLACES)
    fit = calibrate_microphones(Taps(place, on(OUTLINE), taps, power=listen(place, *values, taps, strengths())))
    np.testing.assert_allclose(logarithms_of(fit), scaled("inverse-square", values)[0], atol=1e-4)
    assert fit.calibration.microphone_array.surface.dimension == 3


def test_too_few_microphones(exact):
    power = exact[2].copy()
    power[:, 2:] = 0
    with pytest.raises(
        ValueError, match=r"only 2 of 25 microphones received taps from 4 distances.*microphones 2-24: dead"
    ):
        calibrated(power)


@pytest.fixture(scope="module")
def coarse():
    """Taps 60 mm apart, receptive fields of 15 mm, errors of a fifth: some microphones are far from any tap."""
    places = grid(0.18, 0.18, 4, 4).repeat(3, axis=0)
    values = np.array(parameters("inverse-square")) / np.array([[1], [16]])
    squared = ((places[:, None] - MICROPHONE) ** 2).sum(axis=-1)
    power = responses("inverse-square", values, squared)
    return values, places, power * np.exp(0.2 * np.random.default_rng(3).normal(size=power.shape))


def test_a_shape_that_no_tap_determines_is_estimated_from_the_others(coarse):
    """It is nearly theirs: no microphone's is at its bound, where all places would be located at that microphone."""
    values, places, power = coarse
    fit = calibrated(power, places)
    b = logarithms_of(fit)[1]
    assert fit.calibration.usable.all()
    assert 0 < fit.shared.sum() < COUNT
    own = b[~fit.shared]
    assert np.ptp(b[fit.shared]) < 1.0
    assert own.min() - 0.5 < b[fit.shared].min() <= b[fit.shared].max() < own.max() + 0.5
    assert np.abs(b - np.log(values[1])).max() < 1.5
    errors = fit.calibration.standard_errors
    assert np.isnan(errors[1, fit.shared]).all()
    assert np.isfinite(errors[0]).all()
    assert (errors[1, ~fit.shared] < 1).all()


def test_microphones_at_exchanged_places_are_reported_as_displaced(exact):
    """Their models explain much of the power that they received, but less well than the other microphones' models."""
    microphones = MICROPHONE.copy()
    microphones[[11, 12]] = microphones[[12, 11]]
    power = exact[2] * np.exp(0.1 * np.random.default_rng(7).normal(size=exact[2].shape))
    fit = calibrate_microphones(Taps(microphones, OUTLINE, PLACES, power=power), decay="inverse-square")
    assert set(np.flatnonzero(~fit.calibration.usable)) == {11, 12}
    assert all("is it where it is said to be" in fit.calibration.reasons[k] for k in (11, 12))
    relative = np.asarray(fit.calibration.microphone_array.noise.relative)
    np.testing.assert_allclose(np.delete(relative, [11, 12]), 0.1, atol=0.04)


def test_few_microphones_share_the_noise():
    """None of five microphones is weighted ever more for agreeing with strengths that it determines itself."""
    array, places = MICROPHONES[9][:5], grid(0.18, 0.18, 9, 9)
    squared = ((places[:, None] - array) ** 2).sum(axis=-1)
    rng = np.random.default_rng(8)
    power = 1e-3 / (squared + 4e-4) * np.exp(0.2 * rng.normal(size=squared.shape) + rng.normal(size=(len(places), 1)))
    fit = calibrate_microphones(Taps(array, OUTLINE, places, power=power), decay="inverse-square")
    relative = np.asarray(fit.calibration.microphone_array.noise.relative)
    assert ((relative > 0.1) & (relative < 0.4)).all(), relative
    np.testing.assert_allclose(logarithms_of(fit)[1], np.log(4e-4), atol=0.8)


@pytest.mark.parametrize(
    ("places", "message"),
    [
        (np.repeat(PLACES[80:81], 20, axis=0), r"only 0 of \d+ microphones received taps from 4 distances"),
        (np.repeat(PLACES[[10, 80, 150]], 7, axis=0), r"tap all over the skin"),
        pytest.param(np.random.default_rng(4).permutation(PLACES), r"in the order of the taps", marks=pytest.mark.slow),
    ],
    ids=["one place", "three places", "another order"],
)
def test_uninformative_taps_are_refused(places, message, exact):
    power = exact[2][: len(places)] * np.exp(0.2 * np.random.default_rng(5).normal(size=(len(places), COUNT)))
    with pytest.raises(ValueError, match=message):
        calibrated(power, places)


@pytest.mark.slow
def test_microphones_are_judged_again_after_others_are_left_out(exact):
    """The remaining microphones are fitted as if the others had never been there, until all that remain are usable."""
    rng = np.random.default_rng(1)
    power = exact[2] * np.exp(0.2 * rng.normal(size=exact[2].shape))
    mixture = np.linspace(0.5, 0.95, 8)
    power[:, :8] = np.exp((1 - mixture) * np.log(power[:, :8]) + mixture * rng.normal(size=(NUMBER, 8)))
    fit = calibrated(power)
    good = fit.calibration.usable
    assert good[8:].all()
    assert good.sum() == 19
    assert np.isfinite(fit.calibration.standard_errors[:, good]).all()
    assert all(fit.explained[good] >= 0.3)
    alone = np.where(good, power, np.nan)
    np.testing.assert_allclose(logarithms_of(fit)[1, 8:], logarithms_of(calibrated(alone))[1, 8:], atol=0.03)


@pytest.mark.slow
def test_too_few_usable_microphones(exact):
    """All but two microphones are insensitive: each is listed with the reason why it is not used."""
    rng = np.random.default_rng(10)
    power = exact[2].copy()
    power[:, 2:] = np.exp(rng.normal(size=(NUMBER, COUNT - 2)))
    with pytest.raises(ValueError, match=r"of the 25 microphones that received the taps follow a decay model"):
        calibrated(power)


def test_bad_model(exact):
    with pytest.raises(ValueError, match="inverse-square"):
        calibrated(exact[2], decay="linear")
