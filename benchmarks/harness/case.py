"""The one interface of every case: what it is told, and what it answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

MET, MISSED, NOT_MEASURED, NOT_JUDGED = "met", "missed", "not measured", "not judged"


@dataclass(frozen=True)
class Options:
    """What every case is told; `None` and empty mean the case's own choice.

    `quick`: a smoke run on small problems. `output`: where pictures go. `data`: folder of measured data. `nodes` and
    `electrodes`: sizes, for the cases that have a choice. `rounds`: turns of each contestant. `time_limit`: seconds of
    one call, after which a contestant has given up.
    """

    quick: bool = False
    without_pyeit: bool = False
    output: Path | None = None
    data: Path | None = None
    nodes: tuple[int, ...] = ()
    electrodes: tuple[int, ...] = ()
    rounds: int | None = None
    time_limit: float | None = None


@dataclass
class Table:
    """Rows of text under a header; what was done, its time, its accuracy and what it took in the same row."""

    header: list[str]
    rows: list[list[str]]
    title: str = ""
    caption: str = ""


@dataclass
class Asked:
    """One figure that is asked for: what, what was measured, and `met`, `missed` or `not measured` (or nothing)."""

    asked: str
    measured: str
    verdict: str = ""


def judged(asked: str, measured: str, met: bool) -> Asked:
    """A figure that was measured, and whether it is what is asked."""
    return Asked(asked, measured, MET if met else MISSED)


@dataclass
class Headline:
    """The case in one row of the README: the job, jeit's figure, the best opponent's, their ratio, the accuracy."""

    job: str
    jeit: str
    opponent: str = ""
    ratio: str = ""
    accuracy: str = ""


@dataclass
class Result:
    """What a case answers.

    `notes`: who competed, with which choices. `wrong`: results that disagree, for which the command fails.
    """

    tables: list[Table]
    asked: list[Asked] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    headline: Headline | None = None
    wrong: list[str] = field(default_factory=list)
    seconds: float = 0.0
    peak_memory: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain lists and dictionaries, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> Result:
        """Undo `as_dict`."""
        headline = plain["headline"]
        return cls(
            **plain
            | {
                "tables": [Table(**one) for one in plain["tables"]],
                "asked": [Asked(**one) for one in plain["asked"]],
                "headline": None if headline is None else Headline(**headline),
            }
        )


@dataclass(frozen=True)
class Case:
    """A name, a line about it, and the function that measures it.

    `minutes`: about how long it takes on two quiet cores. `page`: a page of the documentation, and the name of the
    markers in it between which its tables go too. `pictures`: whether it draws any. `timed`: whether its figures are
    times; one whose figures are not may run beside another.
    """

    name: str
    description: str
    run: Callable[[Options], Result]
    minutes: float
    page: tuple[str, str] | None = None
    pictures: bool = False
    timed: bool = True
