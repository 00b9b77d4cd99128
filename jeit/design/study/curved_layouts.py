"""Layouts named in a study of curved skins: spread over the surface, or read from tables."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from jeit.arguments import describe
from jeit.design.defaults import CONTACT_IMPEDANCE
from jeit.design.study.layouts import check_number, check_spacing, is_file
from jeit.layout import SurfaceLayout, read_surface_layout
from jeit.layout.names import DIAMETER
from jeit.mesh import Mesh


def curved_layout(
    name: str,
    folder: Path,
    surface: Mesh,
    outward: bool,
    diameter: float,
    contact_impedance: float,
    minimum_gap: float,
) -> SurfaceLayout:
    """`study_layout` of a curved skin: "inner-N", spread evenly along `surface`, or a `.csv` file with places in space.

    Gaps are along the surface. Raises `ValueError` for an unknown name, electrodes that overlap or are off the
    surface, and gaps below `minimum_gap`.
    """
    try:
        layout = _make(name, folder, surface, outward, diameter)
    except (ValueError, OSError) as error:
        raise ValueError(f"electrodes.layouts: {describe(name)}: {error}") from None
    if minimum_gap > 0:
        check_spacing(layout, layout.lengths(), minimum_gap)
    if not math.isnan(contact_impedance):
        impedance = contact_impedance
    else:
        impedance = CONTACT_IMPEDANCE if layout.contact_impedance is None else layout.contact_impedance
    size = layout.diameters if math.isnan(diameter) else diameter
    return SurfaceLayout(
        layout.centres, size, surface, contact_impedance=impedance, outward=outward, labels=layout.labels, name=name
    )


def _make(name: str, folder: Path, surface: Mesh, outward: bool, diameter: float) -> SurfaceLayout:
    if is_file(name):
        return read_surface_layout(folder / name, surface, outward=outward)
    made = re.fullmatch(r"inner-(\d{1,4})", name)
    if made is None:
        raise ValueError("a curved skin has inner-N, spread evenly along it, or a .csv file with x_mm, y_mm and z_mm.")
    number = int(made[1])
    check_number(number)
    size = DIAMETER if math.isnan(diameter) else diameter
    return SurfaceLayout.spread(surface, number, np.full(number, size), outward=outward, name=name)
