"""Measurements, outlines, electrodes and numbers as JSON has them."""

from __future__ import annotations

import math
from importlib import metadata
from typing import Any

import numpy as np

from jeit.data import Measurement
from jeit.electrodes import AbstractElectrodes
from jeit.mesh import Body


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


def describe_domain(domain: Body | None) -> dict[str, Any]:
    """Shape and size in metres of a body."""
    return {"shape": "not known"} if domain is None else {**domain.describe(), "unit": "m"}


def describe_electrodes(electrodes: AbstractElectrodes | None) -> dict[str, Any]:
    """Kind, number, place and size in metres of electrodes."""
    if electrodes is None:
        return {"kind": "at places not known"}
    return plain(electrodes.describe())


def version_of(package: str) -> str | None:
    """The version of an installed package; None if it is not."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def plain(value: Any) -> Any:
    """Arrays as lists, complex numbers by their parts, and None for numbers that JSON does not know (NaN,
    infinity)."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return plain(np.asarray(value).tolist())
    if isinstance(value, complex):
        return {"real": plain(value.real), "imaginary": plain(value.imag)}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
