"""The public API: the names that semantic versioning protects, as text, and what a change of them asks of the version.

A name is public where `jeit`, a room that is not internal, or `jeit_solvers` has it in its `__all__`. With it go the
names of its parameters and, for a class, its public methods, properties and fields.
`python docs/site/public_api.py` writes the list to `docs/reference/public-api.txt`.
"""

import dataclasses
import enum
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, get_origin

import reference

FILE = Path(__file__).resolve().parents[1] / "reference" / "public-api.txt"
OWN = tuple(reference.TOPS)


def rooms() -> list[str]:
    """The rooms whose names are public, `jeit` itself first."""
    return [one.path for one in reference.packages() if reference.is_public(one.path)]


def names(room: str) -> dict[str, object]:
    """What a room offers, by name; rooms in rooms are left out, for they have names of their own."""
    module = importlib.import_module(room)
    found = {name: getattr(module, name) for name in sorted(module.__all__)}
    return {name: thing for name, thing in found.items() if not isinstance(thing, ModuleType)}


def signature(thing: Any) -> str:
    """Names of the parameters of a function or class, `=…` behind those that have a default.

    Enumerations and aliases of types are called as Python defines it, each version otherwise, and show none.
    """
    if isinstance(thing, enum.EnumType) or get_origin(thing) is not None:
        return ""
    parameters = list(inspect.signature(thing).parameters.values())
    shown, starred = [], False
    for one in parameters:
        starred |= one.kind is one.VAR_POSITIONAL
        if one.kind is one.KEYWORD_ONLY and not starred:
            shown, starred = [*shown, "*"], True
        stars = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(one.kind, "")
        shown.append(f"{stars}{one.name}" + ("" if one.default is one.empty else "=…"))
    return f"({', '.join(shown)})"


def members(thing: type) -> Iterator[str]:
    """Public methods with their parameters, properties and fields of a class, as far as our own classes define them."""
    if issubclass(thing, enum.Enum):
        yield from thing.__members__
        return
    fields = {one.name for one in dataclasses.fields(thing)} if dataclasses.is_dataclass(thing) else set()
    fields |= set(getattr(thing, "_fields", ()))
    own = {name for one in thing.__mro__ if one.__module__.split(".")[0] in OWN for name in vars(one)}
    for name in sorted(fields | own):
        if not name.startswith("_"):
            member = None if name in fields else inspect.getattr_static(thing, name)
            method = isinstance(member, classmethod | staticmethod) or inspect.isfunction(member)
            bound = getattr(thing, name) if isinstance(member, classmethod | staticmethod) else member
            text = signature(bound) if method else ""
            yield name + re.sub(r"^\(self(, )?", "(", text)


def listed() -> list[str]:
    """One line for each public name and each public member of a public class."""
    lines = []
    for room in rooms():
        for name, thing in names(room).items():
            lines.append(f"{room}.{name}{signature(thing) if callable(thing) else ''}")
            if inspect.isclass(thing) and room != "jeit":  # `jeit` repeats names of its rooms
                lines += [f"{room}.{name}.{member}" for member in members(thing)]
    return lines


def _parts(line: str) -> tuple[str, list[str] | None]:
    name, bracket, rest = line.partition("(")
    return name, [one for one in rest.rstrip(")").split(", ") if one] if bracket else None


def _compatible(old: list[str] | None, new: list[str] | None) -> bool:
    """Whether every call that the old parameters allow is allowed by the new ones, too."""
    if old is None or new is None:
        return old is new
    place = old.index("*") if "*" in old else len(old)
    same = [one.removesuffix("=…") for one in old[:place]] == [one.removesuffix("=…") for one in new[:place]]
    kept = all(one in new or (not one.endswith("=…") and f"{one}=…" in new) for one in old if one != "*")
    known = {one.removesuffix("=…") for one in old}
    added = [one for one in new if one.removesuffix("=…") not in known]
    return same and kept and all(one.endswith("=…") or one.startswith("*") for one in added)


def changes(old: list[str], new: list[str]) -> list[str]:
    """What differs between two lists of the public API, each change with the version that it asks for."""
    before, after = dict(map(_parts, old)), dict(map(_parts, new))
    found = []
    for name, parameters in before.items():
        if name not in after:
            found.append(f"{name} is gone: this needs a new MAJOR version; until then keep the name, with a warning")
        elif not _compatible(parameters, after[name]):
            found.append(f"{name}: its parameters {parameters} are now {after[name]}: this needs a new MAJOR version")
        elif parameters != after[name]:
            found.append(f"{name}: its parameters {parameters} are now {after[name]}: this needs a new MINOR version")
    return found + [f"{name} is new: this needs a new MINOR version" for name in after if name not in before]


if __name__ == "__main__":
    FILE.write_text("\n".join(listed()) + "\n", "utf-8")
