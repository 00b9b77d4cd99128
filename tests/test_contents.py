"""Contents pages: what an `__init__` takes from its own modules is in its `__all__`, and no module is."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest
from test_layers import ROOT, modules, offered

PACKAGES = {
    name: path
    for top in ("jeit", "solvers/jeit_solvers")
    for name, path in modules(ROOT / top).items()
    if path.name == "__init__.py"
}


def faults(name: str, path: Path) -> list[str]:
    """What is wrong with the contents of a package."""
    package = importlib.import_module(name)
    entrance = "jeit.start."  # jeit itself calls it, and offers it to nobody
    taken = {one.rpartition(".")[2] for one in offered(path) if one.startswith(f"{name}.") and entrance not in one}
    said = set(getattr(package, "__all__", ()))
    found = [f"{one} is not in __all__" for one in sorted(taken - said)]
    found += [f"{one} is not there" for one in sorted(said) if not hasattr(package, one)]
    rooms = name == "jeit"  # whose contents are its rooms, too
    return found + [
        f"{one} is a module" for one in said if isinstance(getattr(package, one, None), ModuleType) and not rooms
    ]


@pytest.mark.parametrize("name", PACKAGES)
def test_contents(name):
    assert faults(name, PACKAGES[name]) == []


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("from {package}.own import f", "f is not in __all__"),
        ("__all__ = ['f', 'g']\ndef f(): pass", "g is not there"),
        ("from {package} import own\n__all__ = ['own']", "own is a module"),
    ],
)
def test_a_fault_is_found(tmp_path, monkeypatch, text, fault):
    package = "faulty_contents"
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / package).mkdir()
    (tmp_path / package / "__init__.py").write_text(text.format(package=package), "utf-8")
    (tmp_path / package / "own.py").write_text("def f(): pass", "utf-8")
    try:
        assert faults(package, tmp_path / package / "__init__.py") == [fault]
    finally:
        for name in (package, f"{package}.own"):
            sys.modules.pop(name, None)


def test_a_star_leaves_what_was_there_before():
    """Without `__all__` it took the module of that name with it."""
    names: dict = {}
    exec("from jeit.inverse import *\nfrom jeit.inverse.nonlinear import *", names)
    assert callable(names["reconstruct"])
