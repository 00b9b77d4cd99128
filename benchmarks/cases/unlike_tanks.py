"""Estimates of bodies in tanks that deviate from their description: places, and coverage of 68 % intervals.

Sheets are those of `problems/unlike_tanks.py`, solids those of `problems/unlike_solids.py`. jeit's defaults were set on
other tanks with some kinds of error; the other kinds of error were kept back. Results of this case were the reason to
examine tanks with a height.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.timing import say
from benchmarks.problems import unlike_solids
from benchmarks.problems.unlike_tanks import KEPT_BACK, SET_ON, Body, Tank, draw, matched
from jeit import image_difference
from jeit.image import Inclusion
from jeit.imaging import ImagedDifference
from jeit.mesh import centroids

TANKS, FIRST = 270, 900_000
SOLIDS, FIRST_SOLID = 30, 910_000
HEADER = [
    "kind of error", "tanks", "bodies", "median place / R", "worst", "missed", "of them detectable", "spurious",
    "with intervals",
    "hold place", "hold change", "hold area", "hold strength", "median radius of place / R", "median width of change",
    "median error of the peak",
]  # fmt: skip


class Outcome(NamedTuple):
    """Result for one body. **Fields**: `distance` of the body's inclusion from the body, in units of half the tank's
    width, infinite if the body is missed. `detectable`: whether the body is stronger than
    `ImagedDifference.detectable_strength` at its centre. `holds` (4,): whether the circle of the place and the
    intervals of change, area and strength contain the true values, None without intervals. `radius` of the circle of
    the place, in units of half the tank's width. `width` of the interval of the logarithm of conductivity, NaN if the
    interval is open. `error` of the logarithm of conductivity at the peak.
    """

    distance: float
    detectable: bool
    holds: tuple[bool, bool, bool, bool] | None
    radius: float
    width: float
    error: float


def run(options: Options) -> Result:
    """Image all tanks; the table has a row for each kind of error."""
    drawn = [(draw, seed) for seed in range(FIRST, FIRST + TANKS)]
    drawn += [(unlike_solids.draw, seed) for seed in range(FIRST_SOLID, FIRST_SOLID + SOLIDS)]
    rows: dict[str, list[tuple[list[Outcome], int]]] = {}
    refused = []
    for draw_tank, seed in drawn[:1] if options.quick else drawn:
        tank = draw_tank(seed)
        try:
            result = image_difference(tank.frame, tank.reference)
        except ValueError as error:
            refused.append(f"tank {seed}, noise {tank.noise:.1%}: {error}"[:160])
            continue
        found, spurious = matched(tank, result.inclusions)
        outcomes = [outcome(tank, body, one, result) for body, one in zip(tank.bodies, found, strict=True)]
        group = "set on" if tank.kind in SET_ON else "kept back"
        for name in (tank.kind, group, "all", "solids" if len(tank.bodies[0].centre) == 3 else "sheets"):
            rows.setdefault(name, []).append((outcomes, spurious))
        say(f"{seed} {tank.kind}, {tank.outline}, noise {tank.noise:.1%}: {_line(tank, outcomes)} {spurious} spurious")
    names = [name for name in (*SET_ON, *KEPT_BACK, "set on", "kept back", "sheets", "solids", "all") if name in rows]
    asked = []
    for name in names:
        for what, share in zip(("place", "change", "area", "strength"), _coverage(rows[name]), strict=True):
            if np.isfinite(share):
                asked.append(judged(f"{name}: {what} held in 60 to 80 %", f"{share:.0%}", bool(0.6 <= share <= 0.8)))
    every = [one for outcomes, _ in rows.get("all", []) for one in outcomes]
    spurious, tanks = sum(one for _, one in rows.get("all", [])), len(rows.get("all", []))
    detectable = [one for one in every if one.detectable]
    missed, missed_of_all = (
        float(np.mean([np.isinf(one.distance) for one in bodies])) if bodies else 0.0 for bodies in (detectable, every)
    )
    places = np.array([one.distance for one in every if np.isfinite(one.distance)])
    worst = max((one.distance for one in detectable if np.isfinite(one.distance)), default=np.nan)
    asked += [
        judged("spurious bodies in ≤ 2 % of tanks", f"{spurious} in {tanks}", spurious <= 0.02 * tanks),
        judged("≤ 3 % of detectable bodies missed", f"{missed:.1%}, {missed_of_all:.1%} of all", missed <= 0.03),
        judged("median place ≤ 0.02 R", f"{np.median(places):.3f} R", bool(np.median(places) <= 0.02)),
        judged("worst place ≤ 0.1 R", f"{places.max():.3f} R, detectable {worst:.3f} R", bool(places.max() <= 0.1)),
    ]
    counts = f"{len(refused)} of {len(refused) + tanks} tanks refused"
    notes = [f"{counts}, as too noisy or unlike their description", *refused[:10]]
    return Result([Table(HEADER, [_row(name, rows[name]) for name in names])], asked, notes)


def outcome(tank: Tank, body: Body, one: Inclusion | None, result: ImagedDifference) -> Outcome:
    """Compare the inclusion `one` of a `result` with the `body` of a tank."""
    background, detectable = float(result.calibration.conductivity), _is_detectable(body, result)
    if one is None:
        return Outcome(np.inf, detectable, None, np.nan, np.nan, np.nan)
    distance = float(np.linalg.norm(np.array(one.centroid) - body.centre)) / tank.size
    ratio = max(1 + one.peak / background, 1e-3)
    error = abs(float(np.log(ratio / (1 + body.change))))
    if one.contrast_interval is None:
        return Outcome(distance, detectable, None, np.nan, np.nan, error)
    assert one.area_interval is not None
    assert one.centroid_radius is not None
    assert one.strength_interval is not None
    truth = (body.change, body.measure, body.strength)
    intervals = (one.contrast_interval, one.area_interval, one.strength_interval)
    change, area, strength = (_holds(value, interval) for value, interval in zip(truth, intervals, strict=True))
    low, high = one.contrast_interval
    width = np.nan if low is None or high is None else float(np.log((1 + high) / (1 + low)))
    radius = one.centroid_radius / tank.size
    return Outcome(distance, detectable, (distance <= radius, change, area, strength), radius, width, error)


def _is_detectable(body: Body, result: ImagedDifference) -> bool:
    """Whether the strength of a `body` exceeds the detectable strength at its centre."""
    centres, strength = np.asarray(centroids(result.calibration.model.mesh)), result.detectable_strength
    assert strength is not None
    return bool(abs(body.strength) > strength[np.argmin(np.linalg.norm(centres - body.centre, axis=1))])


def _holds(value: float, interval: tuple[float | None, float | None]) -> bool:
    low, high = interval
    return (low is None or low <= value) and (high is None or value <= high)


def _coverage(rows) -> np.ndarray:
    """Fractions (4,) of bodies with intervals for which the circle of the place and the intervals of change, area and
    strength contain the true values."""
    held = [one.holds for outcomes, _ in rows for one in outcomes if one.holds is not None]
    return np.mean(held, axis=0) if held else np.full(4, np.nan)


def _row(name: str, rows) -> list[str]:
    every = [one for outcomes, _ in rows for one in outcomes]
    places = np.array([one.distance for one in every])
    seen = places[np.isfinite(places)]
    widths, errors = (np.array([getattr(one, field) for one in every]) for field in ("width", "error"))
    figures = [f"{np.median(seen):.3f}" if seen.size else "", f"{seen.max():.3f}" if seen.size else ""]
    detectable = np.array([one.detectable for one in every])
    missed = [str(np.isinf(places).sum()), str((np.isinf(places) & detectable).sum())]
    counts = [*missed, str(sum(one for _, one in rows))]
    given = sum(one.holds is not None for one in every)
    shares = [f"{share:.0%}" if np.isfinite(share) else "" for share in _coverage(rows)]
    radii = np.array([one.radius for one in every])
    radius = f"{np.nanmedian(radii):.3f}" if np.isfinite(radii).any() else ""
    spreads = [f"× {np.exp(np.nanmedian(one)):.2f}" if np.isfinite(one).any() else "" for one in (widths, errors)]
    return [name, str(len(rows)), str(len(every)), *figures, *counts, str(given), *shares, radius, *spreads]


def _line(tank: Tank, outcomes: list[Outcome]) -> str:
    parts = []
    for body, one in zip(tank.bodies, outcomes, strict=True):
        limit = "" if one.detectable else " below the limit"
        held = "no interval" if one.holds is None else "".join("+" if yes else "-" for yes in one.holds)
        parts.append(f"{body.change:+.0%} {one.distance:.3f} R {held}{limit}")
    return ", ".join(parts)


CASE = Case("unlike_tanks", "estimates of bodies in tanks that deviate from their description", run, 60, timed=False)
