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
    measured, used = check_frame(model, voltages, mask)
    check_has_values("reconstruct_shapes", (model, measured), "bodies are chosen by comparison", "take reconstruct")
    check_flat(model.mesh, "star shapes")
    background = np.asarray(check_background(model, background))
    deviation = check_noise(noise, measured, used)
    bodies_type, prior_type = (Stars, StarPrior) if model.mesh.dimension == 2 else (Ellipsoids, EllipsoidPrior)
    prior = prior_type() if prior is None else prior
    check_kind("prior", prior, prior_type, f"one of bodies of that dimension, such as {prior_type.__name__}(modes=2)")
    if not (is_number(least_rise) and least_rise >= 1):
        raise ValueError(f"least_rise must be a number from 1; it is {describe(least_rise)}.")
    sign, centre, radius = _check_start(start, model.mesh.dimension)
    independent_model, data = independent_data(model, measured, used, deviation, at_once=True)
    is_solid = model.mesh.dimension == 3
    problem = ShapeProblem(independent_model, data, background, COARSE_TOLERANCE if is_solid else ShapeProblem.rtol)
    bodies = bodies_type.create(model.mesh, prior, centre, sign)
    coefficients = bodies.of_radii(radius)
    if isinstance(prior, EllipsoidPrior) and prior.kinds == "columns":
        bodies, coefficients = bodies.with_other_kind(range(len(radius)), coefficients)
    if smooth is None:
        other_changes = MovedElectrodes.create(problem, 0.0 if accuracy is None else accuracy.movement)
    else:
        other_changes = SmoothField.create(smooth, problem)
    setting = _FitSetting(problem, other_changes)
    finer_model, report = None, progress or (lambda stage: None)
    report("bodies")
    states = []
    if smooth is None:
        states.append(_fit_bodies(setting, 0.0, bodies, coefficients, least_rise))
    if other_changes is not None:
        level, ball_fit, _ = _add_bodies(setting, *bodies.with_modes(1, coefficients))
        bodies_with_modes = ball_fit.bodies.with_modes(prior.modes, ball_fit.coefficients)
        states.append(_fit_bodies(setting, level, *bodies_with_modes, least_rise))
    state = min(states, key=lambda state: state.negative_log_evidence)
    if is_solid:
        state, finer_model = _refine_meshes(state, least_rise, report)
        report("bodies, of which kind")
    else:
        report("bodies, how many")
        state = state._replace(found=improve_fit(setting.problem(state.level), state.found, least_rise))
    (setting, level, (free_fit, objective_ratios, doubtful)), other_changes = state, state.setting.other_changes
    problem = setting.problem(level)
    fitted = _with_common_contrast(problem, free_fit)
    bodies, coefficients = fitted.bodies, fitted.coefficients
    field = 0.0 if other_changes is None else other_changes.conductivity(level, fitted)
    mesh_bodies = bodies.on(model.mesh) if isinstance(bodies, Ellipsoids) else bodies
    conductivity = background * np.exp(mesh_bodies.display_image(coefficients) + field)
    predicted, image = np.asarray(model.voltages(conductivity if finer_model is None else background)), None
    if finer_model is not None:
        predicted = predicted + finer_model.change(model.protocol, bodies.image(coefficients).image, field)
        image = FinerImage(
            finer_model.problem.model, as_array(finer_model.conductivity(bodies.display_image(coefficients), field))
        )
    if other_changes is not None:
        predicted = predicted + other_changes.voltages(level, fitted, model.protocol)
    alternative_bodies, deviations = alternatives(problem, fitted), contrast_deviations(problem, fitted, free_fit)
    normalised_residual = ((predicted - np.asarray(measured)) / np.asarray(deviation))[used]
    order = np.argsort(-np.asarray(objective_ratios), kind="stable")
    bodies_of_fit = [bodies.body(int(k), coefficients, objective_ratios[k]) for k in order]
    if accuracy is not None:
        report("bodies, how large and how strong")
        exact_data = independent_data(model, measured, used, accuracy.noise, at_once=True)[1]
        mesh_correction = setting.bodies_problem.data.voltages - data.voltages  # due to the finer mesh
        exact_data = eqx.tree_at(lambda data: data.voltages, exact_data, exact_data.voltages + mesh_correction)
        unmodelled = unmodelled_deviations(problem, fitted, free_fit)
        quantities = with_quantities(setting.weighted(exact_data).problem(level), fitted, accuracy, unmodelled, order)
        quantities = [
            include_deviation(values, body, *alternative_bodies[k])
            for values, body, k in zip(quantities, bodies_of_fit, order, strict=True)
        ]
        bodies_of_fit = [body.with_quantities(values) for body, values in zip(bodies_of_fit, quantities, strict=True)]
    return ShapeReconstruction(
        bodies=tuple(bodies_of_fit),
        conductivity=as_array(conductivity),
        voltages=as_array(predicted),
        misfit=as_array(np.sqrt(np.mean(normalised_residual**2))),
        drift=float(np.expm1(prior.drift * coefficients[0])),
        doubtful=doubtful,
        contrast_deviations=tuple(deviations[k] for k in order),
        alternatives=tuple(alternative_bodies[k][0] for k in order),
        alternative_deviations=tuple(alternative_bodies[k][1] for k in order),
        finer=image,
    )


