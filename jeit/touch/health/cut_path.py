"""Locate a cut in a skin: fit the cut's path to the change of voltages by least squares on the forward model.

Across a cut, a sheet conducts as if it were longer by some added length, which is very large if the sheet is cut
through; along the cut, the sheet conducts as before. The loss of conductivity is spread over a band about as wide as
two edges of the mesh; the mesh is refined where images show a loss. The unknowns are the ends of the path, its bend,
and the added length; the voltages are computed exactly in every step of the fit. A round spot, such as a press causes,
is fitted too: the better fit determines whether a cut or a press caused the change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jeit.forward import ForwardModel
from jeit.mesh import centroids
from jeit.touch.health.local_change import LocalChange, finer_model

# Number of directions of the starting points of the fit of a cut.
_NUM_DIRECTIONS = 8
# Lengths of the starting points, divided by the skin's side.
_RELATIVE_LENGTHS = (0.08, 0.2)
# Number of starting points that are optimised.
_NUM_OPTIMISED_STARTS = 2
# Maximum number of steps of each optimisation.
_MAX_STEPS = 25
# Added length across a cut through the whole depth, divided by the skin's side; the maximum of the fit.
_MAX_ADDED_LENGTH = 3.0
# Initial added length in the fit of a partial cut, divided by the skin's side.
_INITIAL_PARTIAL_LENGTH = 0.02
# Minimum added length of the fit, divided by the skin's side.
_MIN_ADDED_LENGTH = 1e-4
# Radius of the region of refined mesh, and length of the mesh edges in the region, divided by the skin's side.
_REFINED_RADIUS, _EDGE_LENGTH = 0.22, 0.0125
# Half the width of the band of lost conductivity, in edges of the refined mesh.
_BAND_HALF_WIDTH = 1.5
# Factor by which the band is narrower beyond the ends of a path.
_END_NARROWING = 2.0
# Spot of changed conductivity: initial and maximum radius, divided by the skin's side; extent, in radii; initial and
# maximum depth, where depth is minus the logarithm of the fraction of conductivity that remains at the centre.
_INITIAL_SPOT_RADIUS, _MAX_SPOT_RADIUS, _SPOT_EXTENT, _SPOT_DEPTHS, _MAX_SPOT_DEPTH = 0.05, 0.1, 3.0, (0.5, -0.5), 6.0
# Initial offset of a bend from the middle of a straight path, divided by the length of the path.
_BEND_OFFSET = 0.2
# Maximum ratio of the misfit of a bent path to that of a straight path, for the bent path to be accepted.
_MAX_BEND_RATIO = 0.7
# Maximum ratio of the misfit of a partial cut to that of a cut through the whole depth, for the partial cut to be
# accepted.
_MAX_PARTIAL_RATIO = 0.4
# Misfit below which a cut through the whole depth is certain.
_CERTAIN_MISFIT = 0.01
# Ratio of misfits above which the worse of the fits of a complete and a partial cut is excluded.
_DISTINCT_MISFIT_RATIO = 4.0
# Maximum standard deviation of an end of the path, in mesh edges.
_MAX_END_DEVIATION = 10.0
# Model error, relative to a channel's change and to the root mean square of all changes.
_MODEL_ERROR = 0.05
# Standard deviation of a relative change common to all voltages.
_COMMON_FACTOR_DEVIATION = 0.1
# Step of numerical derivatives with respect to places, divided by the skin's side.
_DERIVATIVE_STEP = 1e-5


@dataclass(frozen=True)
class FittedLoss:
    """Fitted loss of conductivity along the path of a cut or in a round spot.

    **Fields**: `path` (points, 2): points of the path of a cut, metres, or the centre of a spot; `misfit`: fraction of
    the weighted sum of squares of the voltage change that the loss does not explain; `conductivity` (cells,):
    conductivity with the loss, S/m (2-D: S); `through`: whether the cut goes through the whole depth of the skin, which
    is assumed unless the data require a partial cut; `deviation`: standard deviation of the path's length, metres.
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


def _length(fit: _FittedUnknowns) -> float:
    """Length of the fitted path of a cut, metres."""
    return float(np.linalg.norm(np.diff(fit.unknowns[:-2].reshape(-1, 2), axis=0), axis=1).sum())


