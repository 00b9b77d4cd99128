"""selection.txt (tests that run on every Python, at least one file per subpackage) and compiled.txt (tests that run
with the users' compilation settings) list existing files."""

import pytest
from test_layers import ROOMS, ROOT

LISTED = (ROOT / "tests" / "selection.txt").read_text("utf-8").split()
COMPILED = (ROOT / "tests" / "compiled.txt").read_text("utf-8").split()


@pytest.mark.parametrize("listed", [LISTED, COMPILED], ids=["selection", "compiled"])
def test_listed_files_exist_once(listed):
    assert [one for one in listed if not (ROOT / one).exists()] == []
    assert len(set(listed)) == len(listed)


def test_every_subpackage_is_listed():
    rooms = {path.name for path in (ROOT / "tests").iterdir() if any(path.rglob("test_*.py"))}
    beside_the_wheel = {"benchmarks"}  # the tests run on the installed package
    assert {one.split("/")[1] for one in LISTED} >= rooms - beside_the_wheel
    assert rooms >= set(ROOMS) - {"start"}
