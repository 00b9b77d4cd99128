"""`reconstruct_shapes`: the bodies that explain a frame of voltages; their number is estimated from the data."""

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
from jeit.inverse.nonlinear.problem import check_background, check_frame, check_noise, independent_data
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.shapes.bodies import Bodies, BodyPrior
from jeit.inverse.shapes.ellipsoid import Ellipsoid, EllipsoidPrior, Ellipsoids, alternatives, contrast_deviations
from jeit.inverse.shapes.problem import Fit, ShapeProblem, SmoothField
from jeit.inverse.shapes.star import Star, StarPrior, Stars
from jeit.mesh import check_flat
from jeit_solvers.engines import as_array

if TYPE_CHECKING:
    from jeit.inverse.shapes.finer import Finer

# Least factor by which the objective must rise when a body is left out and the others are fitted again.
LEAST_RISE = 1.4
_FIRST_STEPS, _STEPS, _STEPS_WITHOUT, _STEPS_TRIED = 15, 40, 8, 6
_ROUGHLY = 1e-2
# After so many in a row that data do not ask for, weaker ones are not tried.
_MOST_REFUSED = 2
# Least factor by which the objective rises without a body, for the body to be beyond doubt.
_SURELY = 10.0
# Greatest number of changes of the number or kind of bodies.
_MOST_CHANGES = 10
# Greatest number of times that the mesh is refined at the bodies, which move as a result. And the lengths of edges
# there, in units of the least half axis, that are tried in turn: while ghosts are among the bodies, and afterwards.
_MOST_MESHES, _EDGES = 3, ((0.7,), (0.25, 0.35, 0.5, 0.7))
# Least gain of the log evidence for which the richer of two descriptions of the bodies is accepted.
_MARGIN = 2.0


Body = Star | Ellipsoid


class FinerImage(eqx.Module):
    """Conductivity on a finer mesh: `conductivity` (c,), S/m, of the cells of the mesh of `model`. The electrodes lie
    as before; the protocol of `model` is another one, of independent channels."""

    model: ForwardModel
    conductivity: Float[Array, " c"]


