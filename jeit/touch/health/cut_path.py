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
_NUM_CUT_DIRECTIONS = 8
# Lengths of the starting points, divided by the skin's side.
_RELATIVE_CUT_LENGTHS = (0.08, 0.2)
# Number of starting points that are optimised.
_NUM_OPTIMISED_CUTS = 2
# Maximum number of steps of each optimisation.
_MAX_OPTIMISER_STEPS = 25
# Added length across a cut through the whole depth, divided by the skin's side; the maximum of the fit.
_MAX_ADDED_LENGTH = 3.0
# Initial added length in the fit of a partial cut, divided by the skin's side.
_INITIAL_PARTIAL_LENGTH = 0.02
# Minimum added length of the fit, divided by the skin's side.
_MIN_ADDED_LENGTH = 1e-4
# Radius of the region of refined mesh, and length of the mesh edges in the region, divided by the skin's side.
_RELATIVE_REFINED_RADIUS, _RELATIVE_EDGE_LENGTH = 0.22, 0.0125
# Half the width of the band of lost conductivity, in edges of the refined mesh.
_BAND_HALF_WIDTH = 1.5
# Factor by which the band is narrower beyond the ends of a path.
_CUT_END_NARROWING = 2.0
# Spot of changed conductivity: initial and maximum radius, divided by the skin's side; extent, in radii; initial and
# maximum depth, where depth is minus the logarithm of the fraction of conductivity that remains at the centre.
_INITIAL_SPOT_RADIUS, _MAX_SPOT_RADIUS, _SPOT_CUTOFF_RADII, _INITIAL_SPOT_DEPTHS, _MAX_SPOT_DEPTH = (
    0.05,
    0.1,
    3.0,
    (0.5, -0.5),
    6.0,
)
# Initial offset of a bend from the middle of a straight path, divided by the length of the path.
_RELATIVE_BEND_OFFSET = 0.2
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
_RELATIVE_MODEL_ERROR = 0.05
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


