"""`jeit reconstruct`: image a measured file, and write a picture, arrays and a report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.applications import check_method, image_by_network
from jeit.cli.options import (
    NETWORK,
    AsIs,
    Contact,
    Data,
    Description,
    Format,
    Frame,
    Key,
    Model,
    Nodes,
    Quiet,
    Reference,
    ReferenceFrames,
    ReferenceKey,
    make_folder,
    number_or_name,
    read_pair,
)

if TYPE_CHECKING:
    from jeit.imaging import ImagedDifference
    from jeit.inverse.shapes import ShapeReconstruction


def reconstruct(
    data: Data,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="Folder for image.png, image.npz, report.json and, of a solid, image.vtu.",
            show_default=False,
        ),
    ],
    reference: Reference = None,
    reference_frames: ReferenceFrames = None,
    key: Key = None,
    reference_key: ReferenceKey = None,
    format: Format = None,
    description: Description = None,
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
    contact: Contact = None,
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
    num_points: Nodes = None,
    frame: Frame = None,
    as_is: AsIs = False,
    model: Model = None,
    quiet: Quiet = False,
) -> None:
    """Image what changed between REFERENCE and DATA; writes image.png, image.npz, report.json; of solids image.vtu.

    With --method network, how deep a skin is indented: frames.csv, depth.npz, depth.png and report.json.

    In Python: `jeit.image_difference` and `jeit.report.write_image`; `jeit.reconstruct` makes absolute images.
    """
    if method == NETWORK or model is not None:
        unused = {
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
        which = None if frame is None else number_or_name(frame, int)
        image_by_network(
            model,
            (data, reference, format, description),
            output,
            method=method,
            frame=which,
            unused_options=unused,
            quiet=quiet,
        )
        return
    from jeit.cli.console import Steps, plain_console, say_written
    from jeit.imaging import METHODS, ImagingSettings, image_difference
    from jeit.imaging.method import AUTO
    from jeit.report import write_image

    check_method(method, (AUTO, *METHODS))
    given = {
        "segment": segment,
        "method": method,
        "prior": prior,
        "hyperparameter": None if hyperparameter is None else number_or_name(hyperparameter),
        "contact": contact,
        "bodies": bodies,
        "num_points": num_points,
        "as_is": as_is,
    }
    settings = ImagingSettings(**{name: value for name, value in given.items() if value is not None})
    chosen_method = METHODS.get(settings.method, METHODS["one-step"])
    if prior is not None and not chosen_method.takes_prior:
        raise ValueError(f"--prior does not go with --method {method}; leave it out, or choose another method.")
    if hyperparameter is not None and not chosen_method.takes_hyperparameter:
        raise ValueError(f"--hyperparameter: plain {settings.method} has none; leave it out.")
    make_folder(output)
    console = plain_console()
    with Steps(console, quiet=quiet) as step:
        step("read")
        measurement, base = read_pair(data, reference, reference_frames, format, description, (key, reference_key))
        chosen = None if frame is None else number_or_name(frame, int)
        result = image_difference(measurement, base, settings, frame=chosen, progress=step)
        step("write")
        write_image(result, output)
    if not quiet:
        show(console, result, asked=frame is not None)
        solid = ("image.vtu",) if result.mesh.dimension == 3 else ()
        say_written(console, output / "image.png", "image.npz", "report.json", *solid)


# Share of the difference above which rounding is reported.
_ROUNDED = 2e-3


def show(console, result: "ImagedDifference", *, asked: bool = False) -> None:
    """Print the result; `asked`: whether the frame was given by the user."""
    import numpy as np

    from jeit.arguments import counted, percent
    from jeit.cli.console import inclusion_table, pairs, quantity_table, scaled
    from jeit.inverse.nonlinear.reconstruct import Reconstruction
    from jeit_solvers import Status

    calibration, reconstruction = result.calibration, result.reconstruction
    unit = "S" if result.mesh.dimension == 2 else "S/m"
    noise = result.quality.difference_noise
    hyperparameter = float(reconstruction.hyperparameter)
    chosen = "none" if result.chosen_by == "none" else f"{hyperparameter:.3g} ({result.chosen_by})"
    background = np.asarray(calibration.conductivity).item()
    size = scaled(background.real, unit)
    size += f" and {scaled(background.imag, unit)} of susceptivity" if isinstance(background, complex) else ""
    rows = [
        ("background", f"{size}, misfit {percent(float(calibration.misfit))}"),
        ("difference", f"{percent(result.quality.difference)} of the reference"),
        ("noise in it", "not known" if noise is None else f"{percent(noise.relative)}, from {noise.method}"),
        ("method", f"{result.settings.method}, hyperparameter {chosen}"),
        ("mesh", f"{counted(result.mesh.num_points, 'node')}, {counted(result.mesh.num_cells, 'cell')}"),
    ]
    if result.quality.rounding > _ROUNDED:
        rows.insert(3, ("rounding", f"{percent(result.quality.rounding)} of the difference: voltages have few digits"))
    if calibration.note:
        rows.insert(1, ("note", calibration.note))
    if calibration.status != Status.CONVERGED:
        rows.insert(1, ("calibration", f"{calibration.status}. {calibration.reason}"))
    if reconstruction.choice is not None and reconstruction.choice.note:
        rows.append(("hyperparameter", reconstruction.choice.note))
    if isinstance(reconstruction, Reconstruction):
        misfit = f"misfit {float(reconstruction.misfit):.2g} standard deviations"
        iterations = counted(int(reconstruction.iterations), "iteration")
        rows.append(("iteration", f"{reconstruction.status}, {iterations}, {misfit}"))
    elif result.lowest < -1:
        fall = (
            f"falls to {percent(result.lowest)} of the background, below -100 %: bodies may be out of place, missing, "
            "or shown where none are; leave out --method, or take gauss-newton"
        )
        rows.append(("linear image", fall))
    rows += [("doubt", doubt) for doubt in result.doubts]
    if result.shapes is not None:
        rows.append(("bodies", bodies_text(result.shapes, result.mesh.dimension)))
    if result.why:
        rows.append(("chosen, for", result.why))
    if unlike := result.unlike_electrodes:
        numbers = ", ".join(f"{one + 1} ({times:.1f} times)" for one, times in unlike.items())
        rows.append(("note", f"more misfit than at other electrodes at {numbers}: what reads them counts less"))
    if result.wiring.fault:
        rows.append(("wiring", result.wiring.fault))
    rows += [("note", note) for note in dict.fromkeys((*result.measurement.notes, *result.reference.notes))]
    console.print()
    if result.num_frames > 1:
        rows.insert(0, ("frame", _which(result, asked)))
    console.print(pairs(result.measurement.name, rows))
    console.print()
    if any(one.contrast_interval is not None for one in result.inclusions):
        table, note = quantity_table(result.inclusions, background.real), ""
    else:
        table = inclusion_table(result.inclusions, unit, background=background.real)
        note = "  peaks of the image, which blurs; only fitted bodies have intervals"
    console.print(table if result.inclusions else "  no inclusion found")
    if result.inclusions and note:
        console.print(note, style="dim", highlight=False)
    console.print()


def bodies_text(shapes: "ShapeReconstruction", dimension: int) -> str:
    """The bodies fitted as shapes, in half a sentence: outlines in a sheet, surfaces in a solid."""
    from jeit.arguments import counted, percent
    from jeit.inverse.shapes import Ellipsoid

    edge = "surface" if dimension == 3 else "outline"
    left = f"; {counted(len(shapes.doubtful), 'ghost')} left out" if shapes.doubtful else ""
    strong = sum(not one.contrast_is_determined for one in shapes.bodies)
    upright = sum(isinstance(one, Ellipsoid) and one.column for one in shapes.bodies)
    columns = f", {counted(upright, 'column')} through the whole height" if upright else ""
    assumed = f"; of {strong} the data give a limit of the change only" if strong else ""
    alike = any(isinstance(one, Ellipsoid) and one.alike for one in shapes.bodies)
    material = ", as of one material: the data do not contradict it" if alike else ""
    drift = f"the background has drifted by {percent(shapes.drift)}"
    return f"{counted(len(shapes.bodies), edge)} fitted{columns}{material}{left}{assumed}; {drift}"


def _which(result: "ImagedDifference", asked: bool) -> str:
    """The frame that was imaged, of how many, and how to image others."""
    names = result.measurement.frame_names
    said = f"{names[0]!r}, " if names else ""
    said += f"{result.frame} of {result.num_frames}"
    if asked:
        return said
    # Named frames usually show different objects, so that their mean is not useful.
    mean = "" if names else ', or their mean: frames = "mean" in [data] of the description'
    return f"{said}, from 0; --frame takes another{mean}"
