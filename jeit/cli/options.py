"""Command-line options and arguments shared by several commands, and functions that check options."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from jeit.data import Measurement

DataArgument = Annotated[Path, typer.Argument(help="Measured file to image.", show_default=False)]
ReferenceArgument = Annotated[
    Path | None,
    typer.Option(help="Measured file of the undisturbed body; may be left out if DATA has a frame 'reference'."),
]
FormatOption = Annotated[
    str | None,
    typer.Option(
        help="kit4, ktc2023, eidors, sciospec, draeger, carefusion, swisstom, goettingen, cn0565, quadrupoles, "
        "openeit, table or tank6cm; found from the content unless given."
    ),
]
DescriptionOption = Annotated[
    str | None,
    typer.Option(help="TOML file that says what the numbers mean; looked for beside the data unless given."),
]
KeyOption = Annotated[
    str | None,
    typer.Option(help="Array of the frames in a .mat or .npz file; that which fits unless given.", metavar="NAME"),
]
ReferenceKeyOption = Annotated[
    str | None,
    typer.Option(help="Array of the reference, in REFERENCE, or in DATA where no REFERENCE is given.", metavar="NAME"),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
ContactOption = Annotated[
    str | None,
    typer.Option(help="Contact impedance in the calibration: each, common or fixed; found from the protocol."),
]
NodesOption = Annotated[
    int | None, typer.Option(help="Nodes of the mesh, about (default 2000; of a solid body 10000).")
]
AsIsOption = Annotated[
    bool,
    typer.Option(
        "--as-is",
        help="Go on though electrodes, channels or signs look wired otherwise than described; correct nothing.",
    ),
]
ModelOption = Annotated[
    Path | None,
    typer.Option("--model", help="Folder of 'jeit learn image', or its network.jeit; for --method network."),
]
FrameOption = Annotated[
    str | None,
    typer.Option(
        help="Frame of DATA to image, by number from 0 (negative: from the end) or by name; the first unless given."
    ),
]
ReferenceFramesOption = Annotated[
    str | None,
    typer.Option(
        help="Frames, from 0, whose mean is the undisturbed body, such as 0-17 or 5: of REFERENCE, or of DATA where no "
        "REFERENCE is given. All of REFERENCE unless given.",
        metavar="FIRST-LAST",
    ),
]
NETWORK_METHOD = "network"
"""Value of `--method` of `reconstruct` and `stream` for imaging by a network, besides the methods of `jeit.imaging`."""

# Folders created by `make_folder`, inner folders first.
_CREATED_FOLDERS: list[Path] = []
# Input files of the current command.
_INPUT_FILES: list[Path] = []
# Options that name output files.
_OUTPUT_OPTIONS = ("output", "page", "film")


def recording_input_files(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a command so that its input files are recorded. `make_folder` then checks that no output overwrites them."""

    @wraps(command)
    def call_command(**option_values: Any) -> Any:
        _INPUT_FILES.clear()
        for name, option_value in option_values.items():
            with suppress(OSError, ValueError):
                if (
                    name not in _OUTPUT_OPTIONS
                    and isinstance(option_value, str | Path)
                    and Path(option_value).is_file()
                ):
                    _INPUT_FILES.append(Path(option_value))
        return command(**option_values)

    return call_command


class StoppedError(Exception):
    """Error raised when Ctrl-C stops a command, with the message to print."""


