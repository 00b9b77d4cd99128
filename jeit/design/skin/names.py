"""Creation of the electrode layouts and measurement protocols that skin files and study files specify by name, for flat
and curved skins."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_name, describe
from jeit.design.defaults import CONTACT_IMPEDANCE, CURRENT, NUM_PAIRS, PROTOCOL
from jeit.design.measurements import nearest_pairs
from jeit.layout import Layout, SurfaceLayout, named_layout, read_layout, read_surface_layout
from jeit.layout.names import DIAMETER, same_outline
from jeit.layout.surface_layout import check_layout
from jeit.mesh import Mesh, Rectangle
from jeit.protocol import Protocol, adjacent, opposite, two_terminal

ProtocolName = Literal["adjacent", "opposite", "two-terminal"]
PROTOCOLS: tuple[ProtocolName, ...] = ("adjacent", "opposite", "two-terminal")


def curved_layout(
    name: str,
    folder: Path,
    surface: Mesh,
    outward: bool,
    diameter: float,
    contact_impedance: float,
    minimum_gap: float,
) -> SurfaceLayout:
    """Create or read the layout `name` of a curved skin: "inner-N" for N electrodes spread evenly over `surface`, or a
    `.csv` file with positions in space. Other arguments as in `study_layout`.

    Gaps between electrodes are measured along the surface. Raises `ValueError` for an unknown name, electrodes that
    overlap or are not on the surface, and gaps below `minimum_gap`.
    """
    try:
        layout = _create_curved_layout(name, folder, surface, outward, diameter)
    except (ValueError, OSError) as error:
        raise ValueError(f"electrodes.layouts: {describe(name)}: {error}") from None
    if minimum_gap > 0:
        check_spacing(layout, layout.lengths(), minimum_gap)
    if not math.isnan(contact_impedance):
        contact_impedances = contact_impedance
    else:
        contact_impedances = CONTACT_IMPEDANCE if layout.contact_impedance is None else layout.contact_impedance
    electrode_diameters = layout.diameters if math.isnan(diameter) else diameter
    return SurfaceLayout(
        layout.centres,
        electrode_diameters,
        surface,
        contact_impedance=contact_impedances,
        outward=outward,
        labels=layout.labels,
        name=name,
    )


def _create_curved_layout(
    layout_name: str, layout_folder: Path, surface: Mesh, is_outward: bool, electrode_diameter: float
) -> SurfaceLayout:
    if is_layout_file(layout_name):
        return read_surface_layout(layout_folder / layout_name, surface, outward=is_outward)
    name_match = re.fullmatch(r"inner-(\d{1,4})", layout_name)
    if name_match is None:
        raise ValueError("a curved skin has inner-N, spread evenly along it, or a .csv file with x_mm, y_mm and z_mm.")
    num_electrodes = int(name_match[1])
    check_num_electrodes(num_electrodes)
    electrode_diameters = DIAMETER if math.isnan(electrode_diameter) else electrode_diameter
    return SurfaceLayout.spread(
        surface, num_electrodes, np.full(num_electrodes, electrode_diameters), outward=is_outward, name=layout_name
    )


_LAYOUT_FILE_SUFFIXES = (".csv", ".dxf", ".svg")


def study_layout(
    name: str, folder: Path, outline: Rectangle, diameter: float, contact_impedance: float, minimum_gap: float
) -> Layout:
    """Create or read the layout `name` of a skin with this `outline`. Paths of files are relative to `folder`; units
    are metres and ohm·m².

    If `diameter` or `contact_impedance` is NaN, the value in the layout's file is used, or 6 mm and 1e-4 ohm·m² if the
    file has none. Raises `ValueError` for an unknown name, electrodes that overlap or extend beyond the skin, and gaps
    below `minimum_gap`.
    """
    try:
        layout = _create_flat_layout(name, folder, outline, diameter)
    except (ValueError, OSError) as error:
        raise ValueError(f"electrodes.layouts: {describe(name)}: {str(error).removeprefix('name: ')}") from None
    electrode_centres = np.asarray(layout.centres)
    check_spacing(layout, np.linalg.norm(electrode_centres[:, None] - electrode_centres, axis=-1), minimum_gap)
    if not math.isnan(contact_impedance):
        contact_impedances = contact_impedance
    else:
        contact_impedances = CONTACT_IMPEDANCE if layout.contact_impedance is None else layout.contact_impedance
    return Layout(layout.centres, layout.diameters, contact_impedance=contact_impedances, outline=outline, name=name)


def is_layout_file(name: str) -> bool:
    """Whether the `name` of a layout is the name of a file."""
    return Path(name).suffix.lower() in _LAYOUT_FILE_SUFFIXES


def _create_flat_layout(layout_name: str, layout_folder: Path, outline: Rectangle, electrode_diameter: float) -> Layout:
    if not is_layout_file(layout_name):
        layout = named_layout(
            layout_name, outline, diameter=DIAMETER if math.isnan(electrode_diameter) else electrode_diameter
        )
        check_num_electrodes(layout.num_electrodes)
        return layout
    layout = read_layout(layout_folder / layout_name, outline=outline)
    if not same_outline(layout.outline, outline):
        low_x, high_x, low_y, high_y = layout.extent
        raise ValueError(
            f"its skin spans {1e3 * low_x:g} to {1e3 * high_x:g} mm by {1e3 * low_y:g} to {1e3 * high_y:g} mm, and the "
            f"study's is a rectangle of {1e3 * outline.width:g} × {1e3 * outline.height:g} mm about the origin; change "
            "skin.width_mm and skin.height_mm, or the layout."
        )
    electrode_diameters = layout.diameters if math.isnan(electrode_diameter) else electrode_diameter
    return Layout(
        layout.centres,
        electrode_diameters,
        contact_impedance=layout.contact_impedance,
        outline=outline,
        name=layout_name,
    )


def check_num_electrodes(number: int) -> None:
    """Raise `ValueError` unless the `number` of electrodes is allowed in a study."""
    if not 4 <= number <= 1024:
        raise ValueError(f"it has {number} electrodes; give 4 to 1024.")


def check_spacing(layout: Layout | SurfaceLayout, lengths: Float[np.ndarray, "L L"], minimum_gap: float) -> None:
    """Raise `ValueError` for gaps between electrodes below `minimum_gap`; `lengths`: distances (L, L) of their centres,
    metres."""
    electrode_radii = np.asarray(layout.diameters) / 2
    electrode_gaps = lengths - electrode_radii[:, None] - electrode_radii
    np.fill_diagonal(electrode_gaps, np.inf)
    if electrode_gaps.min() < minimum_gap - 1e-9:
        raise ValueError(
            f"electrodes.minimum_gap_mm is {1e3 * minimum_gap:g}, and electrodes of {layout.name!r} are "
            f"{1e3 * electrode_gaps.min():.3g} mm apart: an impossible spacing; ask for less, or for fewer or smaller "
            "electrodes."
        )


def skin_protocol(
    layout: Layout | SurfaceLayout,
    name: ProtocolName = PROTOCOL,
    *,
    num_pairs: int | None = None,
    current: float = CURRENT,
) -> Protocol:
    """Create the measurement protocol of a skin with electrodes of `layout`.

    - `name`: name of the protocol; `current`: injected current, amperes.
    - `num_pairs`: for "two-terminal" only: number of pairs of nearest electrodes that are measured, 0 for all pairs. On
      a curved skin, distances are along the surface. The default is 94 pairs, as in Park et al. 2022, or all pairs if
      fewer.

    Raises `ValueError` for an unknown name, for more pairs than exist, for `num_pairs` with a protocol other than
    "two-terminal", and in the cases of `two_terminal`, `adjacent` and `opposite`.
    """
    check_layout("layout", layout)
    check_name("protocol", name, PROTOCOLS)
    if name != "two-terminal":
        if num_pairs:
            raise ValueError(f"num_pairs is {num_pairs}, and only 'two-terminal' has pairs, not {name!r}.")
        return {"adjacent": adjacent, "opposite": opposite}[name](layout.num_electrodes, current=current)
    checked_num_pairs = number_of_pairs(layout, num_pairs)
    electrode_pairs = np.column_stack(np.triu_indices(layout.num_electrodes, 1))
    if checked_num_pairs < len(electrode_pairs):
        electrode_pairs = electrode_pairs[
            np.sort(nearest_pairs(layout.centres, checked_num_pairs, lengths=layout.lengths()))
        ]
    return two_terminal(layout.num_electrodes, electrode_pairs, current=current)


def number_of_pairs(layout: Layout | SurfaceLayout, num_pairs: int | None) -> int:
    """Number of measured pairs of electrodes, as in `skin_protocol`. Raises `ValueError` for more pairs than exist."""
    num_all_pairs = layout.num_electrodes * (layout.num_electrodes - 1) // 2
    if num_pairs is None:
        return min(NUM_PAIRS, num_all_pairs)
    if not 0 <= num_pairs <= num_all_pairs:
        raise ValueError(
            f"num_pairs is {num_pairs}; '{layout.name}' has {layout.num_electrodes} electrodes, and they make "
            f"{num_all_pairs} pairs; give so many or fewer."
        )
    return num_pairs or num_all_pairs
