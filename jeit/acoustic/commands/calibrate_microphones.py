"""`jeit calibrate-microphones`: fit the decay model of every microphone to taps at known positions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import QuietOption, make_folder, naming_options_in_errors, with_option_names

if TYPE_CHECKING:
    from jeit.acoustic import Taps
    from jeit.acoustic.calibration.calibrate import CalibrationFit

_OPTION_NAMES = {"path": "--output", "intensity": "--low, --high, --window and --hop"}

LowestFrequencyOption = Annotated[
    float | None, typer.Option(help="Lowest frequency of the band, hertz (default 50, or the calibration's).")
]
HighestFrequencyOption = Annotated[
    float | None, typer.Option(help="Highest frequency of the band, hertz (default 1000, or the calibration's).")
]
WindowOption = Annotated[
    float | None, typer.Option(help="Length of a window, seconds (default 0.05, or the calibration's).")
]
HopOption = Annotated[
    float | None,
    typer.Option(
        help="Time from the start of a window to the start of the next, seconds (default 0.0125, or the calibration's)."
    ),
]


def intensity_settings(low: float | None, high: float | None, window: float | None, hop: float | None):
    """Create `IntensitySettings` from the command-line options that were given; None if all options are None."""
    given_options = {"low": low, "high": high, "window": window, "hop": hop}
    given_options = {
        option_name: option_value for option_name, option_value in given_options.items() if option_value is not None
    }
    if not given_options:
        return None
    from jeit.acoustic import IntensitySettings

    return IntensitySettings(**given_options)


def calibrate_microphones(
    taps: Annotated[
        Path,
        typer.Argument(
            help="NPZ file: microphones (M, d) and outline (K, d) in metres, positions (T, d) of the taps in metres, "
            "and intensity (T, M), or samples (T, M, S) with rate in hertz.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="Calibration file to write (JSON); a picture is written to the same folder.",
            show_default=False,
        ),
    ],
    decay: Annotated[
        str,
        typer.Option(
            help="inverse-square, a/(r²+b); exponential; attenuated, the product of both; or auto, the model that best "
            "locates taps left out of the fit."
        ),
    ] = "auto",
    place_error: Annotated[
        float,
        typer.Option(
            help="Standard deviation in metres of each coordinate of the given positions of the microphones, which are "
            "corrected by the taps; 0 if they are exact."
        ),
    ] = 0.002,
    low: LowestFrequencyOption = None,
    high: HighestFrequencyOption = None,
    window: WindowOption = None,
    hop: HopOption = None,
    quiet: QuietOption = False,
) -> None:
    """Calibrate an array of microphones from taps at known places; writes the calibration and a picture of the
    calibration."""
    from jeit.acoustic import calibrate_microphones as calibrate
    from jeit.acoustic import read_taps
    from jeit.acoustic.calibration.calibrate import AUTO
    from jeit.acoustic.decay import find_decay
    from jeit.acoustic.reports import calibration_files, write_calibration
    from jeit.cli.console import Steps, plain_console, print_written_files

    if not 0 <= place_error < float("inf"):
        raise ValueError(f"--place-error must be zero or positive, in metres; it is {place_error}.")
    intensity_options = intensity_settings(low, high, window, hop)
    console = plain_console()
    with naming_options_in_errors(_OPTION_NAMES):
        decay_model = decay if decay == AUTO else find_decay(decay)
        calibration_paths = calibration_files(output)
        make_folder(output.parent, tuple(calibration_path.name for calibration_path in calibration_paths))
        with Steps(console, quiet=quiet) as progress_steps:
            progress_steps("read")
            calibration_taps = read_taps(taps)
            calibration_fit = calibrate(
                calibration_taps,
                decay=decay_model,
                place_error=place_error,
                intensity=intensity_options,
                progress=progress_steps,
            )
            progress_steps("write")
            write_calibration(calibration_fit, output)
    if not quiet:
        _print_summary(console, calibration_fit, calibration_taps)
        print_written_files(console, output, calibration_paths[1].name)


def _print_summary(console, calibration_fit: "CalibrationFit", taps: "Taps") -> None:
    import numpy as np

    from jeit.cli.console import name_value_table

    calibration = calibration_fit.calibration
    is_usable = calibration.usable
    table_rows = [
        ("microphones", f"{int(is_usable.sum())} of {len(is_usable)} usable"),
        ("taps", f"{len(calibration_fit.outlier)}, {int(calibration_fit.outlier.sum())} left out as outliers"),
        ("decay model", f"{calibration.microphone_array.decay.name}: {calibration_fit.evidence}"),
        ("error of the model", f"{100 * calibration_fit.error:.1f} % of an intensity, median"),
        (
            "error of location",
            f"± {1e3 * _location_error(calibration_fit, taps):.1f} mm from one window, median (Cramér-Rao bound)",
        ),
        *([("note", with_option_names(calibration_fit.note, {"decay": "--decay"}))] if calibration_fit.note else []),
        ("scale", "a source of strength 1 has intensity 1 at a typical microphone directly below it"),
    ]
    if calibration_fit.shared.any():
        microphone_numbers = ", ".join(str(k) for k in np.flatnonzero(calibration_fit.shared))
        table_rows.append(
            (
                "tap nearer to",
                f"{microphone_numbers}: no tap determines the decay of their response; that of the others is used",
            )
        )
    console.print()
    console.print(name_value_table(calibration.name, table_rows))
    console.print()
    console.print(_parameter_table(calibration_fit))
    unusable_rows = [
        (f"microphone {k}", f"not usable: {exclusion_reason}")
        for k, exclusion_reason in enumerate(calibration.reasons)
        if exclusion_reason
    ]
    if unusable_rows:
        console.print()
        console.print(name_value_table("Left out", unusable_rows))


def _location_error(calibration_fit: "CalibrationFit", taps: "Taps") -> float:
    """Cramér-Rao bound of the localisation of sources with the positions and strengths of the taps: median over the
    taps of the standard deviation along the major axis of the error ellipse, metres."""
    import numpy as np

    from jeit.acoustic import cramer_rao

    is_received, is_usable = calibration_fit.strength > 0, np.asarray(calibration_fit.calibration.usable)
    cramer_rao_bound = cramer_rao(
        calibration_fit.calibration.microphone_array,
        taps.positions[is_received],
        calibration_fit.strength[is_received],
        use=is_usable,
    )
    return float(np.median(np.sqrt(np.linalg.eigvalsh(cramer_rao_bound)[:, -1])))


def _parameter_table(calibration_fit: "CalibrationFit"):
    """Create a table of the decay models and displacements of all usable microphones."""
    import numpy as np
    from rich.table import Table

    from jeit_solvers.engines import on_host

    calibration = calibration_fit.calibration
    decay, intensity_noise = on_host((calibration.microphone_array.decay, calibration.microphone_array.noise))
    unit_factors, unit_names = {"a": 1.0, "b": 1e6, "length": 1e3}, {"a": "m²", "b": "mm²", "length": "mm"}
    if decay.name == "exponential":
        unit_names["a"] = "1"
    column_titles = [
        column_title
        for parameter_name in decay.parameters
        for column_title in (f"{parameter_name} / {unit_names[parameter_name]}", "± %")
    ]
    printed_table = Table("", *column_titles, "moved / mm", "error %", "explained %", box=None, padding=(0, 1))
    for table_column in printed_table.columns[1:]:
        table_column.justify = "right"
    for k, exclusion_reason in enumerate(calibration.reasons):
        if exclusion_reason:
            continue
        row_cells = []
        for i, parameter_name in enumerate(decay.parameters):
            error_percent = 100 * calibration.standard_errors[i, k]
            row_cells += [
                f"{unit_factors[parameter_name] * float(getattr(decay, parameter_name)[k]):.3g}",
                f"{error_percent:.1f}" if error_percent == error_percent else "–",
            ]
        displacement_mm = 1e3 * float(np.linalg.norm(calibration_fit.displacement[k]))
        row_cells += [
            f"{displacement_mm:.1f}",
            f"{100 * float(intensity_noise.relative[k]):.1f}",
            f"{100 * float(calibration_fit.explained[k]):.1f}",
        ]
        printed_table.add_row(str(k), *row_cells)
    return printed_table