class ShapeReconstruction(eqx.Module):
    """Result of `reconstruct_shapes`.

    **Fields**: `bodies`, `Star`s of a sheet and `Ellipsoid`s of a solid, those that explain most first; `conductivity`
    (m,), S/m (2-D: S), of a solid's cells that are covered in part the geometric mean; `voltages` (M,), what the model
    predicts for the bodies; `misfit`, root mean square of predicted - measured over the channels used, in standard
    deviations; `drift`, the bath's conductivity over its `background`, less one; `doubtful`, bodies among the starts
    that were left out again because their `rise` is too small; `contrast_deviations`, posterior standard deviation of
    each body's contrast due to noise, in solids with 0.1 added for the mesh; `alternatives`, each body of a solid as
    the other kind, ellipsoid or column, where the data do not determine which it is, else None;
    `alternative_deviations`, of their contrasts, or NaN; `finer`, of a solid in which there are any, on the last of the
    meshes that are finer at their surfaces: for pictures.
    """

    bodies: tuple[Body, ...]
    conductivity: Float[Array, " m"]
    voltages: Float[Array, " M"]
    misfit: Float[Array, ""]
    drift: float
    doubtful: tuple[Body, ...]
    contrast_deviations: tuple[float, ...]
    alternatives: tuple[Ellipsoid | None, ...]
    alternative_deviations: tuple[float, ...]
    finer: FinerImage | None = None

    @property
    def hyperparameter(self) -> float:
        """NaN: shapes have a prior of their own."""
        return float("nan")

    @property
    def rule(self) -> str:
        """ "none", as no rule chooses a hyperparameter."""
        return "none"

    @property
    def choice(self) -> None:
        """None, as there is no hyperparameter."""
        return None


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
    progress: Callable[[str], None] | None = None,
) -> ShapeReconstruction:
    """Estimate the bodies, star shapes in a sheet and ellipsoids in a solid, that explain measured `voltages` (M,), in
    volts.

    - `background`: conductivity without them, one number or (m,), S/m (2-D: S); its drift is estimated.
    - `start`: sign, centre (x, y) or (x, y, z) and radius, metres, of every body that may be there, such as of all the
      inclusions of an image; surplus starts do no harm, and two bodies that share one start are separated; no body is
      added where no start is given.
    - `noise`, `mask`: as in `jeit.inverse.reconstruct`.
    - `prior`: `StarPrior()` of sheets, `EllipsoidPrior()` of solids, unless given.
    - `least_rise`: bodies without which the objective rises by less than this factor, or that the evidence does not
      favour, are treated as ghosts.
    - `smooth`: an image of the same channels by a smooth prior and no bounds; what it shows besides bodies is modelled
      as a `SmoothField`, whose level is chosen by the evidence, and only bodies that are detected beside that field are
      fitted.
    - `progress` is called with the name of each stage as it begins: those of a solid take up to a minute.

    All bodies are first fitted together, as strong disks or balls. Then each in turn is left out and the rest are
    fitted again, and the body whose loss raises the objective least is removed, as long as the rise is small. Ghosts
    due to errors of the model and missing electrodes are removed in this way, since other bodies can take their place.
    Each remaining body is split in two, or changed to the other kind, a weak star or a column from floor to lid, where
    the evidence favours it (`ShapeProblem.surprise`): once with splits first, once with kinds first; the better result
    is kept.

    Raises `ValueError` for arguments that do not fit, and for a `smooth` that is no image of these channels by a smooth
    prior.

    Kolehmainen, Arridge, Lionheart, Vauhkonen and Kaipio, Inverse Problems 15 (1999) 1375, boundaries by Fourier
    coefficients; the choice by evidence is jeit's own.
    """
    measured, used = check_frame(model, voltages, mask)
    check_has_values("reconstruct_shapes", (model, measured), "bodies are chosen by comparison", "take reconstruct")
    check_flat(model.mesh, "star shapes")
    background = np.asarray(check_background(model, background))
    deviation = check_noise(noise, measured, used)
    form, kind = (Stars, StarPrior) if model.mesh.dimension == 2 else (Ellipsoids, EllipsoidPrior)
    prior = kind() if prior is None else prior
    check_kind("prior", prior, kind, f"one of bodies of that dimension, such as {kind.__name__}(modes=2)")
    if not (is_number(least_rise) and least_rise >= 1):
        raise ValueError(f"least_rise must be a number from 1; it is {describe(least_rise)}.")
    sign, centre, radius = _checked_start(start, model.mesh.dimension)
    small, data = independent_data(model, measured, used, deviation, at_once=True)
    solid = model.mesh.dimension == 3
    problem = ShapeProblem(small, data, background, _ROUGHLY if solid else ShapeProblem.rtol)
    bodies = form.create(model.mesh, prior, centre, sign)
    coefficients = bodies.of_radii(radius)
    if isinstance(prior, EllipsoidPrior) and prior.kinds == "columns":
        bodies, coefficients = bodies.otherwise(range(len(radius)), coefficients)
    setting = _Setting(problem, None if smooth is None else SmoothField.create(smooth, problem))
    level, report = 0.0, progress or (lambda stage: None)
    report("bodies")
    if smooth is not None:
        level, balls, _ = _added_one_by_one(setting, *bodies.with_modes(1, coefficients))
        bodies, coefficients = balls.bodies.with_modes(prior.modes, balls.coefficients)
        problem = setting.problem(level)
    fitted = problem.fit(*_grown(problem, bodies, coefficients, _FIRST_STEPS), _STEPS)
    found = _without_ghosts(problem, fitted, (), least_rise)
    report("bodies, how many")
    best, there = _State(setting, level, _changed(problem, found, least_rise)), None
    if solid:
        best, there = _on_finer_meshes(best, least_rise, report)
        report("bodies, of which kind")
    (setting, level, (each, rises, doubtful)), beside = best, best.setting.beside
    problem = setting.problem(level)
    fitted = _of_one_material(problem, each)
    bodies, coefficients = fitted.bodies, fitted.coefficients
    field = 0.0 if beside is None else beside.estimate(level, fitted)
    drawn = bodies.on(model.mesh) if isinstance(bodies, Ellipsoids) else bodies
    conductivity = background * np.exp(drawn.shown(coefficients) + field)
    predicted, image = np.asarray(model.voltages(conductivity if there is None else background)), None
    if there is not None:
        predicted = predicted + there.change(model.protocol, bodies.image(coefficients).image, field)
        image = FinerImage(there.problem.model, as_array(there.conductivity(bodies.shown(coefficients), field)))
    others, deviations = alternatives(problem, fitted), contrast_deviations(problem, fitted, each)
    excess = ((predicted - np.asarray(measured)) / np.asarray(deviation))[used]
    order = np.argsort(-np.asarray(rises), kind="stable")
    return ShapeReconstruction(
        bodies=tuple(bodies.body(int(k), coefficients, rises[k]) for k in order),
        conductivity=as_array(conductivity),
        voltages=as_array(predicted),
        misfit=as_array(np.sqrt(np.mean(excess**2))),
        drift=float(np.expm1(prior.drift * coefficients[0])),
        doubtful=doubtful,
        contrast_deviations=tuple(deviations[k] for k in order),
        alternatives=tuple(others[k][0] for k in order),
        alternative_deviations=tuple(others[k][1] for k in order),
        finer=image,
    )


