"""`PlacedMap`: what a self-organising map says of places, once some presses have told where its neurons lie."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, real_array
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap

# Neurons that a frame is told by, and what holds their weights together, over the mean square of their differences.
_NEAREST, _HELD = 9, 0.05
_FEWEST = 10


@dataclass(frozen=True)
class PlacedMap:
    """A `learnt` map whose neurons have `places` (R, C, d), metres: the mean place of the presses that each won, NaN
    of those that won none; make it with `PlacedMap.learn`. `widening`: the root mean square distance of presses held
    out from where they were told, over the spread told. `missed`: the root mean square of what neighbouring neurons
    leave of a press's channel, in the unit of frames."""

    learnt: SelfOrganisingMap
    places: Float[np.ndarray, "R C d"]
    widening: float
    missed: float

    @classmethod
    def learn(cls, learnt: SelfOrganisingMap, frames: ArrayLike, positions: ArrayLike) -> "PlacedMap":
        """Places of the neurons of a `learnt` map, from presses: frames (N, M) as it was learnt from, those or others,
        and their `positions` (N, d), metres.

        Raises `ValueError` for what is no map, fewer than ten presses, and positions that are not finite, one for each
        frame, or all the same.
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
        off = spread = missed = 0.0
        for out in (odd, ~odd):
            part = cls(learnt, _places(winners[~out], positions[~out], learnt.shape), 1.0, 0.0)
            said, own, left = part._told(frames[out])
            off += float(np.sum((said - positions[out]) ** 2))
            spread += float(np.sum(own**2))
            missed += float(np.sum(left**2))
        known = _places(winners, positions, learnt.shape)
        return cls(learnt, known, float(np.sqrt(off / max(spread, 1e-300))), float(np.sqrt(missed / frames.size)))

    @property
    def placed(self) -> Bool[np.ndarray, "R C"]:
        """Neurons that have a place."""
        return np.isfinite(self.places[..., 0])

    def locate(self, frames: ArrayLike) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
        """Places (n, d) of frames (n, M), or one (M,), and their standard deviations (n, d), metres.

        The nearest neurons are combined so that their frames, in shares of sum 1, come nearest to the one read: their
        places, in the same shares, are where it is (a map that is linear between neurons; the shares are those of
        Roweis and Saul 2000), at most as far from their middle as any of them. Raises `ValueError` for frames of
        another number of channels, and NaN.
        """
        said, spread, _ = self._told(self.learnt.checked(frames))
        return said, self.widening * spread

    def _told(self, frames: Float[np.ndarray, "n M"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places (n, d), how far the neurons' own are spread about them (n, d), and what their frames leave (n, M)."""
        map_of_placed, places = self._known
        weights = map_of_placed.weights[0]
        number = min(_NEAREST, len(weights))
        near = map_of_placed.nearest(frames, number)[0]
        own, there = weights[near], places[near]
        middle, centre = own.mean(axis=1, keepdims=True), there.mean(axis=1, keepdims=True)
        apart, round_centre = own - middle, there - centre
        gram = apart @ np.swapaxes(apart, 1, 2)
        held = _HELD * np.trace(gram, axis1=1, axis2=2)[:, None, None] / number + 1e-300
        change = (frames[:, None] - middle).transpose(0, 2, 1)
        shares = np.linalg.solve(gram + held * np.eye(number), apart @ change)
        offset = np.sum(shares * round_centre, axis=1)
        most = np.linalg.norm(round_centre, axis=2).max(axis=1)
        length = np.linalg.norm(offset, axis=1)
        said = centre[:, 0] + offset * np.minimum(1.0, most / np.maximum(length, 1e-300))[:, None]
        spread = np.sqrt(np.mean((there - said[:, None]) ** 2, axis=1))
        return said, spread, (change - np.swapaxes(apart, 1, 2) @ shares)[..., 0]

    def predict(self, features: ArrayLike) -> Float[np.ndarray, "n d"]:
        """Places (n, d) alone, as of `locate`, for who asks as of scikit-learn's estimators."""
        return self.locate(features)[0]

    @cached_property
    def _known(self) -> tuple[SelfOrganisingMap, Float[np.ndarray, "k d"]]:
        """The neurons that have a place, in one row, and those."""
        weights = self.learnt.weights[self.placed]
        return SelfOrganisingMap(weights[None], self.learnt.scale), self.places[self.placed]


def _places(winners: np.ndarray, positions: np.ndarray, shape: tuple[int, int]) -> Float[np.ndarray, "R C d"]:
    number = shape[0] * shape[1]
    count = np.bincount(winners, minlength=number)
    sums = np.stack([np.bincount(winners, one, minlength=number) for one in positions.T], axis=1)
    means = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], np.nan)
    return means.reshape(*shape, positions.shape[1])