def _check_start(start, dimension: int):
    """Signs (k,), centres (k, d) and radii (k,) of the bodies `start`. Raises `ValueError` for invalid starts."""
    try:
        sign = np.array([body[0] for body in start], float)
        centre = np.array([body[1] for body in start], float).reshape(-1, dimension)
        radius = np.array([body[2] for body in start], float)
    except (TypeError, ValueError, IndexError) as error:
        coordinates = "x, y, z"[: 3 * dimension - 2]
        raise ValueError(f"start: give (sign, ({coordinates}), radius), metres, for every body.") from error
    if not (np.isin(sign, (-1, 1)).all() and np.isfinite(centre).all() and (radius > 0).all()):
        raise ValueError("start: signs are +1 or -1, centres finite and radii positive, metres.")
    return sign, centre, radius


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
            fitted = problem.fit(bodies, coefficients, steps, COARSE_TOLERANCE)
            best_level = level if self.other_changes is None else self.other_changes.most_likely_level(fitted)
            if best_level >= level:
                return level, fitted, problem.negative_log_evidence(fitted) + problem.half_log_determinant
            level, coefficients = best_level, fitted.coefficients


def _add_bodies(
    setting: _FitSetting, bodies: Bodies, coefficients, num_certain_bodies: int = 0
) -> tuple[float, ShapeFit, list[int]]:
    """Add bodies one by one to other changes, and retain each body that the data support in addition to earlier ones.

    Returns the level of the other changes, the fit, and the indices of the retained bodies. The first
    `num_certain_bodies` are beyond doubt and are fitted together, because one of two bodies, fitted alone, would move
    to a place between the two.
    """
    rows = bodies.rows(coefficients)
    supported_indices, num_refused = list(range(num_certain_bodies)), 0
    start = np.append(coefficients[0], rows[:num_certain_bodies])
    level, fit, min_surprise = setting.fit_level(bodies.subset(supported_indices), start, 1.0, _NUM_FIRST_STEPS)
    for k in range(num_certain_bodies, len(rows)):
        start = np.append(fit.coefficients, rows[k])
        new_level, new_fit, surprise = setting.fit_level(
            bodies.subset([*supported_indices, k]), start, level, _NUM_FIRST_STEPS
        )
        if surprise + MIN_EVIDENCE_GAIN <= min_surprise:
            level, fit, min_surprise, supported_indices, num_refused = (
                new_level,
                new_fit,
                surprise,
                [*supported_indices, k],
                0,
            )
        elif (num_refused := num_refused + 1) == _MAX_UNSUPPORTED_STARTS:
            break
    return level, fit, supported_indices


