"""Locate a cut: fit its path to the change of voltages by least squares on the forward model.

Across a cut, a sheet conducts as if it were longer there by some length, which is very long if it is cut through; along
the cut, it conducts as before. This loss is spread over a band about as wide as two edges of the mesh, which is refined
where images show a loss. The unknowns are the ends of the path, its bend, and the added length; the voltages are
computed exactly in every step. A round spot, as a press makes, is fitted too: the better fit determines what caused the
change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jeit.forward import ForwardModel
from jeit.mesh import centroids
from jeit.touch.health.local_change import LocalChange, finer_model

# Starting points of the fit: number of directions; lengths divided by the skin's side; number of starting points that
# are optimised; maximum number of steps of each optimisation.
_DIRECTIONS, _LENGTHS, _FOLLOWED, _STEPS = 8, (0.08, 0.2), 2, 25
# Added length across a cut, divided by the skin's side: maximum, for a cut that goes through; initial value of the fit
# of a partial cut; minimum.
_THROUGH, _PART, _LEAST = 3.0, 0.02, 1e-4
# Divided by the skin's side: radius of the refined region; length of the mesh edges in it.
_RADIUS, _EDGE = 0.22, 0.0125
# Half the width of the band, in edges of the refined mesh; factor by which it is narrower beyond a path's ends.
_BAND, _ENDS = 1.5, 2.0
# Spot: initial and maximum radius, divided by the skin's side; extent, in radii; initial and maximum depth, where depth
# is minus the logarithm of the fraction of conductivity left at the centre.
_SPOT, _MOST_SPOT, _REACH, _SPOT_DEPTHS, _MOST_DEPTH = 0.05, 0.1, 3.0, (0.5, -0.5), 6.0
# Initial offset of a bend from the middle of a straight path, divided by the length of the path.
_ASIDE = 0.2
# Maximum ratio of misfits for accepting a bent path in place of a straight one, and a partial cut in place of one that
# goes through.
_BEND, _NOT_THROUGH = 0.7, 0.4
# Misfit below which a cut that goes through is certain; ratio of misfits from which the alternative is excluded;
# maximum uncertainty of an end, in edges.
_CLEAR, _DISTINCT, _WIDEST = 0.01, 4.0, 10.0
# Model error, relative to a change and to the root mean square of all changes; standard deviation of a factor common to
# all changes.
_MODEL, _FACTOR = 0.05, 0.1
# Step of numerical derivatives, divided by the skin's side.
_STEP = 1e-5


@dataclass(frozen=True)
class FittedLoss:
    """Fitted loss of conductivity along a path or in a round spot.

    **Fields**: `path` (k, 2): points of the path, metres, or the centre (1, 2) of a spot; `misfit`: fraction of the
    change's energy that the loss does not explain; `conductivity` (m,): conductivity with the loss, S/m (2-D: S);
    `through`: whether the cut goes through the whole depth, which is assumed unless the data require a partial cut;
    `deviation`: standard deviation of the path's length, metres.
    """

    path: Float[np.ndarray, "k 2"]
    misfit: float
    conductivity: Float[np.ndarray, " m"]
    through: bool = False
    deviation: float = 0.0


@dataclass(frozen=True)
class _FittedUnknowns:
    unknowns: np.ndarray
    misfit: float


def _length(fitted: _FittedUnknowns) -> float:
    """Length of a fitted path, metres."""
    return float(np.linalg.norm(np.diff(fitted.unknowns[:-2].reshape(-1, 2), axis=0), axis=1).sum())


class LossFit:
    """Least-squares fit of a cut or a spot to a `change` (K,), volts, in the `channels` (K,) of a model.

    The change is relative to the `conductivity` (m,), S/m (2-D: S); the mesh is refined around a `centre` (2,), metres.
    """

    def __init__(
        self,
        model: ForwardModel,
        conductivity: Float[np.ndarray, " m"],
        change: Float[np.ndarray, " K"],
        channels: Int[np.ndarray, " K"],
        noise: Float[np.ndarray, " K"],
        centre: Float[np.ndarray, " 2"],
    ):
        """Prepare the fit. `conductivity`: before the change, S/m (2-D: S); `noise` (K,): noise of the change,
        volts."""
        own = np.asarray(centroids(model.mesh))[:, :2]
        self.low, self.high = own.min(axis=0), own.max(axis=0)
        self.side = float((self.high - self.low).max())
        finer, parent, edge = finer_model(model, centre, _RADIUS * self.side, _EDGE * self.side)
        self.region = LocalChange(finer, conductivity[parent], centre, _RADIUS * self.side)
        self.low = np.maximum(self.low, centre - self.region.radius)
        self.high = np.minimum(self.high, centre + self.region.radius)
        self.edge, self.band, self.whole = edge, _BAND * edge, conductivity
        self.parent, self.parts = parent[self.region.cells], np.bincount(parent, minlength=len(conductivity))
        self.conductivity, self.centres = conductivity[self.parent], self.region.centres
        self.dimension = model.mesh.dimension
        protocol = model.protocol
        self.driven = np.asarray(protocol.drive)[np.asarray(protocol.drive_index)[channels]]
        self.measured = np.asarray(protocol.measurement)[np.asarray(protocol.measurement_index)[channels]]
        self.rest = self._channel_voltages(self.region.impedance(np.zeros(len(self.conductivity))))
        size = np.sqrt(np.mean(change**2))
        self.weight = 1 / np.hypot(noise, _MODEL * np.hypot(change, size))
        self.change = change
        # Direction of a uniform change of the skin's conductivity, which is projected out of changes.
        whole = self.weight * self.rest
        self.drift = whole / np.linalg.norm(whole)
        self.energy = float(np.sum(self._weight_residual(change) ** 2))

    def fit_line(self, starts: list[np.ndarray]) -> FittedLoss:
        """Fit a straight cut near one of the places (x, y) in `starts`, or a bent cut if it fits much better."""
        angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        ways = np.column_stack([np.cos(angles), np.sin(angles)])
        tried = []
        for depth in (_THROUGH, _PART):
            first = [
                np.array([*(start - half * way), *(start + half * way), np.log(depth), 0.0])
                for start in starts
                for half in 0.5 * self.side * np.array(_LENGTHS)
                for way in ways
            ]
            tried.append(sorted(first, key=self._misfit)[:_FOLLOWED])
        through = min((self._fit(one, fixed=True) for one in tried[0]), key=lambda one: one.misfit)
        partly = min((self._fit(one) for one in tried[1]), key=lambda one: one.misfit)
        through, partly = self._fit_bend(through, fixed=True), self._fit_bend(partly)
        is_through = not partly.misfit < _NOT_THROUGH * through.misfit
        best, other = (through, partly) if is_through else (partly, through)
        path = best.unknowns[:-2].reshape(-1, 2)
        # A long partial cut and a short cut that goes through may fit about equally well.
        clear = is_through and best.misfit < _CLEAR
        alike = not clear and other.misfit < _DISTINCT * best.misfit
        unsure = abs(_length(best) - _length(other)) if alike else 0.0
        deviation = float(np.hypot(self._deviation(best), unsure))
        return FittedLoss(path, best.misfit, self._conductivity_on_mesh(best.unknowns), is_through, deviation)

    def fit_spot(self, start: np.ndarray) -> FittedLoss:
        """Fit a round spot of lost or gained conductivity near a place (x, y)."""
        begun = [np.array([*start, np.log(_SPOT), depth, 0.0]) for depth in _SPOT_DEPTHS]
        best = min((self._fit(one) for one in begun), key=lambda one: one.misfit)
        return FittedLoss(best.unknowns[None, :2], best.misfit, self._conductivity_on_mesh(best.unknowns))

    def _fit_bend(self, straight: _FittedUnknowns, *, fixed: bool = False) -> _FittedUnknowns:
        ends = straight.unknowns[:-2].reshape(-1, 2)
        middle, (x, y) = ends.mean(axis=0), ends[-1] - ends[0]
        aside = _ASIDE * np.array([-y, x])
        tried = [
            np.array([*ends[0], *place, *ends[-1], *straight.unknowns[-2:]])
            for place in (middle + aside, middle - aside)
        ]
        bent = min((self._fit(one, fixed=fixed) for one in tried), key=lambda one: one.misfit)
        return bent if bent.misfit < _BEND * straight.misfit else straight

    def _fit(self, start: np.ndarray, *, fixed: bool = False) -> _FittedUnknowns:
        """Minimise the misfit over the unknowns, beginning at `start`; if `fixed`, the added length across the cut is
        not fitted."""
        from scipy.optimize import least_squares

        low, high, scale = self._bounds(len(start))
        free = np.ones(len(start), bool)
        free[-2] = not fixed

        def all_unknowns(fitted: np.ndarray) -> np.ndarray:
            unknowns = start.copy()
            unknowns[free] = fitted
            return unknowns

        inside = np.clip(start, low + 1e-9, high - 1e-9)
        found = least_squares(
            lambda fitted: self._residual(all_unknowns(fitted)),
            inside[free],
            lambda fitted: self._jacobian(all_unknowns(fitted))[:, free],  # pyright: ignore[reportArgumentType]
            bounds=(low[free], high[free]),
            x_scale=scale[free],
            max_nfev=_STEPS,
            ftol=1e-3,
            xtol=1e-3,
        )
        return _FittedUnknowns(all_unknowns(found.x), 2 * found.cost / self.energy)

    def _bounds(self, num_unknowns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower bounds, upper bounds and scales of the `num_unknowns` unknowns, each (number,)."""
        if num_unknowns == 5:  # a spot
            low, high = (
                [*self.low, np.log(self.band / self.side), -_MOST_DEPTH],
                [*self.high, np.log(_MOST_SPOT), _MOST_DEPTH],
            )
            scale = [0.05 * self.side, 0.05 * self.side, 0.5, 0.5]
        else:
            places = (num_unknowns - 2) // 2
            low = [*np.tile(self.low, places), np.log(_LEAST)]
            high = [*np.tile(self.high, places), np.log(_THROUGH) + 1e-6]
            scale = [*np.full(2 * places, 0.05 * self.side), 1.0]
        return np.array([*low, -0.5]), np.array([*high, 0.5]), np.array([*scale, _FACTOR])

    def _deviation(self, fitted: _FittedUnknowns) -> float:
        """Standard deviation of a path's length, metres: that of both ends, each combined with half an edge of the
        mesh."""
        least = fitted.misfit * self.energy
        each = least / max(len(self.change) - len(fitted.unknowns), 1)
        path = fitted.unknowns[:-2].reshape(-1, 2)
        square = 2 * (0.5 * self.edge) ** 2
        for end, next_one in ((0, 1), (-1, -2)):
            way = path[end] - path[next_one]
            way = self.edge * way / max(float(np.linalg.norm(way)), 1e-12)
            rises = []
            for sign in (1.0, -1.0):
                moved = path.copy()
                moved[end] += sign * way
                rises.append(self._misfit(np.array([*moved.ravel(), *fitted.unknowns[-2:]])) - least)
            square += self.edge**2 * min(each / max(max(rises), 1e-12 * self.energy), _WIDEST**2)
        return float(np.sqrt(square))

    def _weight_residual(self, volts: np.ndarray) -> np.ndarray:
        scaled = (self.weight * volts.T).T
        return scaled - np.multiply.outer(self.drift, self.drift @ scaled)

    def _misfit(self, unknowns: np.ndarray) -> float:
        return float(np.sum(self._residual(unknowns) ** 2))

    def _channel_voltages(self, impedance: np.ndarray) -> np.ndarray:
        """Voltages (K,) of the channels, computed from a transfer impedance (L, L)."""
        return np.einsum("kl,kl->k", self.measured @ impedance, self.driven)

    def _predicted_change(self, unknowns: np.ndarray) -> np.ndarray:
        return self._channel_voltages(self.region.impedance(self._conductivity_change(unknowns))) - self.rest

    def _residual(self, unknowns: np.ndarray) -> np.ndarray:
        left = (1 + unknowns[-1]) * self._predicted_change(unknowns) - self.change
        return np.append(self._weight_residual(left), unknowns[-1] / _FACTOR)

    def _jacobian(self, unknowns: np.ndarray) -> np.ndarray:
        """Derivatives (K + 1, q) of the weighted residuals with respect to the q unknowns."""
        change = self._conductivity_change(unknowns)
        steps = np.full(len(unknowns) - 1, _STEP)
        steps[: 2 if len(unknowns) == 5 else -1] *= self.side
        ways = []
        for number, step in enumerate(steps):
            more = unknowns.copy()
            more[number] += step
            ways.append((self._conductivity_change(more) - change) / step)
        impedance, slopes = self.region.derivatives(change, ways)
        found = np.column_stack(
            [*(self._channel_voltages(one) for one in slopes), self._channel_voltages(impedance) - self.rest]
        )
        found[:, :-1] *= 1 + unknowns[-1]
        last = np.zeros(len(unknowns))
        last[-1] = 1 / _FACTOR
        return np.concatenate([self._weight_residual(found), last[None]])

    def _conductivity_change(self, unknowns: np.ndarray) -> np.ndarray:
        """Change of the region's conductivity: scalars (c,) for a spot, tensors (c, d, d) for a path."""
        if len(unknowns) == 5:
            return self.conductivity * np.expm1(self._log_spot(unknowns))
        left, across = self._fraction_across_path(unknowns)
        change = np.zeros((len(left), self.dimension, self.dimension))
        change[:, :2, :2] = (self.conductivity * (left - 1))[:, None, None] * across[:, :, None] * across[:, None, :]
        return change

    def _log_spot(self, unknowns: np.ndarray) -> np.ndarray:
        """Logarithm (c,) of the fraction of conductivity that is left in a spot."""
        square = np.sum((self.centres - unknowns[:2]) ** 2, axis=1) / (np.exp(unknowns[2]) * self.side) ** 2
        return -unknowns[3] * np.where(square < _REACH**2, np.exp(-square / 2), 0.0)

    def _fraction_across_path(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fraction of conductivity (m,) left across the nearest part of a path, and the direction (m, 2) across it."""
        path = unknowns[:-2].reshape(-1, 2)
        start, along = path[:-1], np.diff(path, axis=0)
        lengths = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
        along = along / lengths[:, None]
        normal = np.column_stack([-along[:, 1], along[:, 0]])
        off = self.centres[:, None] - start  # (m, s, 2)
        place = np.sum(off * along, axis=-1)
        # The band reaches beyond the ends of its centre line, which is shortened so that the band ends with the path.
        pulled = np.minimum(self.band / _ENDS, 0.45 * lengths)
        first, last = np.zeros(len(lengths)), lengths.copy()
        first[0] += pulled[0]
        last[-1] -= pulled[-1]
        beyond = _ENDS * (place - np.clip(place, first, last))
        square = np.sum(off * normal, axis=-1) ** 2 + beyond**2
        nearest = square.argmin(axis=1)
        square = square[np.arange(len(square)), nearest] / self.band**2
        # Profile of the band across the path, with integral 1.
        shape = np.where(square < 1, (1 - square) ** 2, 0.0) * 15 / (16 * self.band)
        return 1 / (1 + np.exp(unknowns[-2]) * self.side * shape), normal[nearest]

    def _conductivity_on_mesh(self, unknowns: np.ndarray) -> np.ndarray:
        """Conductivity on the mesh of the model before refinement, one value for each cell."""
        # Conductivity is lost across a path, not along it: the geometric mean of both directions is used.
        lost = self._log_spot(unknowns) if len(unknowns) == 5 else 0.5 * np.log(self._fraction_across_path(unknowns)[0])
        return self.whole * np.exp(np.bincount(self.parent, lost, len(self.whole)) / self.parts)
