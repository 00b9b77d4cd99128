"""Batches of frames: independent of each other, in chunks, compiled or not, with missing readings. Maps and bad
input.
"""

import jax
import numpy as np
import pytest
from microphone_arrays import (
    L_SHAPE,
    array,
    both,
    distance,
    inside,
    localise,
    noisy,
    padded,
    received_power,
    same_shape,
)

from jeit.acoustic import Localiser
from jeit.acoustic.localisation.localiser import _MAX_CHUNK_FRAMES


@pytest.fixture(scope="module")
def mixed():
    """Noisy frames inside and outside the outline, some with missing readings."""
    microphone_array = array(9, relative=0.1)
    rng = np.random.default_rng(7)
    places = np.concatenate([inside(40), inside(10, seed=1) + np.array([0.2, 0.0])])
    power = noisy(microphone_array.noise, received_power(microphone_array, places), rng)
    power[rng.random(power.shape) < 0.1] = np.nan
    return microphone_array, power


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=pytest.mark.slow), False])
@both
def test_no_frames_give_nothing(method, compiled):
    """As where a mask selects none."""
    microphone_array = array(9, relative=0.1)
    found = Localiser.create(microphone_array, method=method, compiled=compiled)(np.zeros((0, 9)))
    assert found.position.shape == (0, 2)
    assert found.covariance.shape == (0, 2, 2)
    assert found.converged.shape == (0,)


@pytest.mark.slow
@both
def test_frames_do_not_depend_on_each_other(method, mixed):
    """One by one, in another order, or in another chunk, the results agree to rounding."""
    microphone_array, power = mixed
    localiser = Localiser.create(microphone_array, method=method)
    together = same_shape(localiser, power)
    for frame in range(0, 50, 7):
        alone = localiser(power[frame : frame + 1])
        for key, values in together.items():
            np.testing.assert_allclose(getattr(alone, key)[0], values[frame], rtol=1e-6, atol=1e-9)
    order = np.random.default_rng(8).permutation(50)
    shuffled = same_shape(localiser, power[order])
    for key in ("position", "covariance", "strength", "excess", "misfit"):
        np.testing.assert_allclose(shuffled[key], together[key][order], rtol=1e-9, atol=1e-15)
    many = localiser(padded(power)).position
    assert len(many) > _MAX_CHUNK_FRAMES
    np.testing.assert_allclose(many, padded(together["position"]), rtol=1e-7, atol=1e-10)


@pytest.mark.slow
@both
def test_compiled_or_not(method, mixed):
    microphone_array, power = mixed
    localiser = Localiser.create(microphone_array, method=method)
    with jax.disable_jit():
        eager = localiser(power[:3])
    for key, values in same_shape(localiser, power[:3]).items():
        np.testing.assert_allclose(getattr(eager, key), values, rtol=1e-6, atol=1e-9)


@both
def test_missing_readings(method):
    """NaN, unused, and unused and infinite are equivalent. Exact data stay exact with up to five of nine readings
    missing.
    """
    exact, places = array(9), inside(200, reach=0.6)
    power = received_power(exact, places)
    rng = np.random.default_rng(9)
    use = np.ones(power.shape, bool)
    for frame in range(200):
        use[frame, rng.choice(9, frame % 5 + 1, replace=False)] = False
    found = localise(exact, np.where(use, power, np.nan), method)
    several = use.sum(axis=1) >= 5
    assert distance(found, places)[several].max() < 1e-6
    # Four leave one degree of freedom, and sometimes a second place that fits nearly as well.
    assert np.mean(distance(found, places) < 1e-6) > 0.97
    np.testing.assert_array_equal(found["freedom"], use.sum(axis=1) - 3)
    localiser = Localiser.create(exact, method=method, compiled=False)
    np.testing.assert_array_equal(localiser(np.where(use, power, 1e9), use).position, found["position"])
    infinite = np.where(use, power, np.inf)
    np.testing.assert_array_equal(localise(exact, infinite, method)["position"], found["position"])


@both
def test_too_few_readings_give_nan(method, mixed):
    microphone_array, power = mixed
    power = np.where(np.isnan(power), 1.0, power)
    power[0, 2:] = np.nan
    power[1] = np.nan
    power[2, 3:] = np.nan
    found = localise(microphone_array, power, method)
    for key in ("position", "covariance", "strength", "misfit"):
        assert np.isnan(found[key][:2]).all()
        assert np.isfinite(found[key][2:]).all()
    assert not found["converged"][:2].any()
    np.testing.assert_array_equal(found["freedom"][:4], [0, 0, 0, 6])


@pytest.mark.slow
@both
def test_maps(method):
    """Maps are lowest at the source, to a pixel, and NaN outside the outline. The bottom row is first.

    In NumPy: the compiled program's maps are those of the next test, and of `test_hearing_engines`.
    """
    microphone_array, places = array(9, outline=L_SHAPE, relative=0.02), inside(20, outline=L_SHAPE, reach=0.9)
    localiser = Localiser.create(microphone_array, method=method, map_shape=(40, 30), compiled=False)
    power = noisy(microphone_array.noise, received_power(microphone_array, places), np.random.default_rng(10))
    found, maps = localiser.with_maps(padded(power, 40))
    assert maps.shape == (40, 40, 30)
    x, y = -0.1 + 0.2 * (np.arange(30) + 0.5) / 30, -0.1 + 0.2 * (np.arange(40) + 0.5) / 40
    np.testing.assert_array_equal(np.isnan(maps[0]), (x > 0) & (y[:, None] > 0.01))
    for one, place in zip(np.asarray(maps), np.asarray(found.position), strict=True):
        row, column = np.unravel_index(np.nanargmin(one), one.shape)
        assert np.hypot(x[column] - place[0], y[row] - place[1]) < 0.009
    coarse = localise(microphone_array, power, method)["position"]
    np.testing.assert_allclose(found.position, padded(coarse, 40), atol=1e-8)


@pytest.mark.slow
@both
def test_the_papers_raster(method):
    """200 × 200 pixels of a millimetre: the map of the loss is the formula's, and its minimum is at the place."""
    microphone_array, places = array(9, relative=0.02), inside(5, reach=0.9)
    power = received_power(microphone_array, places)
    found, maps = Localiser.create(microphone_array, method=method, map_shape=(200, 200)).with_maps(power)
    np.testing.assert_allclose(found.position, places, atol=1e-6)
    for one, place in zip(np.asarray(maps), places, strict=True):
        row, column = np.unravel_index(np.nanargmin(one), one.shape)
        assert np.abs(-0.1 + 1e-3 * (np.array([column, row]) + 0.5) - place).max() < 1e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "magic"}, "likelihood, consistency"),
        ({"map_shape": (10,)}, "rows, columns"),
        ({"map_shape": (1, 10)}, "at least two"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        Localiser.create(array(9), **options)


def test_bad_frames():
    localiser = Localiser.create(array(9), compiled=False)
    for power, use in ((np.ones(9), None), (np.ones((4, 8)), None), (np.ones((4, 9)), np.ones((4, 8), bool))):
        with pytest.raises((ValueError, TypeError), match=r"frames, microphones|broadcast|shape"):
            localiser(power, use)
    with pytest.raises(ValueError, match="map_shape"):
        localiser.with_maps(np.ones((4, 9)))
