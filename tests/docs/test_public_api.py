"""The reference is complete and the public API frozen: every public name is documented, listed, and has an example."""

import enum
import inspect
import re
from importlib.util import find_spec

import matplotlib
import public_api
import pytest
import reference
from matplotlib import pyplot

ROOMS = [one for one in public_api.rooms() if one != "jeit"]  # which repeats names of its rooms
FENCE = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
# Names whose docstrings are still to be written, by room.
KNOWN: dict[str, set[str]] = {}


def example(docstring: str) -> str:
    """The code under `**Example:**`, without its fences."""
    return "".join(FENCE.findall(docstring.partition("**Example:**")[2]))


def parameters(thing: object) -> list[str]:
    """What a call of a function or class takes."""
    if inspect.isclass(thing) and issubclass(thing, enum.Enum):
        return []
    try:
        names = inspect.signature(thing).parameters  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return []
    return [one for one in names if not one.startswith("_") and one not in ("self", "cls")]


def faults(name: str, thing: object) -> list[str]:
    """What the docstring of a public function or class lacks: a parameter that is not named, an example."""
    said = inspect.cleandoc(thing.__doc__ or "")
    if not said or said.startswith(f"{name}("):  # the latter is what dataclasses write
        return ["has no docstring"]
    abstract = inspect.isabstract(thing) or "Abstract" in name
    made = not inspect.isclass(thing)
    label = r"\*\*Arguments:\*\*" if made else r"\*\*(?:Arguments:|Fields)\*\*"
    described = "".join(re.split(label, said)[1:]).partition("**Example:**")[0]
    missing = [one for one in parameters(thing) if not re.search(rf"`\*{{0,2}}{one}`", described)]
    found = [f"does not describe its {'argument' if made else 'argument or field'} {one}" for one in missing]
    code = example(said)
    if code:
        compile(code, name, "exec")
        if made and not re.search(rf"\b{name}\(", code):
            found.append("is not called in its example")
    elif not abstract:
        found.append("has no example")
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_name_is_documented(room):
    exported = {name for package in reference.packages() if package.path == room for name in package.exports}
    found = {}
    for name, thing in public_api.names(room).items():
        assert name in exported
        if inspect.isclass(thing) or inspect.isfunction(inspect.unwrap(thing)):  # type: ignore[arg-type]
            found |= {name: fault} if (fault := faults(name, thing)) else {}
    known = KNOWN.get(room, set())
    assert {name: fault for name, fault in found.items() if name not in known} == {}
    assert known - set(found) == set(), "documented by now: to be taken from KNOWN"


def test_the_public_api_is_as_listed():
    """A change of the public API is meant to be one: the list changes in the same commit."""
    changed = public_api.changes(public_api.FILE.read_text("utf-8").splitlines(), public_api.listed())
    assert not changed, "\n".join([*changed, "where this is meant: python docs/site/public_api.py, and CHANGELOG.md"])


@pytest.mark.parametrize(
    ("old", "new", "version"),
    [
        ("f(x)", "g(x)", "MAJOR"),
        ("f(x)", "f(y)", "MAJOR"),
        ("f(x, y)", "f(y, x)", "MAJOR"),
        ("f(x)", "f(x, y)", "MAJOR"),
        ("f(x)", "f(x, *, y)", "MAJOR"),
        ("f(x, y=…)", "f(x, y)", "MAJOR"),
        ("f(x, y=…)", "f(x, *, y=…)", "MAJOR"),
        ("f(x)", "f", "MAJOR"),
        ("f(x, *, y=…)", "f(x, z=…, *, y=…)", "MINOR"),
        ("f(x, y)", "f(x, y=…)", "MINOR"),
        ("f(x)", "f(x, *, y=…)", "MINOR"),
    ],
)
def test_a_change_of_the_public_api_is_found(old, new, version):
    assert version in public_api.changes([old], [new])[0]
    assert public_api.changes([old], [old]) == []


def test_a_missing_argument_and_a_missing_example_are_found():
    def f(x, y):
        """Add.

        **Arguments:**

        - `x`: a number.
        """

    assert faults("f", f) == ["does not describe its argument y", "has no example"]
    f.__doc__ = f"{inspect.cleandoc(f.__doc__ or '')}\n- `y`: a number.\n\n**Example:**\n\n```python\nf(1, 2)\n```\n"
    assert faults("f", f) == []
    assert faults("g", f) == ["is not called in its example"]


@pytest.mark.slow
@pytest.mark.parametrize("room", ROOMS)
def test_examples_run(room, tmp_path, monkeypatch):
    """All examples of a room in one process, each after what its page says that they assume."""
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    offered = public_api.names(room)
    given = dict(offered)
    exec(compile(reference.assumed(room), f"what examples of {room} assume", "exec"), given)
    failed = {}
    for name, thing in offered.items():
        code = example(inspect.cleandoc(thing.__doc__ or "")) if callable(thing) else ""
        needed = re.search(r"# with ([\w.]+)", code)  # a package, or a file that another program writes
        if needed and ("." in needed[1] or not find_spec(needed[1])):
            continue
        try:
            exec(compile(code, f"example of {name}", "exec"), dict(given))
        except Exception as error:  # all of them are reported at once
            failed[name] = f"{type(error).__name__}: {error}"
        pyplot.close("all")
    assert failed == {}