def _cut_length(fitted_cut: _FittedUnknowns) -> float:
    """Length of the fitted path of a cut, metres."""
    return float(np.linalg.norm(np.diff(fitted_cut.unknowns[:-2].reshape(-1, 2), axis=0), axis=1).sum())


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
            model, centre, _RELATIVE_REFINED_RADIUS * self.skin_size, _RELATIVE_EDGE_LENGTH * self.skin_size
        )
        self.region = LocalChange(
            refined_model, conductivity[parent_cells], centre, _RELATIVE_REFINED_RADIUS * self.skin_size
        )
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
        self.weights = 1 / np.hypot(noise, _RELATIVE_MODEL_ERROR * np.hypot(change, rms_change))
        self.change = change
        # Direction of the voltage change due to a uniform change of conductivity; this component is removed from
        # voltage changes.
        uniform_change = self.weights * self.rest_voltages
        self.drift_direction = uniform_change / np.linalg.norm(uniform_change)
        self.energy = float(np.sum(self._weight_residual(change) ** 2))

    def fit_line(self, starts: list[np.ndarray]) -> FittedLoss:
        """Fit a straight cut near one of the places (x, y) in `starts`, metres, or a bent cut if the bent cut fits much
        better."""
        cut_angles = np.pi * np.arange(_NUM_CUT_DIRECTIONS) / _NUM_CUT_DIRECTIONS
        cut_directions = np.column_stack([np.cos(cut_angles), np.sin(cut_angles)])
        initial_cuts_by_depth = []
        for added_length in (_MAX_ADDED_LENGTH, _INITIAL_PARTIAL_LENGTH):
            candidate_cuts = [
                np.array(
                    [
                        *(start_place - half_length * cut_direction),
                        *(start_place + half_length * cut_direction),
                        np.log(added_length),
                        0.0,
                    ]
                )
                for start_place in starts
                for half_length in 0.5 * self.skin_size * np.array(_RELATIVE_CUT_LENGTHS)
                for cut_direction in cut_directions
            ]
            initial_cuts_by_depth.append(sorted(candidate_cuts, key=self._misfit)[:_NUM_OPTIMISED_CUTS])
        complete_cuts = [
            self._minimise_misfit(initial_cut, is_length_fixed=True) for initial_cut in initial_cuts_by_depth[0]
        ]
        partial_cuts = [self._minimise_misfit(initial_cut) for initial_cut in initial_cuts_by_depth[1]]
        complete_cut = min(complete_cuts, key=lambda fitted_cut: fitted_cut.misfit)
        partial_cut = min(partial_cuts, key=lambda fitted_cut: fitted_cut.misfit)
        complete_cut, partial_cut = self._fit_bend(complete_cut, is_length_fixed=True), self._fit_bend(partial_cut)
        is_complete_cut = not partial_cut.misfit < _MAX_PARTIAL_RATIO * complete_cut.misfit
        best_fit, rejected_fit = (complete_cut, partial_cut) if is_complete_cut else (partial_cut, complete_cut)
        cut_path = best_fit.unknowns[:-2].reshape(-1, 2)
        # A long partial cut and a short cut through the whole depth may fit about equally well.
        is_certainly_complete = is_complete_cut and best_fit.misfit < _CERTAIN_MISFIT
        are_fits_similar = not is_certainly_complete and rejected_fit.misfit < _DISTINCT_MISFIT_RATIO * best_fit.misfit
        length_difference = abs(_cut_length(best_fit) - _cut_length(rejected_fit)) if are_fits_similar else 0.0
        length_deviation = float(np.hypot(self._cut_length_deviation(best_fit), length_difference))
        return FittedLoss(
            cut_path, best_fit.misfit, self._conductivity_on_mesh(best_fit.unknowns), is_complete_cut, length_deviation
        )

    def fit_spot(self, start: np.ndarray) -> FittedLoss:
        """Fit a round spot of lost or gained conductivity near a place (x, y), metres."""
        initial_spots = [
            np.array([*start, np.log(_INITIAL_SPOT_RADIUS), spot_depth, 0.0]) for spot_depth in _INITIAL_SPOT_DEPTHS
        ]
        best_spot = min(
            (self._minimise_misfit(initial_spot) for initial_spot in initial_spots),
            key=lambda fitted_spot: fitted_spot.misfit,
        )
        return FittedLoss(
            best_spot.unknowns[None, :2], best_spot.misfit, self._conductivity_on_mesh(best_spot.unknowns)
        )

    def _fit_bend(self, straight_fit: _FittedUnknowns, *, is_length_fixed: bool = False) -> _FittedUnknowns:
        end_points_of_cut = straight_fit.unknowns[:-2].reshape(-1, 2)
        cut_centre, (x, y) = end_points_of_cut.mean(axis=0), end_points_of_cut[-1] - end_points_of_cut[0]
        bend_offset = _RELATIVE_BEND_OFFSET * np.array([-y, x])
        initial_bent_cuts = [
            np.array([*end_points_of_cut[0], *bend_position, *end_points_of_cut[-1], *straight_fit.unknowns[-2:]])
            for bend_position in (cut_centre + bend_offset, cut_centre - bend_offset)
        ]
        bent_fits = [
            self._minimise_misfit(initial_bent_cut, is_length_fixed=is_length_fixed)
            for initial_bent_cut in initial_bent_cuts
        ]
        best_bent_fit = min(bent_fits, key=lambda bent_fit: bent_fit.misfit)
        return best_bent_fit if best_bent_fit.misfit < _MAX_BEND_RATIO * straight_fit.misfit else straight_fit

    def _minimise_misfit(self, initial_unknowns: np.ndarray, *, is_length_fixed: bool = False) -> _FittedUnknowns:
        """Minimise the misfit over the unknowns of a cut or a spot, from `initial_unknowns`; if `is_length_fixed`,
        the added length across the cut is not fitted."""
        from scipy.optimize import least_squares

        lower_bounds, upper_bounds, scales_of_unknowns = self._bounds_of_unknowns(len(initial_unknowns))
        is_fitted_unknown = np.ones(len(initial_unknowns), bool)
        is_fitted_unknown[-2] = not is_length_fixed

        def all_unknowns(fitted_unknowns: np.ndarray) -> np.ndarray:
            unknowns = initial_unknowns.copy()
            unknowns[is_fitted_unknown] = fitted_unknowns
            return unknowns

        clipped_initial_unknowns = np.clip(initial_unknowns, lower_bounds + 1e-9, upper_bounds - 1e-9)
        least_squares_result = least_squares(
            lambda fitted_unknowns: self._residual(all_unknowns(fitted_unknowns)),
            clipped_initial_unknowns[is_fitted_unknown],
            lambda fitted_unknowns: self._jacobian(all_unknowns(fitted_unknowns))[:, is_fitted_unknown],  # pyright: ignore[reportArgumentType]
            bounds=(lower_bounds[is_fitted_unknown], upper_bounds[is_fitted_unknown]),
            x_scale=scales_of_unknowns[is_fitted_unknown],
            max_nfev=_MAX_OPTIMISER_STEPS,
            ftol=1e-3,
            xtol=1e-3,
        )
        return _FittedUnknowns(all_unknowns(least_squares_result.x), 2 * least_squares_result.cost / self.energy)

    def _bounds_of_unknowns(self, num_unknowns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return lower bounds, upper bounds and scales of the unknowns of a cut or a spot, each an array
        (num_unknowns,)."""
        if num_unknowns == 5:  # a spot
            lower_bounds, upper_bounds = (
                [*self.lower_corner, np.log(self.band_half_width / self.skin_size), -_MAX_SPOT_DEPTH],
                [*self.upper_corner, np.log(_MAX_SPOT_RADIUS), _MAX_SPOT_DEPTH],
            )
            scales_of_unknowns = [0.05 * self.skin_size, 0.05 * self.skin_size, 0.5, 0.5]
        else:
            num_path_points = (num_unknowns - 2) // 2
            lower_bounds = [*np.tile(self.lower_corner, num_path_points), np.log(_MIN_ADDED_LENGTH)]
            upper_bounds = [*np.tile(self.upper_corner, num_path_points), np.log(_MAX_ADDED_LENGTH) + 1e-6]
            scales_of_unknowns = [*np.full(2 * num_path_points, 0.05 * self.skin_size), 1.0]
        return (
            np.array([*lower_bounds, -0.5]),
            np.array([*upper_bounds, 0.5]),
            np.array([*scales_of_unknowns, _COMMON_FACTOR_DEVIATION]),
        )

    def _cut_length_deviation(self, fitted_cut: _FittedUnknowns) -> float:
        """Estimate the standard deviation of the length of a cut, metres, from those of both ends and half an edge of
        the mesh at each end."""
        min_energy = fitted_cut.misfit * self.energy
        residual_variance = min_energy / max(len(self.change) - len(fitted_cut.unknowns), 1)
        cut_path = fitted_cut.unknowns[:-2].reshape(-1, 2)
        length_variance = 2 * (0.5 * self.edge_length) ** 2
        for end_index, neighbour_index in ((0, 1), (-1, -2)):
            end_displacement = cut_path[end_index] - cut_path[neighbour_index]
            end_displacement = self.edge_length * end_displacement / max(float(np.linalg.norm(end_displacement)), 1e-12)
            energy_increases = []
            for displacement_sign in (1.0, -1.0):
                shifted_path = cut_path.copy()
                shifted_path[end_index] += displacement_sign * end_displacement
                energy_increases.append(
                    self._misfit(np.array([*shifted_path.ravel(), *fitted_cut.unknowns[-2:]])) - min_energy
                )
            length_variance += self.edge_length**2 * min(
                residual_variance / max(max(energy_increases), 1e-12 * self.energy), _MAX_END_DEVIATION**2
            )
        return float(np.sqrt(length_variance))

    def _weight_residual(self, voltage_residual: np.ndarray) -> np.ndarray:
        weighted_residual = (self.weights * voltage_residual.T).T
        return weighted_residual - np.multiply.outer(self.drift_direction, self.drift_direction @ weighted_residual)

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
        conductivity_change = self._conductivity_change(unknowns)
        difference_steps = np.full(len(unknowns) - 1, _DERIVATIVE_STEP)
        difference_steps[: 2 if len(unknowns) == 5 else -1] *= self.skin_size
        change_derivatives = []
        for unknown_index, difference_step in enumerate(difference_steps):
            shifted_unknowns = unknowns.copy()
            shifted_unknowns[unknown_index] += difference_step
            change_derivatives.append(
                (self._conductivity_change(shifted_unknowns) - conductivity_change) / difference_step
            )
        impedance, impedance_derivatives = self.region.derivatives(conductivity_change, change_derivatives)
        residual_derivatives = np.column_stack(
            [
                *(self._channel_voltages(derivative) for derivative in impedance_derivatives),
                self._channel_voltages(impedance) - self.rest_voltages,
            ]
        )
        residual_derivatives[:, :-1] *= 1 + unknowns[-1]
        prior_derivatives = np.zeros(len(unknowns))
        prior_derivatives[-1] = 1 / _COMMON_FACTOR_DEVIATION
        return np.concatenate([self._weight_residual(residual_derivatives), prior_derivatives[None]])

    def _conductivity_change(self, unknowns: np.ndarray) -> np.ndarray:
        """Compute the change of conductivity in the cells of the region: scalars for a spot, tensors (cells, d, d) in d
        dimensions for a cut."""
        if len(unknowns) == 5:
            return self.conductivity * np.expm1(self._log_fractions_in_spot(unknowns))
        remaining_fractions, cut_normals = self._fractions_across_cut(unknowns)
        conductivity_tensors = np.zeros((len(remaining_fractions), self.dimension, self.dimension))
        changed_cells = np.flatnonzero(remaining_fractions != 1)  # few of the region's cells
        x, y = cut_normals[changed_cells].T
        conductivity_change = self.conductivity[changed_cells] * (remaining_fractions[changed_cells] - 1)
        conductivity_tensors[changed_cells, 0, 0], conductivity_tensors[changed_cells, 1, 1] = (
            conductivity_change * x * x,
            conductivity_change * y * y,
        )
        conductivity_tensors[changed_cells, 0, 1] = conductivity_tensors[changed_cells, 1, 0] = (
            conductivity_change * x * y
        )
        return conductivity_tensors

    def _log_fractions_in_spot(self, unknowns: np.ndarray) -> np.ndarray:
        """Compute the logarithm of the fraction of each cell's conductivity that remains in a spot."""
        squared_distances = (
            np.sum((self.centres - unknowns[:2]) ** 2, axis=1) / (np.exp(unknowns[2]) * self.skin_size) ** 2
        )
        return -unknowns[3] * np.where(squared_distances < _SPOT_CUTOFF_RADII**2, np.exp(-squared_distances / 2), 0.0)

    def _fractions_across_cut(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the fraction of each cell's conductivity that remains across the nearest segment of a path, and the
        direction (cells, 2) across the segment."""
        cut_path = unknowns[:-2].reshape(-1, 2)
        segment_starts, segment_directions = cut_path[:-1], np.diff(cut_path, axis=0)
        segment_lengths = np.maximum(np.linalg.norm(segment_directions, axis=1), 1e-9)
        segment_directions = segment_directions / segment_lengths[:, None]
        segment_normals = np.column_stack([-segment_directions[:, 1], segment_directions[:, 0]])
        # Coordinates are multiplied one by one: sums over an axis of two elements take several times as long.
        x_offsets, y_offsets = (self.centres[:, i, None] - segment_starts[:, i] for i in (0, 1))  # (cells, segments)
        positions_on_path = x_offsets * segment_directions[:, 0] + y_offsets * segment_directions[:, 1]
        positions_across = x_offsets * segment_normals[:, 0] + y_offsets * segment_normals[:, 1]
        # The band reaches beyond the ends of its centre line, which is shortened so that the band ends with the path.
        end_shortening = np.minimum(self.band_half_width / _CUT_END_NARROWING, 0.45 * segment_lengths)
        first_positions, last_positions = np.zeros(len(segment_lengths)), segment_lengths.copy()
        first_positions[0] += end_shortening[0]
        last_positions[-1] -= end_shortening[-1]
        distances_beyond_ends = _CUT_END_NARROWING * (
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
        return 1 / (1 + np.exp(unknowns[-2]) * self.skin_size * profile_across_path), segment_normals[nearest_segments]

    def _conductivity_on_mesh(self, unknowns: np.ndarray) -> np.ndarray:
        """Compute the conductivity with the fitted loss on the mesh of the model before refinement, one value for each
        cell."""
        # Conductivity is lost across a path, not along the path: the geometric mean of both directions is used.
        log_fractions = (
            self._log_fractions_in_spot(unknowns)
            if len(unknowns) == 5
            else 0.5 * np.log(self._fractions_across_cut(unknowns)[0])
        )
        return self.model_conductivity * np.exp(
            np.bincount(self.parents, log_fractions, len(self.model_conductivity)) / self.cells_per_parent
        )
