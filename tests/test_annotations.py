"""Annotations: every module can be imported, and every annotation of a function or class can be evaluated, on each
Python.

Annotations are strings until they are evaluated (`from __future__ import annotations`, which ruff demands), so that no
release of another package breaks an import. Documentation tools and run-time type checkers evaluate them and must
succeed all the same.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import sys
import typing
from collections.abc import Iterator
from importlib.util import find_spec

import pytest
from test_layers import ROOT, modules

MODULES = {name: path for top in ("jeit", "solvers/jeit_solvers") for name, path in modules(ROOT / top).items()}
ROOMS = sorted({".".join(name.split(".")[:2]) for name in MODULES})
# Packages that jeit can run without but that occur in annotations: without the extra, their types are unknown.
OPTIONAL = ("pyvista",)


class Absent:
    """A package that is not installed: any attribute of it is accepted as a type."""

    def __getattr__(self, name: str):
        return typing.Any


def own_functions(module) -> Iterator[tuple[str, object]]:
    """Functions and classes that a module defines, and the methods of its classes, by name."""
    for name, thing in list(vars(module).items()):
        if inspect.isclass(thing) and thing.__module__ == module.__name__:
            yield name, thing
            for method, member in list(vars(thing).items()):
                function = member.fget if isinstance(member, property) else inspect.unwrap(member)
                function = getattr(function, "__func__", function)
                if inspect.isfunction(function) and function.__code__.co_filename == module.__file__:
                    yield f"{name}.{method}", function
        elif callable(thing) and inspect.isfunction(inspect.unwrap(thing)):
            function = inspect.unwrap(thing)
            if function.__code__.co_filename == module.__file__:
                yield name, function


def named_for_checkers(source: str) -> dict[str, object]:
    """Names that a module imports under `if TYPE_CHECKING`."""
    names: dict[str, object] = {}
    for block in ast.parse(source).body:
        for line in block.body if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING" else ():
            if isinstance(line, ast.Import) and line.names[0].name in OPTIONAL and not find_spec(line.names[0].name):
                names[line.names[0].name] = Absent()
            else:
                exec(ast.unparse(line), names)
    return names


def faults(name: str, source: str) -> list[str]:
    """Annotations of a module that cannot be evaluated, and abstract fields that equinox would miss."""
    module = importlib.import_module(name)
    if "AbstractVar[" in source and "from __future__ import annotations" in source:
        return [f"{name}: equinox overlooks AbstractVar in annotations that are text"]
    locals_, found = named_for_checkers(source), []
    for called, thing in own_functions(module):
        try:
            typing.get_type_hints(thing, localns=locals_, include_extras=True)
        except Exception as error:
            found.append(f"{name}.{called}: {type(error).__name__}: {error}")
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_every_annotation_can_be_evaluated(room):
    within = [name for name in MODULES if name == room or (name.startswith(f"{room}.") and room != "jeit")]
    assert [one for name in within for one in faults(name, MODULES[name].read_text("utf-8"))] == []


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("def f(given: Missing): pass", "faulty_hints.f: NameError"),
        ("class C:\n    @property\n    def one(self) -> Float[list[int], '3']: pass", "faulty_hints.C.one: "),
        ("import equinox as eqx\nclass C(eqx.Module):\n    one: eqx.AbstractVar[int]", "equinox overlooks"),
    ],
)
def test_faulty_annotations_are_detected(tmp_path, monkeypatch, source, fault):
    text = f"from __future__ import annotations\n{source}\n"
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "faulty_hints.py").write_text(text, "utf-8")
    importlib.invalidate_caches()
    try:
        found = faults("faulty_hints", text)
    finally:
        sys.modules.pop("faulty_hints", None)
    assert len(found) == 1
    assert fault in found[0]
