"""Drift and noise of an untouched skin: of its conductivity, its contacts, and every reading."""

from __future__ import annotations

import math

import jax
import numpy as np
from jaxtyping import Array, Float


def standard_normal(key: Array, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Draw from `jax.random.normal`: the first of a power of two of draws.

    Fewer programs are then compiled than there are records of different length.
    """
    number = math.prod(shape)
    return np.asarray(jax.random.normal(key, (1 << max(number - 1, 0).bit_length(),)))[:number].reshape(shape)


def walk(
    key: Array, seconds: Float[np.ndarray, " T"], trend: float, deviation: float, number: int
) -> Float[np.ndarray, "T k"]:
    """Logarithms (T, k) of k quantities that drift from 0 at time 0: `trend` per second, the same for all, and a random
    walk of `deviation` per root of a second for each; `seconds` (T,) do not fall."""
    steps = np.diff(seconds, prepend=0.0)
    normal = standard_normal(key, (len(steps), number))
    return trend * np.asarray(seconds)[:, None] + deviation * np.cumsum(np.sqrt(steps)[:, None] * normal, axis=0)


def gains(key: Array, spread: float, number: int) -> Float[np.ndarray, " M"]:
    """Gains of `number` channels: log-normal about 1, `spread` the deviation of the logarithm."""
    return np.exp(spread * standard_normal(key, (number,)))


def white_noise(key: Array, deviation: float, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Independent normal noise, volts."""
    return deviation * standard_normal(key, shape)
