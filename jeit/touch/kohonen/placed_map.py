"""A self-organising map whose neurons have places on a skin or other target values; the drawing of a map as a graph;
and files of maps, which contain only arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.linalg import lsqr
from scipy.spatial import KDTree

from jeit.arguments import check_key, check_kind, real_array
from jeit.arguments.extras import import_optional
from jeit.files import atomically_written_file, npz_arrays, require_arrays
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap

# Number of neurons from which the place of a frame is estimated, and regularisation of the neurons' shares. The
# regularisation is relative to the mean square deviation of the neurons' frames from their mean. The first line is for
# the neurons nearest to the frame, the second for the 5 by 5 neurons on the grid around the nearest neuron.
_NUM_NEAREST_NEURONS, _REGULARISATION = 9, 0.05
_NUM_GRID_NEIGHBOURS, _REGULARISATION_ON_GRID = 25, 0.005
# Weight of the mean place of a neuron's presses in the least-squares fit of the neuron's place, relative to one press.
_MEAN_PLACE_WEIGHT = 0.3
_MIN_PRESSES = 10
# Fields of a `PlacedMap` that its file contains in addition to the map.
_PLACE_FIELDS = "places", "widening", "missed", "fitted"
# Number of frames that are located at once.
_CHUNK_SIZE = 512


@dataclass(frozen=True)
class PlacedMap:
    """A self-organising map whose neurons have places on a skin, created by `PlacedMap.learn`.

    **Fields**

    - `learnt`: the map.
    - `places` (rows, columns, coordinates): mean place of the presses whose frames are nearest to each neuron, metres;
      NaN without such presses.
    - `widening`: root mean square error of the places of held-out presses, divided by their root mean square estimated
      spread.
    - `missed`: root mean square residual of a channel if the frames of presses are approximated by combinations of
      their nearest neurons, in the unit of frames.
    - `fitted` (rows, columns, coordinates): neurons' places by least squares over the presses, metres, used if a frame
      is located by neighbours on the grid; None if a frame is located by the neurons with the nearest frames and their
      `places`.

    **Example:**

    ```python
    placed = PlacedMap.learn(learnt_map, map_frames, map_positions)
    place, deviation = placed.locate(map_frames[:1])
    ```
    """

    learnt: SelfOrganisingMap
    places: Float[np.ndarray, "R C d"]
    widening: float
    missed: float
    fitted: Float[np.ndarray, "R C d"] | None = None

    @classmethod
    def learn(cls, learnt: SelfOrganisingMap, frames: ArrayLike, positions: ArrayLike) -> "PlacedMap":
        """Learn places of a map's neurons from the frames of presses (presses, channels) and their `positions`, metres.

        The frames may, but need not, be those that the map was learnt from. With few presses, a frame is located best
        by the neurons with the nearest frames; with many presses, by neighbours of the nearest neuron on the grid,
        whose places are fitted by least squares. The method with the smaller error on held-out presses is chosen.
        Raises `ValueError` if `learnt` is no map, for fewer than ten presses, and for positions that are not finite,
        not one for each frame, or all the same.
        """
        check_kind("learnt", learnt, SelfOrganisingMap, "a map, as of SelfOrganisingMap.fit")
        frames = learnt.checked(frames)
        positions = real_array("positions", positions, "metres (N, d), one row for each frame")
        if positions.ndim != 2 or len(positions) != len(frames) or not np.isfinite(positions).all():
            raise ValueError(
                f"positions must be finite metres ({len(frames)}, d), a row for each frame; they have shape "
                f"{positions.shape}."
            )
        if len(frames) < _MIN_PRESSES or (positions == positions[0]).all():
            raise ValueError(f"positions: give those of {_MIN_PRESSES} presses or more, at different places.")
        nearest_neurons = learnt.nearest(frames, 1)[0][:, 0]
        is_odd_frame = np.arange(len(frames)) % 2 == 1
        placement_results = []
        for is_fitted in (False, True):
            squared_error = squared_spread = squared_residual = 0.0
            for is_held_out in (is_odd_frame, ~is_odd_frame):
                training_map = cls._from_presses(
                    learnt, frames[~is_held_out], positions[~is_held_out], nearest_neurons[~is_held_out], is_fitted
                )
                place_estimate = training_map._estimate_places(frames[is_held_out])
                squared_error += float(np.sum((place_estimate.places - positions[is_held_out]) ** 2))
                squared_spread += float(np.sum(place_estimate.place_deviations**2))
                squared_residual += float(np.sum(place_estimate.frame_residuals**2))
            placement_results.append(
                (
                    squared_error,
                    is_fitted,
                    float(np.sqrt(squared_error / max(squared_spread, 1e-300))),
                    float(np.sqrt(squared_residual / frames.size)),
                )
            )
        _, is_fitted, deviation_factor, _ = min(placement_results)
        fitted_map = cls._from_presses(learnt, frames, positions, nearest_neurons, is_fitted)
        return replace(fitted_map, widening=deviation_factor, missed=placement_results[0][3])

    @classmethod
    def _from_presses(cls, learnt, frames, positions, nearest_neurons, is_fitted: bool) -> "PlacedMap":
        """Create a map with places from the frames, positions and nearest neurons (`nearest_neurons`) of presses.

        The standard deviations of the map's estimates are not yet calibrated.
        """
        num_neurons = learnt.shape[0] * learnt.shape[1]
        win_counts = np.bincount(nearest_neurons, minlength=num_neurons)[:, None]
        position_sums = np.stack(
            [
                np.bincount(nearest_neurons, coordinate_column, minlength=num_neurons)
                for coordinate_column in positions.T
            ],
            axis=1,
        )
        mean_positions = np.where(win_counts > 0, position_sums / np.maximum(win_counts, 1), np.nan).reshape(
            *learnt.shape, -1
        )
        placed_map = cls(learnt, mean_positions, 1.0, 0.0, mean_positions if is_fitted else None)
        if not is_fitted:
            return placed_map
        combined_neurons, neuron_weights, _ = placed_map._find_neurons_and_weights(frames)
        frame_indices = np.repeat(np.arange(len(frames)), combined_neurons.shape[1])
        combination_matrix = csr_array(
            (neuron_weights.ravel(), (frame_indices, combined_neurons.ravel())),
            shape=(len(frames), np.count_nonzero(win_counts)),
        )
        place_errors = positions - combination_matrix @ mean_positions[placed_map.placed]
        place_corrections = [
            lsqr(combination_matrix, coordinate_column, damp=np.sqrt(_MEAN_PLACE_WEIGHT), atol=1e-9, btol=1e-9)[0]
            for coordinate_column in place_errors.T
        ]
        fitted_positions = mean_positions.copy()
        fitted_positions[placed_map.placed] += np.stack(place_corrections, axis=1)
        return replace(placed_map, fitted=fitted_positions)

    @property
    def placed(self) -> Bool[np.ndarray, "R C"]:
        """Whether each neuron of the grid (rows, columns) has a place on the skin."""
        return np.isfinite(self.places[..., 0])

    def locate(self, frames: ArrayLike) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
        """Estimate the places of touches from frames (frames, channels), and the standard deviations of the places,
        metres.

        A frame is approximated by a combination of the frames of several neurons, with shares of sum 1 by least squares
        (Roweis and Saul 2000). The touch's place is the combination of the neurons' places with the same shares. If
        there are `fitted` places, the neurons are the nearest neuron and its neighbours on the grid; otherwise, the
        neurons with the nearest frames. The estimated place is no farther from the mean of the neurons' places (with
        `fitted` places: from the place of the nearest neuron) than the farthest neuron's place is. Raises `ValueError`
        for frames whose number of channels is not that of the map, and for NaN.
        """
        place_estimate = self._estimate_places(self.learnt.checked(frames))
        return place_estimate.places, self.widening * place_estimate.place_deviations

    def _estimate_places(self, frames: Float[np.ndarray, "n M"]) -> "_PlaceEstimate":
        combined_neurons, neuron_weights, frame_residuals = self._find_neurons_and_weights(frames)
        neuron_places = self._placed_neurons.places[combined_neurons]
        initial_places = neuron_places.mean(axis=1) if self.fitted is None else neuron_places[:, 0]
        place_offsets = np.einsum("nq,nqd->nd", neuron_weights, neuron_places) - initial_places
        max_offset_lengths = np.linalg.norm(neuron_places - initial_places[:, None], axis=2).max(axis=1)
        offset_lengths = np.linalg.norm(place_offsets, axis=1)
        places = (
            initial_places
            + place_offsets * np.minimum(1.0, max_offset_lengths / np.maximum(offset_lengths, 1e-300))[:, None]
        )
        return _PlaceEstimate(places, np.sqrt(np.mean((neuron_places - places[:, None]) ** 2, axis=1)), frame_residuals)

    def _find_neurons_and_weights(self, frames: Float[np.ndarray, "n M"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the neurons from which the places of frames are estimated, and their shares in the frames.

        Returns the indices of these neurons among the neurons with places, and their shares, both (frames, neurons),
        and the residuals of the frames (frames, channels).
        """
        placed_neurons = self._placed_neurons
        if self.fitted is None:
            combined_neurons, regularisation = (
                placed_neurons.neurons.nearest(frames, min(_NUM_NEAREST_NEURONS, len(placed_neurons.places)))[0],
                _REGULARISATION,
            )
        else:
            combined_neurons, regularisation = (
                placed_neurons.grid_neighbours[placed_neurons.neurons.winners(frames)[:, 1]],
                _REGULARISATION_ON_GRID,
            )
        neuron_weights, frame_residuals = np.empty(combined_neurons.shape), np.empty(frames.shape)
        for chunk_start in range(0, len(frames), _CHUNK_SIZE):
            chunk = slice(chunk_start, chunk_start + _CHUNK_SIZE)
            neuron_weights[chunk], frame_residuals[chunk] = _fit_combination_weights(
                placed_neurons.neurons.weights[0][combined_neurons[chunk]], frames[chunk], regularisation
            )
        return combined_neurons, neuron_weights, frame_residuals

    def predict(self, features: ArrayLike) -> Float[np.ndarray, "n d"]:
        """Estimate the places of touches as `locate` does, without standard deviations, in the interface of
        scikit-learn."""
        return self.locate(features)[0]

    @cached_property
    def _placed_neurons(self) -> "_PlacedNeurons":
        neurons = SelfOrganisingMap(self.learnt.weights[self.placed][None], self.learnt.scale)
        neuron_places, grid_positions = (
            (self.places if self.fitted is None else self.fitted)[self.placed],
            np.argwhere(self.placed),
        )
        # Neighbours are sorted by the larger of the distances in rows and columns; the first is the neuron itself.
        grid_neighbours = (
            KDTree(grid_positions)
            .query(grid_positions, min(_NUM_GRID_NEIGHBOURS, len(grid_positions)), p=np.inf)[1]
            .reshape(len(grid_positions), -1)
        )
        return _PlacedNeurons(neurons, neuron_places, grid_neighbours)


