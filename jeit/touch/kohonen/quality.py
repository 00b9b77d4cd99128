"""Quality of a self-organising map: quantisation and topographic errors, and how fast the map's weights converge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, real_array
from jeit.arguments.extras import optional
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap, checked_frames, learn_weights
from jeit.touch.kohonen.training import MapSchedule

# For trustworthiness: maximum number of frames of which all pairs are compared; number of neighbours of each frame.
_MAX_COMPARED_FRAMES, _NUM_NEIGHBOURS = 2000, 12


@dataclass(frozen=True)
class MapQuality:
    """Measures of how well a self-organising map preserves the neighbourhoods of frames.

    `quantisation_error`: mean distance of frames from their nearest neurons, in the unit of frames;
    `topographic_error`: share of the frames whose two nearest neurons are not neighbours on the grid, where each neuron
    has eight neighbours (Kiviluoto 1996); `trustworthiness`: 1 if all frames that are neighbours on the map are
    neighbours by the distance between frames (Venna and Kaski 2001).
    """

    quantisation_error: float
    topographic_error: float
    trustworthiness: float


def map_quality(learnt: SelfOrganisingMap, frames: ArrayLike) -> MapQuality:
    """Compute the quantisation error, the topographic error and the trustworthiness of a self-organising map.

    Trustworthiness is computed for at most 2,000 evenly spaced frames, with 12 neighbours of each frame.

    **Arguments:**

    - `learnt`: the self-organising map.
    - `frames`: frames (frames, channels), those that the map was learnt from, or others in the same unit.

    Raises `ValueError` if `learnt` is no map, and for fewer than 25 frames, frames with another number of channels than
    the map, and NaN.

    **Example:**

    ```python
    quality = map_quality(learnt_map, map_frames)
    print(quality)
    ```
    """
    trustworthiness = optional("sklearn.manifold", "the trustworthiness of a map").trustworthiness

    check_kind("learnt", learnt, SelfOrganisingMap, "a map, as of SelfOrganisingMap.fit")
    frames = learnt.checked(frames)
    if len(frames) <= 2 * _NUM_NEIGHBOURS:
        raise ValueError(f"frames: {len(frames)} are too few to compare; give {2 * _NUM_NEIGHBOURS + 1} or more.")
    nearest_neurons, distances = learnt.nearest(frames, 2)
    row, column = np.unravel_index(nearest_neurons, learnt.shape)
    grid_distances = np.maximum(np.abs(row[:, 0] - row[:, 1]), np.abs(column[:, 0] - column[:, 1]))
    compared_frames = np.unique(np.linspace(0, len(frames) - 1, _MAX_COMPARED_FRAMES).astype(int))
    grid_positions = np.stack([row[compared_frames, 0], column[compared_frames, 0]], axis=1).astype(float)
    trust_score = trustworthiness(frames[compared_frames], grid_positions, n_neighbors=_NUM_NEIGHBOURS)
    return MapQuality(float(distances[:, 0].mean()), float(np.mean(grid_distances > 1)), float(trust_score))


def learning_curves(
    frames: ArrayLike,
    key: Array,
    rates: Sequence[float],
    *,
    steps: int = 10_000,
    shape: tuple[int, int] = (32, 32),
) -> Float[np.ndarray, "r T"]:
    """Compute how the mean weight of self-organising maps changes in training, for several constant learning rates.

    Returns the mean of all weights after each training step (rates, steps), in the unit of frames. `frames`: (frames,
    channels). The initial weights of the maps are small. The neighbourhood radius is constant, half the map's longer
    side. Raises `ValueError` as `SelfOrganisingMap.fit` does.
    """
    radius = max(shape) / 2
    schedules = [MapSchedule(steps, 0, (float(rate), float(rate)), (radius, radius)) for rate in rates]
    return learn_weights(checked_frames(frames), [key], shape, schedules)[1]


def time_constant(curve: ArrayLike) -> float:
    """Number of steps after which a learning curve (steps,) has risen from zero to 1 − 1/e of its final value.

    The final value is the mean of the last tenth of the curve. Raises `ValueError` for a curve that is not
    one-dimensional, not finite, or shorter than ten steps.
    """
    values = real_array("curve", curve, "the means (T,) of a map's weights")
    if values.ndim != 1 or len(values) < 10 or not np.isfinite(values).all():
        raise ValueError(f"curve must be finite, (T,), of ten steps or more; it has shape {values.shape}.")
    final_value = values[-len(values) // 10 :].mean()
    return float(1 + np.argmax(values / final_value >= 1 - np.exp(-1)))
