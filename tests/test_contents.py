"""`__init__` files: names imported from a package's own modules are in its `__all__`, and no module is."""

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
    """List the errors in the `__all__` of a package."""
    package = importlib.import_module(name)
    entrance = "jeit.start."  # called by jeit itself; not a public name
    taken = {one.rpartition(".")[2] for one in offered(path) if one.startswith(f"{name}.") and entrance not in one}
    listed = set(getattr(package, "__all__", ()))
    found = [f"{one} is not in __all__" for one in sorted(taken - listed)]
    found += [f"{one} is not there" for one in sorted(listed) if not hasattr(package, one)]
    rooms = name == "jeit"  # its contents are its subpackages too
    return found + [
        f"{one} is a module" for one in listed if isinstance(getattr(package, one, None), ModuleType) and not rooms
    ]


@pytest.mark.parametrize("name", PACKAGES)
def test_all_lists_the_public_names(name):
    assert faults(name, PACKAGES[name]) == []


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("from {package}.own import f", "f is not in __all__"),
        ("__all__ = ['f', 'g']\ndef f(): pass", "g is not there"),
        ("from {package} import own\n__all__ = ['own']", "own is a module"),
    ],
)
def test_faulty_contents_are_detected(tmp_path, monkeypatch, text, fault):
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


def test_star_import_keeps_names_that_exist():
    """Without `__all__`, the star import replaced `reconstruct` by the module of that name."""
    names: dict = {}
    exec("from jeit.inverse import *\nfrom jeit.inverse.nonlinear import *", names)
    assert callable(names["reconstruct"])
