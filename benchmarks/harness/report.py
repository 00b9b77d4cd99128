"""A case's result as text, and the files in which it is written: `RESULTS.md`, README.md, a page of the
documentation."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

from benchmarks.harness.case import Case, Headline, Result
from benchmarks.harness.machine import ROOT
from benchmarks.harness.tables import duration, markdown, write_between_markers

RESULTS = ROOT / "benchmarks" / "RESULTS.md"
MOST_ROWS = 8
TITLE = (
    "# Results\n\nMade by `python -m benchmarks --all --write`; do not edit. How it is measured: [README](README.md)."
)


def tables(result: Result) -> str:
    """All tables of a case, each under its title."""
    parts = []
    for one in result.tables:
        parts += [part for part in (one.title and f"**{one.title}**", one.caption) if part]
        parts.append(markdown(one.header, one.rows))
    return "\n\n".join(parts)


def text(result: Result, heading: list[str]) -> str:
    """Text of the heading, tables, notes and required figures of a result."""
    spent = f"{duration(result.seconds)} in all"
    if result.peak_memory is not None:
        spent += f"; the case's own process took {result.peak_memory:.0f} MB at most"
    parts = ["\n".join(f"- {line}" for line in dict.fromkeys([*heading, spent, *result.notes])), tables(result)]
    if result.asked:
        parts.append(
            markdown(["asked", "measured", ""], [[one.asked, one.measured, one.verdict] for one in result.asked])
        )
    parts += [f"**Wrong:** {line}" for line in result.wrong]
    return "\n\n".join(parts)


def section(case: Case, result: Result, heading: list[str]) -> str:
    """Text of a case's section of `RESULTS.md`, with the case's row of the README's table in a comment."""
    parts = [f"## {case.name}", f"{case.description[:1].upper()}{case.description[1:]}.", text(result, heading)]
    if result.headline is not None:
        parts.insert(1, f"<!-- headline {json.dumps(vars(result.headline), ensure_ascii=False)} -->")
    return "\n\n".join(parts)


def sections(path: Path) -> dict[str, str]:
    """The sections of a file such as `RESULTS.md`, by name of the case."""
    if not path.exists():
        return {}
    found = re.split(r"^(?=## )", path.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return {one.split("\n", 1)[0][3:].strip(): one.strip() for one in found}


def headlines(known: dict[str, str]) -> dict[str, Headline]:
    """The rows of the README's table that are stored in the sections `known`, by name of the case."""
    found = {name: re.search(r"<!-- headline (.*) -->", one) for name, one in known.items()}
    return {name: Headline(**json.loads(row.group(1))) for name, row in found.items() if row is not None}


def keep(path: Path, name: str, new: str, order: tuple[str, ...]) -> dict[str, str]:
    """Replace or add the section `new` of the case `name` in a file, and return all sections.

    The file is replaced atomically, so that a run that is stopped leaves the old or the new file.
    """
    known = sections(path) | {name: new}
    known = {one: known[one] for one in order if one in known}
    draft = path.with_suffix(".tmp")
    draft.write_text("\n\n".join([TITLE, *known.values()]) + "\n", encoding="utf-8")
    os.replace(draft, path)
    return known


def readme_table(known: dict[str, str]) -> str:
    """The README's table, with at most eight rows."""
    rows = list(headlines(known).values())[:MOST_ROWS]
    header = ["job", "jeit", "best opponent", "times jeit's", "accuracy"]
    cells = [[one.job, one.jeit, one.opponent, one.ratio, one.accuracy] for one in rows]
    return markdown(header, cells, padded=False)


def write(case: Case, result: Result, heading: list[str], order: tuple[str, ...], root: Path = ROOT) -> list[str]:
    """Write the case's section, the README's table, and the case's page of the documentation, if any. Returns messages
    about failures."""
    known = keep(root / "benchmarks" / RESULTS.name, case.name, section(case, result, heading), order)
    pages = [("README.md", "benchmark", readme_table(known))]
    if case.page is not None:
        pages.append((*case.page, tables(result)))
    failed = []
    for page, marker, content in pages:
        try:
            write_between_markers(root / page, content, marker)
        except (OSError, ValueError) as error:
            failed.append(f"{page} is left as it was: {error}")
    return failed
