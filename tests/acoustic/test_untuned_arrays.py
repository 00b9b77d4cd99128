"""The defaults on arrays that jeit's decay models do not describe: random ones, and one with steep decay."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.problems.located_arrays import located, located_by_each, plainly_located, taps_of
from benchmarks.problems.simulated_arrays import DEVELOPMENT, REPORTED, draw_array, steep_array
from jeit.acoustic.calibration.calibrate import fit_each_decay, select_fit
from jeit.acoustic.decay import DECAY_MODELS

FEW = {"microphones": (9, 12), "tap_side": (7, 7), "repeats": (1, 1)}


@pytest.fixture(scope="module")
def steep():
    """Intensity falls by a factor e in 45 mm, besides its spreading. A clean array with reflecting edges."""
    array = steep_array(0.045, microphones=(16, 16), tap_side=(7, 7), repeats=(1, 1))
    fits, refused = fit_each_decay(taps_of(array))
    assert refused == {}
    taken = select_fit(fits, refused)
    judged = {name: located(array, fits[name]) for name in ("inverse-square", taken.left_out[0][0])}
    return taken, judged, plainly_located(array)


@pytest.mark.slow
def test_a_steep_array_is_located(steep):
    """With the law of both factors the error is several times smaller than with a plain fit of a / (r² + b), and its
    ellipses contain most places.
    """
    _, found, plain = steep
    taken = found["attenuated"]
    assert taken.decay == "attenuated"
    assert taken.median < 0.4 * plain.median
    assert taken.median < 3e-3
    assert taken.held(1) > 0.8
    assert taken.silence == 0


@pytest.mark.slow
def test_the_papers_law_alone_is_not_refused(steep):
    """Its result is at least as good as the plain fit."""
    _, found, plain = steep
    assert found["inverse-square"].median < 1.1 * plain.median


@pytest.mark.slow
def test_the_fit_reports_its_law_and_the_reason(steep):
    fit = steep[0]
    names, off = zip(*fit.left_out, strict=True)
    assert names[0] == fit.calibration.microphone_array.decay.name == "attenuated"
    assert set(names) == set(DECAY_MODELS)
    assert off[0] == min(off)
    message = (
        f"locates taps left out of the fit to {1e3 * off[0]:.1f} mm, median (inverse-square {1e3 * off[1]:.1f} mm, "
    )
    assert fit.evidence.startswith(message)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_arrays(seed):
    """None is refused, auto is not much worse than the best law, ellipses contain most places, and silence stays
    silence.
    """
    found = located_by_each(draw_array(replace(DEVELOPMENT, **FEW), seed, touches=30))
    assert {one.message for one in found.values()} == {""}
    assert found["auto"].median < 1.3 * min(found[name].median for name in DECAY_MODELS)
    assert found["auto"].held(1) > 0.8
    assert found["auto"].silence == 0


def test_the_same_seed_draws_the_same_array():
    one, same, other = (draw_array(replace(REPORTED, **FEW), seed, touches=2) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.taps, same.taps)
    np.testing.assert_array_equal(one.sound, same.sound)
    assert other.microphones.shape != one.microphones.shape or (other.microphones != one.microphones).any()


def test_the_simulated_layer_decays_as_specified():
    """Without echoes, leaks or noise, intensities of a steep layer are exp(−r / l) / r² of the distance through it."""
    still = {"reflection": (0.0, 0.0), "uneven": (0.0, 0.0), "signal_to_noise": (120.0, 120.0), "strength": (0.0, 0.0)}
    alike = {"gain_db": (0.0, 0.0), "depth": (0.008, 0.008), "speed": (80.0, 80.0)}
    array = steep_array(0.05, 0, **still, **alike, **FEW)
    power, floor = array.intensity(array.taps)
    away = np.linalg.norm(array.places[:, None] - array.microphones, axis=-1)
    way = np.sqrt(away**2 + 0.008**2)
    # Depths vary by a tenth, which matters at close range, and the band limit causes some ringing in the silence.
    known = (away > 0.03) & (power > 50 * floor)
    left = np.where(known, np.log(power) + way / 0.05 + 2 * np.log(way), np.nan)
    assert known.sum() > 150
    assert np.nanmax(np.abs(left - np.nanmedian(left, axis=1, keepdims=True))) < 0.3
