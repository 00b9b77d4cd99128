"""The structure of the packages: subpackages import downwards only, without cycles and without private modules of
others."""

import ast
import functools
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = (ROOT / "solvers", ROOT)

# The subpackages of the core, each with those that it may import. All may import jeit_solvers, which imports none.
ROOMS: dict[str, set[str]] = {}
ROOMS["start"] = set()
ROOMS["arguments"] = set()
ROOMS["files"] = {"arguments"}
ROOMS["mesh"] = {"arguments", "files"}
ROOMS["electrodes"] = {*ROOMS["mesh"], "mesh"}
ROOMS["layout"] = {*ROOMS["electrodes"], "electrodes"}
ROOMS["protocol"] = {"arguments"}
ROOMS["forward"] = {*ROOMS["electrodes"], "electrodes", "protocol"}
ROOMS["inverse"] = {*ROOMS["forward"], "forward"}
ROOMS["image"] = {*ROOMS["mesh"], "mesh"}
ROOMS["data"] = {*ROOMS["inverse"], "layout", "inverse"}
ROOMS["imaging"] = {*ROOMS["data"], "data", "image"}
ROOMS["plot"] = {*ROOMS["imaging"], "imaging"}
ROOMS["report"] = {*ROOMS["plot"], "plot"}
ROOMS["cli"] = {*ROOMS["report"], "report", "start"}
# The applications: each may import the core and the listed applications. The core imports none of them.
CORE = {*ROOMS["cli"], "cli"}
ROOMS["acoustic"] = CORE
ROOMS["design"] = CORE
ROOMS["touch"] = {*CORE, "acoustic", "design"}
ROOMS["live"] = {*CORE, "acoustic", "touch"}


def modules(top: Path) -> dict[str, Path]:
    """Every module under `top` by its dotted name; an `__init__` file has its package's name."""
    named = {}
    for path in top.rglob("*.py"):
        parts = path.relative_to(top.parent).with_suffix("").parts
        named[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return named


@functools.cache
def parsed(path: Path) -> ast.Module:
    """Syntax tree of a file, for all tests; test files that change have paths of their own."""
    return ast.parse(path.read_text("utf-8"))


@functools.cache
def imported(path: Path) -> set[str]:
    """Dotted names that a file imports anywhere: modules, and names taken from them."""
    names, left = set(), [parsed(path)]
    while left:  # through statements only, because walking through expressions takes most of the time
        node = left.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        for part in ("body", "orelse", "handlers", "finalbody", "cases"):
            left += getattr(node, part, ())
    return names


def offered(page: Path) -> set[str]:
    """Full names of what a package's stub file imports from the modules beneath it."""
    stub = page.with_suffix(".pyi")
    if not stub.exists():
        return on_import(page)
    package = ".".join(page.parent.relative_to(next(top for top in SOURCES if page.is_relative_to(top))).parts)
    statements = [node for node in parsed(stub).body if isinstance(node, ast.ImportFrom)]
    return {f"{package}.{one.module}.{alias.name}" for one in statements if one.module for alias in one.names}


def on_import(path: Path) -> set[str]:
    """Dotted names that are imported when the file is imported, or for type checkers; not those within functions."""
    names, left = set(), list(parsed(path).body)
    while left:
        node = left.pop()
        if isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            left += [child for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt)]
    return names


def rooms_of(house: dict[str, Path]) -> list[str]:
    """List modules outside of any subpackage and imports that are not permitted."""
    faults = []
    for name, path in house.items():
        parts = name.split(".")
        if name in ("jeit", "jeit.__main__", "jeit.simulate"):  # `jeit.simulate` holds only deprecated names
            continue
        if parts[1] not in ROOMS or path.parent.name == "jeit":
            faults.append(f"{name} is in no room")
            continue
        for other in imported(path):
            steps = other.split(".")
            if steps[0] != "jeit" or len(steps) < 2 or steps[1] == parts[1]:
                continue
            if steps[1] not in ROOMS[parts[1]]:
                faults.append(f"{name} looks up: it imports {other}")
            elif any(step.startswith("_") for step in steps[1:]):
                faults.append(f"{name} imports {other}, which is private")
    return faults


