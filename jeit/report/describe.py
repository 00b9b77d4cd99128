"""Measurements, outlines, electrodes and numbers as JSON has them."""

import math
from importlib import metadata
from typing import Any

import numpy as np

from jeit.data import Measurement
from jeit.mesh import Disk, Domain, Polygon, Rectangle


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
    return plain({"kind": type(electrodes).__name__, "number": electrodes.num_electrodes, **known, "unit": "m"})


def version_of(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def plain(value: Any) -> Any:
    """Arrays as lists, and None for numbers that JSON does not know (NaN, infinity)."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
