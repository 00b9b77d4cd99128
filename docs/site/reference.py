"""The API reference: a page for every room and sub-room, with every public name, found by reading the source.

The public API is what `jeit`, its rooms (not their sub-rooms) and `jeit_solvers` export. Their pages have these names
first; what else modules define without an underscore is shown below or on pages of its own, and marked as internal. A
constant is shown where a room exports it. Each name is described once: where it is exported, in the outermost of the
rooms that do; else beside its module.
As a hook of mkdocs this adds the pages and their places in the menu; nothing is written into `docs/`.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOPS = {"jeit": ROOT / "jeit", "jeit_solvers": ROOT / "solvers" / "jeit_solvers"}
# The command line is described command by command, on a page of its own.
_COMMANDS = re.compile(r"jeit\.cli|jeit\.\w+\.commands")
# Rooms that other rooms use, and users do not.
_INTERNAL = {"jeit.arguments", "jeit.cli", "jeit.files", "jeit.simulate", "jeit.start"}
_PROMISE = """!!! info "What is public, and what may change"

    The public API is what `jeit`, its rooms (such as `jeit.inverse`) and `jeit_solvers` export:
    `from jeit.inverse import Matern`. It follows [semantic versioning](https://semver.org): until version 2.0 no public
    name, parameter, method or field vanishes or changes its meaning, and what is to vanish gives a warning for at least
    one minor version before. The [list of public names](../../reference/public-api.txt) is checked by a test.
    All else is marked as internal and may change in any version, as may the text of messages and the last digits of
    results.

    Examples take the names of their page from its room, and begin with what the page says that they assume.
"""
_MARK = """!!! warning "Internal"

    What is described {where} is not part of the public API and may change in any version.
"""


@dataclass(frozen=True)
class Name:
    """A public name: where it is defined, and the first sentence said of it."""

    home: str
    summary: str

    @property
    def last(self) -> str:
        return self.home.rpartition(".")[2]


@dataclass(frozen=True)
class Package:
    """A room, a sub-room, or the whole library: its names as `exports`, and those of its public `modules`."""

    path: str
    docstring: str
    exports: dict[str, Name]
    modules: dict[str, dict[str, Name]]

    @property
    def page(self) -> str:
        """Where its page stands in the site."""
        return f"api/{'/'.join(self.path.split('.'))}/index.md"


def is_public(path: str) -> bool:
    """Whether what a package exports is part of the public API."""
    return path in TOPS or (path.startswith("jeit.") and path.count(".") == 1 and path not in _INTERNAL)


def assumed(room: str) -> str:
    """What the examples of a room's page assume, as Python."""
    path = Path(__file__).parent / "assumed" / f"{room.rpartition('.')[2]}.py"
    return path.read_text("utf-8") if path.exists() else ""


def _first_sentence(text: str | None) -> str:
    first = " ".join((text or "").split("\n\n")[0].split())
    return (first.split(". ")[0].rstrip(".") if first else "").replace("|", "\\|")


@cache
def tree(path: Path) -> ast.Module:
    """The syntax tree of a module, which is parsed once."""
    return ast.parse(path.read_text("utf-8"))


@cache
def _defined(path: Path) -> tuple[tuple[str, str], ...]:
    """Public names that a module defines at its top, each with its docstring, or what stands by a constant."""
    defined = []
    lines = path.read_text("utf-8").split("\n")
    body = tree(path).body
    for node, after in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found = [(node.name, ast.get_docstring(node) or "")]
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            above = lines[node.lineno - 2] if node.lineno > 1 else ""
            said = above.lstrip("# ") if above.startswith("# ") else ""
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                said = str(after.value.value)
            found = [(target.id, said) for target in targets if isinstance(target, ast.Name)]
        else:
            continue
        defined += [(name, text) for name, text in found if not name.startswith("_")]
    return tuple(defined)


def _imported(path: Path, top: str) -> Iterator[tuple[str, str]]:
    """(name, module) of all that an `__init__`, or the stub beside it, takes from its own library."""
    stub = path.with_suffix(".pyi")
    if stub.exists():
        package = ".".join((top, *path.parent.relative_to(TOPS[top]).parts))
        for node in tree(stub).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                yield from ((alias.name, f"{package}.{node.module}.{alias.name}") for alias in node.names)
        return
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == top:
            for alias in node.names:
                name = alias.asname or alias.name
                if not name.startswith("_"):
                    yield name, f"{node.module}.{alias.name}"


def _file(module: str) -> Path:
    top, *parts = module.split(".")
    path = TOPS[top].joinpath(*parts)
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@cache
def _home(dotted: str) -> Name:
    """Where a name is defined that may have been imported from an `__init__` on the way."""
    module, _, name = dotted.rpartition(".")
    path = _file(module)
    for found, text in _defined(path):
        if found == name:
            return Name(dotted, _first_sentence(text))
    for found, source in _imported(path, module.split(".")[0]):
        if found == name:
            return _home(source)
    raise ValueError(f"{dotted}: {path} neither defines nor imports '{name}'.")


@cache
def packages() -> tuple[Package, ...]:
    """Every room and sub-room that is public, the library itself first, and what it has to show."""
    found = []
    for top, folder in TOPS.items():
        for init in sorted(folder.rglob("__init__.py")):
            parts = init.parent.relative_to(folder).parts
            if any(part.startswith("_") for part in parts):
                continue
            path = ".".join((top, *parts))
            modules = {}
            for file in sorted(init.parent.glob("*.py")):
                if not file.stem.startswith("_") and not _COMMANDS.match(path):
                    module = f"{path}.{file.stem}"
                    names = [name for name, _ in _defined(file) if not name.isupper()]
                    modules[module] = {name: _home(f"{module}.{name}") for name in names}
            exports = {name: _home(source) for name, source in sorted(_imported(init, top), key=lambda one: one[0])}
            exports |= {name: _home(f"{path}.{name}") for name, _ in _defined(init)}
            if path == "jeit.cli" or not _COMMANDS.match(path):
                docstring = ast.get_docstring(tree(init)) or ""
                found.append(Package(path, docstring, exports, modules))
    return tuple(found)


@cache
def described() -> dict[str, str]:
    """The room or sub-room on whose page each public name is described, by where the name is defined."""
    where: dict[str, str] = {}
    rooms = [package for package in packages() if package.path != "jeit"]
    for package in sorted(rooms, key=lambda one: one.path.count(".")):
        for name in package.exports.values():
            where.setdefault(name.home, package.path)
    for package in rooms:
        for names in package.modules.values():
            for name in names.values():
                where.setdefault(name.home, package.path)
    return where


def page(package: Package) -> str:
    """The page of a room, as Markdown for mkdocstrings."""
    public = is_public(package.path)
    lines = [f"# {package.path} {{ #{package.path} }}", "", package.docstring, ""]
    lines += [] if public else [_MARK.format(where="on this page")]
    lines += [_PROMISE] if package.path == "jeit" else []
    if assumed(package.path):
        lines += ["Examples on this page assume:", "", "```python", assumed(package.path).rstrip(), "```", ""]
    own = [name for name in package.exports.values() if described()[name.home] == package.path]
    if package.exports:
        lines += ["| name | what it is |", "|---|---|"]
        lines += [f"| [`{name}`][{one.home}] | {one.summary} |" for name, one in package.exports.items()]
        lines += [""]
    for name, one in package.exports.items():
        if one in own:
            rooms = {other.path for other in packages()}
            anchor = f"{package.path}.{name}"  # how users import it; a room may have that name itself
            lines += [] if anchor in rooms | {one.home} else [f"[](){{#{anchor}}}", ""]
            lines += [f"::: {one.home}", ""]
    below = [one for one in packages() if one.path.rpartition(".")[0] == package.path]
    if below:
        lines += ["## Rooms", "", "| room | what is in it |", "|---|---|"]
        for one in below:
            link = "/".join(one.path.split(".")[package.path.count(".") + 1 :])
            lines += [f"| [`{one.path}`]({link}/index.md) | {_first_sentence(one.docstring)} |"]
        lines += [""]
    marked = not public
    for module, names in package.modules.items():
        rest = [one for one in names.values() if described()[one.home] == package.path and one not in own]
        if rest:
            lines += [] if marked else ["## Internal modules", "", _MARK.format(where="from here on")]
            marked = True
            docstring = ast.get_docstring(tree(_file(module))) or ""
            lines += [f"### {module} {{ #{module} }}", "", docstring, ""]
            for one in rest:
                lines += [f"::: {one.home}", "    options:", "      heading_level: 4", ""]
    return "\n".join(lines)


def menu() -> list:
    """The reference's part of the menu: libraries, rooms, sub-rooms."""
    entries: list = []
    nested: dict[str, list] = {}
    for package in packages():
        above, _, last = package.path.rpartition(".")
        nested[package.path] = [package.page]
        (nested[above] if above in nested and above != "jeit" else entries).append({last: nested[package.path]})
    return entries


def on_config(config):
    """Hang the reference into the menu, under the entry that is called so, in whatever section it stands."""
    entries = list(config.nav)
    for entry in entries:
        for title, below in entry.items() if isinstance(entry, dict) else ():
            if title == "API reference":
                entry[title] = menu()
            elif isinstance(below, list):
                entries += below
    return config


def on_files(files, config):
    """Add the reference's pages."""
    from mkdocs.structure.files import File

    for package in packages():
        files.append(File.generated(config, package.page, content=page(package)))
    return files