def circle(house: dict[str, Path]) -> list[str]:
    """Return modules that import each other in a cycle, if there are any; packages' `__init__` files are not
    counted."""
    graph = {}
    for name, path in house.items():
        if path.name == "__init__.py":
            continue
        taken = {part for other in on_import(path) for part in (other, other.rpartition(".")[0])}
        graph[name] = {other for other in taken & house.keys() if house[other].name != "__init__.py"} - {name}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_imports_point_downwards():
    assert rooms_of(modules(ROOT / "jeit")) == []


@pytest.mark.parametrize("top", ["jeit", "solvers/jeit_solvers"])
def test_no_import_cycles(top):
    assert circle(modules(ROOT / top)) == []


def test_solvers_do_not_import_jeit():
    for path in (ROOT / "solvers" / "jeit_solvers").rglob("*.py"):
        assert not {name for name in imported(path) if name.split(".")[0] == "jeit"}, path


@pytest.mark.parametrize(
    ("files", "fault"),
    [
        ({"lonely.py": ""}, "is in no room"),
        ({"attic/box.py": ""}, "is in no room"),
        ({"mesh/up.py": "from jeit.forward import ForwardModel"}, "looks up"),
        ({"mesh/up.py": "def f():\n    from jeit.forward.model import ForwardModel"}, "looks up"),
        (
            {"mesh/up.py": "if 1:\n    pass\nelse:\n    try:\n        pass\n    finally:\n        import jeit.live"},
            "up",
        ),
        ({"mesh/up.py": "try:\n    x = 2\nexcept OSError:\n    import jeit.forward"}, "looks up"),
        ({"forward/sly.py": "from jeit.mesh._surface import orient_surface"}, "is private"),
        ({"forward/sly.py": "from jeit.mesh import _surface"}, "is private"),
    ],
)
def test_faulty_imports_are_detected(tmp_path, files, fault):
    for name, text in files.items():
        (tmp_path / "jeit" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "jeit" / name).write_text(text, "utf-8")
    assert [fault in one for one in rooms_of(modules(tmp_path / "jeit"))] == [True]


def test_an_import_cycle_is_detected(tmp_path):
    (tmp_path / "jeit" / "mesh").mkdir(parents=True)
    (tmp_path / "jeit" / "mesh" / "hen.py").write_text("from jeit.mesh.egg import shell", "utf-8")
    (tmp_path / "jeit" / "mesh" / "egg.py").write_text("from jeit.mesh import hen", "utf-8")
    assert {"jeit.mesh.hen", "jeit.mesh.egg"} <= set(circle(modules(tmp_path / "jeit")))


@pytest.mark.parametrize("top", ["jeit", "solvers/jeit_solvers"])
def test_no_public_name_hides_a_module(top):
    """`import jeit.mesh.quality` would give the function `quality` if a module had its name."""
    house = modules(ROOT / top)
    pages = {name: path for name, path in house.items() if path.name == "__init__.py"}
    given = {f"{name}.{full.rpartition('.')[2]}" for name, path in pages.items() for full in offered(path)}
    assert sorted(given & set(house)) == []


@pytest.mark.parametrize("top", ["jeit", "solvers/jeit_solvers"])
def test_no_module_assigns_a_constant_twice(top):
    """The second value would be read by functions written for the first."""
    twice = []
    for name, path in modules(ROOT / top).items():
        statements = [one for one in parsed(path).body if isinstance(one, ast.Assign)]
        targets = [target for one in statements for target in one.targets]
        names = [one for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
        given = [one.id for one in names if isinstance(one.ctx, ast.Store)]
        twice += [f"{name}.{one}" for one in sorted(set(given)) if given.count(one) > 1]
    assert twice == []


def test_names_of_test_files_are_unique():
    """pytest imports test files by name and can collect only one of two with the same name."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert len(names) == len(set(names))


def test_numbers_of_modules_are_limited():
    """The number of modules stays small enough to learn, and no subpackage has more than fit on a screen."""
    house = [path for top in ("jeit", "solvers/jeit_solvers") for path in modules(ROOT / top).values()]
    assert len(house) <= 430
    assert {str(room): number for room, number in Counter(one.parent for one in house).items() if number > 15} == {}
