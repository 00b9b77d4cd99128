"""Two thousand randomly changed files, half of them in the quick tests: each is accepted or clearly refused, without
remains."""

import pytest
from commands import COMMANDS, READERS
from fuzz import changed_files, tried
from oracle import outcome

FILES = [name for name in READERS if name not in COMMANDS]
EACH = -(-2000 // len(FILES))
# The quick tests have fewer inputs of the slow readers.
QUICKLY = {name: EACH // 8 if name in ("store of a study", "skin, curved") else EACH // 2 for name in FILES}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", FILES)
def test_valid_files_are_accepted(name, tmp_path):
    for one, content in READERS[name].files.items():
        (tmp_path / one).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / one).write_bytes(content)
    READERS[name].use(tmp_path)


def faults(name: str, numbers: range) -> list[str]:
    """The faults among these inputs."""
    return [f"{at}: {one.kind}: {one.message}" for at, one in tried(READERS[name], numbers) if one.faulty]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", FILES)
def test_no_input_causes_a_fault(name):
    assert faults(name, range(QUICKLY[name])) == []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", FILES)
def test_no_further_input_causes_a_fault(name):
    assert faults(name, range(QUICKLY[name], EACH)) == []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", COMMANDS)
def test_commands_fail_with_one_line(name):
    assert faults(name, range(10)) == []


def test_an_input_is_reproduced_by_its_number():
    reader = READERS["layout, csv"]
    assert changed_files(reader, 3) == changed_files(reader, 3) != changed_files(reader, 4)


def _hang():
    while True:
        pass


@pytest.mark.parametrize(
    ("use", "kind"),
    [
        (lambda: None, "accepted"),
        (lambda: int("x"), "refused"),
        (lambda: 1 / 0, "ZeroDivisionError"),
        (lambda: b"\xff".decode(), "unclear"),
        (lambda: (_ for _ in ()).throw(ValueError("x" * 500)), "unclear"),
        (lambda: (_ for _ in ()).throw(ValueError("")), "unclear"),
        (_hang, "hung"),
        (lambda: bytearray(5 * 10**9), "MemoryError"),
    ],
)
def test_the_oracle_detects_faults(use, kind):
    assert outcome(use, seconds=0.2).kind == kind