class LossFit:
    """Least-squares fit of a cut, or of a round spot, to a `change` of voltages, volts, in some `channels` of a model.

    The model's `conductivity` (cells,) is that before the change, S/m (2-D: S); the mesh is refined around a `centre`
    (x, y), metres.
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
        """Prepare the fit. `conductivity`: conductivity before the change, S/m (2-D: S); `noise` (channels,): noise of
        the change, volts."""
        cell_centres = np.asarray(centroids(model.mesh))[:, :2]
        self.lower_corner, self.upper_corner = cell_centres.min(axis=0), cell_centres.max(axis=0)
        self.skin_size = float((self.upper_corner - self.lower_corner).max())
        refined_model, parent_cells, edge_length = finer_model(
            model, centre, _REFINED_RADIUS * self.skin_size, _EDGE_LENGTH * self.skin_size
        )
        self.region = LocalChange(refined_model, conductivity[parent_cells], centre, _REFINED_RADIUS * self.skin_size)
        self.lower_corner = np.maximum(self.lower_corner, centre - self.region.radius)
        self.upper_corner = np.minimum(self.upper_corner, centre + self.region.radius)
        self.edge_length, self.band_half_width, self.model_conductivity = (
            edge_length,
            _BAND_HALF_WIDTH * edge_length,
            conductivity,
        )
        self.parents, self.cells_per_parent = (
            parent_cells[self.region.cells],
            np.bincount(parent_cells, minlength=len(conductivity)),
        )
        self.conductivity, self.centres = conductivity[self.parents], self.region.centres
        self.dimension = model.mesh.dimension
        protocol = model.protocol
        self.drive_currents = np.asarray(protocol.drive)[np.asarray(protocol.drive_index)[channels]]
        self.measurement_weights = np.asarray(protocol.measurement)[np.asarray(protocol.measurement_index)[channels]]
        self.rest_voltages = self._channel_voltages(self.region.impedance(np.zeros(len(self.conductivity))))
        rms_change = np.sqrt(np.mean(change**2))
        self.weights = 1 / np.hypot(noise, _MODEL_ERROR * np.hypot(change, rms_change))
        self.change = change
        # Direction of the voltage change due to a uniform change of conductivity; this component is removed from
        # voltage changes.
        uniform_change = self.weights * self.rest_voltages
        self.drift_direction = uniform_change / np.linalg.norm(uniform_change)
        self.energy = float(np.sum(self._weight_residual(change) ** 2))

    def fit_line(self, starts: list[np.ndarray]) -> FittedLoss:
        """Fit a straight cut near one of the places (x, y) in `starts`, metres, or a bent cut if the bent cut fits much
        better."""
        angles = np.pi * np.arange(_NUM_DIRECTIONS) / _NUM_DIRECTIONS
        directions = np.column_stack([np.cos(angles), np.sin(angles)])
        starts_by_depth = []
        for added_length in (_MAX_ADDED_LENGTH, _INITIAL_PARTIAL_LENGTH):
            candidate_starts = [
                np.array(
                    [*(start - half_length * direction), *(start + half_length * direction), np.log(added_length), 0.0]
                )
                for start in starts
                for half_length in 0.5 * self.skin_size * np.array(_RELATIVE_LENGTHS)
                for direction in directions
            ]
            starts_by_depth.append(sorted(candidate_starts, key=self._misfit)[:_NUM_OPTIMISED_STARTS])
        complete_cuts = [self._minimise_misfit(start, is_length_fixed=True) for start in starts_by_depth[0]]
        partial_cuts = [self._minimise_misfit(start) for start in starts_by_depth[1]]
        complete_cut = min(complete_cuts, key=lambda fit: fit.misfit)
        partial_cut = min(partial_cuts, key=lambda fit: fit.misfit)
        complete_cut, partial_cut = self._fit_bend(complete_cut, is_length_fixed=True), self._fit_bend(partial_cut)
        is_complete_cut = not partial_cut.misfit < _MAX_PARTIAL_RATIO * complete_cut.misfit
        best_fit, rejected_fit = (complete_cut, partial_cut) if is_complete_cut else (partial_cut, complete_cut)
        path = best_fit.unknowns[:-2].reshape(-1, 2)
        # A long partial cut and a short cut through the whole depth may fit about equally well.
        is_certainly_complete = is_complete_cut and best_fit.misfit < _CERTAIN_MISFIT
        are_similar = not is_certainly_complete and rejected_fit.misfit < _DISTINCT_MISFIT_RATIO * best_fit.misfit
        length_difference = abs(_length(best_fit) - _length(rejected_fit)) if are_similar else 0.0
        deviation = float(np.hypot(self._deviation(best_fit), length_difference))
        return FittedLoss(
            path, best_fit.misfit, self._conductivity_on_mesh(best_fit.unknowns), is_complete_cut, deviation
        )

    def fit_spot(self, start: np.ndarray) -> FittedLoss:
        """Fit a round spot of lost or gained conductivity near a place (x, y), metres."""
        candidate_starts = [np.array([*start, np.log(_INITIAL_SPOT_RADIUS), depth, 0.0]) for depth in _SPOT_DEPTHS]
        best_fit = min((self._minimise_misfit(candidate) for candidate in candidate_starts), key=lambda fit: fit.misfit)
        return FittedLoss(best_fit.unknowns[None, :2], best_fit.misfit, self._conductivity_on_mesh(best_fit.unknowns))

    def _fit_bend(self, straight_fit: _FittedUnknowns, *, is_length_fixed: bool = False) -> _FittedUnknowns:
        end_points_of_cut = straight_fit.unknowns[:-2].reshape(-1, 2)
        centre, (x, y) = end_points_of_cut.mean(axis=0), end_points_of_cut[-1] - end_points_of_cut[0]
        bend_offset = _BEND_OFFSET * np.array([-y, x])
        candidate_starts = [
            np.array([*end_points_of_cut[0], *bend_position, *end_points_of_cut[-1], *straight_fit.unknowns[-2:]])
            for bend_position in (centre + bend_offset, centre - bend_offset)
        ]
        bent_fits = [
            self._minimise_misfit(candidate, is_length_fixed=is_length_fixed) for candidate in candidate_starts
        ]
        best_bent_fit = min(bent_fits, key=lambda fit: fit.misfit)
        return best_bent_fit if best_bent_fit.misfit < _MAX_BEND_RATIO * straight_fit.misfit else straight_fit

    def _minimise_misfit(self, start: np.ndarray, *, is_length_fixed: bool = False) -> _FittedUnknowns:
        """Minimise the misfit over the unknowns of a cut or a spot, from `start`; if `is_length_fixed`, the added
        length across the cut is not fitted."""
        from scipy.optimize import least_squares

        lower_bounds, upper_bounds, scales = self._bounds(len(start))
        is_free = np.ones(len(start), bool)
        is_free[-2] = not is_length_fixed

        def all_unknowns(free_unknowns: np.ndarray) -> np.ndarray:
            unknowns = start.copy()
            unknowns[is_free] = free_unknowns
            return unknowns

        clipped_start = np.clip(start, lower_bounds + 1e-9, upper_bounds - 1e-9)
        least_squares_result = least_squares(
            lambda free_unknowns: self._residual(all_unknowns(free_unknowns)),
            clipped_start[is_free],
            lambda free_unknowns: self._jacobian(all_unknowns(free_unknowns))[:, is_free],  # pyright: ignore[reportArgumentType]
            bounds=(lower_bounds[is_free], upper_bounds[is_free]),
            x_scale=scales[is_free],
            max_nfev=_MAX_STEPS,
            ftol=1e-3,
            xtol=1e-3,
        )
        return _FittedUnknowns(all_unknowns(least_squares_result.x), 2 * least_squares_result.cost / self.energy)

    def _bounds(self, num_unknowns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return lower bounds, upper bounds and scales of the unknowns of a cut or a spot, each an array
        (num_unknowns,)."""
        if num_unknowns == 5:  # a spot
            lower_bounds, upper_bounds = (
                [*self.lower_corner, np.log(self.band_half_width / self.skin_size), -_MAX_SPOT_DEPTH],
                [*self.upper_corner, np.log(_MAX_SPOT_RADIUS), _MAX_SPOT_DEPTH],
            )
            scales = [0.05 * self.skin_size, 0.05 * self.skin_size, 0.5, 0.5]
        else:
            num_points = (num_unknowns - 2) // 2
            lower_bounds = [*np.tile(self.lower_corner, num_points), np.log(_MIN_ADDED_LENGTH)]
            upper_bounds = [*np.tile(self.upper_corner, num_points), np.log(_MAX_ADDED_LENGTH) + 1e-6]
            scales = [*np.full(2 * num_points, 0.05 * self.skin_size), 1.0]
        return (
            np.array([*lower_bounds, -0.5]),
            np.array([*upper_bounds, 0.5]),
            np.array([*scales, _COMMON_FACTOR_DEVIATION]),
        )

    def _deviation(self, fitted: _FittedUnknowns) -> float:
        """Estimate the standard deviation of the length of a cut, metres, from those of both ends and half an edge of
        the mesh at each end."""
        min_energy = fitted.misfit * self.energy
        residual_variance = min_energy / max(len(self.change) - len(fitted.unknowns), 1)
        path = fitted.unknowns[:-2].reshape(-1, 2)
        variance = 2 * (0.5 * self.edge_length) ** 2
        for end, next_point in ((0, 1), (-1, -2)):
            step = path[end] - path[next_point]
            step = self.edge_length * step / max(float(np.linalg.norm(step)), 1e-12)
            energy_increases = []
            for sign in (1.0, -1.0):
                shifted_path = path.copy()
                shifted_path[end] += sign * step
                energy_increases.append(
                    self._misfit(np.array([*shifted_path.ravel(), *fitted.unknowns[-2:]])) - min_energy
                )
            variance += self.edge_length**2 * min(
                residual_variance / max(max(energy_increases), 1e-12 * self.energy), _MAX_END_DEVIATION**2
            )
        return float(np.sqrt(variance))

    def _weight_residual(self, volts: np.ndarray) -> np.ndarray:
        scaled = (self.weights * volts.T).T
        return scaled - np.multiply.outer(self.drift_direction, self.drift_direction @ scaled)

    def _misfit(self, unknowns: np.ndarray) -> float:
        return float(np.sum(self._residual(unknowns) ** 2))

    def _channel_voltages(self, impedance: np.ndarray) -> np.ndarray:
        """Compute the voltages of the channels from a transfer impedance matrix (electrodes, electrodes)."""
        return np.einsum("kl,kl->k", self.measurement_weights @ impedance, self.drive_currents)

    def _predicted_change(self, unknowns: np.ndarray) -> np.ndarray:
        return self._channel_voltages(self.region.impedance(self._conductivity_change(unknowns))) - self.rest_voltages

    def _residual(self, unknowns: np.ndarray) -> np.ndarray:
        unexplained_change = (1 + unknowns[-1]) * self._predicted_change(unknowns) - self.change
        return np.append(self._weight_residual(unexplained_change), unknowns[-1] / _COMMON_FACTOR_DEVIATION)

    def _jacobian(self, unknowns: np.ndarray) -> np.ndarray:
        """Compute the derivatives (residuals, unknowns) of the weighted residuals of the fit with respect to the
        unknowns."""
        change = self._conductivity_change(unknowns)
        steps = np.full(len(unknowns) - 1, _DERIVATIVE_STEP)
        steps[: 2 if len(unknowns) == 5 else -1] *= self.skin_size
        change_derivatives = []
        for unknown_index, step in enumerate(steps):
            shifted_unknowns = unknowns.copy()
            shifted_unknowns[unknown_index] += step
            change_derivatives.append((self._conductivity_change(shifted_unknowns) - change) / step)
        impedance, impedance_derivatives = self.region.derivatives(change, change_derivatives)
        columns = np.column_stack(
            [
                *(self._channel_voltages(derivative) for derivative in impedance_derivatives),
                self._channel_voltages(impedance) - self.rest_voltages,
            ]
        )
        columns[:, :-1] *= 1 + unknowns[-1]
        last_row = np.zeros(len(unknowns))
        last_row[-1] = 1 / _COMMON_FACTOR_DEVIATION
        return np.concatenate([self._weight_residual(columns), last_row[None]])

    def _conductivity_change(self, unknowns: np.ndarray) -> np.ndarray:
        """Compute the change of conductivity in the cells of the region: scalars for a spot, tensors (cells, d, d) in d
        dimensions for a cut."""
        if len(unknowns) == 5:
            return self.conductivity * np.expm1(self._log_spot(unknowns))
        fractions, normals = self._fraction_across_path(unknowns)
        change = np.zeros((len(fractions), self.dimension, self.dimension))
        changed_cells = np.flatnonzero(fractions != 1)  # few of the region's cells
        x, y = normals[changed_cells].T
        conductivity_change = self.conductivity[changed_cells] * (fractions[changed_cells] - 1)
        change[changed_cells, 0, 0], change[changed_cells, 1, 1] = (
            conductivity_change * x * x,
            conductivity_change * y * y,
        )
        change[changed_cells, 0, 1] = change[changed_cells, 1, 0] = conductivity_change * x * y
        return change

    def _log_spot(self, unknowns: np.ndarray) -> np.ndarray:
        """Compute the logarithm of the fraction of each cell's conductivity that remains in a spot."""
        squared_distances = (
            np.sum((self.centres - unknowns[:2]) ** 2, axis=1) / (np.exp(unknowns[2]) * self.skin_size) ** 2
        )
        return -unknowns[3] * np.where(squared_distances < _SPOT_EXTENT**2, np.exp(-squared_distances / 2), 0.0)

    def _fraction_across_path(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the fraction of each cell's conductivity that remains across the nearest segment of a path, and the
        direction (cells, 2) across the segment."""
        path = unknowns[:-2].reshape(-1, 2)
        segment_starts, directions = path[:-1], np.diff(path, axis=0)
        lengths = np.maximum(np.linalg.norm(directions, axis=1), 1e-9)
        directions = directions / lengths[:, None]
        normals = np.column_stack([-directions[:, 1], directions[:, 0]])
        # Coordinates are multiplied one by one: sums over an axis of two elements take several times as long.
        x_offsets, y_offsets = (self.centres[:, i, None] - segment_starts[:, i] for i in (0, 1))  # (cells, segments)
        positions_on_path = x_offsets * directions[:, 0] + y_offsets * directions[:, 1]
        positions_across = x_offsets * normals[:, 0] + y_offsets * normals[:, 1]
        # The band reaches beyond the ends of its centre line, which is shortened so that the band ends with the path.
        end_shortening = np.minimum(self.band_half_width / _END_NARROWING, 0.45 * lengths)
        first_positions, last_positions = np.zeros(len(lengths)), lengths.copy()
        first_positions[0] += end_shortening[0]
        last_positions[-1] -= end_shortening[-1]
        distances_beyond_ends = _END_NARROWING * (
            positions_on_path - np.clip(positions_on_path, first_positions, last_positions)
        )
        squared_distances = positions_across**2 + distances_beyond_ends**2
        nearest_segments = squared_distances.argmin(axis=1)
        squared_distances = (
            squared_distances[np.arange(len(squared_distances)), nearest_segments] / self.band_half_width**2
        )
        # Profile of the loss across the band, with integral 1.
        profile_across_path = (
            np.where(squared_distances < 1, (1 - squared_distances) ** 2, 0.0) * 15 / (16 * self.band_half_width)
        )
        return 1 / (1 + np.exp(unknowns[-2]) * self.skin_size * profile_across_path), normals[nearest_segments]

    def _conductivity_on_mesh(self, unknowns: np.ndarray) -> np.ndarray:
        """Compute the conductivity with the fitted loss on the mesh of the model before refinement, one value for each
        cell."""
        # Conductivity is lost across a path, not along the path: the geometric mean of both directions is used.
        log_fractions = (
            self._log_spot(unknowns) if len(unknowns) == 5 else 0.5 * np.log(self._fraction_across_path(unknowns)[0])
        )
        return self.model_conductivity * np.exp(
            np.bincount(self.parents, log_fractions, len(self.model_conductivity)) / self.cells_per_parent
        )
