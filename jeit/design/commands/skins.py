"""Command-line options that describe a flat skin, and reading of an electrode layout with the outline of its skin."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import check_within, naming_options

if TYPE_CHECKING:
    from jeit.layout import Layout

LayoutName = Annotated[
    str,
    typer.Argument(
        help="Layout by name (park-inner, park-boundary, grid-CxR, perimeter-N, inner-N), or a file: CSV in "
        "millimetres, DXF or SVG.",
        show_default=False,
    ),
]
Width = Annotated[float, typer.Option("--width-mm", help="Of the skin, centred at 0, if the layout does not say it.")]
Height = Annotated[float, typer.Option("--height-mm", help="Of the skin, centred at 0, if the layout does not say it.")]
Thickness = Annotated[float, typer.Option("--thickness-mm", help="Of the skin, millimetres.")]
Conductivity = Annotated[float, typer.Option("--conductivity", help="Of the skin, siemens per metre.")]
# Range of conductivities in S/m: from below deionised water to above silver.
_MIN_CONDUCTIVITY, _MAX_CONDUCTIVITY = 1e-9, 1e9


def read_with_outline(name: str, width: float, height: float) -> "Layout":
    """Read an electrode layout with the outline of its skin; `name`: name of a built-in layout, or path of a file. If
    the layout has no outline, the outline is a rectangle of `width` × `height` (mm).

    Raises `ValueError` for a layout with fewer than three electrodes.
    """
    from jeit.layout import named_layout, read_layout
    from jeit.layout.layout import LARGEST, SMALLEST
    from jeit.mesh import Rectangle

    def outline_from_options() -> Rectangle:
        for option, side in (("--width-mm", width), ("--height-mm", height)):
            check_within(option, side, 1e3 * SMALLEST, 1e3 * LARGEST, "mm")
        return Rectangle(1e-3 * width, 1e-3 * height)

    with naming_options({"name": "layout", "path": "layout"}):
        if not Path(name).suffix:
            layout = named_layout(name) if name.startswith("park-") else named_layout(name, outline_from_options())
        else:
            layout = read_layout(name)
            if layout.outline is None:
                layout = read_layout(name, outline=outline_from_options())
    if layout.num_electrodes < 3:
        raise ValueError(f"'{layout.name}' has {layout.num_electrodes} electrodes; give a layout of three or more.")
    return layout


def check_layer(thickness: float, conductivity: float) -> None:
    """Raise `ValueError` unless --thickness-mm is more than the depth of a touch, and --conductivity is from 1e-9 to
    1e9 S/m."""
    from jeit.design.defaults import DEPTH

    if not 1e3 * DEPTH < thickness < float("inf"):
        raise ValueError(
            f"--thickness-mm must be more than the {1e3 * DEPTH:g} mm that a touch is deep; it is {thickness:g}."
        )
    check_within("--conductivity", conductivity, _MIN_CONDUCTIVITY, _MAX_CONDUCTIVITY, "S/m")
