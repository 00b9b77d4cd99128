"""What changes on a skin that nobody touches: its conductivity, its contacts, and every reading."""

import jax
import numpy as np
from jaxtyping import Array, Float


def walk(
    key: Array, seconds: Float[np.ndarray, " T"], trend: float, deviation: float, number: int
) -> Float[np.ndarray, "T k"]:
    """Logarithms (T, k) of k quantities that drift from 0 at time 0: `trend` per second, the same for all, and a random
    walk of `deviation` per root of a second for each; `seconds` (T,) do not fall."""
    steps = np.diff(seconds, prepend=0.0)
    normal = np.asarray(jax.random.normal(key, (len(steps), number)))
    return trend * np.asarray(seconds)[:, None] + deviation * np.cumsum(np.sqrt(steps)[:, None] * normal, axis=0)


def gains(key: Array, spread: float, number: int) -> Float[np.ndarray, " M"]:
    """Of `number` channels: log-normal round 1, `spread` the deviation of the logarithm."""
    return np.exp(spread * np.asarray(jax.random.normal(key, (number,))))


def white_noise(key: Array, deviation: float, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Independent and normal, volts."""
    return deviation * np.asarray(jax.random.normal(key, shape))
