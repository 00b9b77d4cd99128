"""Files of an imaged difference: picture, arrays, and report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from jeit.image import Inclusion
from jeit.imaging.difference import ImagedDifference
from jeit.imaging.electrode_changes import ElectrodeChange
from jeit.imaging.method import METHODS, ImagingSettings
from jeit.inverse import Uncertainty
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.shapes import Ellipsoid, Star
from jeit.mesh import Mesh
from jeit.protocol import Protocol
from jeit.report.folder import (
    describe_detectable_in_image,
    describe_domain,
    describe_electrodes,
    describe_measurement,
    package_version,
    results,
    to_plain_values,
    write_json,
)
from jeit.report.saved_image import saved_extras

IMAGE_FILES = ("image.png", "image.npz", "report.json", "image.vtu")
"""Names of the files written by `write_image`; the last is written only for solids."""
# Number of letters per inch of a picture's width in the text of a doubt, and colour of this text.
_LETTERS_PER_INCH, _DOUBT_COLOUR = 16, "#a3350f"
_REPORTED_PACKAGES = ("jeit", "jax", "numpy", "scipy", "equinox", "lineax", "optimistix", "matplotlib")


def write_image(result: ImagedDifference, folder: str | Path, *, truth: tuple[float, ...] | None = None) -> None:
    """Write `image.png`, `image.npz`, `report.json` and, for a solid, `image.vtu` to a folder.

    Arrays of `image.npz`:

    - `raster`: (rows, columns), change of conductivity, S (3-D: S/m, at half the height), NaN outside the body; row 0
      is at the top, column 0 at the left.
    - `extent`: (x_min, x_max, y_min, y_max) in metres.
    - `conductivity`: (m,), the change of conductivity per cell.
    - `background`: the conductivity of the body in the reference frame.
    - `points`: (n, d), nodes of the mesh in metres; `cells`: (m, d + 1), indices of their nodes.
    - `labels`: (rows, columns), if the image was segmented: 0 background, 1 resistive, 2 conductive.
    - `departure`: (m,), for iterative images, logarithm to base 10 of conductivity divided by background.
    - electrodes and inclusions, see `jeit.report.saved_image.saved_extras`, for `jeit view`.

    The file `image.vtu` has the conductivity and its change per cell, and the electrode of each node. Raises
    `ValueError` for a path that cannot be a folder.

    **Arguments:**

    - `result`: the image.
    - `folder`: folder of the files, created if needed.
    - `truth` (x, y) or (x, y, radius): the true place of a contact and its radius, metres, drawn into the picture of a
      sheet.

    **Example:**

    ```python
    write_image(imaged, "out")
    ```
    """
    with results(folder, IMAGE_FILES) as temporary_folder:
        draw_image(result, truth=truth).savefig(temporary_folder / "image.png", dpi=150)
        np.savez_compressed(temporary_folder / "image.npz", **_image_arrays(result))
        write_json(report_image(result), temporary_folder / "report.json")
        if result.mesh.dimension == 3:
            background, change = np.asarray(result.calibration.conductivity), np.asarray(result.change)
            cell_values = {"change of conductivity": change, "conductivity": background + change}
            from jeit.report.volume_files import draft_vtu

            draft_vtu(temporary_folder / "image.vtu", result.mesh, cell_values, electrodes=result.electrodes)


def _image_arrays(result: ImagedDifference) -> dict[str, Any]:
    """Arrays that `write_image` stores in `image.npz`, by name."""
    arrays: dict[str, Any] = {
        "raster": np.asarray(result.raster),
        "extent": np.asarray(result.extent),
        "conductivity": np.asarray(result.change),
        "background": np.asarray(result.calibration.conductivity),
        "points": np.asarray(result.mesh.points),
        "cells": np.asarray(result.mesh.cells),
    }
    if result.labels is not None:
        arrays["labels"] = result.labels
    if result.iterative and not result.is_complex:
        arrays["departure"] = _drawn_values(result)
    return {**arrays, **saved_extras(result.mesh, result.electrodes, result.inclusions)}


def _drawn_values(result: ImagedDifference) -> np.ndarray:
    """Values per cell that the picture shows: the change of conductivity, or, for iterative images, whose conductivity
    ranges from 0.01 to 100 times the background, the change of its logarithm to base 10."""
    return np.asarray(result.departure) / (math.log(10) if result.iterative else 1)


def draw_image(result: ImagedDifference, *, truth: tuple[float, ...] | None = None):
    """Draw an imaged difference, and return a matplotlib `Figure` that needs no display. For an image of admittivity,
    the real and imaginary part are drawn.

    **Arguments:**

    - `result`: the image.
    - `truth` (x, y) or (x, y, radius): the true place of a contact and its radius, metres, drawn into the picture of a
      sheet.

    **Example:**

    ```python
    draw_image(imaged, truth=(0.02, 0.01)).savefig("image.png")
    ```
    """
    from matplotlib.figure import Figure

    from jeit.plot.colours import CHANGE_SCALE, FACTOR_SCALE
    from jeit.plot.imaging.electrodes import draw_labels, draw_outlines
    from jeit.plot.imaging.image import plot_image

    if result.is_complex:
        from jeit.plot.imaging.image import plot_admittivity

        figure = Figure(figsize=(11.5, 5.2), layout="constrained")
        figure.suptitle(result.measurement.name)
        electrodes = result.electrodes
        plot_admittivity(result.mesh, np.asarray(result.change), electrodes, figure=figure)
        _write_doubts(figure, result.doubts)
        return figure
    colour_scale = FACTOR_SCALE if result.iterative else CHANGE_SCALE
    electrodes = result.electrodes
    if result.mesh.dimension == 3:
        from jeit.plot.solid.slices import plot_solid

        figure = plot_solid(
            result.mesh, _drawn_values(result), electrodes, inclusions=result.inclusions, scale=colour_scale
        )
        figure.suptitle(result.measurement.name)
        _write_doubts(figure, result.doubts)
        return figure
    figure = Figure(figsize=(6.4, 5.6), layout="constrained")
    ax = plot_image(
        result.mesh,
        _drawn_values(result),
        electrodes,
        inclusions=result.inclusions if result.labels is None and result.shapes is None else (),
        title=result.measurement.name,
        scale=colour_scale,
        ax=figure.subplots(),
    )
    if truth is not None:
        x, y, radius = (*truth, 0.0)[:3]
        pressed_style: dict[str, Any] = {"color": "#157f3b", "linewidth": 2, "label": "pressed here"}
        if radius:
            angles = np.linspace(0, 2 * np.pi, 100)
            ax.plot(x + radius * np.cos(angles), y + radius * np.sin(angles), **pressed_style)
        else:
            ax.plot(x, y, marker="+", markersize=15, linestyle="none", **pressed_style)
    if result.labels is not None:
        draw_labels(result.labels, result.extent, ax=ax)
    elif result.shapes is not None:
        draw_outlines([body for body in result.shapes.bodies if isinstance(body, Star)], ax=ax)
    elif result.inclusions:
        ax.plot([], [], color="black", linewidth=1, linestyle=(0, (4, 3)), label="found: sign and area")
    if ax.get_legend_handles_labels()[1]:
        ax.legend(loc="upper left", bbox_to_anchor=(0, 0), frameon=False, borderaxespad=0)
    _write_doubts(figure, result.doubts)
    return figure


def _write_doubts(figure, doubts: Sequence[str]) -> None:
    """Write the first doubt about an image below it, and the number of further doubts."""
    if not doubts:
        return
    further_doubts_text = f" {len(doubts) - 1} more in report.json." if len(doubts) > 1 else ""
    max_line_length = int(_LETTERS_PER_INCH * figure.get_size_inches()[0])
    figure.supxlabel(fill(f"Doubt: {doubts[0]}{further_doubts_text}", max_line_length), fontsize=8, color=_DOUBT_COLOUR)


def report_image(result: ImagedDifference) -> dict[str, Any]:
    """Report of the image and the settings as plain numbers, strings, lists and dictionaries; unknown values are
    None.

    **Arguments:**

    - `result`: the image.

    **Example:**

    ```python
    report_image(imaged)
    ```
    """
    reconstruction, quality, settings = result.reconstruction, result.quality, result.settings
    difference_noise = quality.difference_noise
    report = {
        "data": {**describe_measurement(result.measurement), **_frame_report(result)},
        "reference": describe_measurement(result.reference),
        "geometry": {
            **describe_domain(result.measurement.domain or result.reference.domain),
            "electrodes": describe_electrodes(result.calibration.model.electrodes),
            "mesh": {"points": result.mesh.num_points, "cells": result.mesh.num_cells},
        },
        "protocol": _protocol_report(result.measurement.protocol),
        "uncertainty": _uncertainty_report(
            result.reference.uncertainty or Uncertainty(), result.calibration.model.mesh
        ),
        "calibration": _calibration_report(result),
        "noise": None
        if difference_noise is None
        else {
            "standard_deviation": difference_noise.standard_deviation,
            "unit": "V",
            "relative_to_difference": difference_noise.relative if quality.noise_share is None else quality.noise_share,
            "method": difference_noise.method,
        },
        "unlike_electrodes": {electrode + 1: ratio for electrode, ratio in result.unlike_electrodes.items()},
        "electrode_change": _electrode_change_report(result.electrode_change),
        "wiring": {"fault": result.wiring.fault or None, "misfit": result.wiring.described},
        "quality": {
            "relative_difference": quality.difference,
            "difference_reciprocity_error": quality.difference_reciprocity_error,
            "impossible_signs": quality.impossible_signs,
            "usable_channels": quality.usable_channels,
            "rounding_relative_to_difference": quality.rounding,
        },
        "reconstruction": {
            "quantity": f"change of conductivity against the reference, {_conductivity_unit(result)}",
            "method": settings.method,
            "why": result.why or None,
            "least_change_relative_to_background": result.lowest,
            "prior": _prior_name(settings, result.mesh.dimension),
            **_iteration_report(result),
        },
        "hyperparameter": {
            "value": float(reconstruction.hyperparameter),
            "chosen_by": result.chosen_by,
            "note": (reconstruction.choice.note or None) if reconstruction.choice is not None else None,
        },
        "doubts": list(result.doubts),
        "inclusions": [_inclusion_report(result, inclusion) for inclusion in result.inclusions],
        "shapes": _shapes_report(result),
        "smallest_detectable_body": describe_detectable_in_image(result),
        "inclusion_settings": {"level": result.level, "least_peak": settings.least_peak},
        "timings": {**result.timings, "unit": "s"},
        "versions": {name: package_version(name) for name in _REPORTED_PACKAGES},
    }
    return to_plain_values(report)


def _uncertainty_report(uncertainty: Uncertainty, mesh: Mesh) -> dict[str, Any]:
    """Report of the uncertainty of the measurement's description, from which credible intervals are computed."""
    return {
        "position": uncertainty.position_on(mesh),
        "position_unit": "m",
        "contact_drift": uncertainty.drift,
        "size": uncertainty.size,
        "other": uncertainty.other,
    }


