"""Number and kinds of bodies: removal of ghosts (false bodies), splits in two, and changes to the other kind (a weak
star, or a column), as the evidence (`ShapeProblem.surprise`) supports them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.inverse.shapes.bodies import Bodies, results_of_parts
from jeit.inverse.shapes.problem import ShapeFit, ShapeProblem
from jeit.inverse.shapes.reconstruction import Body

STEPS = 40
"""Maximum number of steps of a fit."""
COARSE_TOLERANCE = 1e-2
"""Relative change of the cost that ends a fit whose result is only compared."""
CERTAIN_OBJECTIVE_RATIO = 10.0
"""A body is beyond doubt if the objective without it is larger by more than this factor."""
MIN_EVIDENCE_GAIN = 2.0
"""Minimum gain of log evidence with which a description of the bodies with more parameters is accepted."""
_TRIAL_STEPS = 6
# Maximum number of steps of the first part of a fit without a body, after which the fit ends if the cost exceeds the
# cost at which the body is beyond doubt by more than this factor; and maximum number of further steps.
_FIRST_REMOVAL_STEPS, _HOPELESS_OBJECTIVE_RATIO, _REMOVAL_STEPS = 3, 30.0, 6
# The data exclude a change of a body's kind if it raises the objective, after a few steps of the fit, by more than this
# factor: on finer meshes the factor increases, because the objective of the right kind decreases.
_EXCLUDED_OBJECTIVE_RATIO = 100.0
# Maximum number of changes of the number or kind of bodies in a search.
_MAX_MODEL_CHANGES = 10


class SearchResult(NamedTuple):
    """Result of removing ghosts: `fit` of the remaining bodies, their `objective_ratios`, and the removed bodies,
    `doubtful`."""

    fit: ShapeFit
    objective_ratios: list[float]
    doubtful: tuple[Body, ...]


def grow_bodies(problem: ShapeProblem, bodies: Bodies, coefficients, steps: int):
    """Fit the bodies as disks or balls, and return the bodies with all modes of their form, and their coefficients."""
    ball_fit = problem.fit(*bodies.with_modes(1, coefficients), steps, COARSE_TOLERANCE)
    return ball_fit.bodies.with_modes(bodies.prior.modes, ball_fit.coefficients)


def remove_unsupported(
    problem: ShapeProblem,
    fitted: ShapeFit,
    doubtful: Sequence[Body],
    least_rise: float,
    min_costs: Float[np.ndarray, " k"] | None = None,
) -> SearchResult:
    """Remove, one at a time, bodies without which the other bodies, fitted again, explain the data about as well. The
    body whose absence raises the cost least is removed first.

    `min_costs`: lower limit of the cost without each body, if known.
    """
    doubtful, costs_without_body = (
        list(doubtful),
        np.zeros(len(fitted.bodies.sign)) if min_costs is None else min_costs.copy(),
    )
    while True:
        bodies, coefficients, fitted_cost, _ = fitted
        # After a ghost is removed, leaving out a further body raises the cost at least as much as before, so costs
        # computed earlier are lower limits.
        certain_cost = max(
            CERTAIN_OBJECTIVE_RATIO * fitted_cost, problem.negative_log_evidence(fitted) + MIN_EVIDENCE_GAIN
        )
        uncertain_bodies = np.flatnonzero(costs_without_body <= certain_cost).tolist()
        starts_without_body = [bodies.without(k, coefficients) for k in uncertain_bodies]
        fits_without = results_of_parts(bodies, partial(_fit_without, problem, certain_cost), starts_without_body)
        fit_without_body = dict(zip(uncertain_bodies, fits_without, strict=True))
        costs_without_body[uncertain_bodies] = [trial_fit.cost for trial_fit in fits_without]
        least_supported_body = min(fit_without_body, key=lambda k: costs_without_body[k], default=None)
        if least_supported_body is None or (
            costs_without_body[least_supported_body] >= least_rise * fitted_cost
            and _is_supported(problem, fit_without_body[least_supported_body], fitted)
        ):
            return SearchResult(fitted, list(costs_without_body / fitted_cost), tuple(doubtful))
        doubtful.append(
            bodies.body(
                least_supported_body, coefficients, float(costs_without_body[least_supported_body]) / fitted_cost
            )
        )
        costs_without_body = np.delete(costs_without_body, least_supported_body)
        fitted = problem.fit(
            fit_without_body[least_supported_body].bodies, fit_without_body[least_supported_body].coefficients, STEPS
        )


def _fit_without(
    problem: ShapeProblem, certain_cost: float, start_of_fit: tuple[Bodies, Float[np.ndarray, " n"]]
) -> ShapeFit:
    """Fit the remaining bodies from their coefficients, `start_of_fit`. The fit ends early if its cost remains far
    above `certain_cost`, above which the omitted body certainly exists."""
    first_fit = problem.fit(*start_of_fit, _FIRST_REMOVAL_STEPS, 2 * COARSE_TOLERANCE)
    if first_fit.cost > _HOPELESS_OBJECTIVE_RATIO * certain_cost:
        return first_fit
    return problem.fit(first_fit.bodies, first_fit.coefficients, _REMOVAL_STEPS, 2 * COARSE_TOLERANCE)


def _split_bodies(problem: ShapeProblem, fitted: ShapeFit, least_rise: float) -> ShapeFit | None:
    """Fit the bodies with one body split in two; None if the data support no split. Each body adds parameters, so no
    split is tried if the whole cost is less than the gain of evidence that it needs."""
    bodies, coefficients, fitted_cost, _ = fitted
    if fitted_cost < MIN_EVIDENCE_GAIN:
        return None

    def fit_with_split(index: tuple[int, ...]) -> ShapeFit:
        return _trial_fit(problem, grow_bodies(problem, *bodies.split(index[0], coefficients, index[1]), _TRIAL_STEPS))

    split_fits = results_of_parts(bodies, fit_with_split, list(np.ndindex(len(bodies.sign), bodies.num_splits)))
    best_split_fit = _best_fit(problem, fitted, split_fits)
    return (
        best_split_fit
        if best_split_fit
        and fitted_cost >= least_rise * best_split_fit.cost
        and _is_supported(problem, fitted, best_split_fit)
        else None
    )


def alternative_fits(problem: ShapeProblem, result: SearchResult) -> tuple[SearchResult, ShapeFit | None]:
    """Fit the bodies with one or all of them changed to the other kind (weak star or column).

    Returns the `result`, with those bodies marked whose kind is certain, and the fit; None if the data support no
    change.
    """
    fitted = result.fit
    bodies = fitted.bodies
    can_change_kind = ~bodies.is_other_kind & ~bodies.is_kind_certain & (not bodies.prior.is_of_one_kind)
    indices = np.flatnonzero(can_change_kind)
    body_groups = [[k] for k in indices] + [indices] * (len(indices) > 1)
    kind_change_fits = results_of_parts(
        bodies,
        lambda body_group: _trial_fit(problem, bodies.with_other_kind(body_group, fitted.coefficients)),
        body_groups,
    )
    is_kind_certain = bodies.is_kind_certain.copy()
    for k, kind_change_fit in zip(indices, kind_change_fits, strict=False):
        is_kind_certain[k] = kind_change_fit.cost > _EXCLUDED_OBJECTIVE_RATIO * fitted.cost
    result = result._replace(fit=fitted._replace(bodies=replace(bodies, is_kind_certain=is_kind_certain)))
    best_changed_fit = _best_fit(problem, fitted, kind_change_fits)
    return result, best_changed_fit if best_changed_fit and _is_supported(problem, fitted, best_changed_fit) else None


def _trial_fit(problem: ShapeProblem, start_of_fit: tuple[Bodies, Float[np.ndarray, " n"]]) -> ShapeFit:
    """Make a few steps of the fit of bodies from their coefficients, `start_of_fit`."""
    return problem.fit(*start_of_fit, _TRIAL_STEPS, COARSE_TOLERANCE)


def _best_fit(problem: ShapeProblem, fitted: ShapeFit, trial_fits: Sequence[ShapeFit]) -> ShapeFit | None:
    """Fit to convergence from the trial fit with the least cost, of those whose cost is at most
    `CERTAIN_OBJECTIVE_RATIO` times that of `fitted` and that the data would support if their cost fell to zero. None if
    there are none."""
    possible_trials = [
        trial_fit
        for trial_fit in trial_fits
        if trial_fit.cost <= CERTAIN_OBJECTIVE_RATIO * fitted.cost
        and problem.negative_log_evidence(trial_fit) - trial_fit.cost + MIN_EVIDENCE_GAIN
        <= problem.negative_log_evidence(fitted)
    ]
    if not possible_trials:
        return None
    best_trial = min(possible_trials, key=lambda trial_fit: trial_fit.cost)
    return problem.fit(best_trial.bodies, best_trial.coefficients, STEPS)


def _is_supported(problem: ShapeProblem, simpler_fit: ShapeFit, other_fit: ShapeFit) -> bool:
    """Whether the log evidence of `other_fit` exceeds that of `simpler_fit` by `MIN_EVIDENCE_GAIN`."""
    return problem.negative_log_evidence(other_fit) + MIN_EVIDENCE_GAIN <= problem.negative_log_evidence(simpler_fit)


def improve_fit(problem: ShapeProblem, result: SearchResult, least_rise: float) -> SearchResult:
    """Search for likelier bodies, starting once with a change of kind and once with a split. Returns the likelier
    result, or `result` if the data support neither change. The second search is left out if even a perfect fit of more
    bodies of these kinds would be less likely than the result of the first."""
    initial_fit, doubtful = result.fit, result.doubtful
    result, other_fit = alternative_fits(problem, result)
    search_results = [] if other_fit is None else [_search_until_stable(problem, doubtful, other_fit, least_rise)]
    least_surprise = problem.negative_log_evidence(initial_fit) - initial_fit.cost
    if all(least_surprise <= problem.negative_log_evidence(search_result.fit) for search_result in search_results):
        split_fit = _split_bodies(problem, initial_fit, least_rise)
        if split_fit is not None:
            search_results.append(_search_until_stable(problem, doubtful, split_fit, least_rise))
    return min(
        search_results or [result], key=lambda candidate_result: problem.negative_log_evidence(candidate_result.fit)
    )


def _search_until_stable(
    problem: ShapeProblem, doubtful: Sequence[Body], start: ShapeFit, least_rise: float
) -> SearchResult:
    """Continue the search from the bodies `start`: remove ghosts, then split a body or, if no split is supported,
    change the kind of a body, until the data support no change. `doubtful`: bodies that were removed before."""
    result = remove_unsupported(problem, start, doubtful, least_rise)
    for _ in range(_MAX_MODEL_CHANGES):
        next_fit = _split_bodies(problem, result.fit, least_rise)
        if next_fit is None:
            result, next_fit = alternative_fits(problem, result)
        if next_fit is None:
            break
        result = remove_unsupported(problem, next_fit, result.doubtful, least_rise)
    return result