class _SearchState(NamedTuple):
    """State of the search: result `found` of fitting the bodies in a `setting`, with other changes at their
    `level`."""

    setting: _FitSetting
    level: float
    found: SearchResult

    @property
    def negative_log_evidence(self) -> float:
        """Negative log evidence of the bodies and of the level, up to a constant."""
        problem = self.setting.problem(self.level)
        return problem.negative_log_evidence(self.found.fit) + problem.half_log_determinant


def _fit_bodies(setting: _FitSetting, level: float, bodies: Bodies, coefficients, least_rise: float) -> _SearchState:
    """Fit all bodies together, with other changes at their `level`, and remove those that are not supported."""
    problem = setting.problem(level)
    fitted = problem.fit(*grow_bodies(problem, bodies, coefficients, _NUM_FIRST_STEPS), STEPS)
    return _SearchState(setting, level, remove_unsupported(problem, fitted, (), least_rise))


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
    for refinement in range(_MAX_REFINEMENTS):
        _, level, (last_fit, objective_ratios, doubtful) = state
        if not len(last_fit.bodies.sign):
            break
        report(f"bodies, finer mesh {refinement + 1}")
        finer_model = refine_at_surfaces(
            base_setting.bodies_problem, last_fit, _RELATIVE_EDGE_LENGTHS_BY_REFINEMENT[refinement > 0]
        )
        setting, bodies, coefficients = (
            base_setting.on(finer_model.problem),
            finer_model.bodies,
            last_fit.coefficients,
        )
        costs = np.array(objective_ratios) * last_fit.cost
        if refinement:
            level, fit, _ = setting.fit_level(bodies, coefficients, level, STEPS)
        else:
            order = np.argsort(-costs)
            start = np.append(coefficients[0], bodies.rows(coefficients)[order])
            num_certain_bodies = int((costs > CERTAIN_OBJECTIVE_RATIO * last_fit.cost).sum())
            level, fit, supported_indices = _add_bodies(setting, bodies.subset(order), start, num_certain_bodies)
            unsupported_indices = np.setdiff1d(np.arange(len(order)), supported_indices)
            doubtful = (
                *doubtful,
                *(bodies.body(k, coefficients, objective_ratios[k]) for k in order[unsupported_indices]),
            )
            costs = costs[order[supported_indices]]
            coefficients = np.append(coefficients[0], bodies.rows(coefficients)[order[supported_indices]])
        problem = setting.problem(level)
        fit = problem.fit(fit.bodies, fit.coefficients, STEPS)
        result = remove_unsupported(problem, fit, doubtful, least_rise, costs)
        if refinement == 0:
            report("bodies, how many")
            result = improve_fit(problem, result, least_rise)
        elif refinement < _MAX_REFINEMENTS - 1:
            result, other_fit = alternative_fits(problem, result)
            if other_fit is not None:
                result = remove_unsupported(problem, other_fit, result.doubtful, least_rise)
        state, new_fit = _SearchState(setting, level, result), result.fit
        if refinement and not bodies.left_refined_cells(coefficients, new_fit.bodies, new_fit.coefficients):
            break
    return state, finer_model


def _with_common_contrast(problem: ShapeProblem, fitted: ShapeFit) -> ShapeFit:
    """Fit one material for all ellipsoids of a sign, if this is likelier than a material for each ellipsoid."""
    for sign in (1, -1):
        bodies = fitted.bodies
        if isinstance(bodies, Ellipsoids) and ((bodies.sign == sign) & ~bodies.same_material).sum() > 1:
            common_fit = problem.fit(*bodies.of_one_material(sign, fitted.coefficients), STEPS)
            fitted = min(fitted, common_fit, key=problem.negative_log_evidence)
    return fitted
