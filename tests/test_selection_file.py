"""The selection of tests that runs on every Python: a list of files that are there, some of every room."""

from test_layers import ROOMS, ROOT

LISTED = (ROOT / "tests" / "selection.txt").read_text("utf-8").split()


def test_files_are_there_once():
    assert [one for one in LISTED if not (ROOT / one).is_file()] == []
    assert len(set(LISTED)) == len(LISTED)


def test_every_room_is_in_it():
    rooms = {path.name for path in (ROOT / "tests").iterdir() if any(path.rglob("test_*.py"))}
    beside_the_wheel = {"benchmarks"}  # tests run on what is installed
    assert {one.split("/")[1] for one in LISTED} >= rooms - beside_the_wheel
    assert rooms >= set(ROOMS) - {"start"}