def _electrode_change_report(change: ElectrodeChange | None) -> dict[str, Any] | None:
    """Report of the change of the electrodes since the reference frame; None if the change explains little of the
    difference."""
    if change is None:
        return None
    return {
        "shift": change.shift.tolist(),
        "shift_unit": "m",
        "contact_factor": change.contact_factor.tolist(),
        "rest_relative_to_difference": change.rest,
    }


def _frame_report(result: ImagedDifference) -> dict[str, Any]:
    """Report of the name of the imaged frame, or its number (from 0) if it has no name, and of the number of frames in
    the file."""
    frame_names = result.measurement.frame_names
    return {"frame": frame_names[0] if frame_names else result.frame, "frames": result.num_frames}


def _conductivity_unit(result: ImagedDifference) -> str:
    return "S" if result.mesh.dimension == 2 else "S/m"


def _protocol_report(protocol: Protocol) -> dict[str, Any]:
    return {
        "name": protocol.name,
        "electrodes": protocol.num_electrodes,
        "drives": protocol.num_drives,
        "measurements": protocol.num_measurements,
        "largest_current": float(np.abs(np.asarray(protocol.drive)).max()),
        "largest_current_unit": "A",
    }


def _calibration_report(result: ImagedDifference) -> dict[str, Any]:
    """Report of the calibration, which fits the forward model to the reference frame."""
    calibration = result.calibration
    electrodes = calibration.model.electrodes
    return {
        "conductivity": np.asarray(calibration.conductivity).item(),
        "conductivity_unit": _conductivity_unit(result),
        "contact": result.settings.contact if calibration.shift is None else "each, with the electrode positions",
        "contact_impedance": None if electrodes.is_point else electrodes.contact_impedance,
        "contact_impedance_unit": "ohm·m" if result.mesh.dimension == 2 else "ohm·m²",
        "relative_misfit": float(calibration.misfit),
        "note": calibration.note or None,
        "iterations": calibration.iterations,
        "status": str(calibration.status),
        "reason": calibration.reason or None,
    }


