"""Detect several simultaneous touches with a self-organising map that was learnt from single touches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, describe, is_number, real_array
from jeit.touch.kohonen.placed_map import PlacedMap

# Minimum strength of a touch, relative to the strongest touch.
_MIN_RELATIVE_STRENGTH = 0.08
# Minimum distance between touches, relative to the extent of the places of a map's neurons.
_RELATIVE_SEPARATION = 0.1
# Minimum decrease of the residual sum of squares by each further touch, divided by the residual variance of a
# channel.
_MIN_RESIDUAL_DECREASE = 25.0
# Maximum number of touches in a frame.
_MAX_TOUCHES = 6


@dataclass(frozen=True)
class MapTouch:
    """One of several simultaneous touches, as detected by a self-organising map.

    `place`: coordinates, metres; `spread`: root mean square distance of the touch's neurons from the place, metres;
    `strength`: sum of the neurons' shares, 1 for a touch like those in the training set.
    """

    place: Float[np.ndarray, " d"]
    spread: float
    strength: float


def neuron_shares(placed: PlacedMap, frame: ArrayLike, reference: ArrayLike) -> Float[np.ndarray, "R C"]:
    """Compute the share (rows, columns) of each neuron of a map in a frame by non-negative least squares.

    The frame's change from the `reference`, the frame of the untouched skin, is approximated by a weighted sum of the
    changes of the neurons' frames from the reference. The weights are the shares; neurons without a place have share 0.
    Changes of small touches add up, and touches have one sign, so few of the non-negative shares differ from 0 (Lawson
    and Hanson 1974). Raises `ValueError` if `placed` is no map with places, and for more than one frame, a number of
    channels that is not that of the map, and NaN.
    """
    superposition = _TouchSuperposition.from_frame(placed, frame, reference)
    neuron_weights = np.zeros(placed.learnt.shape)
    neuron_weights[placed.placed] = superposition.fit_weights(np.ones(len(superposition.places), bool))[0]
    return neuron_weights


def touches_reported(
    placed: PlacedMap,
    frame: ArrayLike,
    reference: ArrayLike,
    *,
    least: float = _MIN_RELATIVE_STRENGTH,
    apart: float | None = None,
) -> list[MapTouch]:
    """Detect the touches in a frame by a self-organising map: at most six, the strongest first.

    Neurons with a share in the frame (`neuron_shares`) are grouped into possible touches. Touches are added one after
    another, as long as each reduces the residual sum of squares by at least 25 times the residual variance of a
    channel, the larger of the residual variances of the frame and the map.

    **Arguments:**

    - `placed`: the self-organising map, with places.
    - `frame`: the frame (channels,), in the unit of the frames that the map was learnt from.
    - `reference`: frame (channels,) of the untouched skin, in the unit of the `frame`.
    - `least`: touches weaker than this fraction of the strongest touch, or of a touch in the training set, are left
      out.
    - `apart`: minimum distance between groups of neurons, metres; by default a tenth of the extent of the neurons'
      places.

    Raises `ValueError` as `neuron_shares` does, and for an invalid `least` or `apart`.

    **Example:**

    ```python
    for touch in touches_reported(placed, map_frames[0], reference):
        print(touch.place, touch.strength)
    ```
    """
    if not (is_number(least) and 0 <= least < 1):
        raise ValueError(f"least must be a share, from 0 to below 1; it is {describe(least)}.")
    if apart is not None and not (is_number(apart) and apart > 0):
        raise ValueError(f"apart must be positive, in metres; it is {describe(apart)}.")
    superposition = _TouchSuperposition.from_frame(placed, frame, reference)
    if apart is None:
        apart = _RELATIVE_SEPARATION * float(np.ptp(superposition.places, axis=0).max())
    neuron_weights, residual_sum_of_squares = superposition.fit_weights(np.ones(len(superposition.places), bool))
    num_neurons = np.count_nonzero(neuron_weights)
    if not num_neurons:
        return []
    residual_variance = max(
        residual_sum_of_squares / max(len(superposition.frame_change) - num_neurons, 1), superposition.map_variance
    )
    selected_groups = _select_groups(
        superposition, superposition.group_neurons(neuron_weights, apart), residual_variance
    )
    if not selected_groups:
        return []
    neuron_weights, _ = superposition.fit_weights(np.any(selected_groups, axis=0))
    touches = [
        _create_touch(superposition.places[neuron_group], neuron_weights[neuron_group])
        for neuron_group in selected_groups
        if neuron_weights[neuron_group].any()
    ]
    touches.sort(key=lambda touch: -touch.strength)
    return [touch for touch in touches if touch.strength >= least * max(1.0, touches[0].strength)]


@dataclass(frozen=True)
class _TouchSuperposition:
    """Model of the `frame_change`, of voltages, as a weighted sum of the `neuron_changes` of neurons at `places`.

    `frame_change` (channels,) and `neuron_changes` (neurons, channels) are divided by the root mean square of the
    neurons' changes; `map_variance`: residual variance of a channel, in the square of this unit; `places` in metres.
    """

    frame_change: Float[np.ndarray, " M"]
    neuron_changes: Float[np.ndarray, "k M"]
    places: Float[np.ndarray, "k d"]
    map_variance: float

    @classmethod
    def from_frame(cls, placed_map: PlacedMap, frame: ArrayLike, reference: ArrayLike) -> "_TouchSuperposition":
        check_kind("placed", placed_map, PlacedMap, "a map with places, as of PlacedMap.learn")
        frame_values, reference_values = (
            _check_frame(placed_map, frame_name, voltages)
            for frame_name, voltages in (("frame", frame), ("reference", reference))
        )
        neuron_changes = placed_map.learnt.weights[placed_map.placed] - reference_values
        rms_change = float(np.sqrt(np.mean(neuron_changes**2))) or 1.0
        placed_positions = placed_map.places[placed_map.placed]
        return cls(
            (frame_values - reference_values) / rms_change,
            neuron_changes / rms_change,
            placed_positions,
            (placed_map.missed / rms_change) ** 2,
        )

    def fit_weights(self, is_selected_neuron: Bool[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " k"], float]:
        """Fit the shares of the neurons `is_selected_neuron` in the frame; also returns the residual sum of squares."""
        from scipy.optimize import nnls

        neuron_weights = np.zeros(len(is_selected_neuron))
        neuron_weights[is_selected_neuron], residual_norm = nnls(
            self.neuron_changes[is_selected_neuron].T, self.frame_change
        )
        return neuron_weights, float(residual_norm) ** 2

    def group_neurons(
        self, neuron_weights: Float[np.ndarray, " k"], min_distance: float
    ) -> list[Bool[np.ndarray, " k"]]:
        """Group the neurons that have a share in the frame into clusters of nearby places.

        Returns a mask of neurons for each cluster that explains much of the frame's change, with the neurons whose
        places are near those of the cluster.
        """
        from scipy.cluster.hierarchy import fcluster, linkage

        neurons_with_share = np.flatnonzero(neuron_weights)
        cluster_numbers = np.ones(1, int)
        if len(neurons_with_share) > 1:
            cluster_numbers = fcluster(linkage(self.places[neurons_with_share], "single"), min_distance, "distance")
        clusters = [
            neurons_with_share[cluster_numbers == cluster_number] for cluster_number in np.unique(cluster_numbers)
        ]
        clusters.sort(
            key=lambda cluster_neurons: (
                -np.linalg.norm(neuron_weights[cluster_neurons] @ self.neuron_changes[cluster_neurons])
            )
        )
        return [
            np.linalg.norm(self.places[:, None] - self.places[cluster_neurons], axis=-1).min(axis=1) < min_distance / 2
            for cluster_neurons in clusters[:_MAX_TOUCHES]
        ]


def _select_groups(
    superposition: _TouchSuperposition, neuron_groups: list[np.ndarray], residual_variance: float
) -> list[Bool[np.ndarray, " k"]]:
    """Select groups of neurons by forward selection until no further group reduces the residual of the frame enough."""
    selected_groups: list[np.ndarray] = []
    residual_sum_of_squares = float(superposition.frame_change @ superposition.frame_change)
    remaining_groups = list(neuron_groups)
    while remaining_groups:
        new_residuals = [
            superposition.fit_weights(np.any([*selected_groups, neuron_group], axis=0))[1]
            for neuron_group in remaining_groups
        ]
        best_index = int(np.argmin(new_residuals))
        if residual_sum_of_squares - new_residuals[best_index] < _MIN_RESIDUAL_DECREASE * residual_variance:
            break
        selected_groups.append(remaining_groups.pop(best_index))
        residual_sum_of_squares = new_residuals[best_index]
    return selected_groups


def _create_touch(places: Float[np.ndarray, "k d"], neuron_weights: Float[np.ndarray, " k"]) -> MapTouch:
    """Create a touch from the places and shares of a group of neurons."""
    centroid = neuron_weights @ places / neuron_weights.sum()
    standard_distance = np.sqrt(neuron_weights @ np.sum((places - centroid) ** 2, axis=1) / neuron_weights.sum())
    return MapTouch(centroid, float(standard_distance), float(neuron_weights.sum()))


def _check_frame(placed_map: PlacedMap, frame_name: str, frame_argument) -> Float[np.ndarray, " M"]:
    frame_values = real_array(frame_name, frame_argument, "one frame (M,)")
    if frame_values.shape != placed_map.learnt.weights.shape[2:] or not np.isfinite(frame_values).all():
        raise ValueError(
            f"{frame_name} must be one finite frame of {placed_map.learnt.weights.shape[2]} channels; it has shape "
            f"{frame_values.shape}" + ("." if np.isfinite(frame_values).all() else ", and NaN or infinite readings.")
        )
    return frame_values
