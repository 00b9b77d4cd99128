"""Layout optimisation: a layout score is maximised over electrode positions by gradients through the forward model.

Bounded L-BFGS minimises -score + w Σ (violation / pitch)² over positions in the bounding box of the outline. The pitch
is the mean spacing of the electrodes; the weight w grows from stage to stage (the quadratic penalty method: Nocedal and
Wright, Numerical Optimization, 2006, chapter 17). Remaining violations are then removed by minimising the penalty
alone, without the score.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_key, check_kind
from jeit.design.defaults import STEPS
from jeit.design.optimisation.design_space import (
    Constraints,
    DesignSpace,
    OptimisationHistory,
    layout_parameters,
    minimise_from_starts,
)
from jeit.design.optimisation.variables import LayoutParameters, Objective, Variables
from jeit.design.scores import Scores
from jeit.design.skin.skin import Skin, check_skin
from jeit.layout import Layout, SurfaceLayout
from jeit.mesh import Domain
from jeit_solvers.engines import as_array, on_host
from jeit_solvers.module import Module

# Stages of the optimisation: weight w of the penalty, and fraction of all steps after which the stage ends.
_PENALTY_WEIGHTS_AND_STAGE_ENDS = ((1e2, 0.5), (1e3, 0.8), (1e4, 1.0))
# Safety margin of the constraints, metres, so that a layout rounded to whole nanometres still satisfies them.
_CONSTRAINT_MARGIN = 2e-7
# Weight of the penalty if it is minimised alone: large, so that the minimisation stops only where the penalty is zero.
_PENALTY_WEIGHT_ALONE = 1e6
# Maximum distance by which the outline may extend beyond the mesh, relative to the size of the skin.
_MAX_OUTLINE_OVERHANG = 0.01
# Minimum relative improvement of the score for a layout to count as better than the given layout.
_MIN_SCORE_IMPROVEMENT = 1e-9
# Number of random positions drawn for a random layout; the first positions inside the allowed region are used.
_NUM_DRAWN_POSITIONS = 20_000


class Optimisation(Module):
    """Result of `optimise_layout` from S starts.

    **Fields**

    - `layout`: the best layout that satisfies all constraints, or the given layout if no such layout is better.
    - `scores`: all scores of `layout`; `value`, `start_value`: values of the objective for `layout` and for the given
      layout.
    - `centres` (S, L, 2) and `radii` (S, L), metres, `contact_impedance` (S, L), ohm·m², `thickness` (S,) of the sheet,
      metres: final parameters of the L electrodes from each start; `values` (S,): final value of the objective from
      each start.
    - `shortfall` (S,): largest final violation of a constraint from each start, metres; 0 if all constraints are
      satisfied.
    - `history` (S, T): value of the objective from each start, initially and after each step, without penalties.
    - `snapshots` (S, T, L, 2): centres of the electrodes initially and after each step, metres.
    - `best`: index of the start that `layout` results from; None if `layout` is the given layout.
    - `status`: "converged", "step limit", "stalled" (no shorter step improved the cost) or "infeasible"; `reason`: an
      explanation of the result in words.
    """

    layout: Layout | SurfaceLayout
    scores: Scores
    value: float
    start_value: float
    centres: Float[np.ndarray, "S L 2"]
    radii: Float[np.ndarray, "S L"]
    contact_impedance: Float[np.ndarray, "S L"]
    thickness: Float[np.ndarray, " S"]
    values: Float[np.ndarray, " S"]
    shortfall: Float[np.ndarray, " S"]
    history: Float[np.ndarray, "S T"]
    snapshots: Float[np.ndarray, "S T L 2"]
    best: int | None = eqx.field(static=True)
    status: str = eqx.field(static=True)
    reason: str = eqx.field(static=True)


def optimise_layout(
    skin: Skin,
    objective: Objective,
    space: DesignSpace | None = None,
    *,
    steps: int = STEPS,
    starts: int = 1,
    key: Array | None = None,
    callback: Callable[[int, Float[np.ndarray, " S"]], None] | None = None,
) -> Optimisation:
    """Maximise the `objective` of a sheet over the positions of its electrodes.

    Use a protocol that does not depend on the order of the electrodes, such as all two-terminal pairs, and confirm the
    result on a finer mesh. The result is deterministic.

    **Arguments:**

    - `skin`: a sheet with the initial layout; `objective`: the maximised function of the scores, for touches of this
      sheet.
    - `space`: the allowed layouts; by default all layouts on the skin.
    - `steps`: maximum number of L-BFGS steps; all starts are optimised together.
    - `starts`: number of initial layouts: the given layout, and random layouts drawn with `key` and moved apart.
    - `callback`: function called with the number of each step, 0 for the initial layouts, and the scores (S,) of all
      starts.

    Raises `ValueError` for a layer instead of a sheet, for arguments that `layout_scores` rejects, if the touches are
    for a sheet of a different thickness, and for constraints that cannot be satisfied.

    **Example:**

    ```python
    optimised = optimise_layout(sheet, objective, DesignSpace(minimum_spacing=0.012), steps=1)
    print(optimised.status, optimised.start_value, optimised.value)
    ```
    """
    space = DesignSpace() if space is None else space
    _check_arguments(skin, objective, space, steps, starts, key)
    constraints = space.constraints(skin)
    design_variables = space.variables(skin, constraints, objective.touches.depth)
    _check_outline(constraints.outline, skin)
    initial_variables = np.stack(
        [design_variables.start, *_random_starts(design_variables, constraints, starts - 1, key)]
    )
    # The given layout is used unchanged, unless it violates the symmetry or the constraints.
    initial_variables = _make_feasible(design_variables, constraints, jnp.asarray(np.array(initial_variables)))
    initial_scores = objective.scores_of_varied(skin, layout_parameters(skin))
    start_value = float(objective.score(initial_scores))
    if not np.isfinite(start_value):
        raise ValueError("score is not finite for the layout given; does some touch change no voltage?")
    layout_search = _LayoutSearch(skin, objective, constraints, design_variables)
    final_variables, optimisation_history, status = layout_search.run_stages(
        jnp.asarray(np.array(initial_variables)), steps, callback
    )
    final_parameters = jax.tree.map(np.asarray, _parameters_of_starts(design_variables, final_variables))
    scores_of_starts = np.asarray(layout_search.penalised_cost(final_variables, 0.0)[1])
    centres_and_radii = zip(final_parameters.centres, final_parameters.radii, strict=True)
    violations_of_starts = np.array(
        [_largest_violation(constraints, centres, radii) for centres, radii in centres_and_radii]
    )
    best_start, status, status_reason = layout_search.choose_best(
        final_parameters, scores_of_starts, violations_of_starts, start_value, status
    )
    final_layout, final_scores = skin.layout, initial_scores
    if best_start is not None:
        best_parameters = LayoutParameters(
            *(parameter_of_starts[best_start] for parameter_of_starts in final_parameters)
        )
        final_layout = layout_search.create_layout(best_parameters, space.contact_impedance is not None)
        final_scores = objective.scores_of_varied(skin, best_parameters)
    return Optimisation(
        layout=final_layout,
        scores=final_scores,
        value=start_value if best_start is None else float(scores_of_starts[best_start]),
        start_value=start_value,
        **final_parameters._asdict(),
        values=scores_of_starts,
        shortfall=np.maximum(violations_of_starts, 0),
        history=np.stack(optimisation_history.scores, axis=1),
        snapshots=np.stack(
            [
                np.asarray(_parameters_of_starts(design_variables, step_variables).centres)
                for step_variables in optimisation_history.variables
            ],
            axis=1,
        ),
        best=best_start,
        status=status,
        reason=status_reason,
    )


class _LayoutSearch(Module):
    """Optimisation of a layout from S starts by the penalty method, and choice of the best result."""

    skin: Skin
    objective: Objective
    constraints: Constraints
    variables: Variables

    def penalised_cost(self, variables_of_starts, penalty_weight):
        """Penalised cost (S,) and score (S,) of the layout of each start, and the gradient (S, v) of the cost with
        respect to the v variables."""
        scores_of_starts, score_gradients = on_host(_scores_and_gradients(variables_of_starts, self))
        constraint_penalties, penalty_gradients = _penalties_of_starts(
            variables_of_starts, self.variables, self.constraints, penalty_weight, 0.0
        )
        return constraint_penalties - scores_of_starts, scores_of_starts, penalty_gradients - score_gradients

    def run_stages(
        self, initial_variables: Float[Array, "S v"], max_steps: int, callback
    ) -> tuple[Float[Array, "S v"], OptimisationHistory, str]:
        """Run all stages. Returns the final variables (S, v), the history of the starts, and the status of the last
        stage."""
        optimisation_history = OptimisationHistory(callback)
        current_variables, optimiser_status, num_steps_done = initial_variables, "step limit", 0
        optimisation_history.add(
            current_variables, self.penalised_cost(current_variables, _PENALTY_WEIGHTS_AND_STAGE_ENDS[0][0])[1]
        )
        for penalty_weight, stage_end_fraction in _PENALTY_WEIGHTS_AND_STAGE_ENDS:
            num_stage_steps = round(stage_end_fraction * max_steps) - num_steps_done
            num_steps_done += num_stage_steps
            if num_stage_steps:
                current_variables, optimiser_status = minimise_from_starts(
                    partial(self.penalised_cost, penalty_weight=penalty_weight),
                    current_variables,
                    num_stage_steps,
                    optimisation_history,
                )
        return (
            _make_feasible(self.variables, self.constraints, current_variables),
            optimisation_history,
            optimiser_status,
        )

    def choose_best(
        self, parameters: LayoutParameters, scores_of_starts, violations_of_starts, start_value: float, status: str
    ) -> tuple[int | None, str, str]:
        """Choose the start with the best final layout. Returns its index, the status, and the reason in words. The
        index is None if no start satisfies the constraints or improves on the given layout."""
        layout = self.skin.layout
        is_valid_start = (violations_of_starts <= 0) & np.isfinite(scores_of_starts)
        is_initial_layout_valid = self.variables.reproduces_parameters(layout_parameters(self.skin))
        is_initial_layout_valid = (
            is_initial_layout_valid
            and _largest_violation(self.constraints, layout.centres, layout.diameters / 2) <= 1e-9
        )
        if not is_valid_start.any():
            most_feasible_start = int(violations_of_starts.argmin())
            violations_by_name = _violations_by_name(
                self.constraints,
                jnp.asarray(parameters.centres[most_feasible_start]),
                jnp.asarray(parameters.radii[most_feasible_start]),
            )
            worst_constraint = max(
                violations_by_name,
                key=lambda constraint_name: float(np.max(violations_by_name[constraint_name], initial=-np.inf)),
            )
            min_violation_mm = 1e3 * violations_of_starts.min()
            status_reason = (
                f"no start satisfies the constraints: {worst_constraint}= lacks {min_violation_mm:.3g} mm at best; ask "
                "for less."
            )
            return None, "infeasible", status_reason
        best_start = int(np.where(is_valid_start, scores_of_starts, -np.inf).argmax())
        if is_initial_layout_valid and scores_of_starts[best_start] <= start_value + _MIN_SCORE_IMPROVEMENT * abs(
            start_value
        ):
            return None, status, "no start is better than the layout given."
        status_reason = (
            f"start {best_start + 1} of {len(scores_of_starts)} is best; the constraints are satisfied by "
            f"{is_valid_start.sum()}."
        )
        if not is_initial_layout_valid:
            status_reason += (
                " The layout given does not satisfy what is asked, and was changed until it did before the first step."
            )
        return best_start, status, status_reason

    def create_layout(self, parameters: LayoutParameters, varies_contacts: bool) -> Layout:
        """Create the layout with the final `parameters`. The contact impedances are those of `parameters` if
        `varies_contacts`, and otherwise those of the given layout."""
        layout = self.skin.layout
        return Layout(
            parameters.centres,
            2 * parameters.radii,
            contact_impedance=parameters.contact_impedance if varies_contacts else layout.contact_impedance,
            outline=self.constraints.outline,
            labels=layout.labels,
            name=f"{layout.name}, optimised",
        )


def _random_starts(variables: Variables, constraints: Constraints, num_layouts: int, random_key) -> list[np.ndarray]:
    """Draw the design variables of `num_layouts` random layouts, with positions uniform in the outline and outside the
    keep-out domains."""
    variables_of_layouts, num_generators = [], variables.num_generators
    for layout_random_key in jax.random.split(random_key, num_layouts) if num_layouts else ():
        unit_positions = np.asarray(jax.random.uniform(layout_random_key, (_NUM_DRAWN_POSITIONS, 2)))
        drawn_positions = unit_positions * variables.size + variables.low
        is_allowed_position = np.asarray(constraints.outline.contains(drawn_positions))
        for keep_out_domain in constraints.keep_out:
            is_allowed_position = is_allowed_position & ~np.asarray(keep_out_domain.contains(drawn_positions))
        allowed_positions = unit_positions[is_allowed_position]
        if len(allowed_positions) < num_generators:
            raise ValueError("keep_out: it leaves no room for the electrodes inside the outline; give less.")
        size_and_contact_variables = variables.start[2 * num_generators :]
        variables_of_layouts.append(
            np.concatenate([allowed_positions[:num_generators].ravel(), size_and_contact_variables])
        )
    return variables_of_layouts


_violations_by_name = eqx.filter_jit(Constraints.violations_by_name)


def _largest_violation(constraints: Constraints, centres, radii) -> float:
    """Largest violation of a constraint, metres; zero or negative if all constraints are satisfied."""
    violations_by_name = _violations_by_name(constraints, centres, radii)
    return max(
        float(np.max(np.asarray(constraint_violations), initial=-np.inf))
        for constraint_violations in violations_by_name.values()
    )


def _make_feasible(variables: Variables, constraints: Constraints, variables_of_starts):
    """Move the layouts of all starts (S, v) until they satisfy the constraints, as far as minimisation of the penalty
    succeeds."""

    def penalty_cost(variables_of_starts):
        penalties, penalty_gradients = _penalties_of_starts(
            variables_of_starts, variables, constraints, _PENALTY_WEIGHT_ALONE, _CONSTRAINT_MARGIN
        )
        return penalties, -penalties, penalty_gradients

    return minimise_from_starts(penalty_cost, variables_of_starts, 500, OptimisationHistory(), tolerance=0.0)[0]


def _penalties_of_starts(
    variables_of_starts,
    variable_mapping: Variables,
    constraints: Constraints,
    penalty_weight: float,
    safety_margin: float,
):
    """Penalty (S,) for violated constraints of the layouts of S starts, times `penalty_weight`, and its gradient (S, v)
    with respect to the v variables. `safety_margin`: safety margin of the constraints, metres."""
    return on_host(
        _penalty_and_gradient(
            variables_of_starts, variable_mapping, constraints, as_array(penalty_weight), as_array(safety_margin)
        )
    )


@eqx.filter_jit
def _penalty_and_gradient(
    variables_of_starts, variable_mapping: Variables, constraints: Constraints, penalty_weight, safety_margin
):
    def penalty_of_start(start_variables):
        constraint_violations = (
            constraints.violations(*variable_mapping.parameters(start_variables)[:2]) + safety_margin
        )
        return penalty_weight * jnp.sum((jnp.maximum(constraint_violations, 0) / variable_mapping.pitch) ** 2)

    return jax.vmap(jax.value_and_grad(penalty_of_start))(variables_of_starts)


@eqx.filter_jit
def _scores_and_gradients(variables_of_starts, layout_search: _LayoutSearch):
    """Score (S,) of the layouts of S starts, and its gradient (S, v) with respect to the v variables."""

    def compute_score(start_variables):
        parameters = layout_search.variables.parameters(start_variables)
        # The score is undefined for an electrode outside the skin, so the electrode is moved to the nearest point of
        # the skin.
        clipped_parameters = parameters._replace(centres=layout_search.constraints.outline.nearest(parameters.centres))
        return layout_search.objective.score(
            layout_search.objective.scores_of_varied(layout_search.skin, clipped_parameters)
        )

    # Starts are evaluated one after the other, since the Jacobian of a single layout fills the processor's cache.
    return jax.lax.map(jax.value_and_grad(compute_score), variables_of_starts)


@eqx.filter_jit
def _parameters_of_starts(variable_mapping: Variables, variables_of_starts) -> LayoutParameters:
    return jax.vmap(variable_mapping.parameters)(variables_of_starts)


def _check_arguments(
    skin: Skin, objective: Objective, design_space: DesignSpace, num_steps: int, num_starts: int, random_key
) -> None:
    check_skin("skin", skin)
    check_kind("objective", objective, Objective, "an Objective, as of Objective.create(skin, places)")
    check_kind("space", design_space, DesignSpace, "a DesignSpace, such as DesignSpace(minimum_spacing=0.01)")
    if skin.num_layers:
        raise ValueError("skin is a layer; layouts are optimised on a sheet: Skin.create(…, num_layers=0).")
    if not np.isclose(float(objective.touches.thickness), float(skin.thickness), rtol=1e-9):
        raise ValueError(
            f"objective: its touches are of a sheet {1e3 * float(objective.touches.thickness):.4g} mm thick, and the "
            f"skin is {1e3 * float(skin.thickness):.4g} mm thick; make them with skin.sheet_touches(…)."
        )
    for argument_name, argument_value in (("steps", num_steps), ("starts", num_starts)):
        if not isinstance(argument_value, int) or argument_value < 1:
            raise ValueError(f"{argument_name} must be a whole number from 1; it is {argument_value!r}.")
    if num_starts > 1 or random_key is not None:
        check_key(random_key, "key, which random starts need,")


def _check_outline(outline: Domain, skin: Skin) -> None:
    low_x, high_x, low_y, high_y = outline.extent
    mesh_points = np.asarray(skin.model.mesh.points)
    outline_overhang = max(*(mesh_points.min(axis=0) - (low_x, low_y)), *((high_x, high_y) - mesh_points.max(axis=0)))
    # The mesh of a disk is a polygon inside the disk, so a small overhang is allowed.
    if outline_overhang > _MAX_OUTLINE_OVERHANG * max(high_x - low_x, high_y - low_y):
        raise ValueError(
            f"outline: it reaches {1e3 * outline_overhang:.3g} mm beyond the model's mesh; give the skin's own."
        )
