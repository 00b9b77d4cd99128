"""Layout optimisation: electrodes moved by gradients through the forward model until a score is best.

Bounded L-BFGS minimises -score + w Σ (shortfall / pitch)² over positions in the outline's box, with w growing from
stage to stage (the quadratic penalty method: Nocedal and Wright, Numerical Optimization, 2006, chapter 17); what of the
constraints is still missing then is made up by the nearest descent of the penalty alone.
"""

from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.design.optimisation.constraints import Constraints, pulled_inside
from jeit.design.optimisation.search import Record, descend
from jeit.design.optimisation.variables import Symmetry, Variables, Varied
from jeit.design.scores import Score, Scores, TouchPrior, layout_scores
from jeit.design.skin.sheet_touches import SheetTouches
from jeit.electrodes import SheetDiscs
from jeit.forward import ForwardModel
from jeit.layout import Layout
from jeit.mesh import Domain

# Weights of the penalty, and the share of the steps after which each ends.
_STAGES = ((1e2, 0.5), (1e3, 0.8), (1e4, 1.0))
# Constraints are met with so much to spare, metres, that rounding a layout to whole nanometres breaks none.
_SPARE = 2e-7
# Of a skin's size, that its mesh may lack.
_OFF = 0.01
# Of a score: less is no improvement.
_ROUNDING = 1e-9
# Random places from which those inside the outline are taken.
_DRAWS = 20_000


class Optimisation(eqx.Module):
    """What `optimise_layout` found from S starts.

    **Fields**

    - `layout`: the best that satisfies all constraints; the one given, if none is better.
    - `scores`: all scores of `layout`; `value`, its score; `start_value`, that of the layout given.
    - `centres` (S, L, 2), `radii` (S, L), metres, `contact_impedance` (S, L), ohm·m², `thickness` (S,) of the sheet,
      metres, and `values` (S,): where each start ended, and its score there.
    - `shortfall` (S,): most that any constraint lacks there, metres; 0 where all are satisfied.
    - `history` (S, T): score of each start after each step, without penalties; `snapshots` (S, T, L, 2), metres, and
      the first is the start itself.
    - `best`: the start that `layout` comes from; None if it is the one given.
    - `status`: "converged", "step limit", "stalled" (no shorter step improved) or "infeasible", and the `reason`.
    """

    layout: Layout
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


def balanced(scores: Scores) -> Float[Array, ""]:
    """log of the soft-worst sensitivity minus that of the mean variance: a per cent of either counts alike."""
    return jnp.log(scores.soft_worst) - jnp.log(scores.mean_variance)


