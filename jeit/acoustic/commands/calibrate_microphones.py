"""`jeit calibrate-microphones`: fit the decay model of every microphone to taps at known positions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import QuietOption, make_folder, naming_options_in_errors, with_option_names

if TYPE_CHECKING:
    from jeit.acoustic import Taps
    from jeit.acoustic.calibration.calibrate import CalibrationFit

_OPTIONS = {"path": "--output", "intensity": "--low, --high, --window and --hop"}

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
    options = {"low": low, "high": high, "window": window, "hop": hop}
    options = {name: value for name, value in options.items() if value is not None}
    if not options:
        return None
    from jeit.acoustic import IntensitySettings

    return IntensitySettings(**options)


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
    settings = intensity_settings(low, high, window, hop)
    console = plain_console()
    with naming_options_in_errors(_OPTIONS):
        decay_model = decay if decay == AUTO else find_decay(decay)
        files = calibration_files(output)
        make_folder(output.parent, tuple(file.name for file in files))
        with Steps(console, quiet=quiet) as step:
            step("read")
            tap_data = read_taps(taps)
            fit = calibrate(tap_data, decay=decay_model, place_error=place_error, intensity=settings, progress=step)
            step("write")
            write_calibration(fit, output)
    if not quiet:
        _print_summary(console, fit, tap_data)
        print_written_files(console, output, files[1].name)


def _print_summary(console, fit: "CalibrationFit", taps: "Taps") -> None:
    import numpy as np

    from jeit.cli.console import name_value_table

    calibration = fit.calibration
    usable = calibration.usable
    rows = [
        ("microphones", f"{int(usable.sum())} of {len(usable)} usable"),
        ("taps", f"{len(fit.outlier)}, {int(fit.outlier.sum())} left out as outliers"),
        ("decay model", f"{calibration.microphone_array.decay.name}: {fit.evidence}"),
        ("error of the model", f"{100 * fit.error:.1f} % of an intensity, median"),
        (
            "error of location",
            f"± {1e3 * _location_error(fit, taps):.1f} mm from one window, median (Cramér-Rao bound)",
        ),
        *([("note", with_option_names(fit.note, {"decay": "--decay"}))] if fit.note else []),
        ("scale", "a source of strength 1 has intensity 1 at a typical microphone directly below it"),
    ]
    if fit.shared.any():
        numbers = ", ".join(str(k) for k in np.flatnonzero(fit.shared))
        rows.append(
            ("tap nearer to", f"{numbers}: no tap determines the decay of their response; that of the others is used")
        )
    console.print()
    console.print(name_value_table(calibration.name, rows))
    console.print()
    console.print(_parameter_table(fit))
    unusable_rows = [
        (f"microphone {k}", f"not usable: {reason}") for k, reason in enumerate(calibration.reasons) if reason
    ]
    if unusable_rows:
        console.print()
        console.print(name_value_table("Left out", unusable_rows))


def _location_error(fit: "CalibrationFit", taps: "Taps") -> float:
    """Cramér-Rao bound of the localisation of sources with the positions and strengths of the taps: median over the
    taps of the standard deviation along the major axis of the error ellipse, metres."""
    import numpy as np

    from jeit.acoustic import cramer_rao

    is_received, usable = fit.strength > 0, np.asarray(fit.calibration.usable)
    cramer_rao_bound = cramer_rao(
        fit.calibration.microphone_array, taps.positions[is_received], fit.strength[is_received], use=usable
    )
    return float(np.median(np.sqrt(np.linalg.eigvalsh(cramer_rao_bound)[:, -1])))


def _parameter_table(fit: "CalibrationFit"):
    """Create a table of the decay models and displacements of all usable microphones."""
    import numpy as np
    from rich.table import Table

    from jeit_solvers.engines import on_host

    calibration = fit.calibration
    decay, noise = on_host((calibration.microphone_array.decay, calibration.microphone_array.noise))
    factors, unit_names = {"a": 1.0, "b": 1e6, "length": 1e3}, {"a": "m²", "b": "mm²", "length": "mm"}
    if decay.name == "exponential":
        unit_names["a"] = "1"
    columns = [text for name in decay.parameters for text in (f"{name} / {unit_names[name]}", "± %")]
    table = Table("", *columns, "moved / mm", "error %", "explained %", box=None, padding=(0, 1))
    for column in table.columns[1:]:
        column.justify = "right"
    for k, reason in enumerate(calibration.reasons):
        if reason:
            continue
        cells = []
        for i, name in enumerate(decay.parameters):
            error = 100 * calibration.standard_errors[i, k]
            cells += [
                f"{factors[name] * float(getattr(decay, name)[k]):.3g}",
                f"{error:.1f}" if error == error else "–",
            ]
        displacement = 1e3 * float(np.linalg.norm(fit.displacement[k]))
        cells += [
            f"{displacement:.1f}",
            f"{100 * float(noise.relative[k]):.1f}",
            f"{100 * float(fit.explained[k]):.1f}",
        ]
        table.add_row(str(k), *cells)
    return table