def _checked_start(start, dimension: int):
    """Signs (k,), centres (k, d) and radii (k,). Raises `ValueError`."""
    try:
        sign = np.array([one[0] for one in start], float)
        centre = np.array([one[1] for one in start], float).reshape(-1, dimension)
        radius = np.array([one[2] for one in start], float)
    except (TypeError, ValueError, IndexError) as error:
        place = "x, y, z"[: 3 * dimension - 2]
        raise ValueError(f"start: give (sign, ({place}), radius), metres, for every body.") from error
    if not (np.isin(sign, (-1, 1)).all() and np.isfinite(centre).all() and (radius > 0).all()):
        raise ValueError("start: signs are +1 or -1, centres finite and radii positive, metres.")
    return sign, centre, radius


def _grown(problem: ShapeProblem, bodies: Bodies, coefficients, steps: int):
    """Bodies with all their modes, fitted to the data as round ones; and their coefficients."""
    found = problem.fit(*bodies.with_modes(1, coefficients), steps, _ROUGHLY)
    return found.bodies.with_modes(bodies.prior.modes, found.coefficients)


class _Setting(NamedTuple):
    """Setting in which bodies are fitted: the problem of them `alone`, or with a smooth field `beside` it."""

    alone: ShapeProblem
    beside: SmoothField | None

    def problem(self, level: float) -> ShapeProblem:
        """The problem with the field at a level."""
        return self.alone if self.beside is None else self.beside.beside(level)

    def on(self, alone: ShapeProblem) -> _Setting:
        """The same with the problem on another mesh."""
        return _Setting(alone, self.beside and replace(self.beside, alone=alone))

    def settled(self, bodies: Bodies, coefficients, level: float, steps: int) -> tuple[float, Fit, float]:
        """The level of the field that goes with some bodies, from a `level` on; their fit, and -log evidence for both.
        From above, so that bodies are not bent by what the field explains."""
        while True:
            problem = self.problem(level)
            fit = problem.fit(bodies, coefficients, steps, _ROUGHLY)
            likeliest = level if self.beside is None else self.beside.likeliest(fit)
            if likeliest >= level:
                return level, fit, problem.surprise(fit) + problem.uncertainty
            level, coefficients = likeliest, fit.coefficients