def optimise_layout(
    layout: Layout,
    model: ForwardModel,
    conductivity,
    touches: SheetTouches,
    *,
    prior: TouchPrior,
    noise,
    score: Score = balanced,
    temperature: float = 0.1,
    outline: Domain | None = None,
    minimum_spacing: float = 0.0,
    keep_out: Sequence[Domain] = (),
    symmetry: Symmetry | None = None,
    sizes: bool | tuple[float, float] = False,
    contact_impedance: tuple[float, float] | None = None,
    thickness: tuple[float, float] | None = None,
    steps: int = 100,
    starts: int = 1,
    key: Array | None = None,
    callback: Callable[[int, Float[np.ndarray, " S"]], None] | None = None,
) -> Optimisation:
    """Move the electrodes of `layout` on a sheet until `score` is as large as it gets.

    The model gives mesh, protocol and contact impedance, and may be of any `SheetDiscs` of as many electrodes; take a
    protocol that does not depend on the order of electrodes, such as `two_terminal`, and confirm what comes out on a
    finer mesh. Same arguments, same result.

    **Arguments:**

    - `conductivity`, `touches`, `prior`, `noise`, `temperature`: as in `layout_scores`.
    - `score`: of `Scores`, to be made large, with differences of order 1, as logarithms have; `balanced` unless given.
    - `outline`: of the sheet, the layout's unless given. `minimum_spacing`: of centres, metres; electrodes never
      overlap. `keep_out`: domains that no electrode may touch.
    - `symmetry`: about the middle of the outline's box. The layout must have an equal share of its electrodes in every
      half (x or y below the middle) or quarter; those of the first are kept, and the others become their images. Take
      several starts: there are fewer ways out of a poor layout.
    - `sizes`: electrodes' sizes are moved too, between half and twice what they are, or between two diameters, metres.
    - `contact_impedance`: electrodes' are varied too, between two values, ohm·m². `thickness`: that of the sheet is
      varied too, between two values, metres, from that of `touches` on; `conductivity`, the sheet's, grows with it.
    - `steps`: of L-BFGS, at most, for all starts at once. `starts`: how many: the layout, and random ones, drawn with
      `key` and moved apart.
    - `callback`: called after each step with its number and the scores (S,).

    Raises `ValueError` for what `layout_scores` refuses, electrodes that do not fit the model, and constraints that
    cannot be.
    """
    outline = layout.outline if outline is None else outline
    if outline is None:
        raise ValueError("outline: the layout does not know that of its skin; give one, such as Rectangle(0.2, 0.2).")
    _check(layout, model, steps, starts, key)
    _check_keep_out(keep_out)
    constraints = Constraints(outline, float(minimum_spacing), tuple(keep_out))
    task = _Task(model, jnp.asarray(conductivity), touches, prior, jnp.asarray(noise, float), temperature)
    skin = Varied(layout.centres, layout.diameters / 2, _contacts(model), touches.thickness)
    options = {"sizes": sizes, "contacts": contact_impedance, "thickness": thickness}
    design = Variables.create(outline, skin, symmetry=symmetry, **options)
    if thickness is not None:
        _check_thickness(thickness, touches, outline)
    constraints.check_room(design.smallest)
    _check_outline(outline, model)
    begin = np.stack([design.start, *_random(design, constraints, starts - 1, key)])
    # A layout given is taken as it is, unless symmetry or the constraints forbid.
    begin = np.array(_feasible(design, constraints, jnp.asarray(begin)))

    given = task.scores(skin)
    start_value = float(score(given))
    if not np.isfinite(start_value):
        raise ValueError("score is not finite for the layout given; does some touch change no voltage?")

    def cost(variables, weight):
        return _cost(variables, jnp.asarray(weight), design, constraints, task, score)

    record = Record(callback)
    variables, status = jnp.asarray(begin), "step limit"
    record.add(variables, cost(variables, _STAGES[0][0])[1])
    done = 0
    for weight, share in _STAGES:
        budget = round(share * steps) - done
        done += budget
        if budget:
            variables, status = descend(partial(cost, weight=weight), variables, budget, record)
    variables = _feasible(design, constraints, variables)
    ends = jax.tree.map(np.asarray, _varied(design, variables))
    values = np.asarray(cost(variables, 0.0)[1])
    lacking = np.array([_lacking(constraints, *one) for one in zip(ends.centres, ends.radii, strict=True)])
    best, status, reason = _judge(design.holds(skin), layout, constraints, ends, values, lacking, start_value, status)
    found, scores = layout, given
    if best is not None:
        end = Varied(*(part[best] for part in ends))
        found, scores = _named(layout, end, outline, contact_impedance is not None), task.scores(end)
    return Optimisation(
        layout=found,
        scores=scores,
        value=start_value if best is None else float(values[best]),
        start_value=start_value,
        **ends._asdict(),
        values=values,
        shortfall=np.maximum(lacking, 0),
        history=np.stack(record.values, axis=1),
        snapshots=np.stack([np.asarray(_varied(design, one).centres) for one in record.variables], axis=1),
        best=best,
        status=status,
        reason=reason,
    )


class _Task(eqx.Module):
    """What scores depend on besides the electrodes."""

    model: ForwardModel
    conductivity: Array
    touches: SheetTouches
    prior: TouchPrior
    noise: Array
    temperature: float

    def scores(self, skin: Varied) -> Scores:
        moved = self.model.with_electrodes(SheetDiscs(skin.centres, skin.radii, skin.contact_impedance))
        conductance = self.conductivity * (skin.thickness / self.touches.thickness)
        touches = self.touches.at_thickness(skin.thickness)
        return layout_scores(
            moved, conductance, touches, prior=self.prior, noise=self.noise, temperature=self.temperature
        )


def _random(design: Variables, constraints: Constraints, count: int, key) -> list[np.ndarray]:
    """Variables of `count` layouts of places drawn evenly from the outline without what is to be kept free."""
    starts, number = [], design.num_generators
    for one in jax.random.split(key, count) if count else ():
        drawn = jax.random.uniform(one, (_DRAWS, 2))
        place = drawn * design.size + design.low
        free = constraints.outline.contains(place)
        for domain in constraints.keep_out:
            free &= ~domain.contains(place)
        usable = np.asarray(drawn)[np.asarray(free)]
        if len(usable) < number:
            raise ValueError("keep_out: it leaves no room for the electrodes inside the outline; give less.")
        rest = design.start[2 * number :]
        starts.append(np.concatenate([usable[:number].ravel(), rest]))
    return starts


def _penalty(design: Variables, constraints: Constraints, variables, spare=0.0) -> Float[Array, ""]:
    shortfall = constraints.shortfall(*design.varied(variables)[:2]) + spare
    return jnp.sum((jnp.maximum(shortfall, 0) / design.pitch) ** 2)


def _lacking(constraints: Constraints, centres, radii) -> float:
    """Most that any constraint lacks, metres; nothing where it is within rounding."""
    return float(jnp.max(constraints.shortfall(jnp.asarray(centres), jnp.asarray(radii))))


def _feasible(design: Variables, constraints: Constraints, variables):
    """The starts (S, v) moved until they satisfy the constraints, as far as descent of the penalty leads."""

    def cost(variables):
        value, slope = _missing(variables, design, constraints)
        return value, -value, slope

    return descend(cost, variables, 500, Record(), tolerance=0.0)[0]


