"""The layouts that a study file names: built in, generated for its skin, or read from files."""

import difflib
import math
import re
from functools import lru_cache
from pathlib import Path

import numpy as np

from jeit.layout import Layout, grid, named_layout, perimeter, quasi_uniform, read_layout
from jeit.mesh import Rectangle

_DIAMETER, _CONTACT_IMPEDANCE = 6e-3, 1e-3  # m, ohm·m²: where neither study nor file says
_FROM_EDGE = 2e-3  # m of skin outside electrodes around the edge, as in "park-boundary"
_BUILT_IN = ("park-inner", "park-boundary")
_SUFFIXES = (".csv", ".dxf", ".svg")
_KNOWN = (*_BUILT_IN, "grid-CxR", "perimeter-N", "inner-N", "FILE.csv", "FILE.dxf", "FILE.svg")


def study_layout(
    name: str, folder: Path, skin: Rectangle, diameter: float, contact_impedance: float, minimum_gap: float
) -> Layout:
    """The layout called `name` on a `skin`, with files relative to `folder`; lengths in metres, ohm·m².

    Diameter and contact impedance are the file's own, or 6 mm and 1e-3 ohm·m², where they are NaN. Raises
    `ValueError` for an unknown name, electrodes that overlap or leave the skin, and gaps below `minimum_gap`.
    """
    try:
        layout = _make(name, folder, skin, diameter)
    except (ValueError, OSError) as error:
        raise ValueError(f"electrodes.layouts: {name!r}: {error}") from None
    _check_gap(layout, minimum_gap)
    if not math.isnan(contact_impedance):
        impedance = contact_impedance
    else:
        impedance = _CONTACT_IMPEDANCE if layout.contact_impedance is None else layout.contact_impedance
    return Layout(layout.centres, layout.diameters, contact_impedance=impedance, outline=skin, name=name)


def is_file(name: str) -> bool:
    """Whether a study reads this layout, rather than knows how to make it."""
    return Path(name).suffix.lower() in _SUFFIXES


def _make(name: str, folder: Path, skin: Rectangle, diameter: float) -> Layout:
    if is_file(name):
        layout = read_layout(folder / name, outline=skin)
        _check_outline(layout, skin)
        size = layout.diameters if math.isnan(diameter) else diameter
        return Layout(layout.centres, size, contact_impedance=layout.contact_impedance, outline=skin, name=name)
    size = _DIAMETER if math.isnan(diameter) else diameter
    return Layout(_centres(name, skin, size), size, outline=skin, name=name)


@lru_cache(maxsize=256)
def _centres(name: str, skin: Rectangle, diameter: float) -> np.ndarray:
    if name in _BUILT_IN:
        layout = _built_in(name)
        _check_outline(layout, skin)
        return np.asarray(layout.centres)
    if match := re.fullmatch(r"grid-(\d{1,3})x(\d{1,3})", name):
        columns, rows = (int(count) for count in match.groups())
        _check_count(columns * rows)
        return grid(skin.width * (1 - 1 / columns), skin.height * (1 - 1 / rows), columns, rows)
    if match := re.fullmatch(r"perimeter-(\d{1,4})", name):
        number = int(match[1])
        _check_count(number)
        inset = diameter + 2 * _FROM_EDGE
        if inset >= min(skin.width, skin.height):
            raise ValueError(f"electrodes {1e3 * diameter:g} mm across do not fit around the edge; make them smaller.")
        track = Rectangle(skin.width - inset, skin.height - inset)
        return perimeter(track, number, start=track.perimeter / number / 2)
    if match := re.fullmatch(r"inner-(\d{1,4})", name):
        _check_count(int(match[1]))
        return quasi_uniform(skin, int(match[1]), margin=diameter / 2)
    close = difflib.get_close_matches(name, _KNOWN, n=1)
    meant = f" (did you mean {close[0]!r}?)" if close else ""
    raise ValueError(f"there is no such layout{meant}; take {', '.join(_KNOWN)}.")


_built_in = lru_cache(named_layout)


def _check_count(number: int) -> None:
    if not 4 <= number <= 1024:
        raise ValueError(f"it has {number} electrodes; give 4 to 1024.")


def _check_outline(layout: Layout, skin: Rectangle) -> None:
    own = layout.outline
    # Lengths come as decimal millimetres.
    same = (
        own is not None
        and np.allclose(own.extent, skin.extent, atol=1e-6)
        and math.isclose(skin.area, own.area, rel_tol=1e-3)
    )
    if not same:
        low_x, high_x, low_y, high_y = layout.extent
        raise ValueError(
            f"its skin spans {1e3 * low_x:g} to {1e3 * high_x:g} mm by {1e3 * low_y:g} to {1e3 * high_y:g} mm, and the "
            f"study's is a rectangle of {1e3 * skin.width:g} × {1e3 * skin.height:g} mm about the origin; change "
            "skin.width_mm and skin.height_mm, or the layout."
        )


def _check_gap(layout: Layout, least: float) -> None:
    centres, radii = np.asarray(layout.centres), np.asarray(layout.diameters) / 2
    gap = np.linalg.norm(centres[:, None] - centres, axis=-1) - radii[:, None] - radii
    np.fill_diagonal(gap, np.inf)
    if gap.min() < least - 1e-9:
        raise ValueError(
            f"electrodes.minimum_gap_mm is {1e3 * least:g}, and electrodes of {layout.name!r} are "
            f"{1e3 * gap.min():.3g} mm apart: an impossible spacing; ask for less, or for fewer or smaller electrodes."
        )
