"""What docstrings must say: what is raised, in what unit a conductivity is, and each public name in the reference."""

import ast
import importlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
import reference

ROOT = Path(__file__).resolve().parents[2]
# Errors that say that the caller erred; those of Python's own protocols (AttributeError of __getattr__) do not count.
ERRORS = {"ValueError", "TypeError", "OSError", "FileNotFoundError", "ImportError", "NotImplementedError"}
UNITS = re.compile(r"S/m|\bsiemens\b|(, |in |2-D: )m?S\b")
# Or the name of another function, whose arguments these are.
ELSEWHERE = re.compile(r"\b(as|as in|as for|like|see|those of|that of|other arguments of)\s+`[\w.]+`")
# Docstrings still to be written, by file.
KNOWN: dict[str, set[str]] = {}
Function = ast.FunctionDef | ast.AsyncFunctionDef


def public(tree: ast.Module) -> Iterator[tuple[str, Function, str]]:
    """Public functions and methods of a module: name, definition, and the docstring of the class that each is in."""
    for node in tree.body:
        if isinstance(node, Function) and not node.name.startswith("_"):
            yield node.name, node, ""
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            said = ast.get_docstring(node) or ""
            for inner in node.body:
                special = (
                    inner.name in ("__init__", "__call__", "__post_init__", "__check_init__")
                    if isinstance(inner, Function)
                    else False
                )
                if isinstance(inner, Function) and (special or not inner.name.startswith("_")):
                    yield f"{node.name}.{inner.name}", inner, said


@cache
def own(function: Function) -> list[ast.Raise | ast.Call]:
    """What the body of a function itself raises and calls, not functions within."""
    found, left = [], list[ast.AST](function.body)
    while left:
        node = left.pop()
        if isinstance(node, ast.Raise | ast.Call):
            found.append(node)
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.ClassDef)):
            left += ast.iter_child_nodes(node)
    return found


def raised(function: Function) -> set[str]:
    """The errors of `ERRORS` that a function's own body raises."""
    found = set()
    for node in own(function):
        if isinstance(node, ast.Raise) and node.exc is not None:
            error = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
            found |= {error.id} if isinstance(error, ast.Name) else set()
    return found & ERRORS


def called(function: Function) -> set[str]:
    """Functions that a function's own body calls by their name alone."""
    return {node.func.id for node in own(function) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}


def faults(path: Path) -> list[str]:
    """What the docstrings of a module lack; a function also raises what the private functions beside it do for it."""
    found = []
    tree = reference.tree(path)
    private = {one.name: raised(one) for one in tree.body if isinstance(one, Function) and one.name.startswith("_")}
    for name, function, said_of_class in public(tree):
        overloads = any("overload" in ast.unparse(one) for one in function.decorator_list)
        said = ast.get_docstring(function) or ""
        if overloads or function.name.startswith("__"):
            said += said_of_class
        elif not said:
            found.append(f"{name}: no docstring")
            continue
        if "***" in said + said_of_class:
            found.append(f"{name}: three asterisks, which are no mark")
        for error in sorted(raised(function).union(*(private.get(one, set()) for one in called(function)))):
            if not re.search(rf"\b[Rr]aise|{error}", f"{said} {said_of_class}"):
                found.append(f"{name}: does not say that it raises {error}")
        arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
        stated = any(pattern.search(text) for pattern in (UNITS, ELSEWHERE) for text in (said, said_of_class))
        if not stated and any(one.arg == "conductivity" for one in arguments):
            found.append(f"{name}: does not say the unit of its conductivity")
    return found


def modules() -> list[Path]:
    """Every module of the house that is public, and not one of the command line, which has its own help."""
    paths = [path for top in reference.TOPS.values() for path in sorted(top.rglob("*.py"))]
    return [
        path
        for path in paths
        if not any(part.startswith("_") and part != "__init__.py" for part in path.relative_to(ROOT).parts)
        and not {"cli", "commands"} & set(path.relative_to(ROOT).parts)
    ]


@pytest.mark.parametrize("path", modules(), ids=lambda path: path.relative_to(ROOT).with_suffix("").as_posix())
def test_docstrings_say_what_is_raised_and_in_what_unit(path):
    known = KNOWN.get(path.relative_to(ROOT).as_posix(), set())
    assert [fault for fault in faults(path) if fault.partition(":")[0] not in known] == []


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("def f(x):\n    return x", "no docstring"),
        ('def f(x):\n    """It."""\n    raise ValueError(x)', "raises ValueError"),
        ('def f(conductivity):\n    """It."""', "the unit of its conductivity"),
        ('class A:\n    """It."""\n    def __post_init__(self):\n        raise ValueError', "raises ValueError"),
    ],
)
def test_a_silent_docstring_is_found(tmp_path, text, fault):
    (tmp_path / "silent.py").write_text(text, "utf-8")
    assert fault in " ".join(faults(tmp_path / "silent.py"))


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    """The text of each page of the reference."""
    return {one.path: reference.page(one) for one in reference.packages()}


@pytest.mark.parametrize("room", [one for one in reference.packages() if one.exports], ids=lambda one: one.path)
def test_the_reference_has_every_public_name(room, pages):
    """Whatever a room shows when it is imported is described, once, on the page that the reference says."""
    module = importlib.import_module(room.path)
    shown = set(getattr(module, "__all__", ())) or {
        name
        for name, thing in vars(module).items()
        if not name.startswith("_") and (getattr(thing, "__module__", None) or "").split(".")[0] in reference.TOPS
    }
    shown -= {name for name in shown if isinstance(getattr(module, name), ModuleType)}  # rooms have pages of their own
    assert shown <= set(room.exports)
    described = reference.described()
    for name in shown:
        home = room.exports[name].home
        assert f"[`{name}`][{home}]" in pages[room.path]
        assert sum(f"::: {home}\n" in text for text in pages.values()) == 1, home
        assert f"::: {home}\n" in pages[described[home]]
        assert room.exports[name].summary or not callable(getattr(module, name)), f"{home} has no docstring"
