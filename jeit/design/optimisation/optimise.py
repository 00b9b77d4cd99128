"""Layout optimisation: a score is maximised over electrode positions by gradients through the forward model.

Bounded L-BFGS minimises -score + w Σ (shortfall / pitch)² over positions in the outline's box, with w growing from
stage to stage (the quadratic penalty method: Nocedal and Wright, Numerical Optimization, 2006, chapter 17); remaining
violations of the constraints are then removed by descent of the penalty alone.
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
from jeit.design.optimisation.design_space import Constraints, DesignSpace, Record, descend, varied_of
from jeit.design.optimisation.variables import Objective, Variables, Varied
from jeit.design.scores import Scores
from jeit.design.skin.skin import Skin, check_skin
from jeit.layout import Layout, SurfaceLayout
from jeit.mesh import Domain

# Weights of the penalty, and the share of the steps after which each ends.
_STAGES = ((1e2, 0.5), (1e3, 0.8), (1e4, 1.0))
# Constraints are met with so much to spare, metres, that rounding a layout to whole nanometres breaks none.
_SPARE = 2e-7
# Fraction of a skin's size that its mesh may lack.
_OFF = 0.01
# Least improvement of a score.
_ROUNDING = 1e-9
# Random places from which those inside the outline are taken.
_DRAWS = 20_000


class Optimisation(eqx.Module):
    """Result of `optimise_layout` from S starts.

    **Fields**

    - `layout`: the best that satisfies all constraints; the one given, if none is better.
    - `scores`: all scores of `layout`; `value`, its score; `start_value`, that of the layout given.
    - `centres` (S, L, 2), `radii` (S, L), metres, `contact_impedance` (S, L), ohm·m², `thickness` (S,) of the sheet,
      metres, and `values` (S,): the result of each start, and its score.
    - `shortfall` (S,): largest violation of a constraint there, metres; 0 where all are satisfied.
    - `history` (S, T): score of each start after each step, without penalties; `snapshots` (S, T, L, 2), metres, and
      the first is the start itself.
    - `best`: the start that `layout` comes from; None if it is the one given.
    - `status`: "converged", "step limit", "stalled" (no shorter step improved) or "infeasible", and the `reason`.
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

    Take a protocol that does not depend on the order of electrodes, such as that of all two-terminal pairs, and confirm
    what comes out on a finer mesh. Same arguments, same result.

    **Arguments:**

    - `skin`: a sheet, of the layout to begin with. `objective`: of its touches.
    - `space`: the layouts allowed; all on the skin unless given.
    - `steps`: of L-BFGS, at most, for all starts at once. `starts`: how many: the layout, and random ones, drawn with
      `key` and moved apart.
    - `callback`: called after each step with its number and the scores (S,).

    Raises `ValueError` for a layer, for arguments that `layout_scores` rejects, for touches of another thickness, and
    for constraints that cannot be satisfied.
    """
    space = DesignSpace() if space is None else space
    _check(skin, objective, space, steps, starts, key)
    constraints = space.constraints(skin)
    variables = space.variables(skin, constraints, objective.touches.depth)
    _check_outline(constraints.outline, skin)
    begin = np.stack([variables.start, *_random(variables, constraints, starts - 1, key)])
    # A layout given is taken as it is, unless symmetry or the constraints forbid.
    begin = _feasible(variables, constraints, jnp.asarray(np.array(begin)))
    given = objective.scores_of_varied(skin, varied_of(skin))
    start_value = float(objective.score(given))
    if not np.isfinite(start_value):
        raise ValueError("score is not finite for the layout given; does some touch change no voltage?")
    search = _Search(skin, objective, constraints, variables)
    ended, record, status = search.run(jnp.asarray(np.array(begin)), steps, callback)
    ends = jax.tree.map(np.asarray, _varied(variables, ended))
    values = np.asarray(search.cost(ended, 0.0)[1])
    lacking = np.array([_lacking(constraints, *one) for one in zip(ends.centres, ends.radii, strict=True)])
    best, status, reason = search.judge(ends, values, lacking, start_value, status)
    found, scores = skin.layout, given
    if best is not None:
        end = Varied(*(part[best] for part in ends))
        found, scores = search.named(end, space.contact_impedance is not None), objective.scores_of_varied(skin, end)
    return Optimisation(
        layout=found,
        scores=scores,
        value=start_value if best is None else float(values[best]),
        start_value=start_value,
        **ends._asdict(),
        values=values,
        shortfall=np.maximum(lacking, 0),
        history=np.stack(record.values, axis=1),
        snapshots=np.stack([np.asarray(_varied(variables, one).centres) for one in record.variables], axis=1),
        best=best,
        status=status,
        reason=reason,
    )


class _Search(eqx.Module):
    """The optimisation from S starts, and its result."""

    skin: Skin
    objective: Objective
    constraints: Constraints
    variables: Variables

    def cost(self, values, weight):
        """Penalised cost of each start (S,), its score (S,) and the gradient of the cost (S, v)."""
        return _cost(values, jnp.asarray(weight), self)

    def run(self, begin: Float[Array, "S v"], steps: int, callback) -> tuple[Float[Array, "S v"], Record, str]:
        """Run the optimisation: final variables of the starts, their history, and the termination of the last stage."""
        record = Record(callback)
        values, status, done = begin, "step limit", 0
        record.add(values, self.cost(values, _STAGES[0][0])[1])
        for weight, share in _STAGES:
            budget = round(share * steps) - done
            done += budget
            if budget:
                values, status = descend(partial(self.cost, weight=weight), values, budget, record)
        return _feasible(self.variables, self.constraints, values), record, status

    def judge(self, ends: Varied, values, lacking, start_value: float, status: str) -> tuple[int | None, str, str]:
        """Index of the best start, None if none improves on the given layout, with the status and its reason."""
        layout = self.skin.layout
        good = (lacking <= 0) & np.isfinite(values)
        fits = self.variables.holds(varied_of(self.skin))
        fits = fits and _lacking(self.constraints, layout.centres, layout.diameters / 2) <= 1e-9
        if not good.any():
            nearest = int(lacking.argmin())
            parts = self.constraints.shortfalls(jnp.asarray(ends.centres[nearest]), jnp.asarray(ends.radii[nearest]))
            worst = max(parts, key=lambda name: float(jnp.max(parts[name], initial=-jnp.inf)))
            least = 1e3 * lacking.min()
            reason = f"no start satisfies the constraints: {worst}= lacks {least:.3g} mm at best; ask for less."
            return None, "infeasible", reason
        best = int(np.where(good, values, -np.inf).argmax())
        if fits and values[best] <= start_value + _ROUNDING * abs(start_value):
            return None, status, "no start is better than the layout given."
        reason = f"start {best + 1} of {len(values)} is best; the constraints are satisfied by {good.sum()}."
        if not fits:
            reason += (
                " The layout given does not satisfy what is asked, and was changed until it did before the first step."
            )
        return best, status, reason

    def named(self, end: Varied, contacts: bool) -> Layout:
        """The layout that ended so; with its contact impedances, if those were varied."""
        layout = self.skin.layout
        return Layout(
            end.centres,
            2 * end.radii,
            contact_impedance=end.contact_impedance if contacts else layout.contact_impedance,
            outline=self.constraints.outline,
            labels=layout.labels,
            name=f"{layout.name}, optimised",
        )


def _random(variables: Variables, constraints: Constraints, count: int, key) -> list[np.ndarray]:
    """Variables of `count` layouts of places drawn evenly from the outline without what is to be kept free."""
    starts, number = [], variables.num_generators
    for one in jax.random.split(key, count) if count else ():
        drawn = jax.random.uniform(one, (_DRAWS, 2))
        place = drawn * variables.size + variables.low
        free = constraints.outline.contains(place)
        for domain in constraints.keep_out:
            free &= ~domain.contains(place)
        usable = np.asarray(drawn)[np.asarray(free)]
        if len(usable) < number:
            raise ValueError("keep_out: it leaves no room for the electrodes inside the outline; give less.")
        rest = variables.start[2 * number :]
        starts.append(np.concatenate([usable[:number].ravel(), rest]))
    return starts


def _penalty(variables: Variables, constraints: Constraints, values, spare=0.0) -> Float[Array, ""]:
    shortfall = constraints.shortfall(*variables.varied(values)[:2]) + spare
    return jnp.sum((jnp.maximum(shortfall, 0) / variables.pitch) ** 2)


def _lacking(constraints: Constraints, centres, radii) -> float:
    """Largest violation of a constraint, metres; 0 where it is within rounding."""
    return float(jnp.max(constraints.shortfall(jnp.asarray(centres), jnp.asarray(radii))))


def _feasible(variables: Variables, constraints: Constraints, values):
    """The starts (S, v) moved until they satisfy the constraints, as far as descent of the penalty leads."""

    def cost(values):
        value, slope = _missing(values, variables, constraints)
        return value, -value, slope

    return descend(cost, values, 500, Record(), tolerance=0.0)[0]


@eqx.filter_jit
def _missing(values, variables: Variables, constraints: Constraints):
    """Penalty of each start (S,) and its gradient (S, v); steep, so that the descent ends at zero, not near it."""
    return jax.vmap(jax.value_and_grad(lambda own: 1e6 * _penalty(variables, constraints, own, _SPARE)))(values)


@eqx.filter_jit
def _cost(values, weight, search: _Search):
    variables, constraints, objective = search.variables, search.constraints, search.objective

    def one(own):
        end = variables.varied(own)
        # An electrode off the skin has no score: a step that goes too far is judged by how it is at the edge.
        end_inside = end._replace(centres=constraints.outline.nearest(end.centres))
        value = objective.score(objective.scores_of_varied(search.skin, end_inside))
        return weight * _penalty(variables, constraints, own) - value, value

    # One start after the other: the Jacobian of one fills the cache.
    (cost, value), slope = jax.lax.map(jax.value_and_grad(one, has_aux=True), values)
    return cost, value, slope


@eqx.filter_jit
def _varied(variables: Variables, values) -> Varied:
    return jax.vmap(variables.varied)(values)


def _check(skin: Skin, objective: Objective, space: DesignSpace, steps: int, starts: int, key) -> None:
    check_skin("skin", skin)
    check_kind("objective", objective, Objective, "an Objective, as of Objective.create(skin, places)")
    check_kind("space", space, DesignSpace, "a DesignSpace, such as DesignSpace(minimum_spacing=0.01)")
    if skin.num_layers:
        raise ValueError("skin is a layer; layouts are optimised on a sheet: Skin.create(…, num_layers=0).")
    if not np.isclose(float(objective.touches.thickness), float(skin.thickness), rtol=1e-9):
        raise ValueError(
            f"objective: its touches are of a sheet {1e3 * float(objective.touches.thickness):.4g} mm thick, and the "
            f"skin is {1e3 * float(skin.thickness):.4g} mm thick; make them with skin.sheet_touches(…)."
        )
    for name, number in (("steps", steps), ("starts", starts)):
        if not isinstance(number, int) or number < 1:
            raise ValueError(f"{name} must be a whole number from 1; it is {number!r}.")
    if starts > 1 or key is not None:
        check_key(key, "key, which random starts need,")


def _check_outline(outline: Domain, skin: Skin) -> None:
    low_x, high_x, low_y, high_y = outline.extent
    points = np.asarray(skin.model.mesh.points)
    off = max(*(points.min(axis=0) - (low_x, low_y)), *((high_x, high_y) - points.max(axis=0)))
    # The mesh of a disk is a polygon inside it.
    if off > _OFF * max(high_x - low_x, high_y - low_y):
        raise ValueError(f"outline: it reaches {1e3 * off:.3g} mm beyond the model's mesh; give the skin's own.")