def reporting_when_stopped(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a command so that Ctrl-C raises `StoppedError`, because typer does not report `KeyboardInterrupt`."""

    @wraps(command)
    def call_command(*arguments: Any, **option_values: Any) -> Any:
        try:
            return command(*arguments, **option_values)
        except KeyboardInterrupt:
            raise StoppedError("stopped.") from None

    return call_command


@contextmanager
def naming_options_in_errors(options: dict[str, str]) -> Iterator[None]:
    """Context manager that replaces names of Python arguments by names of options in error messages, see
    `with_option_names`. The keys of `options` are names of arguments, its values names of options."""
    try:
        yield
    except (ValueError, FileNotFoundError) as error:
        message = str(error)
        if (renamed_message := with_option_names(message, options)) == message:
            raise
        raise ValueError(renamed_message) from error


def read_file(
    option: str,
    path: Path,
    format: str | None,
    description: str | None,
    like: "Measurement | None" = None,
    key: str | None = None,
) -> "Measurement":
    """Read the measured file at `path`. Error messages name the `option` by which the user specified the file, "DATA"
    or "--reference"."""
    from jeit.data import read

    with naming_options_in_errors({"path": option, "key": "--reference-key" if option == "--reference" else "--key"}):
        return read(path, format, description, like=like, key=key)


def read_pair(
    data: Path,
    reference: Path | None,
    frames: str | None,
    format: str | None,
    description: str | None,
    keys: tuple[str | None, str | None] = (None, None),
) -> "tuple[Measurement, Measurement | None]":
    """Read DATA and its reference. `frames`: range of the frames that are used as reference, from the reference file
    or, without such a file, from DATA. `keys`: names of the arrays of voltages in DATA and in the reference file."""
    key, reference_key = keys
    is_same_data = reference is not None and reference.resolve() == data.resolve() and key == reference_key
    reference = data if reference is None and reference_key is not None else reference
    reference_measurement = (
        None if reference is None else read_file("--reference", reference, format, description, key=reference_key)
    )
    measurement = read_file("DATA", data, format, description, like=reference_measurement, key=key)
    if is_same_data and frames is None and measurement.num_frames > 1:
        raise ValueError(
            "--reference: it is the file of DATA itself. Give a file of the undisturbed body, or the frames of DATA in "
            "which it was undisturbed, such as --reference-frames 0-9."
        )
    reference_source = measurement if reference_measurement is None else reference_measurement
    return measurement, reference_measurement if frames is None else reference_of_frames(reference_source, frames)


def reference_of_frames(measurement: "Measurement", frames: str) -> "Measurement":
    """Return the frames of a measurement that the option --reference-frames selects, such as "0-17" or "5"."""
    range_match = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9}))?", frames.strip())
    first_frame, last_frame = (int(range_match[1]), int(range_match[2] or range_match[1])) if range_match else (0, -1)
    if not first_frame <= last_frame < measurement.num_frames:
        raise ValueError(
            f"--reference-frames: give FIRST-LAST, such as 0-17, or one number, of the frames 0 to "
            f"{measurement.num_frames - 1} of '{measurement.name}'; it is {frames!r}."
        )
    return measurement.frames(slice(first_frame, last_frame + 1))


def with_option_names(message: str, options: dict[str, str]) -> str:
    """Replace names of Python arguments in an error message by names of options. Names are replaced at the beginning of
    the message, and where they are written as `name=`.

    For options in millimetres, whose names end in "-mm", the question in the message whether millimetres were confused
    with metres is removed.
    """
    from jeit.arguments import MILLIMETRE_HINT

    unit_questions = MILLIMETRE_HINT, "are both in metres?"

    for argument, option in options.items():
        if message.startswith((f"{argument} ", f"{argument}:")):
            for unit_question in unit_questions if option.endswith("-mm") else ():
                message = message.replace(f"; {unit_question}", ".")
            message = option + message.removeprefix(argument)
        message = re.sub(rf"\b{argument}=(?!\w)", option, message)
    return message


def check_positive(options: dict[str, float]) -> None:
    """Raise `ValueError` unless the values of all `options` are positive and finite."""
    for name, value in options.items():
        if not 0 < value < float("inf"):
            raise ValueError(f"{name} must be positive; it is {value:g}.")


def check_at_least(options: dict[str, tuple[int | None, int]]) -> None:
    """Raise `ValueError` if an option, given as a pair of value and minimum, has a value below the minimum."""
    for name, (value, minimum) in options.items():
        if value is not None and value < minimum:
            raise ValueError(f"{name} must be at least {minimum}; it is {value}.")


def check_seed(seed: int) -> None:
    """Raise `ValueError` for a seed that random numbers do not take."""
    if not 0 <= seed < 2**32:
        raise ValueError(f"--seed must be at least 0 and less than 2³²; it is {seed}.")


def check_within(name: str, value: float, minimum: float, maximum: float, unit: str = "") -> None:
    """Raise `ValueError` unless the option `name` has a `value` from `minimum` to `maximum`."""
    if not minimum <= value <= maximum:
        unit = f" {unit}" if unit else ""
        raise ValueError(f"{name} must be from {minimum:g} to {maximum:g}{unit}; it is {value:g}.")


def make_folder(output: Path, names: tuple[str, ...] = ("image.png", "image.npz", "report.json", "image.vtu")) -> None:
    """Create the folder for result files with the given `names` before the computation; `remove_empty_folders` removes
    it if it stays empty. Raises `ValueError` if `output` cannot be a folder, and if a result would overwrite an input
    file of the command."""
    for name in names:
        if any((output / name).exists() and (output / name).samefile(input_file) for input_file in _INPUT_FILES):
            raise ValueError(
                f"--output {output}: {name} in it was given, and would be written over; give another folder."
            )
    from jeit.report.folder import results_folder

    missing_folders = [folder for folder in (output, *output.parents) if not folder.exists()]
    with naming_options_in_errors({"folder": "--output"}):
        results_folder(output, names)
    _CREATED_FOLDERS.extend(missing_folders)


def remove_empty_folders() -> None:
    """Remove the empty folders among those created by `make_folder`."""
    while _CREATED_FOLDERS:
        with suppress(OSError):
            _CREATED_FOLDERS.pop(0).rmdir()


def convert_to_number_if_possible(text: str, number_type: type = float):
    """Convert text to a number; return the text itself if it is not a number."""
    try:
        return number_type(text)
    except ValueError:
        return text
