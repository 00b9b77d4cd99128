"""Flat skins on the command line: the options that describe them, and a layout of electrodes with its skin."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jeit.cli.options import check_within

if TYPE_CHECKING:
    from jeit.layout import Layout
    from jeit.mesh import Domain

LayoutName = Annotated[
    str,
    typer.Argument(
        help="Built-in layout (park-inner, park-boundary, grid-CxR), or a file: CSV in millimetres, DXF or SVG.",
        show_default=False,
    ),
]
Width = Annotated[float, typer.Option("--width-mm", help="Of the skin, centred at 0, if a file does not say it.")]
Height = Annotated[float, typer.Option("--height-mm", help="Of the skin, centred at 0, if a file does not say it.")]
Thickness = Annotated[float, typer.Option("--thickness-mm", help="Of the skin, millimetres.")]
Conductivity = Annotated[float, typer.Option("--conductivity", help="Of the skin, siemens per metre.")]
# Of conductivities in S/m: deionised water and silver, with room to spare.
_LEAST_CONDUCTIVITY, _MOST_CONDUCTIVITY = 1e-9, 1e9


def read(name: str, width: float, height: float) -> "tuple[Layout, Domain]":
    """A layout, by name or from a file, and its skin's outline: width × height (mm) where a file does not say it.

    Raises `ValueError` for fewer than three electrodes.
    """
    from jeit.layout import named_layout, read_layout
    from jeit.layout.layout import LARGEST, SMALLEST
    from jeit.mesh import Rectangle

    found = read_layout(name) if Path(name).suffix else named_layout(name)
    if found.outline is None:
        for option, side in (("--width-mm", width), ("--height-mm", height)):
            check_within(option, side, 1e3 * SMALLEST, 1e3 * LARGEST, "mm")
        found = read_layout(name, outline=Rectangle(1e-3 * width, 1e-3 * height))
    if found.num_electrodes < 3:
        raise ValueError(f"'{found.name}' has {found.num_electrodes} electrodes; give a layout of three or more.")
    return found, _plain(found.known_outline)


def check_layer(thickness: float, conductivity: float) -> None:
    """Raise `ValueError` unless --thickness-mm is more than a touch is deep and --conductivity one that a skin has."""
    from jeit.design import Bell

    deepest = 1e3 * Bell().depth
    if not deepest < thickness < float("inf"):
        raise ValueError(
            f"--thickness-mm must be more than the {deepest:g} mm that a touch is deep; it is {thickness:g}."
        )
    check_within("--conductivity", conductivity, _LEAST_CONDUCTIVITY, _MOST_CONDUCTIVITY, "S/m")


def _plain(outline: "Domain") -> "Domain":
    """A drawing's four corners are a rectangle if they are one: it is then meshed as one."""
    from jeit.mesh import Disk, Rectangle

    if isinstance(outline, Disk | Rectangle) or getattr(outline, "holes", ()) or len(outline.vertices) != 4:
        return outline
    low_x, high_x, low_y, high_y = outline.extent
    width, height = high_x - low_x, high_y - low_y
    if abs(width * height - outline.area) > 1e-6 * width * height:
        return outline
    return Rectangle(width, height, ((low_x + high_x) / 2, (low_y + high_y) / 2))
