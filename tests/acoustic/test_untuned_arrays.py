"""The defaults on arrays that jeit's decay models do not describe: drawn at random, and one that falls off steeply."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.problems.heard_arrays import DEVELOPMENT, REPORTED, draw_array, steep_array
from benchmarks.problems.located_arrays import located, located_by_each, plainly_located, taps_of
from jeit.acoustic.calibration.calibrate import fit_each_decay, select_fit
from jeit.acoustic.decay import DECAYS

FEW = {"microphones": (9, 12), "tap_side": (7, 7), "repeats": (1, 1)}


@pytest.fixture(scope="module")
def steep():
    """Intensity falls by e in 45 mm, beside its spreading; a clean array with edges that reflect."""
    array = steep_array(0.045, microphones=(16, 16), tap_side=(7, 7), repeats=(1, 1))
    fits, refused = fit_each_decay(taps_of(array))
    assert refused == {}
    taken = select_fit(fits, refused)
    judged = {name: located(array, fits[name]) for name in ("inverse-square", taken.left_out[0][0])}
    return taken, judged, plainly_located(array)


@pytest.mark.slow
def test_a_steep_array_is_located(steep):
    """By the law of both factors, several times as well as by a plain fit of a / (r² + b); its ellipses hold most."""
    _, found, plain = steep
    taken = found["attenuated"]
    assert taken.decay == "attenuated"
    assert taken.median < 0.4 * plain.median
    assert taken.median < 3e-3
    assert taken.held(1) > 0.8
    assert taken.silence == 0


@pytest.mark.slow
def test_the_papers_law_alone_is_not_refused(steep):
    """And does as well as the plain fit, at least."""
    _, found, plain = steep
    assert found["inverse-square"].median < 1.1 * plain.median


@pytest.mark.slow
def test_the_fit_says_which_law_and_why(steep):
    fit = steep[0]
    names, off = zip(*fit.left_out, strict=True)
    assert names[0] == fit.calibration.microphone_array.decay.name == "attenuated"
    assert set(names) == set(DECAYS)
    assert off[0] == min(off)
    said = f"locates taps left out of the fit to {1e3 * off[0]:.1f} mm, median (inverse-square {1e3 * off[1]:.1f} mm, "
    assert fit.evidence.startswith(said)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_arrays_drawn_at_random(seed):
    """None is refused; auto is no worse than the best law by much; its ellipses hold most; silence is silence."""
    found = located_by_each(draw_array(replace(DEVELOPMENT, **FEW), seed, touches=30))
    assert {one.said for one in found.values()} == {""}
    assert found["auto"].median < 1.3 * min(found[name].median for name in DECAYS)
    assert found["auto"].held(1) > 0.8
    assert found["auto"].silence == 0


def test_the_same_seed_draws_the_same_array():
    one, same, other = (draw_array(replace(REPORTED, **FEW), seed, touches=2) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.taps, same.taps)
    np.testing.assert_array_equal(one.sound, same.sound)
    assert other.microphones.shape != one.microphones.shape or (other.microphones != one.microphones).any()


def test_the_layer_sounds_as_it_should():
    """Without echoes, leaks or noise, intensities of a steep layer are exp(−r / l) / r² of the way through it."""
    still = {"reflection": (0.0, 0.0), "uneven": (0.0, 0.0), "signal_to_noise": (120.0, 120.0), "strength": (0.0, 0.0)}
    alike = {"gain_db": (0.0, 0.0), "depth": (0.008, 0.008), "speed": (80.0, 80.0)}
    array = steep_array(0.05, 0, **still, **alike, **FEW)
    power, floor = array.intensity(array.taps)
    away = np.linalg.norm(array.places[:, None] - array.microphones, axis=-1)
    way = np.sqrt(away**2 + 0.008**2)
    # Depths scatter by a tenth, which shows near by; what is cut off the band rings a little in the silence.
    known = (away > 0.03) & (power > 50 * floor)
    left = np.where(known, np.log(power) + way / 0.05 + 2 * np.log(way), np.nan)
    assert known.sum() > 150
    assert np.nanmax(np.abs(left - np.nanmedian(left, axis=1, keepdims=True))) < 0.3
