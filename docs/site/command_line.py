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
        yield f"{path} {one.name or one.callback.__name__.replace('_', '-')}", one.callback
    for one in app.registered_groups:
        yield from commands(one.typer_instance, f"{path} {one.name or one.typer_instance.info.name}")


def _row(name: str, annotation: Any, default: Any) -> str:
    kind, info = get_args(annotation)[:2]
    plain = next((one for one in (get_args(kind) or (kind,)) if one is not NoneType), str)
    value = info.metavar or _VALUES.get(getattr(plain, "__name__", ""), name.upper())
    if type(info).__name__ == "ArgumentInfo":
        shown = f"`{info.metavar or name.upper()}`"
    else:
        # In an annotation Typer takes the first of the names given for the default.
        first = (info.default,) if isinstance(info.default, str) else ()
        options = (*first, *(info.param_decls or ())) or (f"--{name.replace('_', '-')}",)
        shown = ", ".join(f"`{option}`" if plain is bool else f"`{option} {value}`" for option in options)
    told = (
        "required"
        if default is inspect.Parameter.empty
        else ""
        if default is None or default is False
        else f"`{default}`"
    )
    return (
        "| "
        + " | ".join(" ".join(str(cell or "").split()).replace("|", "\\|") for cell in (shown, info.help, told))
        + " |"
    )


def page() -> str:
    """The page, as Markdown."""
    from jeit.cli.app import app

    lines = [_HEAD]
    for path, function in commands(app):
        hints = get_type_hints(function, include_extras=True)
        parameters = inspect.signature(function).parameters
        rows = [
            _row(name, hints[name], one.default)
            for name, one in parameters.items()
            if hasattr(hints[name], "__metadata__")
        ]
        head = ["| argument or option | what it is | default |", "|---|---|---|"]
        lines += [f"## {path}", "", inspect.getdoc(function) or "", "", *head, *rows, ""]
    return "\n".join(lines)


def on_files(files, config):
    """Add the page."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, "command-line.md", content=page()))
    return files