class _PlacedNeurons(NamedTuple):
    """Those neurons of a map to which a place on the skin is assigned, as a map of one row.

    `places` (neurons, coordinates): the neurons' places for estimates, metres; `grid_neighbours` (neurons, neighbours):
    indices of the neurons around each neuron on the grid.
    """

    neurons: SelfOrganisingMap
    places: Float[np.ndarray, "k d"]
    grid_neighbours: Int[np.ndarray, "k q"]


class _PlaceEstimate(NamedTuple):
    """Estimated places of touches (frames, coordinates), metres.

    `place_deviations` (frames, coordinates): standard deviations of the neurons' places around an estimated place;
    `frame_residuals` (frames, channels): residuals of the frames.
    """

    places: Float[np.ndarray, "n d"]
    place_deviations: Float[np.ndarray, "n d"]
    frame_residuals: Float[np.ndarray, "n M"]


def _fit_combination_weights(
    neuron_frames: Float[np.ndarray, "n q M"], frames: Float[np.ndarray, "n M"], regularisation: float
):
    """Compute shares (frames, neurons), of sum 1, with which the frames of neurons are combined to approximate
    `frames`.

    Also returns the residuals of the approximation (frames, channels).
    """
    num_neurons = neuron_frames.shape[1]
    mean_frames = neuron_frames.mean(axis=1, keepdims=True)
    neuron_deviations = neuron_frames - mean_frames
    gram_matrix = neuron_deviations @ np.swapaxes(neuron_deviations, 1, 2)
    gram_diagonal = np.einsum("nqq->nq", gram_matrix)  # a view of the diagonal of `gram_matrix`
    gram_diagonal += regularisation * gram_diagonal.mean(axis=1, keepdims=True) + 1e-300
    frame_deviations = frames - mean_frames[:, 0]
    combination_weights = np.linalg.solve(gram_matrix, neuron_deviations @ frame_deviations[..., None])
    frame_residuals = frame_deviations - (np.swapaxes(combination_weights, 1, 2) @ neuron_deviations)[:, 0]
    return combination_weights[..., 0] + (1 - combination_weights.sum(axis=1)) / num_neurons, frame_residuals


