"""Damage detected from frames: cuts, dead electrodes and torn wires, false alarms, and errors of touches beside cuts.

Park et al. 2022 cut and repaired their skin, and saw no artefacts afterwards. They publish no figures, so the limits
are jeit's own: at least 95 % of cuts of the full depth are detected, at most 1 % of alarms are false, and touches
farther than 25 mm from the cut (12.5 mm on the skin of half the size) have errors of at most 1.2 times those on the
undamaged skin.
"""

from __future__ import annotations

import itertools

import numpy as np

from benchmarks.harness.case import Asked, Case, Options, Result, Table, judged
from benchmarks.harness.timing import say
from benchmarks.problems.damaged_skins import APART, RATE, DamagedSkin, changes
from jeit.touch import watch
from jeit.touch.health import EventKind

SKINS = {"park": "hydrogel, 200 mm, 32 inner electrodes, 94 pairs", "round": "film, 100 mm, 16 electrodes, 208"}
# Seconds of a sequence of touches, seconds of a recording with damage, and time in seconds at which the damage begins.
SEQUENCE, RECORDING, BEGINS = 60.0, 90.0, 30.0
# These have no limit.
SEED = 1
HEADER = ["skin", "what", "recordings", "detected", "named correctly", "detected after, median", "error, median"]


def run(options: Options) -> Result:
    """Monitor sequences of touches without damage, then with every kind of damage."""
    quick = options.quick
    rows, asked = [], []
    for name in ("park",) if quick else SKINS:
        skin = DamagedSkin(name, SEED, (900, 500) if quick else (2500, 1200), 10 if quick else 120)
        for part in (_touches, _cuts, _faults):
            found, verdicts = part(skin, quick)
            rows += found
            asked += verdicts
            for row in found:
                say(" | ".join(row))
    caption = "Error of a cut: mean distance of its path and the detected one, both ways. Half as deep: no limit."
    return Result([Table(HEADER, rows, "Damage detected", caption)], asked)


def _touches(skin: DamagedSkin, quick: bool) -> tuple[list[list[str]], list[Asked]]:
    number, seconds = 4 if quick else 1000, np.arange(0, SEQUENCE, 1 / RATE)
    alarms = 0
    for one in range(number):
        frames = skin.read(skin.skin, 1000 + one, seconds, skin.touches)
        alarms += bool(watch(skin.health, frames, seconds).events)
    share = alarms / number
    row = [SKINS[skin.name], "touches, no damage", f"{number:,}", f"{alarms}", "", "", ""]
    asked = f"{skin.name}: false alarms < 1 % of 1,000 touch sequences"
    return [row], [judged(asked, f"{100 * share:.1f} %", share < 0.01)]


def _cuts(skin: DamagedSkin, quick: bool) -> tuple[list[list[str]], list[Asked]]:
    rows, asked = [], []
    seconds = np.arange(0, RECORDING, 1 / RATE)
    for depth, number, first in ((1.0, 1 if quick else 20, 10_000), (0.5, 1 if quick else 5, 20_000)):
        detected, named, after, error, beside = 0, 0, [], [], []
        for one in range(first, first + number):
            cut = skin.cut(one, depth)
            whole, torn, glued = skin.damaged(cut)
            touches = skin.presses(one, 6)
            before, later = changes(whole, touches), changes(torn, touches)
            known = watch(skin.health, skin.read(whole, one, seconds, before, (BEGINS, torn, later)), seconds)
            events = [event for event in known.events if abs(event.time - BEGINS) < 3.0]
            detected += bool(events)
            cuts = [event for event in events if event.kind == EventKind.CUT]
            named += bool(cuts)
            after += [event.noticed - BEGINS for event in events[:1]]
            error += [apart(cut.along(1e-3), event.path) for event in cuts[:1] if event.path is not None]
            away = far(skin, one, cut)
            if depth == 1 and events and away:
                mended = known.repaired(
                    skin.skin.read(skin.key(one), np.tile(skin.at_rest(glued), (10, 1)), np.array([80.0]))
                )
                states = ((skin.health, whole), (known, torn), (mended, glued))
                beside.append([skin.off(health, state, away, one) for health, state in states])
        median = [f"{np.median(after):.1f} s" if after else "–", f"{1e3 * np.median(error):.1f} mm" if error else "–"]
        rows.append(
            [SKINS[skin.name], f"cuts, {depth:g} of the depth", str(number), str(detected), str(named), *median]
        )
        if depth == 1:
            asked.append(
                judged(
                    f"{skin.name}: ≥ 95 % of cuts found", f"{100 * detected / number:.0f} %", detected >= 0.95 * number
                )
            )
        if beside:
            off = np.concatenate(beside, axis=1)
            means = np.nanmean(off, axis=1)
            for condition, mean in zip(("beside the cut", "after repair"), means[1:], strict=True):
                errors_beside = f"{1e3 * mean:.1f} against {1e3 * means[0]:.1f} mm, {mean / means[0]:.2f}×"
                asked.append(
                    judged(f"{skin.name}: touches {condition} ≤ 1.2 × pristine", errors_beside, mean <= 1.2 * means[0])
                )
    return rows, asked


def _faults(skin: DamagedSkin, quick: bool) -> tuple[list[list[str]], list[Asked]]:
    rows, asked = [], []
    seconds = np.arange(0, RECORDING, 1 / RATE)
    number = 1 if quick else 10
    for kind in ("dead", "torn", "loose"):
        detected, named, after = 0, 0, []
        for one in range(30_000, 30_000 + number):
            electrode, more = skin.fault(one, kind, seconds, BEGINS)
            known = watch(skin.health, skin.read(skin.skin, one, seconds, skin.touches, more=more), seconds)
            events = [event for event in known.events if abs(event.time - BEGINS) < 3.0]
            detected += bool(events)
            right = [event for event in events if event.electrode == electrode]
            named += bool(right)
            after += [event.noticed - BEGINS for event in events[:1]]
        median = f"{np.median(after):.1f} s" if after else "–"
        rows.append([SKINS[skin.name], f"{kind} electrodes", str(number), str(detected), str(named), median, ""])
        if kind != "loose":
            asked.append(
                judged(f"{skin.name}: {kind} electrodes found and named", f"{named} of {number}", named == number)
            )
    return rows, asked


def far(skin: DamagedSkin, number: int, cut) -> list:
    """Touches with at least the required distance from the cut."""
    away = []
    for press in skin.presses(number + 50_000, 12):
        if np.linalg.norm(cut.along(1e-3) - press.position, axis=1).min() > APART * skin.scale:
            away.append(press)
    return away[:6]


def apart(true: np.ndarray, path: np.ndarray) -> float:
    """Mean distance in metres between the true path of a cut (n, 2) and the detected path (k, 2), averaged over both
    directions."""
    parts = [np.linspace(a, b, 50) for a, b in itertools.pairwise(path)]
    distance = np.linalg.norm(true[:, None] - np.concatenate(parts), axis=-1)
    return 0.5 * float(distance.min(axis=0).mean() + distance.min(axis=1).mean())


CASE = Case("skin_health", "damage detected from frames, and touches located beside it", run, 20, timed=False)
