"""A self-organising map whose neurons have places on a skin, or other values; a map's drawing as a graph; and files of
maps, which contain only arrays."""

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
from jeit.arguments.extras import optional
from jeit.files import need, npz_arrays, written_whole
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap

# Number of neurons from which a place is estimated, and regularisation of their shares, relative to the mean square of
# the differences of their frames: first for the neurons nearest to the frame, then for the 5 by 5 neurons on the grid
# around the nearest one.
_NUM_NEAREST, _REGULARISATION = 9, 0.05
_NUM_ON_GRID, _REGULARISATION_ON_GRID = 25, 0.005
# Weight of the mean place of a neuron's presses in the fit of its place, relative to that of one press.
_MEAN_WEIGHT = 0.3
_FEWEST = 10
# What a file has of a `PlacedMap` beside its map.
_OF_PLACES = "places", "widening", "missed", "fitted"
# Number of frames that are located at once.
_AT_ONCE = 512


@dataclass(frozen=True)
class PlacedMap:
    """A self-organising map whose neurons have places, created by `PlacedMap.learn`.

    **Fields**

    - `learnt`: the map.
    - `places` (R, C, d): mean place of the presses that each neuron won, metres, NaN if it won none.
    - `widening`: root mean square error of held-out presses, divided by the estimated spread.
    - `missed`: root mean square residual of a channel if presses are approximated by the neurons nearest to them, in
      the unit of frames.
    - `fitted` (R, C, d): places that fit the presses best, metres, if neighbours on the grid locate a frame; None if
      the neurons nearest to the frame locate it, by `places`.

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
        """Learn places of a map's neurons from presses: frames (N, M) and their `positions` (N, d), metres.

        The frames may be those that the map was learnt from, or others. With few presses, a frame is located best by
        the neurons nearest to it; with many, by neighbours on the grid, whose places are fitted by least squares. The
        choice is the one with less error on held-out presses. Raises `ValueError` if `learnt` is no map, for fewer than
        ten presses, and for positions that are not finite, not one for each frame, or all the same.
        """
        check_kind("learnt", learnt, SelfOrganisingMap, "a map, as of SelfOrganisingMap.fit")
        frames = learnt.checked(frames)
        positions = real_array("positions", positions, "metres (N, d), one row for each frame")
        if positions.ndim != 2 or len(positions) != len(frames) or not np.isfinite(positions).all():
            raise ValueError(
                f"positions must be finite metres ({len(frames)}, d), a row for each frame; they have shape "
                f"{positions.shape}."
            )
        if len(frames) < _FEWEST or (positions == positions[0]).all():
            raise ValueError(f"positions: give those of {_FEWEST} presses or more, at different places.")
        winners = learnt.nearest(frames, 1)[0][:, 0]
        odd = np.arange(len(frames)) % 2 == 1
        ways = []
        for fit in (False, True):
            off = spread = missed = 0.0
            for out in (odd, ~odd):
                part = cls._from_presses(learnt, frames[~out], positions[~out], winners[~out], fit)
                placed = part._estimate_places(frames[out])
                off += float(np.sum((placed.places - positions[out]) ** 2))
                spread += float(np.sum(placed.spread**2))
                missed += float(np.sum(placed.left**2))
            ways.append((off, fit, float(np.sqrt(off / max(spread, 1e-300))), float(np.sqrt(missed / frames.size))))
        _, fit, widening, _ = min(ways)
        whole = cls._from_presses(learnt, frames, positions, winners, fit)
        return replace(whole, widening=widening, missed=ways[0][3])

    @classmethod
    def _from_presses(cls, learnt, frames, positions, winners, fit: bool) -> "PlacedMap":
        """Create a map with places from presses and their winners (N,).

        Its standard deviations are not yet calibrated.
        """
        number = learnt.shape[0] * learnt.shape[1]
        count = np.bincount(winners, minlength=number)[:, None]
        sums = np.stack([np.bincount(winners, one, minlength=number) for one in positions.T], axis=1)
        means = np.where(count > 0, sums / np.maximum(count, 1), np.nan).reshape(*learnt.shape, -1)
        placed = cls(learnt, means, 1.0, 0.0, means if fit else None)
        if not fit:
            return placed
        near, shares, _ = placed._locating_neurons(frames)
        row = np.repeat(np.arange(len(frames)), near.shape[1])
        combined = csr_array((shares.ravel(), (row, near.ravel())), shape=(len(frames), np.count_nonzero(count)))
        off = positions - combined @ means[placed.placed]
        moved = [lsqr(combined, one, damp=np.sqrt(_MEAN_WEIGHT), atol=1e-9, btol=1e-9)[0] for one in off.T]
        fitted = means.copy()
        fitted[placed.placed] += np.stack(moved, axis=1)
        return replace(placed, fitted=fitted)

    @property
    def placed(self) -> Bool[np.ndarray, "R C"]:
        """Whether each neuron has a place (R, C)."""
        return np.isfinite(self.places[..., 0])

    def locate(self, frames: ArrayLike) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
        """Estimate the places (n, d) of frames (n, M), or one frame (M,), and their standard deviations (n, d), metres.

        A frame is approximated by a combination of the frames of several neurons, with shares of sum 1 by least squares
        (Roweis and Saul 2000). The place is the combination of the neurons' places with the same shares. The neurons
        are those whose frames are nearest to the given frame; or, if there are `fitted` places, the nearest neuron and
        those around it on the grid. The place is limited to the distance of the farthest of the neurons' places from
        their mean, or, on the grid, from the place of the nearest neuron. Raises `ValueError` for
        frames with another number of channels, and NaN.
        """
        placed = self._estimate_places(self.learnt.checked(frames))
        return placed.places, self.widening * placed.spread

    def _estimate_places(self, frames: Float[np.ndarray, "n M"]) -> "_Estimate":
        near, shares, left = self._locating_neurons(frames)
        there = self._placed_neurons.places[near]
        own = there.mean(axis=1) if self.fitted is None else there[:, 0]
        offset = np.einsum("nq,nqd->nd", shares, there) - own
        most = np.linalg.norm(there - own[:, None], axis=2).max(axis=1)
        length = np.linalg.norm(offset, axis=1)
        said = own + offset * np.minimum(1.0, most / np.maximum(length, 1e-300))[:, None]
        return _Estimate(said, np.sqrt(np.mean((there - said[:, None]) ** 2, axis=1)), left)

    def _locating_neurons(self, frames: Float[np.ndarray, "n M"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the neurons that locate frames.

        Returns their indices (n, q) among the neurons with places, their shares (n, q), and the residuals of the frames
        (n, M).
        """
        known = self._placed_neurons
        if self.fitted is None:
            near, held = known.neurons.nearest(frames, min(_NUM_NEAREST, len(known.places)))[0], _REGULARISATION
        else:
            near, held = known.around[known.neurons.winners(frames)[:, 1]], _REGULARISATION_ON_GRID
        shares, left = np.empty(near.shape), np.empty(frames.shape)
        for first in range(0, len(frames), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            shares[some], left[some] = _combination_shares(known.neurons.weights[0][near[some]], frames[some], held)
        return near, shares, left

    def predict(self, features: ArrayLike) -> Float[np.ndarray, "n d"]:
        """Predict only the places (n, d) of `locate`, in the interface of scikit-learn's estimators."""
        return self.locate(features)[0]

    @cached_property
    def _placed_neurons(self) -> "_PlacedNeurons":
        neurons = SelfOrganisingMap(self.learnt.weights[self.placed][None], self.learnt.scale)
        places, grid = (self.places if self.fitted is None else self.fitted)[self.placed], np.argwhere(self.placed)
        # Sorted by the larger of the distances in rows and columns: the first is the neuron itself.
        around = KDTree(grid).query(grid, min(_NUM_ON_GRID, len(grid)), p=np.inf)[1].reshape(len(grid), -1)
        return _PlacedNeurons(neurons, places, around)


class _PlacedNeurons(NamedTuple):
    """The neurons that have a place, as a map of one row.

    `places` (k, d): the places that estimates use; `around` (k, q): indices of the neurons around each on the grid.
    """

    neurons: SelfOrganisingMap
    places: Float[np.ndarray, "k d"]
    around: Int[np.ndarray, "k q"]


class _Estimate(NamedTuple):
    """Estimated places (n, d), metres.

    `spread` (n, d): standard deviations of the neurons' places around them; `left` (n, M): residuals of the frames.
    """

    places: Float[np.ndarray, "n d"]
    spread: Float[np.ndarray, "n d"]
    left: Float[np.ndarray, "n M"]


def _combination_shares(
    neuron_frames: Float[np.ndarray, "n q M"], frames: Float[np.ndarray, "n M"], regularisation: float
):
    """Compute shares (n, q) of sum 1 whose combinations of the neurons' frames are nearest to the given frames.

    Also returns the residuals (n, M).
    """
    count = neuron_frames.shape[1]
    middle = neuron_frames.mean(axis=1, keepdims=True)
    apart = neuron_frames - middle
    gram = apart @ np.swapaxes(apart, 1, 2)
    diagonal = np.einsum("nqq->nq", gram)  # a view of `gram`
    diagonal += regularisation * diagonal.mean(axis=1, keepdims=True) + 1e-300
    change = frames - middle[:, 0]
    found = np.linalg.solve(gram, apart @ change[..., None])
    left = change - (np.swapaxes(found, 1, 2) @ apart)[:, 0]
    return found[..., 0] + (1 - found.sum(axis=1)) / count, left


# Number of iterations; minimum distance of neighbours' frames, relative to the median, for the strength of a spring.
_STEPS, _LEAST = 60, 1e-2


def drawn_map(learnt: SelfOrganisingMap, key: Array) -> Float[np.ndarray, "R C 2"]:
    """Draw a map as a graph: places (R, C, 2) of its neurons, from -1 to 1, by springs (Fruchterman and Reingold 1991).

    Each neuron is tied to its four neighbours on the grid, more strongly if their frames are more similar; all neurons
    repel each other. The initial places are those on the grid, shifted slightly at random by `key`; the orientation of
    the drawing has no meaning. Raises `ValueError` if `learnt` is no map, and for an invalid key.
    """
    networkx = optional("networkx", "a map drawn as a graph")
    import jax

    check_kind("learnt", learnt, SelfOrganisingMap, "a map, as of SelfOrganisingMap.fit")
    check_key(key)
    rows, columns = learnt.shape
    first, second = neighbours(learnt.shape)
    flat = learnt.weights.reshape(rows * columns, -1)
    distance = np.linalg.norm(flat[first] - flat[second], axis=1)
    usual = float(np.median(distance)) or 1.0
    strength = usual / np.maximum(distance, _LEAST * usual)
    graph = networkx.Graph()
    graph.add_nodes_from(range(rows * columns))
    graph.add_weighted_edges_from(zip(first.tolist(), second.tolist(), strength.tolist(), strict=True))
    grid = np.stack(np.unravel_index(np.arange(rows * columns), learnt.shape), axis=1) / max(rows, columns)
    grid = grid + 1e-3 * np.asarray(jax.random.normal(key, grid.shape))
    start = dict(enumerate(grid))
    drawn = networkx.spring_layout(graph, pos=start, iterations=_STEPS, method="force", seed=0)
    return np.array([drawn[one] for one in range(rows * columns)]).reshape(rows, columns, 2)


def neighbours(shape: tuple[int, int]) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"]]:
    """Return the indices of the neurons at both ends of every edge of a grid of this shape, counted row by row."""
    number = np.arange(shape[0] * shape[1]).reshape(shape)
    first = np.concatenate([number[:-1].ravel(), number[:, :-1].ravel()])
    return first, np.concatenate([number[1:].ravel(), number[:, 1:].ravel()])


def write_map(learnt: SelfOrganisingMap | PlacedMap, path: str | Path) -> None:
    """Write a map to an NPZ file: its `weights` and `scale`, and the places of a `PlacedMap`.

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
    placed = isinstance(learnt, PlacedMap)
    plain = learnt.learnt if placed else learnt
    more = {name: getattr(learnt, name) for name in _OF_PLACES} if placed else {}
    more = {name: value for name, value in more.items() if value is not None}
    with written_whole(path) as file:
        np.savez_compressed(file, weights=plain.weights, scale=plain.scale, **more)


def read_map(path: str | Path) -> SelfOrganisingMap | PlacedMap:
    """Read a map from a file that `write_map` wrote.

    **Arguments:**

    - `path`: path of the file.

    Raises `FileNotFoundError`, and `ValueError` for any other file.

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
        arrays = npz_arrays(Path(path), "weights", "scale", *_OF_PLACES)
        need(arrays, "weights", "scale")
        learnt = SelfOrganisingMap(arrays["weights"], _read_scalar("scale", arrays))
        if "places" not in arrays:
            return learnt
        numbers = _read_scalar("widening", arrays), _read_scalar("missed", arrays)
        return PlacedMap(learnt, arrays["places"], *numbers, arrays.get("fitted"))
    except ValueError as error:
        raise ValueError(f"'{path}' is no map: {error}") from None


def _read_scalar(name: str, arrays: dict[str, np.ndarray]) -> float:
    value = arrays.get(name, np.zeros(0))
    if value.dtype.kind not in "fiu" or value.shape != ():
        raise ValueError(f"{name} must be one number; it has shape {value.shape}.")
    return float(value)
