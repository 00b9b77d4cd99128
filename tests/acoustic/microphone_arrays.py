"""Arrays of microphones and the power that they receive from sources, computed in NumPy from the formulas, for the
tests here.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.acoustic import Localiser, MicrophoneArray
from jeit.acoustic.decay import InverseSquare
from jeit.acoustic.localisation.localiser import METHODS
from jeit.acoustic.microphones import IntensityNoise
from jeit.acoustic.surface import make_surface
from jeit.layout import grid

both = pytest.mark.parametrize("method", METHODS)
# Compilation takes long: for some programs only the likelihood's variant is in the quick suite.
quick_likelihood = pytest.mark.parametrize(
    "method", [pytest.param(one, marks=[] if one == "likelihood" else [pytest.mark.slow]) for one in METHODS]
)

OUTLINE = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
L_SHAPE = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.01], [0.0, 0.01], [0.0, 0.1], [-0.1, 0.1]])
MICROPHONES = {
    3: np.array([[-0.07, -0.06], [0.08, -0.05], [0.01, 0.075]]),
    4: grid(0.14, 0.14, 2, 2) + np.array([[0.004, -0.003], [0.0, 0.005], [-0.005, 0.0], [0.006, 0.004]]),
    9: grid(0.14, 0.14, 3, 3),
    25: grid(0.16, 0.16, 5, 5),
}


def models(count, seed=0):
    """Parameters a and b of `count` microphones, m²: they vary by about ten per cent, as in microphones of one type."""
    rng = np.random.default_rng(seed)
    return 1e-3 * np.exp(0.3 * rng.normal(size=count)), 1e-3 * np.exp(0.3 * rng.normal(size=count))


def listen(microphones, a, b, places, strength=1.0):
    """Intensities I0 a / (r² + b) of sources at `places` (F, d): (F, M)."""
    squared = ((np.asarray(places)[:, None] - np.asarray(microphones)) ** 2).sum(axis=-1)
    return np.broadcast_to(strength, len(places))[:, None] * np.asarray(a) / (squared + np.asarray(b))


def array(count, *, outline=OUTLINE, microphones=None, points=None, seed=0, **noise):
    """MicrophoneArray with such decay models. `noise` is as for `IntensityNoise.create`."""
    place = MICROPHONES[count] if microphones is None else microphones
    a, b = models(count, seed)
    decay = InverseSquare(jnp.asarray(a), jnp.asarray(b))
    surface = make_surface(outline, points)
    return MicrophoneArray(jnp.asarray(place), surface, decay, IntensityNoise.create(count, **noise))


def received_power(microphone_array, places, strength=1.0):
    """Power (F, M) received without noise by the microphones of `microphone_array`, whose decay is InverseSquare."""
    return listen(microphone_array.microphones, microphone_array.decay.a, microphone_array.decay.b, places, strength)


def variance(noise, received):
    """Variance τ² S² + κ S + s² of received power S (F, M)."""
    return (np.asarray(noise.relative) * received) ** 2 + np.asarray(noise.cross) * received + noise.deviation**2


def noisy(noise, received, rng):
    """Random draws from the noise model: levels log(S + N) are normal with variance var / (S + N)²."""
    floor = np.asarray(noise.floor)
    level = np.log(received + floor)
    deviation = np.sqrt(np.asarray(variance(noise, received))) / (received + floor)
    return np.exp(level + deviation * rng.normal(size=received.shape)) - floor


def inside(number, seed=0, outline=OUTLINE, reach=1.0):
    """Random places in an outline, or in its middle part, of relative size `reach`."""
    rng = np.random.default_rng(seed)
    low, high = outline.min(axis=0), outline.max(axis=0)
    places = low + (high - low) * (0.5 + reach * (rng.random((20 * number, 2)) - 0.5))
    contained = make_surface(outline).outline.contains(places)
    return places[np.asarray(contained)][:number]


def padded(power, number=1100):
    """Frames repeated up to a number that exceeds the batch size, so that one compiled program serves all tests."""
    return power[np.arange(number) % len(power)]


def same_shape(localiser, power):
    """What a localiser finds in frames, by the program shared by all tests."""
    found = localiser(padded(np.asarray(power)))
    return {key: np.asarray(getattr(found, key))[: len(power)] for key in found.__dataclass_fields__}


def localise(microphone_array, power, method="likelihood"):
    """What the NumPy engine finds. The compiled program finds the same: see `test_hearing_engines`."""
    found = Localiser.create(microphone_array, method=method, compiled=False)(np.asarray(power))
    return {key: np.asarray(getattr(found, key)) for key in found.__dataclass_fields__}


def distance(found, places):
    """Distance of the places found from the true places, metres."""
    return np.linalg.norm(found["position"] - places, axis=1)


def assert_same(one, other, tolerance=1e-7):
    """Assert that all arrays agree to a fraction of their size, and are NaN at the same entries."""
    for mine, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        mine, theirs = np.asarray(mine, float), np.asarray(theirs, float)
        size = np.abs(theirs[np.isfinite(theirs)]).max(initial=1e-300)
        np.testing.assert_allclose(mine, theirs, rtol=tolerance, atol=tolerance * size)