@eqx.filter_jit
def _missing(variables, design: Variables, constraints: Constraints):
    """Penalty of each start (S,) and its gradient (S, v); steep, for the descent is to end at zero, not near it."""
    return jax.vmap(jax.value_and_grad(lambda own: 1e6 * _penalty(design, constraints, own, _SPARE)))(variables)


@eqx.filter_jit
def _cost(variables, weight, design: Variables, constraints: Constraints, task: _Task, score: Score):
    """Penalised cost of each start (S,), its score (S,) and the gradient of the cost (S, v)."""

    def one(own):
        skin = design.varied(own)
        # An electrode off the skin has no score: a step that goes too far is judged by how it is at the edge.
        value = score(task.scores(skin._replace(centres=pulled_inside(skin.centres, constraints.outline))))
        return weight * _penalty(design, constraints, own) - value, value

    # One start after the other: the Jacobian of one fills the cache.
    (cost, value), slope = jax.lax.map(jax.value_and_grad(one, has_aux=True), variables)
    return cost, value, slope


@eqx.filter_jit
def _varied(design: Variables, variables) -> Varied:
    return jax.vmap(design.varied)(variables)


def _judge(holds, layout, constraints, ends, values, lacking, start_value, status) -> tuple[int | None, str, str]:
    """Which start is best, None if not one improves on the layout given, and what to say of it."""
    good = (lacking <= 0) & np.isfinite(values)
    fits = holds and _lacking(constraints, layout.centres, layout.diameters / 2) <= 1e-9
    if not good.any():
        nearest = int(lacking.argmin())
        parts = constraints.shortfalls(jnp.asarray(ends.centres[nearest]), jnp.asarray(ends.radii[nearest]))
        worst = max(parts, key=lambda name: float(jnp.max(parts[name], initial=-jnp.inf)))
        reason = (
            f"no start satisfies the constraints: {worst} lacks {1e3 * lacking.min():.3g} mm at best; ask for less."
        )
        return None, "infeasible", reason
    best = int(np.where(good, values, -np.inf).argmax())
    if fits and values[best] <= start_value + _ROUNDING * abs(start_value):
        return None, status, "no start is better than the layout given."
    reason = f"start {best + 1} of {len(values)} is best; {good.sum()} satisfy the constraints."
    if not fits:
        reason += (
            " The layout given does not satisfy what is asked, and was changed until it did before the first step."
        )
    return best, status, reason


def _named(layout: Layout, skin: Varied, outline: Domain, contacts: bool) -> Layout:
    return Layout(
        skin.centres,
        2 * skin.radii,
        contact_impedance=skin.contact_impedance if contacts else layout.contact_impedance,
        outline=outline,
        labels=layout.labels,
        name=f"{layout.name}, optimised",
    )


def _contacts(model: ForwardModel) -> Float[Array, " L"]:
    return model.electrodes.contact_impedance  # pyright: ignore[reportAttributeAccessIssue]


def _check(layout: Layout, model: ForwardModel, steps: int, starts: int, key) -> None:
    if not isinstance(model.electrodes, SheetDiscs):
        raise ValueError(
            f"model has {type(model.electrodes).__name__}; layouts are optimised on a sheet with SheetDiscs, such as "
            "layout.sheet_discs(contact_impedance)."
        )
    if model.electrodes.num_electrodes != layout.num_electrodes:
        raise ValueError(
            f"layout has {layout.num_electrodes} electrodes and the model {model.electrodes.num_electrodes}; their "
            "number cannot change."
        )
    for name, number in (("steps", steps), ("starts", starts)):
        if not isinstance(number, int) or number < 1:
            raise ValueError(f"{name} must be a whole number from 1; it is {number!r}.")
    if starts > 1 and key is None:
        raise ValueError("key: random starts need one, such as jax.random.key(0).")


def _check_keep_out(keep_out) -> None:
    if isinstance(keep_out, Domain) or not all(isinstance(one, Domain) for one in keep_out):
        raise ValueError(f"keep_out must be a list of domains, such as [Disk(0.01, (0.02, 0.0))]; it is {keep_out!r}.")


def _check_outline(outline: Domain, model: ForwardModel) -> None:
    low_x, high_x, low_y, high_y = outline.extent
    points = np.asarray(model.mesh.points)
    off = max(*(points.min(axis=0) - (low_x, low_y)), *((high_x, high_y) - points.max(axis=0)))
    # The mesh of a disk is a polygon inside it.
    if off > _OFF * max(high_x - low_x, high_y - low_y):
        raise ValueError(f"outline: it reaches {1e3 * off:.3g} mm beyond the model's mesh; give the skin's own.")


def _check_thickness(thickness, touches: SheetTouches, outline: Domain) -> None:
    low_x, high_x, low_y, high_y = outline.extent
    if np.min(thickness) <= touches.depth:
        raise ValueError(f"thickness: the touches are {1e3 * touches.depth:.3g} mm deep; let the sheet be thicker.")
    if np.max(thickness) > max(high_x - low_x, high_y - low_y):
        raise ValueError(f"thickness is {thickness!r} metres, more than the skin is wide; are they millimetres?")
