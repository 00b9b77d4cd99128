"""The command line's page of the site: every command, argument and option, from the functions behind the commands."""

import inspect
from collections.abc import Callable, Iterator
from types import NoneType
from typing import Any, get_args, get_type_hints

_HEAD = """# The command line

Every command, as `jeit COMMAND --help` says it. What is wrong with a call or with the data is said in one line on
standard error; the exit status is 0 when all is done, 1 when the data or the values are wrong, 2 when the call is.
`JEIT_DEBUG=1` shows the traceback instead.
"""
_VALUES = {"Path": "PATH", "str": "TEXT", "int": "INTEGER", "float": "NUMBER"}


def commands(app: Any, path: str = "jeit") -> Iterator[tuple[str, Callable]]:
    """What is typed to call each command of a Typer application, and the function behind it."""
    for one in app.registered_commands:
        name = one.name or one.callback.__name__.replace("_", "-")
        # What is hidden is called by the name of its group and its arguments.
        yield path if one.hidden else f"{path} {name}", one.callback
    for one in app.registered_groups:
        yield from commands(one.typer_instance, f"{path} {one.name or one.typer_instance.info.name}")


def _plain(annotation: Any) -> Any:
    """The type of a parameter, without None."""
    kind = get_args(annotation)[0]
    return next((one for one in (get_args(kind) or (kind,)) if one is not NoneType), str)


def _options(name: str, annotation: Any) -> tuple[str, ...]:
    """What an option may be called; nothing for an argument."""
    info = get_args(annotation)[1]
    if type(info).__name__ == "ArgumentInfo":
        return ()
    # In an annotation Typer takes the first of the names given for the default.
    first = (info.default,) if isinstance(info.default, str) else ()
    return (*first, *(info.param_decls or ())) or (f"--{name.replace('_', '-')}",)


def _annotations(function: Callable) -> dict[str, Any]:
    hints = get_type_hints(function, include_extras=True)
    return {
        name: hints[name] for name in inspect.signature(function).parameters if hasattr(hints[name], "__metadata__")
    }


def parameters(function: Callable) -> tuple[dict[str, bool], int]:
    """The names of a command's options, each with whether it takes a value; and how many arguments there are."""
    annotations = _annotations(function)
    options = {one: _plain(kind) is not bool for name, kind in annotations.items() for one in _options(name, kind)}
    return options, sum(not _options(name, kind) for name, kind in annotations.items())


def _row(name: str, annotation: Any, default: Any) -> str:
    info, plain, options = get_args(annotation)[1], _plain(annotation), _options(name, annotation)
    value = info.metavar or _VALUES.get(getattr(plain, "__name__", ""), name.upper())
    shown = ", ".join(f"`{option}`" if plain is bool else f"`{option} {value}`" for option in options)
    default_text = (
        "required" if default is inspect.Parameter.empty else "" if default is None or default is False else default
    )
    cells = (shown or f"`{info.metavar or name.upper()}`", info.help, default_text)
    return "| " + " | ".join(" ".join(str(cell).split()).replace("|", "\\|") for cell in cells) + " |"


def page() -> str:
    """The page, as Markdown."""
    from jeit.cli.app import application

    lines = [_HEAD]
    for path, function in commands(application()):
        defaults = inspect.signature(function).parameters
        rows = [_row(name, kind, defaults[name].default) for name, kind in _annotations(function).items()]
        head = ["| argument or option | what it is | default |", "|---|---|---|"]
        lines += [f"## {path}", "", inspect.getdoc(function) or "", "", *head, *rows, ""]
    return "\n".join(lines)


def on_files(files, config):
    """Add the page."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, "command-line.md", content=page()))
    return files
