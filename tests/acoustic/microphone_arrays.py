"""Arrays of microphones, and what they hear of sources, worked out in NumPy from the formulas: shared by tests here."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.acoustic import Localiser, MicrophoneArray
from jeit.acoustic.decay import InverseSquare
from jeit.acoustic.localisation.localiser import METHODS
from jeit.acoustic.noise import IntensityNoise
from jeit.acoustic.surface import make_surface
from jeit.layout import grid

both = pytest.mark.parametrize("method", METHODS)
# Programs take long to compile: of some, only the likelihood's is for the quick suite.
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
    """a and b of so many microphones, m²: within some ten per cent of each other, as those of one kind are."""
    rng = np.random.default_rng(seed)
    return 1e-3 * np.exp(0.3 * rng.normal(size=count)), 1e-3 * np.exp(0.3 * rng.normal(size=count))


def listen(microphones, a, b, places, strength=1.0):
    """I0 a / (r² + b) of sources at `places` (F, d), (F, M)."""
    squared = ((np.asarray(places)[:, None] - np.asarray(microphones)) ** 2).sum(axis=-1)
    return np.broadcast_to(strength, len(places))[:, None] * np.asarray(a) / (squared + np.asarray(b))


def array(count, *, outline=OUTLINE, microphones=None, points=None, seed=0, **noise):
    """MicrophoneArray with such models; `noise` as of `IntensityNoise.create`."""
    place = MICROPHONES[count] if microphones is None else microphones
    a, b = models(count, seed)
    decay = InverseSquare(jnp.asarray(a), jnp.asarray(b))
    surface = make_surface(outline, points)
    return MicrophoneArray(jnp.asarray(place), surface, decay, IntensityNoise.create(count, **noise))


def hear(microphone_array, places, strength=1.0):
    """What the microphones of `microphone_array`, which are InverseSquare, receive without noise, (F, M)."""
    return listen(microphone_array.microphones, microphone_array.decay.a, microphone_array.decay.b, places, strength)


def variance(noise, received):
    """τ² S² + κ S + s² of power received, S (F, M)."""
    return (np.asarray(noise.relative) * received) ** 2 + np.asarray(noise.cross) * received + noise.deviation**2


def noisy(noise, received, rng):
    """Draws from the noise model: levels log(S + N) are normal with variance var / (S + N)²."""
    floor = np.asarray(noise.floor)
    level = np.log(received + floor)
    deviation = np.sqrt(np.asarray(variance(noise, received))) / (received + floor)
    return np.exp(level + deviation * rng.normal(size=received.shape)) - floor


def inside(number, seed=0, outline=OUTLINE, reach=1.0):
    """Random places in an outline, or in the middle part of it that `reach` says."""
    rng = np.random.default_rng(seed)
    low, high = outline.min(axis=0), outline.max(axis=0)
    places = low + (high - low) * (0.5 + reach * (rng.random((20 * number, 2)) - 0.5))
    contained = make_surface(outline).outline.contains(places)
    return places[np.asarray(contained)][:number]


def padded(power, number=1100):
    """Frames repeated until there are so many, more than are worked on together: one compiled program serves all."""
    return power[np.arange(number) % len(power)]


def same_shape(localiser, power):
    """What a localiser finds of frames, by the program of all tests."""
    found = localiser(padded(np.asarray(power)))
    return {key: np.asarray(getattr(found, key))[: len(power)] for key in found.__dataclass_fields__}


def localise(microphone_array, power, method="likelihood"):
    """What NumPy finds, which a compiled program finds too: see `test_hearing_engines`."""
    found = Localiser.create(microphone_array, method=method, compiled=False)(np.asarray(power))
    return {key: np.asarray(getattr(found, key)) for key in found.__dataclass_fields__}


def distance(found, places):
    """Of what was found from where it is, metres."""
    return np.linalg.norm(found["position"] - places, axis=1)


def assert_same(one, other, tolerance=1e-7):
    """All arrays agree to a part of their size, and NaN where the other is."""
    for mine, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        mine, theirs = np.asarray(mine, float), np.asarray(theirs, float)
        size = np.abs(theirs[np.isfinite(theirs)]).max(initial=1e-300)
        np.testing.assert_allclose(mine, theirs, rtol=tolerance, atol=tolerance * size)
