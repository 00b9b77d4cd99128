"""Search for the bodies, including their number, that explain a frame of voltages (`reconstruct_shapes`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
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
from jeit.inverse.shapes.bodies import Bodies, BodyPrior, results_for
from jeit.inverse.shapes.ellipsoid import (
    EllipsoidPrior,
    Ellipsoids,
    alternatives,
    contrast_deviations,
    unmodelled_deviations,
)
from jeit.inverse.shapes.problem import Fit, ShapeProblem, SmoothField
from jeit.inverse.shapes.quantities import Accuracy, include_deviation, with_quantities
from jeit.inverse.shapes.reconstruction import Body, FinerImage, ShapeReconstruction
from jeit.inverse.shapes.star import StarPrior, Stars
from jeit.mesh import check_flat
from jeit_solvers import one_thread_of_blas
from jeit_solvers.engines import as_array

if TYPE_CHECKING:
    from jeit.inverse.shapes.finer_mesh import FinerModel

# A body is a ghost if the objective rises by less than this factor when the body is left out and all other bodies are
# fitted again.
LEAST_RISE = 1.4
_FIRST_STEPS, _STEPS, _TRIAL_STEPS = 15, 40, 6
# Steps of the fit without a body: in all, and those after which the fit ends if the cost exceeds the cost at which the
# body is beyond doubt by more than this factor.
_REMOVAL_STEPS, _FIRST_REMOVAL_STEPS, _HOPELESS_RISE = 6, 3, 30.0
_COARSE_TOLERANCE = 1e-2
# Number of successive starts that the data do not support, after which the remaining, weaker starts are not tried.
_MAX_UNSUPPORTED = 2
# A body is beyond doubt if the objective without it is larger by more than this factor.
_CERTAIN_RISE = 10.0
# The data exclude a change of a body's kind if it raises the objective, after a few steps of the fit, by more than this
# factor: on finer meshes the factor increases, because the objective of the right kind decreases.
_EXCLUDED_RISE = 100.0
# Maximum number of changes of the number or kind of bodies in a search.
_MAX_CHANGES = 10
# Maximum number of times that the mesh is refined at the bodies, which move as a result. Edge lengths on the bodies'
# surfaces, in units of the shortest half axis, that are tried in turn: in the first refinement, when some bodies may
# still be ghosts (false bodies), and in later refinements.
_MAX_REFINEMENTS, _EDGE_LENGTHS = 3, ((0.7,), (0.7, 0.5, 0.35, 0.25))
# Minimum gain of log evidence with which a description of the bodies with more parameters is accepted.
_MIN_EVIDENCE_GAIN = 2.0


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
    least_rise: float = LEAST_RISE,
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
      quantities.
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
    form, prior_type = (Stars, StarPrior) if model.mesh.dimension == 2 else (Ellipsoids, EllipsoidPrior)
    prior = prior_type() if prior is None else prior
    check_kind("prior", prior, prior_type, f"one of bodies of that dimension, such as {prior_type.__name__}(modes=2)")
    if not (is_number(least_rise) and least_rise >= 1):
        raise ValueError(f"least_rise must be a number from 1; it is {describe(least_rise)}.")
    sign, centre, radius = _check_start(start, model.mesh.dimension)
    independent_model, data = independent_data(model, measured, used, deviation, at_once=True)
    is_solid = model.mesh.dimension == 3
    problem = ShapeProblem(independent_model, data, background, _COARSE_TOLERANCE if is_solid else ShapeProblem.rtol)
    bodies = form.create(model.mesh, prior, centre, sign)
    coefficients = bodies.of_radii(radius)
    if isinstance(prior, EllipsoidPrior) and prior.kinds == "columns":
        bodies, coefficients = bodies.with_other_kind(range(len(radius)), coefficients)
    setting = _FitSetting(problem, None if smooth is None else SmoothField.create(smooth, problem))
    level, report = 0.0, progress or (lambda stage: None)
    report("bodies")
    if smooth is not None:
        level, ball_fit, _ = _add_bodies(setting, *bodies.with_modes(1, coefficients))
        bodies, coefficients = ball_fit.bodies.with_modes(prior.modes, ball_fit.coefficients)
        problem = setting.problem(level)
    fitted = problem.fit(*_grow_bodies(problem, bodies, coefficients, _FIRST_STEPS), _STEPS)
    result = _remove_unsupported(problem, fitted, (), least_rise)
    state, finer_model = _SearchState(setting, level, result), None
    if is_solid:
        state, finer_model = _refine_meshes(state, least_rise, report)
        report("bodies, of which kind")
    else:
        report("bodies, how many")
        state = state._replace(found=_improve_fit(problem, result, least_rise))
    (setting, level, (free_fit, rises, doubtful)), smooth_field = state, state.setting.smooth_field
    problem = setting.problem(level)
    fitted = _with_common_contrast(problem, free_fit)
    bodies, coefficients = fitted.bodies, fitted.coefficients
    field = 0.0 if smooth_field is None else smooth_field.estimate(level, fitted)
    mesh_bodies = bodies.on(model.mesh) if isinstance(bodies, Ellipsoids) else bodies
    conductivity = background * np.exp(mesh_bodies.display_image(coefficients) + field)
    predicted, image = np.asarray(model.voltages(conductivity if finer_model is None else background)), None
    if finer_model is not None:
        predicted = predicted + finer_model.change(model.protocol, bodies.image(coefficients).image, field)
        image = FinerImage(
            finer_model.problem.model, as_array(finer_model.conductivity(bodies.display_image(coefficients), field))
        )
    alternates, deviations = alternatives(problem, fitted), contrast_deviations(problem, fitted, free_fit)
    normalised_residual = ((predicted - np.asarray(measured)) / np.asarray(deviation))[used]
    order = np.argsort(-np.asarray(rises), kind="stable")
    found_bodies = [bodies.body(int(k), coefficients, rises[k]) for k in order]
    if accuracy is not None:
        report("bodies, how large and how strong")
        exact_data = independent_data(model, measured, used, accuracy.noise, at_once=True)[1]
        mesh_correction = setting.bodies_problem.data.voltages - data.voltages  # due to the finer mesh
        exact_data = eqx.tree_at(lambda data: data.voltages, exact_data, exact_data.voltages + mesh_correction)
        unmodelled = unmodelled_deviations(problem, fitted, free_fit)
        quantities = with_quantities(setting.weighted(exact_data).problem(level), fitted, accuracy, unmodelled, order)
        quantities = [
            include_deviation(values, body, *alternates[k])
            for values, body, k in zip(quantities, found_bodies, order, strict=True)
        ]
        found_bodies = [body.with_quantities(values) for body, values in zip(found_bodies, quantities, strict=True)]
    return ShapeReconstruction(
        bodies=tuple(found_bodies),
        conductivity=as_array(conductivity),
        voltages=as_array(predicted),
        misfit=as_array(np.sqrt(np.mean(normalised_residual**2))),
        drift=float(np.expm1(prior.drift * coefficients[0])),
        doubtful=doubtful,
        contrast_deviations=tuple(deviations[k] for k in order),
        alternatives=tuple(alternates[k][0] for k in order),
        alternative_deviations=tuple(alternates[k][1] for k in order),
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


def _grow_bodies(problem: ShapeProblem, bodies: Bodies, coefficients, steps: int):
    """Fit the bodies as disks or balls, and return the bodies with all modes of their form, and their coefficients."""
    ball_fit = problem.fit(*bodies.with_modes(1, coefficients), steps, _COARSE_TOLERANCE)
    return ball_fit.bodies.with_modes(bodies.prior.modes, ball_fit.coefficients)


class _FitSetting(NamedTuple):
    """Setting in which bodies are fitted: the problem of bodies without a smooth field, and the smooth field, or None
    if there is none."""

    bodies_problem: ShapeProblem
    smooth_field: SmoothField | None

    def problem(self, level: float) -> ShapeProblem:
        """The problem of bodies, with the smooth field of this `level` if there is a field."""
        return self.bodies_problem if self.smooth_field is None else self.smooth_field.problem_at(level)

    def on(self, bodies_problem: ShapeProblem) -> _FitSetting:
        """Copy of the setting with the problem `bodies_problem` on another mesh."""
        return _FitSetting(
            bodies_problem, self.smooth_field and replace(self.smooth_field, bodies_problem=bodies_problem)
        )

    def weighted(self, data: Data) -> _FitSetting:
        """Copy of the setting with the weights and errors of `data`."""
        bodies_problem, smooth_field = replace(self.bodies_problem, data=data), self.smooth_field
        if smooth_field is not None:
            weight_ratio = np.asarray(data.weight) / np.asarray(self.bodies_problem.data.weight)
            smooth_field = replace(
                smooth_field, jacobian=weight_ratio[:, None] * smooth_field.jacobian, bodies_problem=bodies_problem
            )
        return _FitSetting(bodies_problem, smooth_field)

    def fit_level(self, bodies: Bodies, coefficients, level: float, steps: int) -> tuple[float, Fit, float]:
        """Alternate between fitting the bodies and lowering the smooth field's level, until no lower level is likelier.

        Returns the level, the fit of the bodies and -log evidence. The level decreases from `level`, because bodies
        fitted with too low a level would be distorted to explain changes that belong to the field.
        """
        while True:
            problem = self.problem(level)
            fitted = problem.fit(bodies, coefficients, steps, _COARSE_TOLERANCE)
            best_level = level if self.smooth_field is None else self.smooth_field.likeliest_level(fitted)
            if best_level >= level:
                return level, fitted, problem.surprise(fitted) + problem.half_log_determinant
            level, coefficients = best_level, fitted.coefficients


def _add_bodies(setting: _FitSetting, bodies: Bodies, coefficients, num_sure: int = 0) -> tuple[float, Fit, list[int]]:
    """Add bodies one by one to a smooth field, and retain each body that the data support in addition to earlier ones.

    Returns the level of the field, the fit, and the indices of the retained bodies. The first `num_sure` bodies are
    beyond doubt and are fitted together, because one of two bodies, fitted alone, would move to a place between the
    two.
    """
    rows = bodies.rows(coefficients)
    supported, num_refused = list(range(num_sure)), 0
    start = np.append(coefficients[0], rows[:num_sure])
    level, fit, min_surprise = setting.fit_level(bodies.subset(supported), start, 1.0, _FIRST_STEPS)
    for k in range(num_sure, len(rows)):
        start = np.append(fit.coefficients, rows[k])
        new_level, new_fit, surprise = setting.fit_level(bodies.subset([*supported, k]), start, level, _FIRST_STEPS)
        if surprise + _MIN_EVIDENCE_GAIN <= min_surprise:
            level, fit, min_surprise, supported, num_refused = new_level, new_fit, surprise, [*supported, k], 0
        elif (num_refused := num_refused + 1) == _MAX_UNSUPPORTED:
            break
    return level, fit, supported


class _SearchResult(NamedTuple):
    """Result of removing ghosts: `fit` of the remaining bodies, their `rises`, and the removed bodies, `doubtful`."""

    fit: Fit
    rises: list[float]
    doubtful: tuple[Body, ...]


class _SearchState(NamedTuple):
    """State of the search: result `found` of fitting the bodies in a `setting`, with the smooth field at its
    `level`."""

    setting: _FitSetting
    level: float
    found: _SearchResult


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
        _, level, (last_fit, rises, doubtful) = state
        if not len(last_fit.bodies.sign):
            break
        report(f"bodies, finer mesh {refinement + 1}")
        finer_model = refine_at_surfaces(base_setting.bodies_problem, last_fit, _EDGE_LENGTHS[refinement > 0])
        setting, bodies, coefficients = (
            base_setting.on(finer_model.problem),
            finer_model.bodies,
            last_fit.coefficients,
        )
        costs = np.array(rises) * last_fit.cost
        if refinement:
            level, fit, _ = setting.fit_level(bodies, coefficients, level, _STEPS)
        else:
            order = np.argsort(-costs)
            start = np.append(coefficients[0], bodies.rows(coefficients)[order])
            num_sure = int((costs > _CERTAIN_RISE * last_fit.cost).sum())
            level, fit, supported = _add_bodies(setting, bodies.subset(order), start, num_sure)
            unsupported = np.setdiff1d(np.arange(len(order)), supported)
            doubtful = (*doubtful, *(bodies.body(k, coefficients, rises[k]) for k in order[unsupported]))
            costs = costs[order[supported]]
            coefficients = np.append(coefficients[0], bodies.rows(coefficients)[order[supported]])
        problem = setting.problem(level)
        fit = problem.fit(fit.bodies, fit.coefficients, _STEPS)
        result = _remove_unsupported(problem, fit, doubtful, least_rise, costs)
        if refinement == 0:
            report("bodies, how many")
            result = _improve_fit(problem, result, least_rise)
        elif refinement < _MAX_REFINEMENTS - 1:
            result, other_fit = _alternative_fits(problem, result)
            if other_fit is not None:
                result = _remove_unsupported(problem, other_fit, result.doubtful, least_rise)
        state, new_fit = _SearchState(setting, level, result), result.fit
        if refinement and not bodies.left_refined_cells(coefficients, new_fit.bodies, new_fit.coefficients):
            break
    return state, finer_model


def _remove_unsupported(
    problem: ShapeProblem,
    fitted: Fit,
    doubtful: Sequence[Body],
    least_rise: float,
    min_costs: Float[np.ndarray, " k"] | None = None,
) -> _SearchResult:
    """Remove, one at a time, bodies without which the other bodies, fitted again, explain the data about as well. The
    body whose absence raises the cost least is removed first.

    `min_costs`: lower limit of the cost without each body, if known.
    """
    doubtful, costs = list(doubtful), np.zeros(len(fitted.bodies.sign)) if min_costs is None else min_costs.copy()
    while True:
        bodies, coefficients, cost, _ = fitted
        # After a ghost is removed, leaving out a further body raises the cost at least as much as before, so costs
        # computed earlier are lower limits.
        certain_cost = max(_CERTAIN_RISE * cost, problem.surprise(fitted) + _MIN_EVIDENCE_GAIN)
        uncertain = np.flatnonzero(costs <= certain_cost).tolist()
        starts = [bodies.without(k, coefficients) for k in uncertain]
        fits_without = results_for(bodies, partial(_fit_without, problem, certain_cost), starts)
        fits = dict(zip(uncertain, fits_without, strict=True))
        costs[uncertain] = [fit.cost for fit in fits_without]
        weakest = min(fits, key=lambda k: costs[k], default=None)
        if weakest is None or (costs[weakest] >= least_rise * cost and _is_supported(problem, fits[weakest], fitted)):
            return _SearchResult(fitted, list(costs / cost), tuple(doubtful))
        doubtful.append(bodies.body(weakest, coefficients, float(costs[weakest]) / cost))
        costs = np.delete(costs, weakest)
        fitted = problem.fit(fits[weakest].bodies, fits[weakest].coefficients, _STEPS)


def _fit_without(problem: ShapeProblem, certain_cost: float, start: tuple[Bodies, Float[np.ndarray, " n"]]) -> Fit:
    """Fit the remaining bodies from their coefficients `start`. The fit ends early if its cost remains far above
    `certain_cost`, at which the absent body is beyond doubt."""
    first_fit = problem.fit(*start, _FIRST_REMOVAL_STEPS, 2 * _COARSE_TOLERANCE)
    if first_fit.cost > _HOPELESS_RISE * certain_cost:
        return first_fit
    return problem.fit(first_fit.bodies, first_fit.coefficients, _REMOVAL_STEPS, 2 * _COARSE_TOLERANCE)


def _split_bodies(problem: ShapeProblem, fitted: Fit, least_rise: float) -> Fit | None:
    """Fit the bodies with one body split in two; None if the data support no split. Each body adds parameters, so no
    split is tried if the whole cost is less than the gain of evidence that it needs."""
    bodies, coefficients, cost, _ = fitted
    if cost < _MIN_EVIDENCE_GAIN:
        return None

    def trial(index: tuple[int, ...]) -> Fit:
        return _trial_fit(problem, _grow_bodies(problem, *bodies.split(index[0], coefficients, index[1]), _TRIAL_STEPS))

    trials = results_for(bodies, trial, list(np.ndindex(len(bodies.sign), bodies.num_splits)))
    split = _best_fit(problem, fitted, trials)
    return split if split and cost >= least_rise * split.cost and _is_supported(problem, fitted, split) else None


def _alternative_fits(problem: ShapeProblem, result: _SearchResult) -> tuple[_SearchResult, Fit | None]:
    """Fit the bodies with one or all of them changed to the other kind (weak star or column).

    Returns the `result`, with those bodies marked whose kind is certain, and the fit; None if the data support no
    change.
    """
    fitted = result.fit
    bodies = fitted.bodies
    can_change = ~bodies.is_other_kind & ~bodies.is_kind_certain & (not bodies.prior.is_of_one_kind)
    indices = np.flatnonzero(can_change)
    groups = [[k] for k in indices] + [indices] * (len(indices) > 1)
    trials = results_for(
        bodies, lambda group: _trial_fit(problem, bodies.with_other_kind(group, fitted.coefficients)), groups
    )
    is_kind_certain = bodies.is_kind_certain.copy()
    for k, trial in zip(indices, trials, strict=False):
        is_kind_certain[k] = trial.cost > _EXCLUDED_RISE * fitted.cost
    result = result._replace(fit=fitted._replace(bodies=replace(bodies, is_kind_certain=is_kind_certain)))
    change = _best_fit(problem, fitted, trials)
    return result, change if change and _is_supported(problem, fitted, change) else None


def _with_common_contrast(problem: ShapeProblem, fitted: Fit) -> Fit:
    """Fit one material for all ellipsoids of a sign, if this is likelier than a material for each ellipsoid."""
    for sign in (1, -1):
        bodies = fitted.bodies
        if isinstance(bodies, Ellipsoids) and ((bodies.sign == sign) & ~bodies.same_material).sum() > 1:
            common_fit = problem.fit(*bodies.of_one_material(sign, fitted.coefficients), _STEPS)
            fitted = min(fitted, common_fit, key=problem.surprise)
    return fitted


def _trial_fit(problem: ShapeProblem, start: tuple[Bodies, Float[np.ndarray, " n"]]) -> Fit:
    """Make a few steps of the fit of bodies from their coefficients `start`."""
    return problem.fit(*start, _TRIAL_STEPS, _COARSE_TOLERANCE)


def _best_fit(problem: ShapeProblem, fitted: Fit, trial_fits: Sequence[Fit]) -> Fit | None:
    """Fit to convergence from the best of several trial fits. None if its cost is more than `_CERTAIN_RISE` times that
    of `fitted`, or if the data could not support it even if its cost fell to zero."""
    best_trial = min(trial_fits, key=lambda trial: trial.cost, default=None)
    if best_trial is None or best_trial.cost > _CERTAIN_RISE * fitted.cost:
        return None
    least_surprise = problem.surprise(best_trial) - best_trial.cost
    if least_surprise + _MIN_EVIDENCE_GAIN > problem.surprise(fitted):
        return None
    return problem.fit(best_trial.bodies, best_trial.coefficients, _STEPS)


def _is_supported(problem: ShapeProblem, simple_fit: Fit, other_fit: Fit) -> bool:
    """Whether the log evidence of `other_fit` exceeds that of `simple_fit` by `_MIN_EVIDENCE_GAIN`."""
    return problem.surprise(other_fit) + _MIN_EVIDENCE_GAIN <= problem.surprise(simple_fit)


def _improve_fit(problem: ShapeProblem, result: _SearchResult, least_rise: float) -> _SearchResult:
    """Search for likelier bodies, starting once with a change of kind and once with a split. Returns the likelier
    result, or `result` if the data support neither change. The second search is left out if even a perfect fit of more
    bodies of these kinds would be less likely than the result of the first."""
    base_fit, doubtful = result.fit, result.doubtful
    result, other_fit = _alternative_fits(problem, result)
    results = [] if other_fit is None else [_search_until_stable(problem, doubtful, other_fit, least_rise)]
    least_surprise = problem.surprise(base_fit) - base_fit.cost
    if all(least_surprise <= problem.surprise(found.fit) for found in results):
        split = _split_bodies(problem, base_fit, least_rise)
        if split is not None:
            results.append(_search_until_stable(problem, doubtful, split, least_rise))
    return min(results or [result], key=lambda candidate: problem.surprise(candidate.fit))


def _search_until_stable(
    problem: ShapeProblem, doubtful: Sequence[Body], start: Fit, least_rise: float
) -> _SearchResult:
    """Continue the search from the bodies `start`: remove ghosts, then split a body or, if no split is supported,
    change the kind of a body, until the data support no change. `doubtful`: bodies that were removed before."""
    result = _remove_unsupported(problem, start, doubtful, least_rise)
    for _ in range(_MAX_CHANGES):
        next_fit = _split_bodies(problem, result.fit, least_rise)
        if next_fit is None:
            result, next_fit = _alternative_fits(problem, result)
        if next_fit is None:
            break
        result = _remove_unsupported(problem, next_fit, result.doubtful, least_rise)
    return result