def _inclusion_report(result: ImagedDifference, inclusion: Inclusion) -> dict[str, Any]:
    return {
        "sign": inclusion.sign,
        "kind": inclusion.kind,
        "centroid": list(inclusion.centroid),
        "centroid_unit": "m",
        **_size_report(inclusion),
        "peak": inclusion.peak,
        "peak_unit": _conductivity_unit(result),
        "peak_relative_to_background": inclusion.peak / float(np.real(result.calibration.conductivity)),
        **_interval_report(inclusion),
    }


def _interval_report(inclusion: Inclusion) -> dict[str, Any]:
    """Report of the radius of the 68 % region of a body's position, and of 68 % intervals of its properties. A limit
    that the data do not determine is None; the report is empty if no intervals were estimated."""
    if inclusion.contrast_interval is None:
        return {}
    return {
        "centroid_radius": inclusion.centroid_radius,
        "centroid_radius_unit": "m",
        "contrast_interval": inclusion.contrast_interval,
        "volume_interval" if inclusion.is_solid else "area_interval": inclusion.area_interval,
        "strength": inclusion.strength,
        "strength_interval": inclusion.strength_interval,
        "strength_unit": "m³" if inclusion.is_solid else "m²",
        "intervals_hold": "68 %",
    }


def _size_report(inclusion: Inclusion) -> dict[str, Any]:
    """Report of the size of an inclusion: its volume in a solid, its area in a sheet."""
    if inclusion.is_solid:
        return {"volume": inclusion.area, "volume_unit": "m³"}
    return {"area": inclusion.area, "area_unit": "m²"}


