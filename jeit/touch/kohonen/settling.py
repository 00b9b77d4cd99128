"""Measure how a map's mean weight converges: learning curves, and their time constants."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import real_array
from jeit.touch.kohonen.self_organising_map import checked_frames, learn_weights
from jeit.touch.kohonen.training import Schedule


def learning_curves(
    frames: ArrayLike,
    key: Array,
    rates: Sequence[float],
    *,
    steps: int = 10_000,
    shape: tuple[int, int] = (32, 32),
) -> Float[np.ndarray, "r T"]:
    """Mean of all weights after each of `steps`, with each of the `rates` ε: (rates, steps), in the unit of frames (N,
    M).

    Weights are small at first; the rates are constant, as is the radius, half the map's longer side. Raises
    `ValueError` as `SelfOrganisingMap.fit` does.
    """
    radius = max(shape) / 2
    schedules = [Schedule(steps, 0, (float(rate), float(rate)), (radius, radius)) for rate in rates]
    return learn_weights(checked_frames(frames), [key], shape, schedules)[1]


def time_constant(curve: ArrayLike) -> float:
    """Steps after which a curve (T,) has come 1 − 1/e of the way from zero to its end, the mean of its last tenth.

    Raises `ValueError` for what is no curve of ten steps or more.
    """
    values = real_array("curve", curve, "the means (T,) of a map's weights")
    if values.ndim != 1 or len(values) < 10 or not np.isfinite(values).all():
        raise ValueError(f"curve must be finite, (T,), of ten steps or more; it has shape {values.shape}.")
    end = values[-len(values) // 10 :].mean()
    return float(1 + np.argmax(values / end >= 1 - np.exp(-1)))
