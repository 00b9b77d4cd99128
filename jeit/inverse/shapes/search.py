"""Search for the bodies, including their number, that explain a frame of voltages (`reconstruct_shapes`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_has_values, check_kind, describe, is_number
from jeit.forward import ForwardModel
from jeit.inverse.channels import Data
from jeit.inverse.nonlinear.problem import check_background, check_frame, check_noise, independent_data
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.shapes.alternatives import alternatives, contrast_deviations, unmodelled_deviations
from jeit.inverse.shapes.bodies import Bodies, BodyPrior
from jeit.inverse.shapes.ellipsoid import EllipsoidPrior, Ellipsoids
from jeit.inverse.shapes.number_and_kinds import (
    CERTAIN_OBJECTIVE_RATIO,
    COARSE_TOLERANCE,
    MIN_EVIDENCE_GAIN,
    STEPS,
    SearchResult,
    alternative_fits,
    grow_bodies,
    improve_fit,
    remove_unsupported,
)
from jeit.inverse.shapes.problem import MovedElectrodes, OtherChanges, ShapeFit, ShapeProblem, SmoothField
from jeit.inverse.shapes.quantities import Accuracy, include_deviation, with_quantities
from jeit.inverse.shapes.reconstruction import FinerImage, ShapeReconstruction
from jeit.inverse.shapes.star import StarPrior, Stars
from jeit.mesh import check_flat
from jeit_solvers import one_thread_of_blas
from jeit_solvers.engines import as_array

if TYPE_CHECKING:
    from jeit.inverse.shapes.finer_mesh import FinerModel

# A body is a ghost if the objective rises by less than this factor when the body is left out and all other bodies are
# fitted again.
MIN_OBJECTIVE_RATIO = 1.4
_NUM_FIRST_STEPS = 15
# Number of successive starts that the data do not support, after which the remaining, weaker starts are not tried.
_MAX_UNSUPPORTED_STARTS = 2
# Maximum number of times that the mesh is refined at the bodies, which move as a result. Edge lengths on the bodies'
# surfaces, in units of the shortest half axis, that are tried in turn: in the first refinement, when some bodies may
# still be ghosts (false bodies), and in later refinements.
_MAX_REFINEMENTS, _RELATIVE_EDGE_LENGTHS_BY_REFINEMENT = 3, ((0.7,), (0.7, 0.5, 0.35, 0.25))


@one_thread_of_blas()  # several threads would only wait for each other in its small products
def reconstruct_shapes(
    model: ForwardModel,
    voltages: Float[Array, " M"],
    background: ArrayLike,
    *,
    start: Sequence[tuple[int, Sequence[float], float]],
    noise: Float[Array, " M"] | float | None = None,
    mask: Bool[Array, " M"] | None = None,
    prior: BodyPrior | None = None,
    least_rise: float = MIN_OBJECTIVE_RATIO,
    smooth: Reconstruction | None = None,
    accuracy: Accuracy | None = None,
    progress: Callable[[str], None] | None = None,
) -> ShapeReconstruction:
    """Estimate the bodies (star shapes in a sheet, ellipsoids in a solid) that explain measured voltages.

    All bodies are first fitted together, as disks or balls of high contrast. Then each body in turn is left out and all
    other bodies are fitted again; the body whose absence raises the objective least is removed, as long as the rise is
    small. This removal eliminates ghosts (false bodies) due to model errors and missing electrodes, because other
    bodies can take the place of a ghost. Remaining bodies are split in two, or changed to the other kind (a weak star,
    or a column from floor to lid), if the evidence (`ShapeProblem.surprise`) favours this change. The search is run
    twice, once starting with a split and once with a change of kind, and the better result is returned.

    **Arguments:**

    - `model`: the forward model.
    - `voltages` (M,): measured voltages, volts.
    - `background`: conductivity of the bath without bodies, one number or (m,), S/m (2-D: S); its drift is estimated.
    - `start`: sign, centre (x, y) or (x, y, z) and radius, in metres, of every possible body, for example of all
      inclusions of an image. Starts without a body do no harm, and two bodies at one start are separated, but no body
      is added without a start.
    - `noise`, `mask`: as in `jeit.inverse.reconstruct`.
    - `prior`: default `StarPrior()` for sheets, `EllipsoidPrior()` for solids.
    - `least_rise`: a body is a ghost if the objective without it rises by less than this factor, or if the evidence
      does not favour it.
    - `smooth`: an image reconstructed from the same channels with a smooth prior and no bounds. Changes of conductivity
      besides the bodies are then modelled as a `SmoothField`, whose level is chosen by the evidence, and only bodies
      that are detected in addition to this field are fitted.
    - `accuracy`: errors of the data, used in place of `noise` to estimate the `quantities` of each body. None: no
      quantities. In a sheet without a `smooth` image, changes of its edge's electrodes (`Accuracy.movement`) are
      modelled in addition to the bodies, as far as the evidence supports them.
    - `progress`: function called with the name of each stage as it begins. Stages take up to a minute in a solid.

    Raises `ValueError` for invalid or inconsistent arguments, and if `smooth` is not an image of the same channels with
    a smooth prior.

    Kolehmainen, Arridge, Lionheart, Vauhkonen and Kaipio, Inverse Problems 15 (1999) 1375, describe boundaries by
    Fourier coefficients; the choice of bodies by evidence is jeit's own.

    **Example:**

    ```python
    found = reconstruct_shapes(model, voltages, 1.0, start=[(1, (0.04, 0.0), 0.03)])
    [body.centroid for body in found.bodies]
    ```
    """
    measured_voltages, is_used_channel = check_frame(model, voltages, mask)
    check_has_values(
        "reconstruct_shapes", (model, measured_voltages), "bodies are chosen by comparison", "take reconstruct"
    )
    check_flat(model.mesh, "star shapes")
    background = np.asarray(check_background(model, background))
    noise_deviation = check_noise(noise, measured_voltages, is_used_channel)
    bodies_type, prior_type = (Stars, StarPrior) if model.mesh.dimension == 2 else (Ellipsoids, EllipsoidPrior)
    prior = prior_type() if prior is None else prior
    check_kind("prior", prior, prior_type, f"one of bodies of that dimension, such as {prior_type.__name__}(modes=2)")
    if not (is_number(least_rise) and least_rise >= 1):
        raise ValueError(f"least_rise must be a number from 1; it is {describe(least_rise)}.")
    signs_of_bodies, centre, radius = _check_start(start, model.mesh.dimension)
    independent_model, independent_voltages = independent_data(
        model, measured_voltages, is_used_channel, noise_deviation, at_once=True
    )
    is_solid = model.mesh.dimension == 3
    problem = ShapeProblem(
        independent_model, independent_voltages, background, COARSE_TOLERANCE if is_solid else ShapeProblem.rtol
    )
    bodies = bodies_type.create(model.mesh, prior, centre, signs_of_bodies)
    coefficients = bodies.of_radii(radius)
    if isinstance(prior, EllipsoidPrior) and prior.kinds == "columns":
        bodies, coefficients = bodies.with_other_kind(range(len(radius)), coefficients)
    if smooth is None:
        other_changes = MovedElectrodes.create(problem, 0.0 if accuracy is None else accuracy.movement)
    else:
        other_changes = SmoothField.create(smooth, problem)
    fit_setting = _FitSetting(problem, other_changes)
    finer_model, report_stage = None, progress or (lambda stage_name: None)
    report_stage("bodies")
    search_states = []
    if smooth is None:
        search_states.append(_fit_bodies(fit_setting, 0.0, bodies, coefficients, least_rise))
    if other_changes is not None:
        level, ball_fit, _ = _add_bodies(fit_setting, *bodies.with_modes(1, coefficients))
        bodies_with_modes = ball_fit.bodies.with_modes(prior.modes, ball_fit.coefficients)
        search_states.append(_fit_bodies(fit_setting, level, *bodies_with_modes, least_rise))
    search_state = min(search_states, key=lambda search_state: search_state.negative_log_evidence)
    if is_solid:
        search_state, finer_model = _refine_meshes(search_state, least_rise, report_stage)
        report_stage("bodies, of which kind")
    else:
        report_stage("bodies, how many")
        search_state = search_state._replace(
            search_result=improve_fit(fit_setting.problem(search_state.level), search_state.search_result, least_rise)
        )
    (fit_setting, level, (free_fit, objective_ratios, doubtful_bodies)), other_changes = (
        search_state,
        search_state.setting.other_changes,
    )
    problem = fit_setting.problem(level)
    common_contrast_fit = _with_common_contrast(problem, free_fit)
    bodies, coefficients = common_contrast_fit.bodies, common_contrast_fit.coefficients
    smooth_field = 0.0 if other_changes is None else other_changes.conductivity(level, common_contrast_fit)
    mesh_bodies = bodies.on(model.mesh) if isinstance(bodies, Ellipsoids) else bodies
    conductivity = background * np.exp(mesh_bodies.display_image(coefficients) + smooth_field)
    predicted_voltages, image = np.asarray(model.voltages(conductivity if finer_model is None else background)), None
    if finer_model is not None:
        predicted_voltages = predicted_voltages + finer_model.change(
            model.protocol, bodies.image(coefficients).image, smooth_field
        )
        image = FinerImage(
            finer_model.problem.model,
            as_array(finer_model.conductivity(bodies.display_image(coefficients), smooth_field)),
        )
    if other_changes is not None:
        predicted_voltages = predicted_voltages + other_changes.voltages(level, common_contrast_fit, model.protocol)
    alternative_bodies, deviations_of_contrast = (
        alternatives(problem, common_contrast_fit),
        contrast_deviations(problem, common_contrast_fit, free_fit),
    )
    normalised_residual = ((predicted_voltages - np.asarray(measured_voltages)) / np.asarray(noise_deviation))[
        is_used_channel
    ]
    order_by_support = np.argsort(-np.asarray(objective_ratios), kind="stable")
    bodies_of_fit = [bodies.body(int(k), coefficients, objective_ratios[k]) for k in order_by_support]
    if accuracy is not None:
        report_stage("bodies, how large and how strong")
        exact_data = independent_data(model, measured_voltages, is_used_channel, accuracy.noise, at_once=True)[1]
        # Due to the finer mesh.
        mesh_correction = fit_setting.bodies_problem.data.voltages - independent_voltages.voltages
        exact_data = eqx.tree_at(
            lambda independent_voltages: independent_voltages.voltages,
            exact_data,
            exact_data.voltages + mesh_correction,
        )
        unmodelled_contrast_deviations = unmodelled_deviations(problem, common_contrast_fit, free_fit)
        quantities_of_bodies = with_quantities(
            fit_setting.weighted(exact_data).problem(level),
            common_contrast_fit,
            accuracy,
            unmodelled_contrast_deviations,
            order_by_support,
        )
        quantities_of_bodies = [
            include_deviation(body_quantities, body, *alternative_bodies[k])
            for body_quantities, body, k in zip(quantities_of_bodies, bodies_of_fit, order_by_support, strict=True)
        ]
        bodies_of_fit = [
            body.with_quantities(body_quantities)
            for body, body_quantities in zip(bodies_of_fit, quantities_of_bodies, strict=True)
        ]
    return ShapeReconstruction(
        bodies=tuple(bodies_of_fit),
        conductivity=as_array(conductivity),
        voltages=as_array(predicted_voltages),
        misfit=as_array(np.sqrt(np.mean(normalised_residual**2))),
        drift=float(np.expm1(prior.drift * coefficients[0])),
        doubtful=doubtful_bodies,
        contrast_deviations=tuple(deviations_of_contrast[k] for k in order_by_support),
        alternatives=tuple(alternative_bodies[k][0] for k in order_by_support),
        alternative_deviations=tuple(alternative_bodies[k][1] for k in order_by_support),
        finer=image,
    )


def _check_start(start, dimension: int):
    """Signs (k,), centres (k, d) and radii (k,) of the bodies `start`. Raises `ValueError` for invalid starts."""
    try:
        signs_of_bodies = np.array([body[0] for body in start], float)
        centre = np.array([body[1] for body in start], float).reshape(-1, dimension)
        radius = np.array([body[2] for body in start], float)
    except (TypeError, ValueError, IndexError) as error:
        names_of_coordinates = "x, y, z"[: 3 * dimension - 2]
        raise ValueError(f"start: give (sign, ({names_of_coordinates}), radius), metres, for every body.") from error
    if not (np.isin(signs_of_bodies, (-1, 1)).all() and np.isfinite(centre).all() and (radius > 0).all()):
        raise ValueError("start: signs are +1 or -1, centres finite and radii positive, metres.")
    return signs_of_bodies, centre, radius


class _FitSetting(NamedTuple):
    """Setting in which bodies are fitted: the problem of bodies alone, and other changes besides the bodies, or None if
    there are none."""

    bodies_problem: ShapeProblem
    other_changes: OtherChanges | None

    def problem(self, level: float) -> ShapeProblem:
        """The problem of bodies, with other changes of this `level` if there are any."""
        return self.bodies_problem if self.other_changes is None else self.other_changes.problem_at(level)

    def on(self, bodies_problem: ShapeProblem) -> _FitSetting:
        """Copy of the setting with the problem `bodies_problem` on another mesh."""
        return _FitSetting(
            bodies_problem, self.other_changes and replace(self.other_changes, bodies_problem=bodies_problem)
        )

    def weighted(self, data: Data) -> _FitSetting:
        """Copy of the setting with the weights and errors of `data`."""
        bodies_problem, other_changes = replace(self.bodies_problem, data=data), self.other_changes
        if other_changes is not None:
            weight_ratio = np.asarray(data.weight) / np.asarray(self.bodies_problem.data.weight)
            other_changes = replace(
                other_changes, jacobian=weight_ratio[:, None] * other_changes.jacobian, bodies_problem=bodies_problem
            )
        return _FitSetting(bodies_problem, other_changes)

    def fit_level(self, bodies: Bodies, coefficients, level: float, steps: int) -> tuple[float, ShapeFit, float]:
        """Alternate between fitting the bodies and lowering the level of other changes, until no lower one is likelier.

        Returns the level, the fit of the bodies and -log evidence. The level decreases from `level`, because bodies
        fitted with too low a level would be distorted to explain other changes.
        """
        while True:
            problem = self.problem(level)
            shape_fit = problem.fit(bodies, coefficients, steps, COARSE_TOLERANCE)
            best_level = level if self.other_changes is None else self.other_changes.most_likely_level(shape_fit)
            if best_level >= level:
                return level, shape_fit, problem.negative_log_evidence(shape_fit) + problem.half_log_determinant
            level, coefficients = best_level, shape_fit.coefficients


def _add_bodies(
    setting: _FitSetting, bodies: Bodies, coefficients, num_certain_bodies: int = 0
) -> tuple[float, ShapeFit, list[int]]:
    """Add bodies one by one to other changes, and retain each body that the data support in addition to earlier ones.

    Returns the level of the other changes, the fit, and the indices of the retained bodies. The first
    `num_certain_bodies` are beyond doubt and are fitted together, because one of two bodies, fitted alone, would move
    to a place between the two.
    """
    coefficient_rows = bodies.rows(coefficients)
    supported_indices, num_refused = list(range(num_certain_bodies)), 0
    start_coefficients = np.append(coefficients[0], coefficient_rows[:num_certain_bodies])
    level, shape_fit, min_negative_log_evidence = setting.fit_level(
        bodies.subset(supported_indices), start_coefficients, 1.0, _NUM_FIRST_STEPS
    )
    for k in range(num_certain_bodies, len(coefficient_rows)):
        start_coefficients = np.append(shape_fit.coefficients, coefficient_rows[k])
        new_level, new_fit, negative_log_evidence = setting.fit_level(
            bodies.subset([*supported_indices, k]), start_coefficients, level, _NUM_FIRST_STEPS
        )
        if negative_log_evidence + MIN_EVIDENCE_GAIN <= min_negative_log_evidence:
            level, shape_fit, min_negative_log_evidence, supported_indices, num_refused = (
                new_level,
                new_fit,
                negative_log_evidence,
                [*supported_indices, k],
                0,
            )
        elif (num_refused := num_refused + 1) == _MAX_UNSUPPORTED_STARTS:
            break
    return level, shape_fit, supported_indices


class _SearchState(NamedTuple):
    """State of the search: `search_result` of fitting the bodies in a `setting`, with other changes at their
    `level`."""

    setting: _FitSetting
    level: float
    search_result: SearchResult

    @property
    def negative_log_evidence(self) -> float:
        """Negative log evidence of the bodies and of the level, up to a constant."""
        problem = self.setting.problem(self.level)
        return problem.negative_log_evidence(self.search_result.fit) + problem.half_log_determinant


def _fit_bodies(setting: _FitSetting, level: float, bodies: Bodies, coefficients, least_rise: float) -> _SearchState:
    """Fit all bodies together, with other changes at their `level`, and remove those that are not supported."""
    problem = setting.problem(level)
    shape_fit = problem.fit(*grow_bodies(problem, bodies, coefficients, _NUM_FIRST_STEPS), STEPS)
    return _SearchState(setting, level, remove_unsupported(problem, shape_fit, (), least_rise))


def _refine_meshes(
    state: _SearchState, least_rise: float, report: Callable[[str], None]
) -> tuple[_SearchState, FinerModel | None]:
    """Fit the bodies on meshes refined at their surfaces, until the surfaces stay within the refined cells.

    Ghosts due to the coarse mesh are removed. The number and kinds of the bodies are determined on the first refined
    mesh, because on the coarse mesh further bodies would explain its errors. Returns the state and the last refined
    problem, which is None if there are no bodies.
    """
    from jeit.inverse.shapes.finer_mesh import refine_at_surfaces

    base_setting, finer_model = state.setting, None
    for refinement_index in range(_MAX_REFINEMENTS):
        _, level, (last_fit, objective_ratios, doubtful) = state
        if not len(last_fit.bodies.sign):
            break
        report(f"bodies, finer mesh {refinement_index + 1}")
        finer_model = refine_at_surfaces(
            base_setting.bodies_problem, last_fit, _RELATIVE_EDGE_LENGTHS_BY_REFINEMENT[refinement_index > 0]
        )
        refined_setting, bodies, coefficients = (
            base_setting.on(finer_model.problem),
            finer_model.bodies,
            last_fit.coefficients,
        )
        costs_without_body = np.array(objective_ratios) * last_fit.cost
        if refinement_index:
            level, shape_fit, _ = refined_setting.fit_level(bodies, coefficients, level, STEPS)
        else:
            order_by_cost = np.argsort(-costs_without_body)
            start_coefficients = np.append(coefficients[0], bodies.rows(coefficients)[order_by_cost])
            num_certain_bodies = int((costs_without_body > CERTAIN_OBJECTIVE_RATIO * last_fit.cost).sum())
            level, shape_fit, supported_indices = _add_bodies(
                refined_setting, bodies.subset(order_by_cost), start_coefficients, num_certain_bodies
            )
            unsupported_indices = np.setdiff1d(np.arange(len(order_by_cost)), supported_indices)
            doubtful = (
                *doubtful,
                *(bodies.body(k, coefficients, objective_ratios[k]) for k in order_by_cost[unsupported_indices]),
            )
            costs_without_body = costs_without_body[order_by_cost[supported_indices]]
            coefficients = np.append(coefficients[0], bodies.rows(coefficients)[order_by_cost[supported_indices]])
        problem = refined_setting.problem(level)
        shape_fit = problem.fit(shape_fit.bodies, shape_fit.coefficients, STEPS)
        search_result = remove_unsupported(problem, shape_fit, doubtful, least_rise, costs_without_body)
        if refinement_index == 0:
            report("bodies, how many")
            search_result = improve_fit(problem, search_result, least_rise)
        elif refinement_index < _MAX_REFINEMENTS - 1:
            search_result, other_fit = alternative_fits(problem, search_result)
            if other_fit is not None:
                search_result = remove_unsupported(problem, other_fit, search_result.doubtful, least_rise)
        state, new_fit = _SearchState(refined_setting, level, search_result), search_result.fit
        if refinement_index and not bodies.left_refined_cells(coefficients, new_fit.bodies, new_fit.coefficients):
            break
    return state, finer_model


def _with_common_contrast(problem: ShapeProblem, fitted: ShapeFit) -> ShapeFit:
    """Fit one material for all ellipsoids of a sign, if this is likelier than a material for each ellipsoid."""
    for contrast_sign in (1, -1):
        bodies = fitted.bodies
        if isinstance(bodies, Ellipsoids) and ((bodies.sign == contrast_sign) & ~bodies.same_material).sum() > 1:
            common_fit = problem.fit(*bodies.of_one_material(contrast_sign, fitted.coefficients), STEPS)
            fitted = min(fitted, common_fit, key=problem.negative_log_evidence)
    return fitted