# Number of iterations of the spring layout.
_NUM_ITERATIONS = 60
# Minimum distance between the frames of neighbours, relative to the median, in the strength of a spring.
_MIN_RELATIVE_DISTANCE = 1e-2


def drawn_map(learnt: SelfOrganisingMap, key: Array) -> Float[np.ndarray, "R C 2"]:
    """Compute a drawing of a map as a graph by a spring layout (Fruchterman and Reingold 1991).

    Returns places (rows, columns, 2) of the neurons in the drawing, from -1 to 1. Each neuron is tied to its four
    neighbours on the grid, more strongly if their frames are more similar; all neurons repel each other. The initial
    places are those on the grid, shifted slightly at random by `key`; the orientation of the drawing has no meaning.
    Raises `ValueError` if `learnt` is no map, and for an invalid key.
    """
    networkx = import_optional("networkx", "a map drawn as a graph")
    import jax

    check_kind("learnt", learnt, SelfOrganisingMap, "a map, as of SelfOrganisingMap.fit")
    check_key(key)
    num_rows, num_columns = learnt.shape
    first_neurons, second_neurons = neighbours(learnt.shape)
    weight_rows = learnt.weights.reshape(num_rows * num_columns, -1)
    edge_distances = np.linalg.norm(weight_rows[first_neurons] - weight_rows[second_neurons], axis=1)
    median_edge_distance = float(np.median(edge_distances)) or 1.0
    edge_strengths = median_edge_distance / np.maximum(edge_distances, _MIN_RELATIVE_DISTANCE * median_edge_distance)
    map_graph = networkx.Graph()
    map_graph.add_nodes_from(range(num_rows * num_columns))
    map_graph.add_weighted_edges_from(
        zip(first_neurons.tolist(), second_neurons.tolist(), edge_strengths.tolist(), strict=True)
    )
    initial_grid = np.stack(np.unravel_index(np.arange(num_rows * num_columns), learnt.shape), axis=1) / max(
        num_rows, num_columns
    )
    initial_grid = initial_grid + 1e-3 * np.asarray(jax.random.normal(key, initial_grid.shape))
    initial_places = dict(enumerate(initial_grid))
    final_places = networkx.spring_layout(
        map_graph, pos=initial_places, iterations=_NUM_ITERATIONS, method="force", seed=0
    )
    return np.array([final_places[neuron_index] for neuron_index in range(num_rows * num_columns)]).reshape(
        num_rows, num_columns, 2
    )


