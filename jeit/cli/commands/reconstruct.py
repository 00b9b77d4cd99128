"""`jeit reconstruct`: image a measured file, and write a picture, arrays and a report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.applications import check_method, image_by_network
from jeit.cli.options import (
    NETWORK_METHOD,
    AsIsOption,
    ContactOption,
    DataArgument,
    DescriptionOption,
    FormatOption,
    FrameOption,
    KeyOption,
    ModelOption,
    NodesOption,
    QuietOption,
    ReferenceArgument,
    ReferenceFramesOption,
    ReferenceKeyOption,
    convert_to_number_if_possible,
    make_folder,
    read_pair,
)

if TYPE_CHECKING:
    from jeit.imaging import ImagedDifference
    from jeit.inverse.shapes import ShapeReconstruction


def reconstruct(
    data: DataArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="Folder for image.png, image.npz, report.json and, of a solid, image.vtu.",
            show_default=False,
        ),
    ],
    reference: ReferenceArgument = None,
    reference_frames: ReferenceFramesOption = None,
    key: KeyOption = None,
    reference_key: ReferenceKeyOption = None,
    format: FormatOption = None,
    description: DescriptionOption = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="auto (default): one-step, or gauss-newton and outlines of bodies where that is unsound, bodies in "
            "solids wherever the data show them; one-step, back-projection, filtered-back-projection; gauss-newton, "
            "levenberg-marquardt, total-variation; shapes, outlines of strong bodies, in solids their surfaces; "
            "network, maps of depth by one that learnt the skin (--model)."
        ),
    ] = None,
    prior: Annotated[
        str | None,
        typer.Option(
            help="tikhonov, laplace, noser, gaussian (default) or matern; not for back-projection and total-variation. "
            "Another than the default asks in solids for an image by it, not for bodies."
        ),
    ] = None,
    hyperparameter: Annotated[
        str | None,
        typer.Option(
            help="A number, or the rule that chooses it: noise-figure (default), l-curve, gcv, discrepancy, "
            "best-resolution, see jeit choose; of a one-step image unless a method is given. Unless given 5 for "
            "gauss-newton and levenberg-marquardt, 300 for total-variation.",
            metavar="VALUE|RULE",
        ),
    ] = None,
    contact: ContactOption = None,
    segment: Annotated[
        bool,
        typer.Option(
            "--segment",
            help="Cut inclusions out; add labels to image.npz: 0 background, 1 resistive, 2 conductive.",
        ),
    ] = False,
    bodies: Annotated[
        str | None,
        typer.Option(
            help="Of bodies in a solid, if it is known: ellipsoids, balls and the like, or columns through its whole "
            "height; either (default)."
        ),
    ] = None,
    num_points: NodesOption = None,
    frame: FrameOption = None,
    as_is: AsIsOption = False,
    model: ModelOption = None,
    quiet: QuietOption = False,
) -> None:
    """Image the change from REFERENCE to DATA; writes image.png, image.npz, report.json; for solids image.vtu.

    With --method network, the indentation depth of a skin is imaged: frames.csv, depth.npz, depth.png and report.json.

    In Python: `jeit.image_difference` and `jeit.report.write_image`; `jeit.reconstruct` makes absolute images.
    """
    if method == NETWORK_METHOD or model is not None:
        unused_options = {
            "prior": prior,
            "hyperparameter": hyperparameter,
            "contact": contact,
            "num-points": num_points,
            "segment": segment or None,
            "reference-frames": reference_frames,
            "bodies": bodies,
            "as-is": as_is or None,
            "key": key,
            "reference-key": reference_key,
        }
        frame_selector = None if frame is None else convert_to_number_if_possible(frame, int)
        image_by_network(
            model,
            (data, reference, format, description),
            output,
            method=method,
            frame=frame_selector,
            unused_options=unused_options,
            quiet=quiet,
        )
        return
    from jeit.cli.console import Steps, plain_console, print_written_files
    from jeit.imaging import METHODS, ImagingSettings, image_difference
    from jeit.imaging.method import AUTO
    from jeit.report import write_image

    check_method(method, (AUTO, *METHODS))
    setting_values = {
        "segment": segment,
        "method": method,
        "prior": prior,
        "hyperparameter": None if hyperparameter is None else convert_to_number_if_possible(hyperparameter),
        "contact": contact,
        "bodies": bodies,
        "num_points": num_points,
        "as_is": as_is,
    }
    settings = ImagingSettings(**{name: value for name, value in setting_values.items() if value is not None})
    chosen_method = METHODS.get(settings.method, METHODS["one-step"])
    if prior is not None and not chosen_method.takes_prior:
        raise ValueError(f"--prior does not go with --method {method}; leave it out, or choose another method.")
    if hyperparameter is not None and not chosen_method.takes_hyperparameter:
        raise ValueError(f"--hyperparameter: plain {settings.method} has none; leave it out.")
    make_folder(output)
    console = plain_console()
    with Steps(console, quiet=quiet) as step:
        step("read")
        measurement, reference_measurement = read_pair(
            data, reference, reference_frames, format, description, (key, reference_key)
        )
        frame_number = None if frame is None else convert_to_number_if_possible(frame, int)
        result = image_difference(measurement, reference_measurement, settings, frame=frame_number, progress=step)
        step("write")
        write_image(result, output)
    if not quiet:
        print_imaging_result(console, result, frame_given=frame is not None)
        solid_file_names = ("image.vtu",) if result.mesh.dimension == 3 else ()
        print_written_files(console, output / "image.png", "image.npz", "report.json", *solid_file_names)


# Fraction of the difference between frame and reference above which rounding of the voltages is reported.
_MIN_REPORTED_ROUNDING_ERROR = 2e-3


def _assumed_noise_text(result: "ImagedDifference") -> str:
    """Text on the noise of a frame whose noise was not measured: the noise that was assumed relative to the difference
    from the reference, both as root mean squares over the usable channels."""
    import numpy as np

    from jeit.arguments import percent

    if result.noise is None:
        return "not known"
    usable_channels = np.asarray(result.measurement.mask)[0] & np.asarray(result.reference.mask)[0]
    reference_voltages = np.asarray(result.reference.voltages)[0][usable_channels]
    difference_norm = result.quality.difference * np.linalg.norm(reference_voltages)
    assumed_share = np.linalg.norm(np.asarray(result.noise)[usable_channels]) / difference_norm
    return f"not measured; {percent(assumed_share)} is assumed, model error included"


def print_imaging_result(console, result: "ImagedDifference", *, frame_given: bool = False) -> None:
    """Print the result of imaging. `frame_given` states whether the user selected the frame."""
    import numpy as np

    from jeit.arguments import counted, percent
    from jeit.cli.console import (
        format_with_unit,
        inclusion_table,
        name_value_table,
        quantity_table,
        smallest_body_text,
    )
    from jeit.inverse.nonlinear.reconstruct import Reconstruction
    from jeit.report.folder import describe_detectable_in_image
    from jeit_solvers import Status

    calibration, reconstruction = result.calibration, result.reconstruction
    unit = "S" if result.mesh.dimension == 2 else "S/m"
    noise, noise_share = result.quality.difference_noise, result.quality.noise_share
    hyperparameter = float(reconstruction.hyperparameter)
    hyperparameter_text = "none" if result.chosen_by == "none" else f"{hyperparameter:.3g} ({result.chosen_by})"
    background = np.asarray(calibration.conductivity).item()
    background_text = format_with_unit(background.real, unit)
    background_text += (
        f" and {format_with_unit(background.imag, unit)} of susceptivity" if isinstance(background, complex) else ""
    )
    if noise_share is not None:
        noise_text = f"{percent(noise_share)}, from {result.quality.noise_source}"
    else:
        noise_text = _assumed_noise_text(result) if noise is None else f"{percent(noise.relative)}, from {noise.method}"
    noise_text += "" if result.electrode_change is None else "; of the rest that moved electrodes leave"
    table_rows = [
        ("background", f"{background_text}, misfit {percent(float(calibration.misfit))}"),
        ("difference", f"{percent(result.quality.difference)} of the reference"),
        ("noise in it", noise_text),
        ("method", f"{result.settings.method}, hyperparameter {hyperparameter_text}"),
        ("mesh", f"{counted(result.mesh.num_points, 'node')}, {counted(result.mesh.num_cells, 'cell')}"),
    ]
    if (detectable_report := describe_detectable_in_image(result)) is not None:
        table_rows.insert(3, ("smallest body", smallest_body_text(detectable_report)))
    if result.quality.rounding > _MIN_REPORTED_ROUNDING_ERROR:
        table_rows.insert(
            3, ("rounding", f"{percent(result.quality.rounding)} of the difference: voltages have few digits")
        )
    if calibration.note:
        table_rows.insert(1, ("note", calibration.note))
    if calibration.status != Status.CONVERGED:
        table_rows.insert(1, ("calibration", f"{calibration.status}. {calibration.reason}"))
    if reconstruction.choice is not None and reconstruction.choice.note:
        table_rows.append(("hyperparameter", reconstruction.choice.note))
    if isinstance(reconstruction, Reconstruction):
        misfit_text = f"misfit {float(reconstruction.misfit):.2g} standard deviations"
        iterations_text = counted(int(reconstruction.iterations), "iteration")
        table_rows.append(("iteration", f"{reconstruction.status}, {iterations_text}, {misfit_text}"))
    table_rows += [("doubt", doubt) for doubt in result.doubts]
    if result.shapes is not None:
        table_rows.append(("bodies", bodies_text(result.shapes, result.mesh.dimension)))
    if result.why:
        table_rows.append(("chosen, for", result.why))
    if unlike_electrodes := result.unlike_electrodes:
        electrode_numbers = ", ".join(
            f"{electrode + 1} ({ratio:.1f} times)" for electrode, ratio in unlike_electrodes.items()
        )
        table_rows.append(
            ("note", f"more misfit than at other electrodes at {electrode_numbers}: what reads them counts less")
        )
    if result.wiring.fault:
        table_rows.append(("wiring", result.wiring.fault))
    table_rows += [("note", note) for note in dict.fromkeys((*result.measurement.notes, *result.reference.notes))]
    console.print()
    if result.num_frames > 1:
        table_rows.insert(0, ("frame", _frame_text(result, frame_given)))
    console.print(name_value_table(result.measurement.name, table_rows))
    console.print()
    if any(inclusion.contrast_interval is not None for inclusion in result.inclusions):
        inclusions_table, table_note = quantity_table(result.inclusions, background.real), ""
    else:
        inclusions_table = inclusion_table(result.inclusions, unit, background=background.real)
        table_note = "  peaks of the image, which blurs; only fitted bodies have intervals"
    console.print(inclusions_table if result.inclusions else "  no inclusion found")
    if result.inclusions and table_note:
        console.print(table_note, style="dim", highlight=False)
    console.print()


def bodies_text(shapes: "ShapeReconstruction", dimension: int) -> str:
    """Text about the bodies whose shapes were fitted: outlines in a sheet (`dimension` 2), surfaces in a solid."""
    from jeit.arguments import counted, percent
    from jeit.inverse.shapes import Ellipsoid

    shape_noun = "surface" if dimension == 3 else "outline"
    rejected_bodies_text = f"; {counted(len(shapes.doubtful), 'ghost')} left out" if shapes.doubtful else ""
    num_undetermined_contrasts = sum(not body.contrast_is_determined for body in shapes.bodies)
    num_columns = sum(isinstance(body, Ellipsoid) and body.column for body in shapes.bodies)
    columns_text = f", {counted(num_columns, 'column')} through the whole height" if num_columns else ""
    undetermined_text = (
        f"; of {num_undetermined_contrasts} the data give a limit of the change only"
        if num_undetermined_contrasts
        else ""
    )
    shares_material = any(isinstance(body, Ellipsoid) and body.alike for body in shapes.bodies)
    material_text = ", as of one material: the data do not contradict it" if shares_material else ""
    background_drift_text = f"the background has drifted by {percent(shapes.drift)}"
    fitted_text = f"{counted(len(shapes.bodies), shape_noun)} fitted{columns_text}"
    return f"{fitted_text}{material_text}{rejected_bodies_text}{undetermined_text}; {background_drift_text}"


def _frame_text(result: "ImagedDifference", frame_given: bool) -> str:
    """Text that states which frame was imaged, the number of frames, and how to image other frames."""
    frame_names = result.measurement.frame_names
    frame_text = f"{frame_names[0]!r}, " if frame_names else ""
    frame_text += f"{result.frame} of {result.num_frames}"
    if frame_given:
        return frame_text
    # The mean of named frames is not proposed, because named frames usually show different objects.
    mean_hint = "" if frame_names else ', or their mean: frames = "mean" in [data] of the description'
    return f"{frame_text}, from 0; --frame takes another{mean_hint}"
