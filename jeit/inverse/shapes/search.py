"""`reconstruct_shapes`: the strong bodies that explain a frame of voltages, as many as it tells of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_has_values, check_kind, is_number, told
from jeit.forward import ForwardModel
from jeit.inverse.nonlinear.checks import check_background, check_frame, check_noise
from jeit.inverse.nonlinear.observed import independent_data
from jeit.inverse.shapes.problem import ShapeProblem
from jeit.inverse.shapes.star import Star, StarPrior, Stars
from jeit_solvers.engines import as_array

# How many times the objective must rise, at least, when a body is left out and the others fitted again.
LEAST_RISE = 1.4
# And when a body is taken for strong that is better taken for weak, which costs no coefficient.
_LEAST_RISE_WEAK = 1.1
_FIRST_STEPS, _STEPS, _STEPS_WITHOUT, _STEPS_TRIED = 15, 40, 8, 6
_ROUGHLY = 1e-2
# Directions, from its longer axis, along which a star is split in two; and how many changes are made at most.
_ACROSS, _MOST_CHANGES = (0.0, np.pi / 2), 10


class ShapeReconstruction(eqx.Module):
    """What `reconstruct_shapes` found.

    **Fields**: `stars`, the bodies, those that explain most first; `conductivity` (m,), S/m (2-D: S); `voltages` (M,),
    what the model predicts for it; `misfit`, root mean square of predicted - measured over the channels used, in
    standard deviations; `drift`, how many times as conductive as its `background` the bath is, less one; `doubtful`,
    bodies that were started from and left out again, their `rise` too small.
    """

    stars: tuple[Star, ...]
    conductivity: Float[Array, " m"]
    voltages: Float[Array, " M"]
    misfit: Float[Array, ""]
    drift: float
    doubtful: tuple[Star, ...]

    @property
    def hyperparameter(self) -> float:
        """NaN: shapes have a prior of their own."""
        return float("nan")

    @property
    def rule(self) -> str:
        """No rule chose it: "none"."""
        return "none"

    @property
    def choice(self) -> None:
        """None."""
        return None


def reconstruct_shapes(
    model: ForwardModel,
    voltages: Float[Array, " M"],
    background: ArrayLike,
    *,
    start: Sequence[tuple[int, Sequence[float], float]],
    noise: Float[Array, " M"] | float | None = None,
    mask: Bool[Array, " M"] | None = None,
    prior: StarPrior | None = None,
    least_rise: float = LEAST_RISE,
) -> ShapeReconstruction:
    """The strong bodies, as star shapes, that explain measured `voltages` (M,), in volts, of a sheet or tank.

    - `background`: conductivity without them, one number or (m,), S/m (2-D: S); what it has drifted is estimated.
    - `start`: sign, centre (x, y) and radius, metres, of every body that may be there, such as of all the inclusions
      of an image; too many do no harm, and two that are one there are told apart; where none is, none is added.
    - `noise`, `mask`: as in `jeit.inverse.reconstruct`. `prior`: `StarPrior()` unless given.
    - `least_rise`: bodies whose loss raises the objective less than so many times are taken for ghosts; and those that
      raise it by less than they have coefficients (Akaike).

    All are fitted together, as strong disks first. Then one after the other is left out and the rest fitted again, and
    that which is missed least goes, for as long as it is missed so little. What errors of the model and electrodes gone
    missing make of themselves is missed little, for other bodies can take its place. Of what is left, each is split in
    two for as long as that explains as much more, or taken for weak where that explains any more.

    Raises `ValueError` for arguments that do not fit, and for solids.

    Kolehmainen, Arridge, Lionheart, Vauhkonen and Kaipio, Inverse Problems 15 (1999) 1375, boundaries by Fourier
    coefficients; the choice by evidence is jeit's own.
    """
    measured, used = check_frame(model, voltages, mask)
    check_has_values("reconstruct_shapes", (model, measured), "bodies are chosen by comparison", "take reconstruct")
    if model.mesh.dimension != 2:
        raise ValueError(
            "reconstruct_shapes: star shapes are for sheets and tanks in two dimensions; take reconstruct."
        )
    background = np.asarray(check_background(model, background))
    deviation = check_noise(noise, measured, used)
    prior = StarPrior() if prior is None else prior
    check_kind("prior", prior, StarPrior, "a StarPrior, such as StarPrior(modes=4)")
    if not (is_number(least_rise) and least_rise >= 1):
        raise ValueError(f"least_rise must be a number from 1; it is {told(least_rise)}.")
    sign, centre, radius = _checked_start(start)
    small, data = independent_data(model, measured, used, deviation, at_once=True)
    problem = ShapeProblem(small, data, background)
    stars = Stars.create(model.mesh, prior, centre, sign)
    stars, coefficients = _grown(problem, stars, stars.of_radii(radius))
    fitted = _Fit(problem, stars, *problem.fit(stars, coefficients, _STEPS))
    fitted, rises, doubtful = _without_ghosts(fitted, least_rise)
    for _ in range(_MOST_CHANGES):
        changed = _with_one_change(fitted, least_rise)
        if changed is None:
            break
        fitted, rises, ghosts = _without_ghosts(changed, least_rise)
        doubtful += ghosts
    stars, coefficients = fitted.stars, fitted.coefficients
    conductivity = background * np.exp(stars.image(coefficients).image)
    predicted = np.asarray(model.voltages(conductivity))
    excess = ((predicted - np.asarray(measured)) / np.asarray(deviation))[used]
    order = np.argsort(-np.asarray(rises), kind="stable")
    return ShapeReconstruction(
        stars=tuple(stars.star(int(k), coefficients, rises[k]) for k in order),
        conductivity=as_array(conductivity),
        voltages=as_array(predicted),
        misfit=as_array(np.sqrt(np.mean(excess**2))),
        drift=float(np.expm1(prior.drift * coefficients[0])),
        doubtful=tuple(doubtful),
    )


def _checked_start(start):
    """Signs (k,), centres (k, 2) and radii (k,). Raises `ValueError`."""
    try:
        sign = np.array([one[0] for one in start], float)
        centre = np.array([one[1] for one in start], float).reshape(-1, 2)
        radius = np.array([one[2] for one in start], float)
    except (TypeError, ValueError, IndexError) as error:
        raise ValueError("start: give (sign, (x, y), radius), metres, for every body.") from error
    if not (np.isin(sign, (-1, 1)).all() and np.isfinite(centre).all() and (radius > 0).all()):
        raise ValueError("start: signs are +1 or -1, centres finite and radii positive, metres.")
    return sign, centre, radius


class _Fit(NamedTuple):
    """Stars fitted to data; the least `cost`."""

    problem: ShapeProblem
    stars: Stars
    coefficients: Float[np.ndarray, " n"]
    cost: float


def _grown(problem: ShapeProblem, stars: Stars, coefficients, steps: int = _FIRST_STEPS):
    """Stars with all their modes, fitted to the data as disks; and their coefficients."""
    disks, coefficients = stars.with_modes(1, coefficients)
    coefficients, _ = problem.fit(disks, coefficients, steps, _ROUGHLY)
    return disks.with_modes(stars.prior.modes, coefficients)


def _is_told(worse: float, better: float, coefficients: int, least_rise: float) -> bool:
    """Whether data tell of what has so many coefficients and lowers the objective from `worse` to `better`."""
    return worse >= max(least_rise * better, better + coefficients)


def _without_ghosts(fitted: _Fit, least_rise: float) -> tuple[_Fit, list[float], list[Star]]:
    """Stars that data tell of, and their rises; and those left out."""
    doubtful: list[Star] = []
    while True:
        problem, stars, coefficients, cost = fitted
        tried = []
        for k in range(len(stars.sign)):
            others, remaining = stars.without(k, coefficients)
            tried.append((*problem.fit(others, remaining, _STEPS_WITHOUT, 2 * _ROUGHLY), others))
        rises = [value / cost for _, value, _ in tried]
        if not rises or _is_told(min(rises) * cost, cost, stars.prior.size, least_rise):
            return fitted, rises, doubtful
        least = int(np.argmin(rises))
        doubtful.append(stars.star(least, coefficients, rises[least]))
        remaining, _, others = tried[least]
        fitted = _Fit(problem, others, *problem.fit(others, remaining, _STEPS))


def _with_one_change(fitted: _Fit, least_rise: float) -> _Fit | None:
    """Of the stars with one of them split in two, or one or all taken for weak, those that explain most; None if data
    do not tell of the change."""
    problem, stars, coefficients, cost = fitted
    tried = []
    for k in range(len(stars.sign)):
        for across in _ACROSS:
            two, start = _grown(problem, *stars.split(k, coefficients, across), _STEPS_TRIED)
            tried.append((*problem.fit(two, start, 3, _ROUGHLY), two))
    strong = np.flatnonzero(~stars.weak)
    for some in [[k] for k in strong] + [strong] * (len(strong) > 1):
        weak, start = stars.weakened(some, coefficients)
        tried.append((*problem.fit(weak, start, _STEPS_TRIED, _ROUGHLY), weak))
    if not tried:
        return None
    start, _, changed = min(tried, key=lambda one: one[1])
    start, value = problem.fit(changed, start, _STEPS)
    more = len(start) - len(coefficients)
    told = _is_told(cost, value, more, least_rise if more else min(least_rise, _LEAST_RISE_WEAK))
    return _Fit(problem, changed, start, value) if told else None
