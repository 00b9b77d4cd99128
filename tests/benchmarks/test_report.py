"""RESULTS.md, with one section for each case, and the README's table."""

import subprocess

import pytest

from benchmarks.harness import machine, report
from benchmarks.harness.case import Asked, Case, Headline, Options, Result, Table
from benchmarks.harness.tables import duration, markdown, times

ORDER = ("first", "second", "third")
HEADING = ["a machine", "commit 1234567, 2030-01-02"]


def never(options: Options) -> Result:
    raise NotImplementedError


def result(figure: str, wrong: tuple[str, ...] = ()) -> Result:
    headline = Headline("a job", figure, "SciPy: 2.00 s", "2.0×", "same to 1e-12")
    table = Table(["task", "time"], [["a job", figure]], "What it took", "On one mesh.")
    return Result([table], [Asked("< 2 s", figure, "met")], ["jeit: a note"], headline, list(wrong), 3.0, 100.0)


@pytest.fixture
def root(tmp_path):
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("before\n<!-- benchmark:begin -->\nold\n<!-- benchmark:end -->\nafter\n")
    (tmp_path / "docs" / "page.md").write_text("<!-- figures:begin -->\n<!-- figures:end -->\n")
    return tmp_path


def write(root, name: str, figure: str, page=None) -> list[str]:
    return report.write(Case(name, "what it does", never, 1, page=page), result(figure), HEADING, ORDER, root)


def test_a_section_contains_the_judged_figures_and_their_origin(root):
    write(root, "first", "1.00 s")
    text = (root / "benchmarks" / "RESULTS.md").read_text("utf-8")
    for part in ("## first", "What it does.", "commit 1234567, 2030-01-02", "jeit: a note", "**What it took**"):
        assert part in text
    assert "| < 2 s | 1.00 s   | met |" in text  # padded to the heading, to be read as text
    assert "| a job | 1.00 s | SciPy: 2.00 s | 2.0× | same to 1e-12 |" in (root / "README.md").read_text("utf-8")
    assert "3.00 s in all; the case's own process took 100 MB at most" in text


def test_one_case_is_replaced_and_the_others_stay(root):
    assert write(root, "second", "1.00 s") == []
    write(root, "first", "3.00 s")
    before = report.sections(root / "benchmarks" / "RESULTS.md")
    write(root, "second", "4.00 s")
    after = report.sections(root / "benchmarks" / "RESULTS.md")
    assert list(after) == ["first", "second"]
    assert after["first"] == before["first"]
    assert "4.00 s" in after["second"]
    assert "1.00 s" not in after["second"]


def test_the_readme_has_a_row_for_every_case_in_order(root):
    write(root, "third", "1.00 s")
    write(root, "first", "5.00 s")
    text = (root / "README.md").read_text("utf-8")
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    rows = [line for line in text.splitlines() if line.startswith("| a job")]
    assert ["5.00 s" in rows[0], "1.00 s" in rows[1]] == [True, True]
    many = {str(k): f'<!-- headline {{"job": "j", "jeit": "{k}"}} -->' for k in range(12)}
    assert len(report.readme_table(many).splitlines()) == 2 + 8


def test_a_page_gets_the_tables_and_one_without_markers_is_unchanged(root):
    assert write(root, "first", "1.00 s", ("docs/page.md", "figures")) == []
    assert "On one mesh." in (root / "docs" / "page.md").read_text("utf-8")
    (failed,) = write(root, "first", "1.00 s", ("docs/page.md", "elsewhere"))
    assert "elsewhere:begin" in failed
    assert "## first" in (root / "benchmarks" / "RESULTS.md").read_text("utf-8")


def test_disagreement_is_reported():
    assert "**Wrong:** images differ" in report.text(result("1 s", ("images differ",)), HEADING)


def test_only_files_that_affect_figures_make_a_commit_dirty(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "ROOT", tmp_path)
    assert machine.commit() == "unknown"
    for name in ("jeit/a.py", "solvers/b.py", "benchmarks/RESULTS.md", "README.md", "pyproject.toml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("one\n")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for arguments in (["init", "-q"], ["add", "."], ["commit", "-qm", "All"]):
        subprocess.run([*git, *arguments], check=True)
    clean = machine.commit()
    assert len(clean) >= 7
    assert "dirty" not in clean
    for name in ("benchmarks/RESULTS.md", "README.md"):
        (tmp_path / name).write_text("two\n")
    assert machine.commit() == clean
    (tmp_path / "jeit" / "new.py").write_text("two\n")
    assert machine.commit() == f"{clean}-dirty"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0, "0 s"), (1.5e-6, "1.50 µs"), (0.01234, "12.3 ms"), (123.4, "123 s"), (float("nan"), "–")],
)
def test_durations_have_three_figures(seconds, text):
    assert duration(seconds) == text


def test_ratios_and_tables_read_as_text():
    assert [times(value) for value in (0.35, 1.0, 12.34, 571.2)] == ["0.35×", "1.0×", "12.3×", "571×"]
    assert markdown(["a", "bb"], [["1", "2"]]) == "| a | bb |\n| - | -- |\n| 1 | 2  |"
