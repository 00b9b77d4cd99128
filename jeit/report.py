"""What is left of an imaged difference on disk: a picture, arrays, and a report."""

import json
import math
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from jeit.data import Measurement
from jeit.electrodes import contact_impedance
from jeit.imaging import ImagedDifference
from jeit.mesh import Disk, Domain, Polygon, Rectangle

_PACKAGES = ("jeit", "jax", "numpy", "scipy", "equinox", "lineax", "optimistix", "matplotlib")


def write(result: ImagedDifference, folder: str | Path, *, truth: tuple[float, float] | None = None) -> None:
    """Write `image.png`, `image.npz` and `report.json` into `folder`, made if need be.

    The NPZ holds `raster` (rows, columns), the change of conductivity (S; 3-D: S/m), NaN outside the body, row 0 at the
    top, column 0 at the left; `extent` (x_min, x_max, y_min, y_max) in metres; `conductivity` (m,), the same change per
    cell; `background`, the conductivity it is a change of; `points` (n, d) and `cells` (m, d + 1). `truth`: a known
    position (x, y) in metres, marked in the picture.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    draw(result, truth=truth).savefig(folder / "image.png", dpi=150)
    np.savez_compressed(
        folder / "image.npz",
        raster=np.asarray(result.raster),
        extent=np.asarray(result.extent),
        conductivity=np.asarray(result.change),
        background=np.asarray(result.calibration.conductivity),
        points=np.asarray(result.mesh.points),
        cells=np.asarray(result.mesh.cells),
    )
    text = json.dumps(report(result), indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "report.json").write_text(text + "\n", "utf-8")


def draw(result: ImagedDifference, *, truth: tuple[float, float] | None = None):
    """The picture of a result, as a matplotlib `Figure` that needs no display."""
    from matplotlib.figure import Figure

    from jeit.plot import plot_image

    figure = Figure(figsize=(6.4, 5.6), layout="constrained")
    ax = plot_image(
        result.mesh,
        result.change,
        result.calibration.model.electrodes,
        inclusions=result.inclusions,
        title=result.measurement.name,
        ax=figure.subplots(),
    )
    if truth is not None:
        ring = {"marker": "o", "markersize": 15, "markerfacecolor": "none", "markeredgewidth": 2, "linestyle": "none"}
        ax.plot(*truth, color="#157f3b", label="pressed here", **ring)
    if result.inclusions:
        ax.plot([], [], color="black", linewidth=1, linestyle=(0, (4, 3)), label="found: sign and area")
    if ax.get_legend_handles_labels()[1]:
        ax.legend(loc="upper left", bbox_to_anchor=(0, 0), frameon=False, borderaxespad=0)
    return figure


def report(result: ImagedDifference) -> dict[str, Any]:
    """All that was found and decided, as plain numbers, strings, lists and dictionaries; what is not known is None."""
    calibration, reconstruction, quality = result.calibration, result.reconstruction, result.quality
    electrodes, protocol = calibration.model.electrodes, result.measurement.protocol
    unit = "S" if result.mesh.dimension == 2 else "S/m"
    noise = quality.difference_noise
    settings = result.settings
    background = float(calibration.conductivity)
    content = {
        "data": describe_measurement(result.measurement),
        "reference": describe_measurement(result.reference),
        "geometry": {
            **describe_domain(result.measurement.domain or result.reference.domain),
            "electrodes": describe_electrodes(electrodes),
            "mesh": {"points": result.mesh.num_points, "cells": result.mesh.num_cells},
        },
        "protocol": {
            "name": protocol.name,
            "electrodes": protocol.num_electrodes,
            "drives": protocol.num_drives,
            "measurements": protocol.num_measurements,
            "largest_current": float(np.abs(np.asarray(protocol.drive)).max()),
            "largest_current_unit": "A",
        },
        "calibration": {
            "conductivity": background,
            "conductivity_unit": unit,
            "contact": settings.contact,
            "contact_impedance": None if electrodes.is_point else contact_impedance(electrodes),
            "contact_impedance_unit": "ohm·m" if result.mesh.dimension == 2 else "ohm·m²",
            "relative_misfit": float(calibration.misfit),
            "iterations": calibration.iterations,
            "status": calibration.status,
        },
        "noise": None
        if noise is None
        else {
            "standard_deviation": noise.standard_deviation,
            "unit": "V",
            "relative_to_difference": noise.relative,
            "method": noise.method,
        },
        "quality": {
            "relative_difference": quality.difference,
            "difference_reciprocity_error": quality.difference_reciprocity_error,
            "impossible_signs": quality.impossible_signs,
            "usable_channels": quality.usable_channels,
        },
        "reconstruction": {
            "quantity": f"change of conductivity against the reference, {unit}",
            "method": settings.method,
            "least_change_relative_to_background": result.lowest,
            "prior": _prior(settings.prior) if settings.method == "one-step" else None,
        },
        "hyperparameter": {
            "value": float(reconstruction.hyperparameter),
            "chosen_by": reconstruction.rule,
        },
        "inclusions": [
            {
                "sign": inclusion.sign,
                "kind": inclusion.kind,
                "centroid": list(inclusion.centroid),
                "centroid_unit": "m",
                "area": inclusion.area,
                "area_unit": "m²" if result.mesh.dimension == 2 else "m³",
                "peak": inclusion.peak,
                "peak_unit": unit,
                "peak_relative_to_background": inclusion.peak / background,
            }
            for inclusion in result.inclusions
        ],
        "inclusion_settings": {"level": settings.level, "least_peak": settings.least_peak},
        "timings": {**result.timings, "unit": "s"},
        "versions": {name: _version(name) for name in _PACKAGES},
    }
    return _plain(content)


def describe_measurement(measurement: Measurement) -> dict[str, Any]:
    """Name, source, channels and notes of a measurement."""
    mask = np.asarray(measurement.mask)
    return {
        "name": measurement.name,
        "source": measurement.source,
        "frame": measurement.frame_names[0] if len(measurement.frame_names) == 1 else None,
        "channels": measurement.num_channels,
        "masked": int((~mask).sum()),
        "notes": list(measurement.notes),
    }


def describe_domain(domain: Domain | None) -> dict[str, Any]:
    """Shape and size in metres of an outline."""
    if isinstance(domain, Disk):
        return {"shape": "disk", "radius": float(domain.radius), "centre": list(domain.centre), "unit": "m"}
    if isinstance(domain, Rectangle):
        size = {"width": float(domain.width), "height": float(domain.height)}
        return {"shape": "rectangle", **size, "centre": list(domain.centre), "unit": "m"}
    if isinstance(domain, Polygon):
        return {"shape": "polygon", "vertices": np.asarray(domain.vertices).tolist(), "unit": "m"}
    return {"shape": "not known"}


def describe_electrodes(electrodes) -> dict[str, Any]:
    """Kind, number, place and size in metres of electrodes."""
    if electrodes is None:
        return {"kind": "at places not known"}
    known = {
        name: getattr(electrodes, name)
        for name in ("position", "width", "height", "radius")
        if hasattr(electrodes, name)
    }
    return _plain({"kind": type(electrodes).__name__, "number": electrodes.num_electrodes, **known, "unit": "m"})


def _prior(prior) -> str:
    return prior if isinstance(prior, str) else type(prior).__name__


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _plain(value: Any) -> Any:
    """Arrays as lists, and None for numbers that JSON does not know (NaN, infinity)."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return _plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
