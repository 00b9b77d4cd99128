"""A cut's path from the change of voltages that it made: a line of lost conductivity, fitted to the exact model.

Along a path, conductivity falls by exp(−a w(d)), w a Gaussian of the distance d to it about as wide as the mesh can
hold; depth a, and the places of the path's ends and its bend, are found by least squares, the voltages solved anew in
every step. A round spot is fitted too, which is what a press makes: the better of the two says what it is.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jeit.forward import ForwardModel
from jeit.mesh import centroids, measures

# Of the edge of a mean cell, how wide a cut is; directions tried first, of which so many are followed; steps of each.
_WIDTH, _DIRECTIONS, _FOLLOWED, _STEPS = 0.6, 6, 2, 25
# Of the skin's side, the length that is begun with; depths a, least, first and greatest.
_LENGTH, _LEAST_DEPTH, _DEPTH, _MOST_DEPTH = 0.18, 0.1, 2.5, 9.0
# Of a spot, the radius, of the skin's side, and the depth that are begun with.
_SPOT, _SPOT_DEPTH = 0.05, 0.5
# A bend has to take so much of the misfit that a straight line leaves.
_BEND = 0.6
# Of a change, and of the root mean square of all, what no model of it gets right.
_MODEL = 0.05


@dataclass(frozen=True)
class FittedLoss:
    """Conductivity lost: along a `path` (k, 2), metres, or of a round spot at `path` (1, 2); `misfit`, the share of the
    change's energy that it does not explain, and its `conductivity` (m,), S/m (2-D: S)."""

    path: Float[np.ndarray, "k 2"]
    misfit: float
    conductivity: Float[np.ndarray, " m"]


class LossFit:
    """Least squares for a `change` (K,) of voltages of a model's `channels` (K,), volts, from `conductivity` (m,), S/m
    (2-D: S)."""

    def __init__(
        self,
        model: ForwardModel,
        conductivity: Float[np.ndarray, " m"],
        change: Float[np.ndarray, " K"],
        channels: Int[np.ndarray, " K"],
        noise: Float[np.ndarray, " K"],
    ):
        """`conductivity` as it was, S/m (2-D: S); `noise` (K,), volts."""
        self.model, self.conductivity, self.channels = model, conductivity, channels
        self.centres = np.asarray(centroids(model.mesh))[:, :2]
        area = np.asarray(measures(model.mesh))
        self.low, self.high = self.centres.min(axis=0), self.centres.max(axis=0)
        self.side = float((self.high - self.low).max())
        flat = model.mesh.dimension == 2
        across = float(np.mean(area)) if flat else float(np.prod(self.high - self.low)) / len(area) * 3
        self.width = _WIDTH * 1.5 * np.sqrt(across)
        self.rest = np.asarray(model.voltages(conductivity))[channels]
        size = np.sqrt(np.mean(change**2))
        self.weight = 1 / np.hypot(noise, _MODEL * np.hypot(change, size))
        self.change = change
        self.energy = float(np.sum((self.weight * change) ** 2))

    def line(self, start: np.ndarray) -> FittedLoss:
        """A straight cut near a place (x, y), or a bent one where that is far better."""
        half = 0.5 * _LENGTH * self.side
        angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        first = [
            np.concatenate([start - half * way, start + half * way, [_DEPTH]])
            for way in np.column_stack([np.cos(angles), np.sin(angles)])
        ]
        tried = sorted(first, key=lambda one: self._misfit(one))[:_FOLLOWED]
        straight = min((self._fitted(one) for one in tried), key=lambda one: one[1])
        ends = straight[0][:-1].reshape(-1, 2)
        bent = self._fitted(np.concatenate([ends[0], ends.mean(axis=0), ends[-1], straight[0][-1:]]))
        best = bent if bent[1] < _BEND * straight[1] else straight
        path = best[0][:-1].reshape(-1, 2)
        return FittedLoss(path, best[1], self._values(best[0])[0])

    def spot(self, start: np.ndarray) -> FittedLoss:
        """A round one."""
        best = self._fitted(np.array([*start, _SPOT * self.side, _SPOT_DEPTH]))
        return FittedLoss(best[0][None, :2], best[1], self._values(best[0])[0])

    def _fitted(self, start: np.ndarray) -> tuple[np.ndarray, float]:
        from scipy.optimize import least_squares

        low, high = self._bounds(len(start))
        inside = np.clip(start, low + 1e-9, high - 1e-9)
        scale = np.full(len(start), 0.05 * self.side)
        scale[-1] = 1.0
        found = least_squares(
            self._residual,
            inside,
            self._slope,  # pyright: ignore[reportArgumentType]
            bounds=(low, high),
            x_scale=scale,
            max_nfev=_STEPS,
            ftol=1e-4,
            xtol=1e-4,
        )
        return found.x, 2 * found.cost / self.energy

    def _bounds(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        if number == 4:  # a spot
            low = np.concatenate([self.low, [self.width], [-_MOST_DEPTH]])
            return low, np.concatenate([self.high, [0.3 * self.side], [_MOST_DEPTH]])
        places = (number - 1) // 2
        low = np.concatenate([np.tile(self.low, places), [_LEAST_DEPTH]])
        return low, np.concatenate([np.tile(self.high, places), [_MOST_DEPTH]])

    def _misfit(self, unknowns: np.ndarray) -> float:
        return float(np.sum(self._residual(unknowns) ** 2))

    def _residual(self, unknowns: np.ndarray) -> np.ndarray:
        voltages = np.asarray(self.model.voltages(self._values(unknowns)[0]))[self.channels]
        return self.weight * (voltages - self.rest - self.change)

    def _slope(self, unknowns: np.ndarray) -> np.ndarray:
        values, slope = self._values(unknowns)
        jacobian = np.asarray(self.model.jacobian(values))[self.channels]
        return self.weight[:, None] * (jacobian @ slope)

    def _values(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Conductivity (m,) and its derivatives (m, q) by the unknowns."""
        depth = unknowns[-1]
        if len(unknowns) == 4:
            off = self.centres - unknowns[:2]
            square, width = np.sum(off**2, axis=1), unknowns[2]
            shape = np.exp(-square / (2 * width**2))
            by = np.column_stack([shape[:, None] * off / width**2, shape * square / width**3])
        else:
            shape, by = self._near_path(unknowns[:-1].reshape(-1, 2))
        values = self.conductivity * np.exp(-depth * shape)
        return values, -values[:, None] * np.column_stack([depth * by, shape])

    def _near_path(self, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """w(d) (m,) and its derivatives by the coordinates of the path's places."""
        start, along = path[:-1], np.diff(path, axis=0)
        off = self.centres[:, None] - start  # (m, s, 2)
        share = np.sum(off * along, axis=-1) / np.maximum(np.sum(along**2, axis=-1), 1e-12)
        share = np.clip(share, 0.0, 1.0)
        away = off - share[..., None] * along
        square = np.sum(away**2, axis=-1)
        nearest = square.argmin(axis=1)
        rows = np.arange(len(self.centres))
        shape = np.exp(-square[rows, nearest] / (2 * self.width**2))
        # The foot's own movement along the path changes the distance by nothing.
        pull = shape[:, None] * away[rows, nearest] / self.width**2
        by = np.zeros((len(rows), *path.shape))
        by[rows, nearest] += (1 - share[rows, nearest])[:, None] * pull
        by[rows, nearest + 1] += share[rows, nearest][:, None] * pull
        return shape, by.reshape(len(rows), -1)
