"""Layout optimisation: electrodes moved by gradients through the forward model until a score is best.

Bounded L-BFGS minimises -score + w Σ (shortfall / pitch)² over positions in the outline's box, with w growing from
stage to stage (the quadratic penalty method: Nocedal and Wright, Numerical Optimization, 2006, chapter 17); what of the
constraints is still missing then is made up by the nearest descent of the penalty alone.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linear_sum_assignment

from jeit.design.constraints import Constraints
from jeit.design.scores import Score, Scores, SheetTouches, TouchPrior, layout_scores
from jeit.electrodes import Layout, SheetDiscs
from jeit.forward import ForwardModel
from jeit.mesh import Domain

Symmetry = Literal["mirror-x", "mirror-y", "rotate-2", "rotate-4"]
_IMAGES = {
    None: ((1, 0, 0, 1),),
    "mirror-x": ((1, 0, 0, 1), (-1, 0, 0, 1)),
    "mirror-y": ((1, 0, 0, 1), (1, 0, 0, -1)),
    "rotate-2": ((1, 0, 0, 1), (-1, 0, 0, -1)),
    "rotate-4": ((1, 0, 0, 1), (0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0)),
}
# Weights of the penalty, and the share of the steps after which each ends.
_STAGES = ((1e2, 0.5), (1e3, 0.8), (1e4, 1.0))
# Constraints are met with so much to spare, metres, that rounding a layout to whole nanometres breaks none.
_SPARE = 2e-7
# Random places from which those inside the outline are taken.
_DRAWS = 20_000
# A score that rises by less in a step, relative, has settled.
_TOLERANCE = 1e-5


class Optimisation(eqx.Module):
    """What `optimise_layout` found from S starts.

    **Fields**

    - `layout`: the best that satisfies all constraints; the one given, if none is better.
    - `scores`: all scores of `layout`; `value`, its score; `start_value`, that of the layout given.
    - `centres` (S, L, 2) metres, `radii` (S, L) metres, `values` (S,): where each start ended, and its score there.
    - `shortfall` (S,): most that any constraint lacks there, metres; 0 where all are satisfied.
    - `history` (S, T): score of each start after each step, without penalties; `snapshots` (S, T, L, 2), metres, and
      the first is the start itself.
    - `status`: "converged", "step limit" or "infeasible", and the `reason`.
    """

    layout: Layout
    scores: Scores
    value: float
    start_value: float
    centres: Float[np.ndarray, "S L 2"]
    radii: Float[np.ndarray, "S L"]
    values: Float[np.ndarray, " S"]
    shortfall: Float[np.ndarray, " S"]
    history: Float[np.ndarray, "S T"]
    snapshots: Float[np.ndarray, "S T L 2"]
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
      half (x or y below the middle) or quarter; those of the first are kept, and the others become their images.
    - `sizes`: electrodes' sizes are moved too, between half and twice what they are, or between two diameters, metres.
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
    constraints = Constraints(outline, float(minimum_spacing), tuple(keep_out))
    design = _Design.create(layout, outline, symmetry, sizes)
    constraints.check_room(design.radii if design.least is None else np.full(layout.num_electrodes, design.least.min()))
    begin = np.stack([design.variables, *_random(design, constraints, starts - 1, key)])
    # A layout given is taken as it is, unless symmetry or the constraints forbid.
    begin = np.array(_feasible(design, constraints, jnp.asarray(begin)))

    task = _Task(model, jnp.asarray(conductivity), touches, prior, jnp.asarray(noise, float), temperature)
    given = task.scores(layout.centres, layout.diameters / 2)
    start_value = float(score(given))
    if not np.isfinite(start_value):
        raise ValueError("score is not finite for the layout given; does some touch change no voltage?")

    def cost(variables, weight):
        return _cost(variables, jnp.asarray(weight), design, constraints, task, score)

    record = _Record(callback)
    variables, settled = jnp.asarray(begin), False
    record.add(variables, cost(variables, _STAGES[0][0])[1])
    done = 0
    for weight, share in _STAGES:
        budget = round(share * steps) - done
        done += budget
        if budget:
            variables, settled = _descend(partial(cost, weight=weight), variables, budget, record)
    variables = _feasible(design, constraints, variables)
    centres, radii = (np.asarray(part) for part in _electrodes(design, variables))
    values = np.asarray(cost(variables, 0.0)[1])
    lacking = np.array([_lacking(constraints, *one) for one in zip(centres, radii, strict=True)])
    path = np.stack([np.asarray(_electrodes(design, one)[0]) for one in record.variables], axis=1)
    best, status, reason = _judge(layout, constraints, values, lacking, start_value, settled)
    found = layout if best is None else _named(layout, centres[best], radii[best], outline)
    return Optimisation(
        found,
        given if best is None else task.scores(found.centres, found.diameters / 2),
        start_value if best is None else float(values[best]),
        start_value,
        centres,
        radii,
        values,
        np.maximum(lacking, 0),
        np.stack(record.values, axis=1),
        path,
        status,
        reason,
    )


class _Task(eqx.Module):
    """What scores depend on besides the electrodes."""

    model: ForwardModel
    conductivity: Array
    touches: SheetTouches
    prior: TouchPrior
    noise: Array
    temperature: float

    def scores(self, centres, radii) -> Scores:
        discs = SheetDiscs(centres, radii, self.model.electrodes.contact_impedance)  # pyright: ignore[reportAttributeAccessIssue]
        moved = self.model.with_electrodes(discs)
        return layout_scores(
            moved, self.conductivity, self.touches, prior=self.prior, noise=self.noise, temperature=self.temperature
        )


class _Design(eqx.Module):
    """From variables between 0 and 1 to electrodes: G generators, of which the others are images.

    `low`, `size` (2,) of the box, metres; `images` (k, 2, 2); `order` (L,) of the images in the layout; `radii` (L,) in
    metres; `span`, log of the largest over the smallest radius and `least` (G,) metres, None if sizes are kept;
    `variables`, of the layout; `pitch`, side of the square that each electrode would have to itself, metres.
    """

    low: np.ndarray
    size: np.ndarray
    images: np.ndarray
    order: np.ndarray
    radii: np.ndarray
    least: np.ndarray | None
    span: np.ndarray | None
    variables: np.ndarray
    pitch: float

    @classmethod
    def create(cls, layout: Layout, outline: Domain, symmetry: str | None, sizes) -> "_Design":
        if symmetry not in _IMAGES:
            raise ValueError(f"symmetry must be None or one of {', '.join(filter(None, _IMAGES))}; it is {symmetry!r}.")
        centres, radii = np.asarray(layout.centres), np.asarray(layout.diameters) / 2
        x_min, x_max, y_min, y_max = outline.extent
        least = span = None
        if sizes is not False:
            ends = (radii / 2, radii * 2) if sizes is True else tuple(np.full(len(radii), d / 2) for d in sizes)
            if not (ends[0] > 0).all() or not (ends[1] > ends[0]).all():
                raise ValueError(f"sizes must be two diameters in metres, the smaller one first; they are {sizes!r}.")
            least, span = ends[0], np.log(ends[1] / ends[0])
        room = radii.min() if least is None else least.min()
        low, size = np.array([x_min, y_min]) + room, np.array([x_max - x_min, y_max - y_min]) - 2 * room
        if (size <= 0).any():
            raise ValueError("outline: it is smaller than an electrode; give millimetres divided by 1000.")
        if symmetry == "rotate-4" and not np.isclose(size[0], size[1]):
            raise ValueError("symmetry: a quarter turn maps only a square onto itself, and the outline's box is none.")
        images = np.array(_IMAGES[symmetry], float).reshape(-1, 2, 2)
        middle = low + size / 2
        first = _in_first_part(centres - middle, symmetry)
        if first.sum() * len(images) != len(centres):
            raise ValueError(
                f"symmetry: {first.sum()} of {len(centres)} electrodes are in the first of {len(images)} parts of the "
                f"skin for '{symmetry}'; give a layout with {len(centres) / len(images):g} in each."
            )
        every = (np.einsum("kij,gj->kgi", images, centres[first] - middle) + middle).reshape(-1, 2)
        # Which image is which electrode: the nearest, all in all.
        order = linear_sum_assignment(np.linalg.norm(centres[:, None] - every, axis=-1))[1]
        variables = np.clip((centres[first] - low) / size, 0, 1).ravel()
        if least is not None and span is not None:
            least, span = least[first], span[first]
            variables = np.concatenate([variables, np.clip(np.log(radii[first] / least) / span, 0, 1)])
        own = np.tile(radii[first], len(images))[order]
        pitch = float(np.sqrt(np.prod(size) / len(order)))
        return cls(low, size, images, order, own, least, span, variables, pitch)

    @property
    def num_generators(self) -> int:
        return len(self.order) // len(self.images)

    def electrodes(self, variables: Float[Array, " v"]) -> tuple[Float[Array, "L 2"], Float[Array, " L"]]:
        """Centres and radii, metres."""
        number = self.num_generators
        place = variables[: 2 * number].reshape(number, 2) * self.size - self.size / 2
        centres = jnp.einsum("kij,gj->kgi", self.images, place).reshape(-1, 2) + self.low + self.size / 2
        radii = jnp.asarray(self.radii)
        if self.least is not None and self.span is not None:
            radii = jnp.tile(self.least * jnp.exp(self.span * variables[2 * number :]), len(self.images))[self.order]
        return centres[self.order], radii


def _in_first_part(offset: np.ndarray, symmetry: str | None) -> np.ndarray:
    x, y = offset.T
    if symmetry == "mirror-x":
        return x < 0
    if symmetry in ("mirror-y", "rotate-2"):
        return y < 0
    return (x > 0) & (y >= 0) if symmetry == "rotate-4" else np.ones(len(offset), bool)


def _random(design: _Design, constraints: Constraints, count: int, key) -> list[np.ndarray]:
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
        rest = design.variables[2 * number :]
        starts.append(np.concatenate([usable[:number].ravel(), rest]))
    return starts


def _penalty(design: _Design, constraints: Constraints, variables, spare=0.0) -> Float[Array, ""]:
    shortfall = constraints.shortfall(*design.electrodes(variables)) + spare
    return jnp.sum((jnp.maximum(shortfall, 0) / design.pitch) ** 2)


def _lacking(constraints: Constraints, centres, radii) -> float:
    """Most that any constraint lacks, metres; nothing where it is within rounding."""
    return float(jnp.max(constraints.shortfall(jnp.asarray(centres), jnp.asarray(radii))))


def _feasible(design: _Design, constraints: Constraints, variables):
    """The starts (S, v) moved until they satisfy the constraints, as far as descent of the penalty leads."""

    def cost(variables):
        value, slope = _missing(variables, design, constraints)
        return value, -value, slope

    return _descend(cost, variables, 500, _Record(None), tolerance=0.0)[0]


@eqx.filter_jit
def _missing(variables, design: _Design, constraints: Constraints):
    """Penalty of each start (S,) and its gradient (S, v); steep, for the descent is to end at zero, not near it."""
    return jax.vmap(jax.value_and_grad(lambda own: 1e6 * _penalty(design, constraints, own, _SPARE)))(variables)


@eqx.filter_jit
def _cost(variables, weight, design: _Design, constraints: Constraints, task: _Task, score: Score):
    """Penalised cost of each start (S,), its score (S,) and the gradient of the cost (S, v)."""

    def one(own):
        value = score(task.scores(*design.electrodes(own)))
        return weight * _penalty(design, constraints, own) - value, value

    # One start after the other: the Jacobian of one fills the cache.
    (cost, value), slope = jax.lax.map(jax.value_and_grad(one, has_aux=True), variables)
    return cost, value, slope


@eqx.filter_jit
def _electrodes(design: _Design, variables):
    return jax.vmap(design.electrodes)(variables)


class _Record:
    """The way of the starts: variables (S, v) and scores (S,) after every step."""

    def __init__(self, callback):
        self.variables, self.values, self.callback = [], [], callback

    def add(self, variables, values) -> None:
        self.variables.append(np.array(variables))
        self.values.append(np.array(values))
        if self.callback is not None:
            self.callback(len(self.values) - 1, self.values[-1])


def _descend(cost, variables, steps: int, record: _Record, *, tolerance: float = _TOLERANCE):
    """Minimise the sum of the starts' costs between 0 and 1; where it ends, and whether it settled."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # jaxopt says on import that it is not developed further
        import jaxopt
    last = {}

    def value_and_slope(variables):
        value, score, slope = cost(variables)
        last.update(variables=np.asarray(variables), score=np.asarray(score))
        return jnp.sum(value), slope

    def after_step(variables):
        same = np.array_equal(last["variables"], variables)
        record.add(variables, last["score"] if same else cost(variables)[1])

    solver = jaxopt.ScipyBoundedMinimize(
        fun=value_and_slope,
        method="L-BFGS-B",
        value_and_grad=True,
        jit=False,
        tol=tolerance,
        maxiter=steps,
        callback=after_step,
    )
    bounds = (jnp.zeros_like(variables), jnp.ones_like(variables))
    found, info = solver.run(variables, bounds)
    return found, bool(info.success)


def _judge(layout, constraints, values, lacking, start_value, settled) -> tuple[int | None, str, str]:
    """Which start is best, None if not one improves on the layout given, and what to say of it."""
    good = (lacking <= 0) & np.isfinite(values)
    fits = _lacking(constraints, layout.centres, layout.diameters / 2) <= 1e-9
    if not good.any():
        reason = f"no start satisfies the constraints: they lack {1e3 * lacking.min():.3g} mm at best."
        return None, "infeasible", reason
    best = int(np.where(good, values, -np.inf).argmax())
    status = "converged" if settled else "step limit"
    if fits and values[best] <= start_value:
        return None, status, "no start is better than the layout given."
    reason = f"start {best + 1} of {len(values)} is best; {good.sum()} satisfy the constraints."
    return best, status, reason


def _named(layout: Layout, centres, radii, outline: Domain) -> Layout:
    return Layout(
        centres,
        2 * radii,
        contact_impedance=layout.contact_impedance,
        outline=outline,
        labels=layout.labels,
        name=f"{layout.name}, optimised",
    )


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
