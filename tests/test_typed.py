"""Types as seen by a user's type checker: both packages have markers, and every parameter of a public function has a
type."""

import functools
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import jeit
import jeit_solvers

ROOT = Path(__file__).resolve().parents[1]


@functools.cache
def rooms() -> list[str]:
    """Packages with public names."""
    found = ["jeit", "jeit_solvers"]
    for top in (jeit, jeit_solvers):
        inside = pkgutil.walk_packages(top.__path__, f"{top.__name__}.")
        found += [one.name for one in inside if one.ispkg and ".cli" not in one.name and one.name != "jeit.simulate"]
    return found


def makers(given: type) -> Iterator[tuple[str, Callable]]:
    """Constructors of a class: its `__init__` and its class methods."""
    for name, member in vars(given).items():
        if name == "__init__" and inspect.unwrap(member).__module__ != "typing":  # protocols have their own `__init__`
            yield f"{given.__name__}()", inspect.unwrap(member)
        elif isinstance(member, classmethod) and not name.startswith("_"):
            yield f"{given.__name__}.{name}", inspect.unwrap(member.__func__)


def methods(given: type) -> Iterator[tuple[str, Callable]]:
    """Public methods that a class defines first; inherited methods are checked where they are defined."""
    for name, member in vars(given).items():
        first = not any(name in vars(base) for base in given.__mro__[1:])
        method = inspect.unwrap(getattr(member, "__func__", member)) if callable(member) else member
        method = getattr(method, "method", method)  # equinox wraps compiled methods
        if first and not name.startswith("_") and inspect.isfunction(method):
            yield f"{given.__name__}.{name}", method


def untyped(function: Callable) -> list[str]:
    """Parameters without a type, except the object itself."""
    parameters = list(inspect.signature(function).parameters.values())
    return [
        one.name
        for place, one in enumerate(parameters)
        if one.annotation is one.empty and not (place == 0 and one.name in ("self", "cls"))
    ]


@functools.cache
def offered() -> dict[str, Callable]:
    """Every public function, constructor and method, by package and name."""
    found = {}
    for room in rooms():
        package = importlib.import_module(room)
        for name in getattr(package, "__all__", ()):
            thing = getattr(package, name)
            if inspect.isclass(thing):
                found |= {f"{room}.{member}": one for member, one in (*makers(thing), *methods(thing))}
            elif inspect.isfunction(inspect.unwrap(thing)):
                found[f"{room}.{name}"] = inspect.unwrap(thing)
    return found


@pytest.mark.parametrize("room", rooms())
def test_every_parameter_has_a_type(room):
    within = {name: one for name, one in offered().items() if name.rpartition(".")[0].removeprefix(room) in ("", ".")}
    within |= {name: one for name, one in offered().items() if name.startswith(f"{room}.")}
    assert {name: missing for name, one in within.items() if (missing := untyped(one))} == {}


def test_public_functions_are_collected():
    found = offered()
    assert len(found) > 400
    assert {"jeit.reconstruct", "jeit.layout.Layout()", "jeit.inverse.Imager.create"} <= set(found)


def test_a_missing_type_is_detected():
    class Made:
        def __init__(self, place, *, size: float = 1.0):
            pass

        @classmethod
        def create(cls, other):
            pass

    assert {name: untyped(one) for name, one in makers(Made)} == {"Made()": ["place"], "Made.create": ["other"]}


@pytest.mark.parametrize("package", [jeit, jeit_solvers])
def test_type_markers_are_in_the_packages(package):
    """The wheel takes these folders whole: `packages` of pyproject.toml."""
    import tomllib

    folder = Path(package.__file__).parent
    assert (folder / "py.typed").is_file()
    build = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert folder in [ROOT / name for name in build["packages"]]
