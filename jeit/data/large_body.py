"""Described bodies that are large for lengths in metres: told of once, by the keys of the description."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np

from jeit.mesh import Body, OwnMesh
from jeit.mesh.sizes import LARGE

if TYPE_CHECKING:
    from jeit.data.description_tables import GeometryTable

_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
# How many times a key's length the body is large.
_ACROSS = {"radius": 2.0, "width": 1.0, "depth": 1.0, "height": 1.0, "thickness": 1.0}


def warn_large_body(table: GeometryTable, body: Body, origin: str) -> None:
    """Warn, in one sentence, of lengths in `[geometry]` of the file `origin` that look like those of another unit."""
    from jeit.data.description_tables import PolygonTable  # it was imported when the table was read

    lengths = {key: float(getattr(table, key, None) or 0) for key in _ACROSS}
    large = {key: length for key, length in lengths.items() if _ACROSS[key] * length > LARGE}
    if isinstance(body, OwnMesh):
        place, size = "mesh", _extent(body.given.points)
        give = {unit: f"scale = {factor * getattr(table, 'scale', 1.0):g}" for unit, factor in _UNITS.items()}
    elif isinstance(table, PolygonTable) and not large:
        place, size = "vertices", _extent(table.vertices)
        give = {unit: f"{factor:g} times those" for unit, factor in _UNITS.items()}
    else:
        place, size = ", geometry.".join(large), max((_ACROSS[key] * large[key] for key in large), default=0.0)
        give = {
            unit: " and ".join(f"{factor * length:g}" for length in large.values()) for unit, factor in _UNITS.items()
        }
    if not size > LARGE:
        return
    said = " and ".join(f"{length:g} m" for length in large.values()) or f"{size:.3g} m"
    warnings.warn(
        f"{origin}: geometry.{place}: {said} {'are' if len(large) > 1 else 'is'} large for what electrodes are put on. "
        f"If the lengths are millimetres, give {give['millimetres']}, if centimetres, {give['centimetres']}, if "
        f"inches, {give['inches']}, and so all other lengths: jeit computes in metres.",
        UserWarning,
        stacklevel=5,
    )


def _extent(points) -> float:
    return float(np.ptp(np.asarray(points), axis=0).max())