def _shapes_report(result: ImagedDifference) -> dict[str, Any] | None:
    """Report of fitted bodies with their outlines, and of bodies rejected as artefacts; None if no bodies were
    fitted."""
    if result.shapes is None:
        return None
    body_reports, rejected_body_reports = (
        [
            {
                "sign": body.sign,
                "centroid": body.centroid,
                **_form_report(body),
                "conductivity_over_background": math.exp(body.sign * body.contrast),
                "conductivity_is": _conductivity_origin_text(body),
                "rise": body.rise,
            }
            for body in bodies
        ]
        for bodies in (result.shapes.bodies, result.shapes.doubtful)
    )
    alternatives_with_deviations = zip(result.shapes.alternatives, result.shapes.alternative_deviations, strict=True)
    for body_report, (alternative_shape, deviation) in zip(body_reports, alternatives_with_deviations, strict=True):
        if alternative_shape is not None:
            conductivity_ratio = math.exp(alternative_shape.sign * alternative_shape.contrast)
            alternative_conductivity = {
                "conductivity_over_background": conductivity_ratio,
                "deviation_of_logarithm": deviation,
            }
            body_report["or"] = {
                "centroid": alternative_shape.centroid,
                **_form_report(alternative_shape),
                **alternative_conductivity,
            }
    return {
        "bodies": body_reports,
        "left_out": rejected_body_reports,
        "length_unit": "m",
        "rise": "how many times the objective rises if the body is left out",
        "misfit": float(result.shapes.misfit),
        "misfit_unit": "standard deviations",
        "drift_of_background": result.shapes.drift,
    }


def _form_report(body: Star | Ellipsoid) -> dict[str, Any]:
    """Report of the form of a body: area and outline of a star-shaped body, or volume, centre and half axes of an
    ellipsoid or a column."""
    if isinstance(body, Star):
        return {"area": body.area, "outline": body.outline}
    form_name = "column" if body.column else "ellipsoid"
    return {"form": form_name, "volume": body.volume, "centre": body.centre, "half_axes": body.axes}


def _conductivity_origin_text(body: Star | Ellipsoid) -> str:
    """Describe in words whether the conductivity of a body was estimated or assumed."""
    if not body.contrast_is_determined:
        return "assumed, as of what is strong"
    if isinstance(body, Ellipsoid) and body.alike:
        return "estimated from the data, as of one material with all others of its sign"
    return "estimated from the data"


def _prior_name(settings: ImagingSettings, dimension: int) -> str | None:
    """Name of the prior in the settings, or of the fixed prior of the method; None for methods without a prior."""
    imaging_method = METHODS[settings.method]
    if settings.method == "shapes" and dimension == 3:
        return "ellipsoids and columns"
    if not imaging_method.takes_prior:
        return imaging_method.prior
    return settings.prior if isinstance(settings.prior, str) else type(settings.prior).__name__


def _iteration_report(result: ImagedDifference) -> dict[str, Any]:
    """Report of the iteration; empty for images that were not computed iteratively."""
    reconstruction = result.reconstruction
    if not isinstance(reconstruction, Reconstruction):
        return {}
    return {
        "status": str(reconstruction.status),
        "reason": reconstruction.reason,
        "iterations": reconstruction.iterations,
        "misfit": float(reconstruction.misfit),
        "misfit_unit": "standard deviations",
        "objective_per_iteration": np.asarray(reconstruction.costs),
    }
