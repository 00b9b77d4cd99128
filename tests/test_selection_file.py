"""The tests that run on every Python, some of every room, and those that run as users' programs are compiled: lists of
files that are there."""

import pytest
from test_layers import ROOMS, ROOT

LISTED = (ROOT / "tests" / "selection.txt").read_text("utf-8").split()
COMPILED = (ROOT / "tests" / "compiled.txt").read_text("utf-8").split()


@pytest.mark.parametrize("listed", [LISTED, COMPILED], ids=["selection", "compiled"])
def test_files_are_there_once(listed):
    assert [one for one in listed if not (ROOT / one).exists()] == []
    assert len(set(listed)) == len(listed)


def test_every_room_is_in_it():
    rooms = {path.name for path in (ROOT / "tests").iterdir() if any(path.rglob("test_*.py"))}
    beside_the_wheel = {"benchmarks"}  # tests run on what is installed
    assert {one.split("/")[1] for one in LISTED} >= rooms - beside_the_wheel
    assert rooms >= set(ROOMS) - {"start"}
