"""Left-out taps: they choose the decay model, and the factor by which covariances are widened."""

import functools
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest
from microphone_arrays import MICROPHONES, OUTLINE, listen, models

from jeit.acoustic import Calibration, Intensities, Taps, calibrate_microphones, locate
from jeit.acoustic.calibration.calibrate import CalibrationFit, fit_each_decay, select_fit
from jeit.acoustic.calibration.usable_microphones import LeftOutTaps, _assign_folds
from jeit.acoustic.decay import DECAY_MODELS
from jeit.layout import grid

ARRAY, PLACES = MICROPHONES[9], grid(0.18, 0.18, 7, 7)
SQUARED = ((PLACES[:, None] - ARRAY) ** 2).sum(axis=-1)
LAWS = {
    "inverse-square": 1e-3 / (SQUARED + 1e-3),
    "exponential": np.exp(-np.sqrt(SQUARED) / 0.03),
    "attenuated": np.exp(-np.sqrt(SQUARED) / 0.05) / (SQUARED + 1e-4),
}


def taps(power, error=0.05, seed=0):
    return Taps(
        ARRAY, OUTLINE, PLACES, power=power * np.exp(error * np.random.default_rng(seed).normal(size=power.shape))
    )


@functools.cache
def fitted(law):
    """Fits of every law to taps simulated by one, and the laws that cannot be fitted."""
    return fit_each_decay(taps(LAWS[law]))


# `test_untuned_arrays` has a steep array, whose law is reported as attenuated.
@pytest.mark.parametrize(
    "law", [pytest.param(one, marks=pytest.mark.slow if one == "attenuated" else []) for one in LAWS]
)
def test_auto_chooses_the_law_that_simulated_the_taps(law):
    fit = select_fit(*fitted(law))
    assert fit.calibration.microphone_array.decay.name == law
    assert fit.left_out[0][1] < 2.1e-3
    assert {name for name, _ in fit.left_out} == set(DECAY_MODELS)


def test_the_chosen_fit_is_that_of_its_law_alone():
    auto = select_fit(*fitted("exponential"))
    alone = calibrate_microphones(taps(LAWS["exponential"]), decay="exponential")
    assert eqx.tree_equal(auto.calibration, alone.calibration)
    assert alone.left_out == auto.left_out[:1]


@pytest.mark.slow
def test_auto_fits_every_law_and_chooses():
    auto, expected = calibrate_microphones(taps(LAWS["exponential"])), select_fit(*fitted("exponential"))
    assert eqx.tree_equal(auto.calibration, expected.calibration)
    assert auto.left_out == expected.left_out


def test_the_simpler_of_two_equally_good_laws_is_chosen():
    fits, _ = fitted("inverse-square")
    off = {"inverse-square": 1.04e-3, "exponential": 5e-3, "attenuated": 1e-3}
    errors_of_fits = {name: eqx.tree_at(lambda f: f.left_out, fit, ((name, off[name]),)) for name, fit in fits.items()}
    assert select_fit(errors_of_fits, {}).calibration.microphone_array.decay.name == "inverse-square"
    errors_of_fits["inverse-square"] = eqx.tree_at(
        lambda f: f.left_out, fits["inverse-square"], (("inverse-square", 1.06e-3),)
    )
    assert select_fit(errors_of_fits, {}).calibration.microphone_array.decay.name == "attenuated"


def test_errors_of_fits_are_stated_in_millimetres_and_percent():
    errors = (("inverse-square", 0.0123), ("exponential", 0.02), ("attenuated", np.inf))
    fit = SimpleNamespace(error=0.304, left_out=errors)
    expected = "locates taps left out of the fit to 12.3 mm, median (exponential 20.0 mm, attenuated refused)"
    assert CalibrationFit.evidence.fget(fit) == expected
    assert CalibrationFit.note.fget(fit).startswith("the models miss the recorded levels by 30 %")


def test_taps_in_another_order_are_refused():
    """By one law, with its reason, and by auto, with the first reason."""
    power = np.random.default_rng(1).permutation(LAWS["inverse-square"])
    with pytest.raises(ValueError, match="in the order of the taps"):
        calibrate_microphones(taps(power, 0.2), decay="inverse-square")
    with pytest.raises(ValueError, match="in the order of the taps"):
        select_fit({}, {"inverse-square": "are positions in the order of the taps?", "exponential": "other"})


@pytest.mark.slow
def test_taps_in_another_order_are_refused_by_every_law():
    power = np.random.default_rng(1).permutation(LAWS["inverse-square"])
    fits, refused = fit_each_decay(taps(power, 0.2))
    assert fits == {}
    assert set(refused) == set(DECAY_MODELS)
    with pytest.raises(ValueError, match="in the order of the taps"):
        select_fit(fits, refused)


def test_taps_at_one_place_are_left_out_together():
    part = _assign_folds(PLACES.repeat(3, axis=0)).reshape(-1, 3)
    assert (part == part[:, :1]).all()
    assert np.bincount(part[:, 0]).tolist() == [13, 12, 12, 12]


def test_the_widening_covers_nine_in_ten_taps():
    square = 3.0 * np.random.default_rng(2).chisquare(2, 4000)
    taken = LeftOutTaps(np.ones(4000), square, 1.0)
    assert taken.widening == pytest.approx(3.0, rel=0.06)
    assert LeftOutTaps(np.ones(4000), square / 9, 1.0).widening == 1
    assert LeftOutTaps(np.ones(9), square[:9], 1.0).widening == 1
    assert LeftOutTaps(np.full(9, np.nan), np.full(9, np.nan), 1.0).median == np.inf


def test_covariances_of_places_are_widened_by_the_calibration(tmp_path):
    """By `widening`, which its file keeps. Files without the key are of calibrations that widen nothing."""
    a, b = models(9)
    calibration = calibrate_microphones(taps(listen(ARRAY, a, b, PLACES)), decay="inverse-square").calibration
    plain, wide = (eqx.tree_at(lambda c: c.widening, calibration, value) for value in (1.0, 2.5))
    touch = Intensities(np.arange(2.0), listen(ARRAY, a, b, [[0.01, 0.02], [-0.03, 0.0]]))
    one, other = locate(touch, plain), locate(touch, wide)
    np.testing.assert_allclose(other.covariance, 2.5 * one.covariance, rtol=1e-12)
    np.testing.assert_array_equal(other.position, one.position)
    wide.save(tmp_path / "wide.json")
    assert Calibration.load(tmp_path / "wide.json").widening == 2.5
    text = (tmp_path / "wide.json").read_text("utf-8")
    (tmp_path / "older.json").write_text(text.replace(' "widening": 2.5,\n', ""), "utf-8")
    assert Calibration.load(tmp_path / "older.json").widening == 1
    (tmp_path / "narrow.json").write_text(text.replace('"widening": 2.5', '"widening": 0.5'), "utf-8")
    with pytest.raises(ValueError, match=r"widening is 0\.5, and must be from 1 up\.$"):
        Calibration.load(tmp_path / "narrow.json")


def test_no_microphone_is_estimated_to_be_noiseless():
    """One of eight similar microphones is noiseless, by chance: its estimate is about half the others' noise at
    least.
    """
    rng = np.random.default_rng(4)
    power = LAWS["exponential"] + 0.02 * rng.normal(size=SQUARED.shape)
    power[:, 4] = LAWS["exponential"][:, 4]
    deviation = np.asarray(
        calibrate_microphones(taps(power, 0.05), decay="exponential").calibration.microphone_array.noise.deviation
    )
    assert deviation.min() > 0.4 * np.median(deviation) > 0.004
