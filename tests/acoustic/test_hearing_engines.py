"""Two engines with one formula: the NumPy engine locates the same touches as the compiled program.

For one source, the quick tests compare them in `test_localiser_gradients`, without the search for minima.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from microphone_arrays import array, assert_same, both, inside, noisy, quick_likelihood, received_power, same_shape

from jeit.acoustic import Localiser, cramer_rao, touch_tracks, track
from jeit.acoustic.decay import DECAY_MODELS
from jeit.acoustic.localisation.locations import Locations, LocationStatus
from jeit.acoustic.localisation.two_sources import locate_two
from jeit_solvers.engines import slopes

FRAMES = 160


@pytest.fixture(scope="module")
def touched():
    """Noisy frames inside and outside the outline, some with missing readings."""
    microphone_array = array(9, relative=0.1, floor=1e-4, freedom=100.0)
    rng = np.random.default_rng(11)
    places = inside(FRAMES)
    places[::8] += [0.15, 0.02]
    power = noisy(
        microphone_array.noise, received_power(microphone_array, places, np.exp(rng.normal(size=FRAMES))), rng
    )
    power[rng.random(power.shape) < 0.05] = np.nan
    return microphone_array, power


@pytest.mark.slow
@both
def test_places(method, touched):
    microphone_array, power = touched
    at_once, compiled = (Localiser.create(microphone_array, method=method, compiled=one) for one in (False, True))
    expected = at_once(power)
    assert_same({key: getattr(expected, key) for key in expected.__dataclass_fields__}, same_shape(compiled, power))
    assert isinstance(expected.position, jax.Array)


@quick_likelihood
def test_maps(method, touched):
    microphone_array, power = touched
    at_once, compiled = (
        Localiser.create(microphone_array, method=method, compiled=one, map_shape=(30, 40)) for one in (False, True)
    )
    assert_same(at_once.maps(power), compiled.maps(power))


def test_traced_intensities_are_compiled(touched):
    """Although NumPy was requested: it could not read the traced intensities.

    `test_localiser_gradients` compares places of one source.
    """
    microphone_array, power = touched
    assert jax.eval_shape(lambda power: locate_two(microphone_array, power), power).position.shape == (FRAMES, 2, 2)


@pytest.mark.slow
def test_two_sources(touched):
    """Where the places are determined: steps with Fisher's matrix converge slowly where no place fits."""
    microphone_array, power = touched
    both = power[1:40] + power[41:80]
    at_once = locate_two(microphone_array, both)
    compiled = locate_two(microphone_array, both, compiled=True)
    np.testing.assert_array_equal(at_once.freedom, compiled.freedom)
    np.testing.assert_allclose(at_once.misfit, compiled.misfit, rtol=1e-5)
    deviation = np.sqrt(np.linalg.eigvalsh(np.nan_to_num(compiled.covariance))[..., -1:])
    off = np.nan_to_num(at_once.position - compiled.position)
    assert (np.abs(off) <= 1e-3 * deviation).all()
    assert np.median(np.abs(off)) < 1e-9


def test_bound(touched):
    microphone_array, _ = touched
    places = inside(30)
    compiled = jax.jit(lambda places: cramer_rao(microphone_array, places, 2.0))(places)
    assert_same(cramer_rao(microphone_array, places, 2.0), compiled, 1e-12)


def test_tracks(monkeypatch):
    rng = np.random.default_rng(12)
    times = np.arange(100) * 0.0125
    position = np.cumsum(1e-3 * rng.normal(size=(100, 2)), axis=0)
    position[rng.random(100) < 0.1] = np.nan
    number = np.zeros(100)
    found = Locations(
        times,
        position,
        np.tile(1e-6 * np.eye(2), (100, 1, 1)),
        number,
        np.full(100, LocationStatus.TOUCH, object),
        number,
        number.astype(int),
        np.ones((100, 9), bool),
        np.full((100, 2), np.nan),
        number,
        overlap=4.0,
        faults=("",) * 9,
        notes=(),
        name="",
    )
    at_once = track(found)
    monkeypatch.setattr(touch_tracks, "MAX_NUMPY_FRAMES", 0)
    compiled = track(found)
    assert_same(
        [at_once.position, at_once.covariance, at_once.velocity, at_once.rejected],
        [compiled.position, compiled.covariance, compiled.velocity, compiled.rejected],
        1e-9,
    )


@pytest.mark.parametrize("name", DECAY_MODELS)
def test_slopes_of_decay_models(name):
    """Complex steps agree with JAX's derivatives."""
    values = np.log(np.random.default_rng(13).uniform(0.5, 2.0, (len(DECAY_MODELS[name].parameters), 5)))
    squared = np.geomspace(1e-6, 1.0, 35).reshape(5, 7)

    def of(squared):
        return lambda values: DECAY_MODELS[name].from_logarithms(values).log_response(squared)

    assert_same(
        slopes(of(squared), values), jax.jit(lambda values: slopes(of(jnp.asarray(squared)), values))(values), 1e-13
    )
