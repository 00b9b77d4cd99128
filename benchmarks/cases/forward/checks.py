"""The required figures of the case `forward`, compared with the measured figures."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.cases.forward.match import Match
from benchmarks.harness.case import NOT_MEASURED, Asked, judged
from benchmarks.harness.contest import Figures
from benchmarks.harness.tables import duration

JACOBIAN = "voltages and Jacobian"


def checks(matches: list[Match]) -> list[Asked]:
    """All checks that the measured figures allow."""
    return [*_against_pyeit(matches), *_against_scipy(matches), *_images(matches), *_batches(matches)]


def _figures(match: Match, task: str, name: str) -> Figures | None:
    figures = match.figures.get(task, {}).get(name)
    return figures if figures is not None and figures.seconds and not figures.remark else None


def _at_least(asked: str, match: Match, task: str, opponent: str, times: float) -> Asked | None:
    mine, other = _figures(match, task, "jeit"), _figures(match, task, opponent)
    if mine is None or other is None:
        return None
    ratio = other.median / mine.median
    return judged(asked, f"{ratio:.1f}×", ratio >= times)


def _against_pyeit(matches: list[Match]) -> Iterator[Asked]:
    for match in matches:
        if match.model != "point" or match.num_electrodes != 16:
            continue
        times = 100 if match.num_points < 2000 else 50
        asked = f"{JACOBIAN}, 16 electrodes, {match.num_points} nodes: ≥ {times}× pyEIT"
        check = _at_least(asked, match, JACOBIAN, "pyeit", times)
        yield check or Asked(asked, _reason(match), NOT_MEASURED)


def _against_scipy(matches: list[Match]) -> Iterator[Asked]:
    for match in matches:
        if match.model != "complete" or match.num_electrodes != 16:
            continue
        times = 6.0 if match.num_points < 2000 else 5.0 if match.num_points < 10_000 else 2.5
        asked = f"{JACOBIAN}, 16 electrodes, {match.num_points} nodes: ≥ {times:g}× SciPy"
        check = _at_least(asked, match, JACOBIAN, "scipy plain", times)
        if check is not None:
            tuned = _at_least("", match, JACOBIAN, "scipy tuned", times)
            if tuned is not None:
                check.measured += f" ({tuned.measured} tuned SciPy)"
            yield check


def _images(matches: list[Match]) -> Iterator[Asked]:
    for match in matches:
        if match.model != "complete" or match.num_electrodes != 16 or match.num_points > 2000:
            continue
        for task, limit, text in (
            ("linear image", 50e-6, "a linear image < 50 µs"),
            ("1000 linear images", 10e-3, "1,000 linear images < 10 ms"),
        ):
            mine = _figures(match, task, "jeit")
            if mine is not None:
                asked = f"{text} ({match.num_cells} cells, {match.num_channels} channels)"
                yield judged(asked, duration(mine.median), mine.median < limit)


def _batches(matches: list[Match]) -> Iterator[Asked]:
    for match in matches:
        for batch, alone in (("64 conductivities", "voltages"), ("64 Jacobians", JACOBIAN)):
            many, one = _figures(match, batch, "jeit"), _figures(match, alone, "jeit")
            if match.num_electrodes != 16 or many is None or one is None:
                continue
            each = many.median / 64
            # On a quiet machine, medians of two repeated measurements differ by 5 %.
            yield judged(
                f"{batch}, {match.num_points} nodes: per item no more than one alone ({alone})",
                f"{duration(each)} against {duration(one.median)}",
                each <= 1.05 * one.median,
            )


def _reason(match: Match) -> str:
    figures = match.figures[JACOBIAN].get("pyeit")
    return "pyEIT left out" if figures is None else f"pyEIT cannot: {figures.remark}"