def _added_one_by_one(setting: _Setting, bodies: Bodies, coefficients, sure: int = 0) -> tuple[float, Fit, list[int]]:
    """The level of a smooth field, the bodies that data ask for besides, each after those before it, and which they
    are. The first `sure` are beyond doubt and fitted together: one of two that is fitted alone moves between them, and
    does not come back."""
    rows = bodies.rows(coefficients)
    chosen, refused = list(range(sure)), 0
    start = np.append(coefficients[0], rows[:sure])
    level, fit, least = setting.settled(bodies.only(chosen), start, 1.0, _FIRST_STEPS)
    for k in range(sure, len(rows)):
        start = np.append(fit.coefficients, rows[k])
        tried, one, surprise = setting.settled(bodies.only([*chosen, k]), start, level, _FIRST_STEPS)
        if surprise + _MARGIN <= least:
            level, fit, least, chosen, refused = tried, one, surprise, [*chosen, k], 0
        elif (refused := refused + 1) == _MOST_REFUSED:
            break
    return level, fit, chosen


class _Found(NamedTuple):
    """Bodies that the data support, with their rises, and the bodies left out."""

    fit: Fit
    rises: list[float]
    doubtful: tuple[Body, ...]


class _State(NamedTuple):
    """State of the search: the bodies `found` in a `setting`, with the field at its `level`."""

    setting: _Setting
    level: float
    found: _Found


def _on_finer_meshes(state: _State, least_rise: float, report: Callable[[str], None]) -> tuple[_State, Finer | None]:
    """The same fitted where the mesh is finer on their surfaces, again until they stay there; ghosts that a coarser one
    made are not. And the last of those meshes."""
    from jeit.inverse.shapes.finer import finer

    given, there = state.setting, None
    for again in range(_MOST_MESHES):
        _, level, (before, rises, doubtful) = state
        if not len(before.bodies.sign):
            break
        report(f"bodies, finer mesh {again + 1}")
        there = finer(given.alone, before, _EDGES[again > 0])
        setting, bodies, coefficients = given.on(there.problem), there.bodies, before.coefficients
        missed = np.array(rises) * before.cost
        if again:
            level, fit, _ = setting.settled(bodies, coefficients, level, _STEPS)
        else:
            order = np.argsort(-missed)
            start = np.append(coefficients[0], bodies.rows(coefficients)[order])
            sure = int((missed > _SURELY * before.cost).sum())
            level, fit, some = _added_one_by_one(setting, bodies.only(order), start, sure)
            left = np.setdiff1d(np.arange(len(order)), some)
            doubtful = (*doubtful, *(bodies.body(k, coefficients, rises[k]) for k in order[left]))
            missed = missed[order[some]]
            coefficients = np.append(coefficients[0], bodies.rows(coefficients)[order[some]])
        problem = setting.problem(level)
        fit = problem.fit(fit.bodies, fit.coefficients, _STEPS)
        found = _without_ghosts(problem, fit, doubtful, least_rise, missed)
        if again < _MOST_MESHES - 1 and (other := _otherwise(problem, found.fit)):
            found = _without_ghosts(problem, other, found.doubtful, least_rise)
        state, after = _State(setting, level, found), found.fit
        if again and not bodies.moved(coefficients, after.bodies, after.coefficients):
            break
    return state, there


def _without_ghosts(
    problem: ShapeProblem,
    fitted: Fit,
    doubtful: Sequence[Body],
    least_rise: float,
    known: Float[np.ndarray, " k"] | None = None,
) -> _Found:
    """The bodies that are missed when they are left out and the rest fitted again; the least missed goes first.

    `known`: the cost without each, at least, if that is known.
    """
    doubtful, missed = list(doubtful), np.zeros(len(fitted.bodies.sign)) if known is None else known.copy()
    while True:
        bodies, coefficients, cost, _ = fitted
        # With one ghost fewer that others can replace, the remaining bodies are missed at least as much.
        beyond_doubt = max(_SURELY * cost, problem.surprise(fitted) + _MARGIN)
        unsure, others = np.flatnonzero(missed <= beyond_doubt).tolist(), {}
        for k in unsure:
            others[k] = problem.fit(*bodies.without(k, coefficients), _STEPS_WITHOUT, 2 * _ROUGHLY)
            missed[k] = others[k].cost
        least = min(others, key=lambda k: missed[k], default=None)
        if least is None or (missed[least] >= least_rise * cost and _is_supported(problem, others[least], fitted)):
            return _Found(fitted, list(missed / cost), tuple(doubtful))
        doubtful.append(bodies.body(least, coefficients, float(missed[least]) / cost))
        missed = np.delete(missed, least)
        fitted = problem.fit(others[least].bodies, others[least].coefficients, _STEPS)


