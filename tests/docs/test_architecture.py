"""The pages on architecture describe the house as it stands."""

import re
from pathlib import Path

import pytest
from test_layers import CORE, ROOMS

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "explanation" / "architecture.md").read_text("utf-8")
PAGES = ("explanation/architecture.md", "explanation/code-paths.md", "how-to/add-to-jeit.md")
ALL = "\n".join((ROOT / "docs" / page).read_text("utf-8") for page in PAGES)


def test_the_table_says_what_each_room_may_import():
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*?) *\|$", TEXT, re.MULTILINE))
    assert set(rows) == set(ROOMS)
    for number, (room, said) in enumerate(rows.items()):
        above = list(rows)[:number] if said.startswith("all of the above") else []
        core = CORE if said.startswith("the core") else ()
        below = [*core, *above, *re.findall(r"`(\w+)`", said)]
        assert set(below) == ROOMS[room], room


def test_the_drawing_has_every_room():
    drawing = TEXT.partition("```text")[2].partition("```")[0]
    assert [room for room in ROOMS if not re.search(rf"│ {room}\b", drawing)] == []


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`((?:jeit|solvers|tests|examples)/[\w/.]+)`", ALL))))
def test_files_are_there(path):
    assert (ROOT / path).exists()


def test_names_are_there():
    """What a file is said to hold is in it."""
    said = re.findall(r"`([A-Za-z_]+)`(?: says| there)?,? in\s+`(jeit/[\w/]+\.py)`", ALL)
    said += [(name, path) for path, name in re.findall(r"\*\*`(jeit/[\w/]+\.py)`\*\*, `(\w+)`", ALL)]
    said += re.findall(r"`([A-Z_]+)` (?:in|of)\s+`(jeit/[\w/]+\.py)`", ALL)
    assert len(said) >= 6
    assert [
        (name, path) for name, path in said if not re.search(rf"\b{name}\b", (ROOT / path).read_text("utf-8"))
    ] == []


def test_five_files():
    walk = TEXT.partition("## One measured frame, five files")[2].partition("```")[0]
    assert len(re.findall(r"^\d\. \*\*`jeit/", walk, re.MULTILINE)) == 5
