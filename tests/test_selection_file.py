"""selection.txt (tests that run on every Python, at least one file per subpackage), compiled.txt (tests that run with
the users' compilation settings) and repeated.txt (tests that are left to the slow set) list existing tests."""

import re

import pytest
from test_layers import ROOMS, ROOT

LISTED = (ROOT / "tests" / "selection.txt").read_text("utf-8").split()
COMPILED = (ROOT / "tests" / "compiled.txt").read_text("utf-8").split()
REPEATED = (ROOT / "tests" / "repeated.txt").read_text("utf-8").splitlines()


@pytest.mark.parametrize("listed", [LISTED, COMPILED], ids=["selection", "compiled"])
def test_listed_files_exist_once(listed):
    assert [path for path in listed if not (ROOT / path).exists()] == []
    assert len(set(listed)) == len(listed)


def test_repeated_tests_exist_once():
    functions = {test.partition("[")[0] for test in REPEATED}
    defined = set()
    for path in {function.partition("::")[0] for function in functions}:
        names = re.findall(r"^def (test_\w+)", (ROOT / path).read_text("utf-8"), re.MULTILINE)
        defined |= {f"{path}::{name}" for name in names}
    assert functions <= defined
    assert len(set(REPEATED)) == len(REPEATED)


def test_every_subpackage_is_listed():
    rooms = {path.name for path in (ROOT / "tests").iterdir() if any(path.rglob("test_*.py"))}
    beside_the_wheel = {"benchmarks"}  # the tests run on the installed package
    assert {path.split("/")[1] for path in LISTED} >= rooms - beside_the_wheel
    assert rooms >= set(ROOMS) - {"start"}