def _in_two(problem: ShapeProblem, fitted: Fit, least_rise: float) -> Fit | None:
    """The bodies with one of them split in two; None if the data do not support the split."""
    bodies, coefficients, cost, _ = fitted
    tried = [
        _grown(problem, *bodies.split(k, coefficients, number), _STEPS_TRIED)
        for k in range(len(bodies.sign))
        for number in range(bodies.num_splits)
    ]
    found = _best(problem, fitted, tried)
    return found if found and cost >= least_rise * found.cost and _is_supported(problem, fitted, found) else None


def _otherwise(problem: ShapeProblem, fitted: Fit) -> Fit | None:
    """The bodies with one or all of them changed to the other kind, weak stars or columns; None if the data do not
    support the change."""
    plain = np.flatnonzero(~fitted.bodies.other & (not fitted.bodies.prior.is_of_one_kind))
    some = [[k] for k in plain] + [plain] * (len(plain) > 1)
    found = _best(problem, fitted, [fitted.bodies.otherwise(one, fitted.coefficients) for one in some])
    return found if found and _is_supported(problem, fitted, found) else None


def _of_one_material(problem: ShapeProblem, fitted: Fit) -> Fit:
    """The ellipsoids with those of either sign of one material, where that is likelier than that each is of its own."""
    for sign in (1, -1):
        bodies = fitted.bodies
        if isinstance(bodies, Ellipsoids) and ((bodies.sign == sign) & ~bodies.alike).sum() > 1:
            alike = problem.fit(*bodies.of_one_material(sign, fitted.coefficients), _STEPS)
            fitted = min(fitted, alike, key=problem.surprise)
    return fitted


def _best(problem: ShapeProblem, fitted: Fit, starts: Sequence[tuple[Bodies, Float[np.ndarray, " n"]]]) -> Fit | None:
    """The least cost from several starts, by which a few steps are best; None where those are hopeless beside what is
    fitted."""
    tried = [problem.fit(*one, _STEPS_TRIED, _ROUGHLY) for one in starts]
    best = min(tried, key=lambda one: one.cost, default=None)
    if best is None or best.cost > _SURELY * fitted.cost:
        return None
    return problem.fit(best.bodies, best.coefficients, _STEPS)


def _is_supported(problem: ShapeProblem, simple: Fit, other: Fit) -> bool:
    """Whether the evidence is for the other."""
    return problem.surprise(other) + _MARGIN <= problem.surprise(simple)


def _changed(problem: ShapeProblem, found: _Found, least_rise: float) -> _Found:
    """The bodies that explain the data best once some are split and others of the other kind; or as they are."""
    changes = [_in_two(problem, found.fit, least_rise), _otherwise(problem, found.fit)]
    ways = [_searched(problem, found, one, least_rise) for one in changes if one is not None] or [found]
    return min(ways, key=lambda one: problem.surprise(one.fit))


def _searched(problem: ShapeProblem, found: _Found, changed: Fit, least_rise: float) -> _Found:
    """The bodies that explain the data once they are `changed`: split one by one, and then other kinds tried."""
    for _ in range(_MOST_CHANGES):
        found = _without_ghosts(problem, changed, found.doubtful, least_rise)
        change = _in_two(problem, found.fit, least_rise) or _otherwise(problem, found.fit)
        if change is None:
            break
        changed = change
    return found
