"""A map whose neurons have places or other values, drawn on a skin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.linalg import lsqr
from scipy.spatial import KDTree

from jeit.arguments import check_key, check_kind, real_array
from jeit.arguments.extras import optional
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap

# The number of neurons that a place is estimated from: those nearest to the frame, or 5 by 5 on the grid about the
# nearest; and the regularisation of their shares, relative to the mean square of their differences.
_NEAREST, _HELD = 9, 0.05
_ON_GRID, _HELD_ON_GRID = 25, 0.005
# The number of presses that count as much for a neuron's place as the mean of all that it won.
_DOUBT = 0.3
_FEWEST = 10
# The number of frames that are located at once.
_AT_ONCE = 512


@dataclass(frozen=True)
class PlacedMap:
    """A `learnt` map whose neurons have `places` (R, C, d), metres; make it with `PlacedMap.learn`.

    A place is the mean of the presses that a neuron won, NaN for those that won none. `widening`: the root mean square
    error of held-out presses, over the estimated spread. `missed`: the root mean square of what the neurons nearest to
    a press leave of a channel, in the unit of frames. `fitted` (R, C, d), metres: places that fit presses best, where
    neighbours on the grid locate a frame; None: it is located by the neurons nearest to it, and their places.
    """

    learnt: SelfOrganisingMap
    places: Float[np.ndarray, "R C d"]
    widening: float
    missed: float
    fitted: Float[np.ndarray, "R C d"] | None = None

    @classmethod
    def learn(cls, learnt: SelfOrganisingMap, frames: ArrayLike, positions: ArrayLike) -> "PlacedMap":
        """Learn places of the neurons of a `learnt` map from presses: frames (N, M) and their `positions` (N, d),
        metres.

        The frames are those that the map was learnt from, or others. With few presses the neurons nearest to a frame
        locate it better; with many, neighbours on the grid, with places fitted by least squares. The choice is what has
        less error on held-out presses. Raises `ValueError` for what is no map, fewer than ten presses, and positions
        that are not finite, one for each frame, or all the same.
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
                part = cls._of(learnt, frames[~out], positions[~out], winners[~out], fit)
                placed = part._located(frames[out])
                off += float(np.sum((placed.places - positions[out]) ** 2))
                spread += float(np.sum(placed.spread**2))
                missed += float(np.sum(placed.left**2))
            ways.append((off, fit, float(np.sqrt(off / max(spread, 1e-300))), float(np.sqrt(missed / frames.size))))
        _, fit, widening, _ = min(ways)
        whole = cls._of(learnt, frames, positions, winners, fit)
        return replace(whole, widening=widening, missed=ways[0][3])

    @classmethod
    def _of(cls, learnt, frames, positions, winners, fit: bool) -> "PlacedMap":
        """The map with places from these presses, with these winners (N,); without an estimate of deviations yet."""
        number = learnt.shape[0] * learnt.shape[1]
        count = np.bincount(winners, minlength=number)[:, None]
        sums = np.stack([np.bincount(winners, one, minlength=number) for one in positions.T], axis=1)
        means = np.where(count > 0, sums / np.maximum(count, 1), np.nan).reshape(*learnt.shape, -1)
        placed = cls(learnt, means, 1.0, 0.0, means if fit else None)
        if not fit:
            return placed
        near, shares, _ = placed._shares(frames)
        row = np.repeat(np.arange(len(frames)), near.shape[1])
        combined = csr_array((shares.ravel(), (row, near.ravel())), shape=(len(frames), np.count_nonzero(count)))
        off = positions - combined @ means[placed.placed]
        moved = [lsqr(combined, one, damp=np.sqrt(_DOUBT), atol=1e-9, btol=1e-9)[0] for one in off.T]
        fitted = means.copy()
        fitted[placed.placed] += np.stack(moved, axis=1)
        return replace(placed, fitted=fitted)

    @property
    def placed(self) -> Bool[np.ndarray, "R C"]:
        """Neurons that have a place."""
        return np.isfinite(self.places[..., 0])

    def locate(self, frames: ArrayLike) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
        """Estimate the places (n, d) of frames (n, M), or one (M,), and their standard deviations (n, d), metres.

        The neurons nearest to a frame, or those about the nearest on the grid (`fitted`), are combined with shares of
        sum 1 so that their frames are nearest to it; the place is the combination of their places with the same shares
        (a map that is linear between neurons; the shares are those of Roweis and Saul 2000), at most as far from the
        middle of these, or on the grid from the nearest, as any of them. Raises `ValueError` for frames of another
        number of channels, and NaN.
        """
        placed = self._located(self.learnt.checked(frames))
        return placed.places, self.widening * placed.spread

    def _located(self, frames: Float[np.ndarray, "n M"]) -> "_Located":
        near, shares, left = self._shares(frames)
        there = self._known.places[near]
        own = there.mean(axis=1) if self.fitted is None else there[:, 0]
        offset = np.einsum("nq,nqd->nd", shares, there) - own
        most = np.linalg.norm(there - own[:, None], axis=2).max(axis=1)
        length = np.linalg.norm(offset, axis=1)
        said = own + offset * np.minimum(1.0, most / np.maximum(length, 1e-300))[:, None]
        return _Located(said, np.sqrt(np.mean((there - said[:, None]) ** 2, axis=1)), left)

    def _shares(self, frames: Float[np.ndarray, "n M"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Numbers (n, q), among the neurons with places, of those that locate frames, their shares (n, q), and what
        they leave (n, M)."""
        known = self._known
        if self.fitted is None:
            near, held = known.neurons.nearest(frames, min(_NEAREST, len(known.places)))[0], _HELD
        else:
            near, held = known.around[known.neurons.winners(frames)[:, 1]], _HELD_ON_GRID
        shares, left = np.empty(near.shape), np.empty(frames.shape)
        for first in range(0, len(frames), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            shares[some], left[some] = _combined(known.neurons.weights[0][near[some]], frames[some], held)
        return near, shares, left

    def predict(self, features: ArrayLike) -> Float[np.ndarray, "n d"]:
        """Places (n, d) alone, as of `locate`, in the interface of scikit-learn's estimators."""
        return self.locate(features)[0]

    @cached_property
    def _known(self) -> "_Known":
        neurons = SelfOrganisingMap(self.learnt.weights[self.placed][None], self.learnt.scale)
        places, grid = (self.places if self.fitted is None else self.fitted)[self.placed], np.argwhere(self.placed)
        # Sorted by the longer way along the grid: the first is the neuron itself.
        around = KDTree(grid).query(grid, min(_ON_GRID, len(grid)), p=np.inf)[1].reshape(len(grid), -1)
        return _Known(neurons, places, around)


class _Known(NamedTuple):
    """The neurons that have a place, in one row; the places that estimates use; the numbers of those about each on the
    grid."""

    neurons: SelfOrganisingMap
    places: Float[np.ndarray, "k d"]
    around: Int[np.ndarray, "k q"]


class _Located(NamedTuple):
    """Estimated places (n, d), the spread of the neurons' places about them (n, d), and the residual of frames (n,
    M)."""

    places: Float[np.ndarray, "n d"]
    spread: Float[np.ndarray, "n d"]
    left: Float[np.ndarray, "n M"]


def _combined(own: Float[np.ndarray, "n q M"], frames: Float[np.ndarray, "n M"], held: float):
    """Shares (n, q), of sum 1, with which the neurons' frames are nearest to the given ones, and the residual (n,
    M)."""
    count = own.shape[1]
    middle = own.mean(axis=1, keepdims=True)
    apart = own - middle
    gram = apart @ np.swapaxes(apart, 1, 2)
    diagonal = np.einsum("nqq->nq", gram)  # a view
    diagonal += held * diagonal.mean(axis=1, keepdims=True) + 1e-300
    change = frames - middle[:, 0]
    found = np.linalg.solve(gram, apart @ change[..., None])
    left = change - (np.swapaxes(found, 1, 2) @ apart)[:, 0]
    return found[..., 0] + (1 - found.sum(axis=1)) / count, left


# Steps of the springs, and the distance of neighbours, relative to the usual one, below which springs grow no stronger.
_STEPS, _LEAST = 60, 1e-2


def drawn_map(learnt: SelfOrganisingMap, key: Array) -> Float[np.ndarray, "R C 2"]:
    """Places (R, C, 2) of a map's neurons on paper, from -1 to 1, by Fruchterman and Reingold's springs (1991).

    Each neuron is tied to its four neighbours on the grid, the stronger the nearer its frame is to theirs; all repel
    each other. They start from their places on the grid, moved a little at random by `key`: which way round the drawing
    comes out says nothing. Raises `ValueError` for what is no map, and no key.
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
    """Numbers of the neurons, row by row, at both ends of every edge of a grid of this shape."""
    number = np.arange(shape[0] * shape[1]).reshape(shape)
    first = np.concatenate([number[:-1].ravel(), number[:, :-1].ravel()])
    return first, np.concatenate([number[1:].ravel(), number[:, 1:].ravel()])