def neighbours(shape: tuple[int, int]) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"]]:
    """Return the indices, counted row by row, of the neurons at both ends of every edge of a grid of this `shape`."""
    neuron_indices = np.arange(shape[0] * shape[1]).reshape(shape)
    first_neurons = np.concatenate([neuron_indices[:-1].ravel(), neuron_indices[:, :-1].ravel()])
    return first_neurons, np.concatenate([neuron_indices[1:].ravel(), neuron_indices[:, 1:].ravel()])


def write_map(learnt: SelfOrganisingMap | PlacedMap, path: str | Path) -> None:
    """Write a self-organising map to an NPZ file: its `weights` and `scale`, and the places of a `PlacedMap`.

    **Arguments:**

    - `learnt`: the map.
    - `path`: path of the file.

    Raises `ValueError` if `learnt` is no map, or `path` is a folder.

    **Example:**

    ```python
    write_map(learnt_map, "map.npz")
    learnt_map = read_map("map.npz")
    ```
    """
    check_kind("learnt", learnt, (SelfOrganisingMap, PlacedMap), "a map, as of SelfOrganisingMap.fit, or a PlacedMap")
    if Path(path).is_dir():
        raise ValueError(f"'{path}' is a folder; give a file, such as {Path(path) / 'map.npz'}.")
    has_places = isinstance(learnt, PlacedMap)
    map_without_places = learnt.learnt if has_places else learnt
    place_arrays = {field_name: getattr(learnt, field_name) for field_name in _PLACE_FIELDS} if has_places else {}
    place_arrays = {
        field_name: field_value for field_name, field_value in place_arrays.items() if field_value is not None
    }
    with atomically_written_file(path) as file:
        np.savez_compressed(file, weights=map_without_places.weights, scale=map_without_places.scale, **place_arrays)


def read_map(path: str | Path) -> SelfOrganisingMap | PlacedMap:
    """Read a self-organising map from a file that `write_map` wrote.

    **Arguments:**

    - `path`: path of the file.

    Raises `FileNotFoundError` if the file does not exist, and `ValueError` if the file contains no map.

    **Example:**

    ```python
    write_map(placed, "map.npz")
    placed = read_map("map.npz")
    ```
    """
    if Path(path).is_dir():
        raise ValueError(f"'{path}' is a folder; give an NPZ file.")
    if not Path(path).is_file():
        raise FileNotFoundError(f"'{path}': there is no such file.")
    try:
        map_arrays = npz_arrays(Path(path), "weights", "scale", *_PLACE_FIELDS)
        require_arrays(map_arrays, "weights", "scale")
        learnt = SelfOrganisingMap(map_arrays["weights"], _read_scalar("scale", map_arrays))
        if "places" not in map_arrays:
            return learnt
        error_measures = _read_scalar("widening", map_arrays), _read_scalar("missed", map_arrays)
        return PlacedMap(learnt, map_arrays["places"], *error_measures, map_arrays.get("fitted"))
    except ValueError as error:
        raise ValueError(f"'{path}' is no map: {error}") from None


def _read_scalar(array_name: str, map_arrays: dict[str, np.ndarray]) -> float:
    scalar_array = map_arrays.get(array_name, np.zeros(0))
    if scalar_array.dtype.kind not in "fiu" or scalar_array.shape != ():
        raise ValueError(f"{array_name} must be one number; it has shape {scalar_array.shape}.")
    return float(scalar_array)
