"""The tutorials: notebooks without outputs, which say what they cost, and which run from top to bottom."""

import ast
import json
import re
import time
from pathlib import Path

import matplotlib
import pytest
from matplotlib import pyplot

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "tutorials"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
MOST_WORDS = 900

each = pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)


def cells(notebook: Path, kind: str) -> list[str]:
    """The text of the cells of one kind, "code" or "markdown"."""
    found = json.loads(notebook.read_text("utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == kind]


def code(cell: str) -> str:
    """A cell as plain Python: without the commands of the notebook, such as %pip."""
    return "\n".join(line for line in cell.splitlines() if not line.startswith(("%", "!")))


@each
def test_outputs_are_left_to_the_site(notebook):
    found = json.loads(notebook.read_text("utf-8"))
    executed = [cell for cell in found["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in executed)
    assert (found["nbformat"], found["metadata"]["kernelspec"]["name"]) == (4, "python3")
    identifiers = [cell["id"] for cell in found["cells"]]
    assert len(set(identifiers)) == len(identifiers)


@each
def test_a_notebook_says_for_whom_it_is_and_what_it_costs(notebook):
    first = cells(notebook, "markdown")[0]
    assert first.startswith(f"# {notebook.name[0]}. ")
    assert re.search(r"^For ", first, re.MULTILINE)
    assert re.search(r"\d+ minutes.* \d+ s\b.* [\d.]+ GB", " ".join(first.split()))
    assert re.fullmatch(r"(#.*\n)*# %pip install .*", cells(notebook, "code")[0])
    assert sum(len(cell.split()) for cell in cells(notebook, "markdown")) <= MOST_WORDS


@each
def test_a_notebook_imports_public_names(notebook):
    """From `jeit`, a room of it, or `jeit_solvers`: two levels at most."""
    for cell in cells(notebook, "code"):
        for node in ast.walk(ast.parse(code(cell))):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            modules += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not [one for one in modules if re.match(r"jeit\.\w+\.|jeit_solvers\.", one)]


@each
def test_a_notebook_stands_in_the_index_and_the_menu(notebook):
    assert f"]({notebook.name})" in (FOLDER / "index.md").read_text("utf-8")
    assert f"tutorials/{notebook.name}\n" in (ROOT / "mkdocs.yml").read_text("utf-8")


@pytest.mark.slow
@each
def test_a_notebook_runs(notebook, tmp_path, monkeypatch, capsys):
    """Every cell, one after the other, in an empty folder. What a cell claims, it asserts."""
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "__main__"}
    began = time.perf_counter()
    for number, cell in enumerate(cells(notebook, "code"), 1):
        exec(compile(code(cell), f"{notebook.stem}, code cell {number}", "exec"), names)
    assert pyplot.get_fignums(), "a tutorial shows pictures"
    pyplot.close("all")
    with capsys.disabled():
        print(f"\n{notebook.stem}: {time.perf_counter() - began:.0f} s")
