"""The command-line application: its commands and the reporting of errors."""

from __future__ import annotations

import gc
import importlib
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated

import typer

from jeit.cli.applications import COMMANDS
from jeit.cli.options import (
    StoppedError,
    naming_options_in_errors,
    recording_input_files,
    remove_empty_folders,
    reporting_when_stopped,
)
from jeit.start import discard_damaged_cache_files, quick_compilation

# Commands that run the same compiled program many times. If the compiler optimises fully, a frame is computed three
# times as fast.
_FULLY_OPTIMISED_COMMANDS = (
    "study",
    "live",
    "stream",
    "layout optimise",
    "touch fit",
    "touch gestures",
    "touch watch",
    "learn",
    "listen fit",
)

# Warnings of future changes in other packages, which are useful to programmers but not to users of the command line.
_DEVELOPER_WARNINGS = (DeprecationWarning, PendingDeprecationWarning, FutureWarning)

# Maximum number of characters of an error message.
_MAX_MESSAGE_LENGTH = 390


def application(commands: Iterable[str] = COMMANDS) -> typer.Typer:
    """Create the command-line application with the commands that `commands` names."""
    app = typer.Typer(
        name="jeit",
        add_completion=False,
        rich_markup_mode="markdown",
        pretty_exceptions_enable=False,
        help="Electrical impedance tomography, from a measured tank or skin to an image; and passive acoustic "
        "tomography, from a skin's microphones to where it was touched.",
    )
    app.callback(invoke_without_command=True)(_print_version_or_help)
    for name in commands:
        command = getattr(importlib.import_module(COMMANDS[name]), name.replace("-", "_"))
        if isinstance(command, typer.Typer):
            app.add_typer(command)
        else:
            app.command()(command)
    return app


def _print_version_or_help(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Say which version this is.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed_version

        typer.echo(f"jeit {installed_version('jeit')}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `jeit` with `arguments` (default: the arguments of the process), and return the exit status.

    Exit status: 0 for success, 1 for an error in the data or in values of options, 2 for wrong usage of the command,
    130 if stopped. Errors are reported in one line on standard error; JEIT_DEBUG=1 shows the traceback instead.
    """
    for text_stream in (sys.stdout, sys.stderr):
        if isinstance(text_stream, io.TextIOWrapper):
            text_stream.reconfigure(errors="replace")  # avoids errors on terminals without Greek letters
    command_arguments = sys.argv[1:] if arguments is None else list(arguments)
    root_command = run_as_command(command_arguments)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _create_warning_printer()
            if arguments is None:
                _set_up_process(
                    compile_quickly=not " ".join(command_arguments[:2]).startswith(_FULLY_OPTIMISED_COMMANDS)
                )
            exit_status = root_command.main(args=command_arguments, prog_name="jeit", standalone_mode=False)
    except (KeyboardInterrupt, StoppedError) as stop_error:
        remove_empty_folders()
        return _print_error(str(stop_error) or "stopped.", 130)
    except Exception as error:
        remove_empty_folders()
        if os.environ.get("JEIT_DEBUG"):
            raise
        return _report_error(error)
    return exit_status if isinstance(exit_status, int) else 0


def run_as_command(arguments: Sequence[str] = ()):
    """Create the application as a click command whose error messages name options instead of Python arguments.

    If the first of the `arguments` is the name of a command, only that command is imported.
    """
    command_name = arguments[0] if arguments else None
    root_command = typer.main.get_command(application([command_name] if command_name in COMMANDS else COMMANDS))
    _name_options_in_errors(root_command)
    return root_command


def _name_options_in_errors(command) -> None:
    """Make the error messages of all commands name options instead of Python arguments."""
    for subcommand in getattr(command, "commands", {}).values():
        _name_options_in_errors(subcommand)
    option_names = {
        parameter.name: max(parameter.opts, key=len)
        for parameter in command.params
        if parameter.param_type_name == "option"
    }
    if command.callback is not None and option_names:
        command.callback = recording_input_files(naming_options_in_errors(option_names)(command.callback))
    if command.callback is not None:
        command.callback = reporting_when_stopped(command.callback)


def _report_error(error: Exception) -> int:
    """Report an error in one line on standard error; return the exit status."""
    if hasattr(error, "format_message"):  # an error of click or typer about the usage of the command
        context = getattr(error, "ctx", None)
        command_path = context.command_path if context is not None else "jeit"
        message = error.format_message().rstrip(".")  # pyright: ignore[reportAttributeAccessIssue]
        return _print_error(f"{message}. See '{command_path} --help'.", 2)
    if type(error).__name__ == "Abort":
        return _print_error("stopped.", 130)
    if isinstance(error, ValueError) or (isinstance(error, ImportError) and "pip install" in str(error)):
        return _print_error(str(error), 1)
    if isinstance(error, ImportError):
        return _print_error(f"a package that this command needs cannot be imported ({error}); install it anew.", 1)
    if isinstance(error, OSError):
        file_name = f"{error.filename}: " if error.filename else ""
        return _print_error(f"{file_name}{str(error.strerror or error).rstrip('.')}.", 1)
    if isinstance(error, MemoryError):
        return _print_error("there is not enough memory; ask for fewer --num-points.", 1)
    return _print_error(
        f"this should not have happened: {type(error).__name__}: {error}. "
        "Run again with JEIT_DEBUG=1 for the traceback, and report it.",
        1,
    )


def _print_error(message: str, exit_status: int) -> int:
    print(f"jeit: {_format_on_one_line(message)}", file=sys.stderr)
    return exit_status


def _format_on_one_line(message: str) -> str:
    """Convert an error message to one line of printable characters, shortened in the middle if it is too long."""
    line = "".join(character if character.isprintable() else "�" for character in " ".join(message.split()))
    half_length = (_MAX_MESSAGE_LENGTH - 3) // 2
    return line if len(line) <= _MAX_MESSAGE_LENGTH else f"{line[:half_length]} … {line[-half_length:]}"


def _create_warning_printer() -> Callable[..., None]:
    """Create a function that prints each warning only once. Without it, warnings of objects that a command creates
    repeatedly would be repeated."""
    printed_texts: set[str] = set()

    def show_warning(message, category, filename, lineno, file=None, line=None) -> None:
        warning_text = str(message)
        if issubclass(category, _DEVELOPER_WARNINGS) and not os.environ.get("JEIT_DEBUG"):
            return
        if warning_text not in printed_texts and not discard_damaged_cache_files(warning_text):
            printed_texts.add(warning_text)
            print(f"jeit: warning: {_format_on_one_line(warning_text)}", file=sys.stderr)

    return show_warning


def _set_up_process(*, compile_quickly: bool) -> None:
    """Configure the process for a command: compiler flags, warnings and garbage collection. `compile_quickly`: whether
    to compile with few optimisations, for commands that spend most of their time on compilation. XLA_FLAGS set by the
    user take precedence."""
    if compile_quickly:
        os.environ.setdefault("XLA_FLAGS", quick_compilation())
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # suppresses messages about fonts and unwritable folders
    # Imports and tracing create many small objects, which Python's garbage collector would scan repeatedly.
    gc.set_threshold(100_000, 20, 50)
