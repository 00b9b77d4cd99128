"""The interface of every benchmark case: options and result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

MET, MISSED, NOT_MEASURED, NOT_JUDGED = "met", "missed", "not measured", "not judged"


@dataclass(frozen=True)
class Options:
    """The options of a benchmark case. If an option is `None` or empty, the case chooses the value.

    `quick`: a smoke run on small problems. `output`: folder for figures. `data`: folder of measured data. `nodes` and
    `electrodes`: numbers of nodes and electrodes, for cases in which they can be chosen. `rounds`: turns of each
    contestant. `time_limit`: maximum seconds of one call of a contestant.
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
    """Table of results: rows of text under a header. Each row has a job, its time, its accuracy and its memory."""

    header: list[str]
    rows: list[list[str]]
    title: str = ""
    caption: str = ""


@dataclass
class Asked:
    """A required figure: the requirement, the measured figure, and `met`, `missed` or `not measured` (or empty)."""

    asked: str
    measured: str
    verdict: str = ""


def judged(asked: str, measured: str, met: bool) -> Asked:
    """A required figure, the measured figure, and whether it meets the requirement."""
    return Asked(asked, measured, MET if met else MISSED)


@dataclass
class Headline:
    """The result of a case in one row of the README: the job, jeit's figure, the best opponent's figure, their ratio,
    and the accuracy."""

    job: str
    jeit: str
    opponent: str = ""
    ratio: str = ""
    accuracy: str = ""


@dataclass
class Result:
    """The result of a benchmark case.

    `notes`: the contestants and their choices. `wrong`: results that disagree, for which the command fails.
    """

    tables: list[Table]
    asked: list[Asked] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    headline: Headline | None = None
    wrong: list[str] = field(default_factory=list)
    seconds: float = 0.0
    peak_memory: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """The result as plain lists and dictionaries, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> Result:
        """Create a result from the return value of `as_dict`."""
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
    """A benchmark case: name, one-line description, and the function that measures it.

    `minutes`: approximate duration on two quiet cores. `page`: a page of the documentation, and the name of the markers
    in the page between which the tables are written. `pictures`: whether the case draws pictures. `timed`: whether the
    figures are times. A case whose figures are not times may run in parallel with another case.
    """

    name: str
    description: str
    run: Callable[[Options], Result]
    minutes: float
    page: tuple[str, str] | None = None
    pictures: bool = False
    timed: bool = True
