"""`jeit view`: view a saved image in an interactive window, or write pictures of it from several sides."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.options import QuietOption, make_folder, naming_options_in_errors


def view(
    image: Annotated[Path, typer.Argument(help="An image.npz, as jeit reconstruct writes it.", show_default=False)],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for pictures; without it a window opens where one can."),
    ] = None,
    level: Annotated[
        list[float] | None,
        typer.Option(help="Isosurface at this share of the strongest change (default 0.5); may be given again."),
    ] = None,
    azimuth: Annotated[float, typer.Option(help="Degrees from the x axis towards y, where one looks from.")] = -60.0,
    elevation: Annotated[float, typer.Option(help="Degrees above the horizontal.")] = 25.0,
    plane_mm: Annotated[
        list[str] | None,
        typer.Option(
            "--plane-mm",
            help="A slice of its own: z=20, or a point and the direction looked from, 0,0,85/1,1,0; again for more.",
            metavar="AXIS=MM|X,Y,Z/NX,NY,NZ",
        ),
    ] = None,
    axis: Annotated[str, typer.Option(help="Axis that the grid of slices is across: x, y or z.")] = "z",
    slices: Annotated[int, typer.Option(help="Slices in the grid.")] = 9,
    quiet: QuietOption = False,
) -> None:
    """View IMAGE in a window if PyVista and a display are available, else write pictures to a folder 'view' beside it.

    Pictures of a solid are overview.png, isosurfaces.png from four sides, slices.png, and planes.png of slices that you
    choose; of a curved skin surface.png; of a sheet image.png.

    In Python: `jeit.report.read_image` and `jeit.report.write_views`; `jeit.plot.view_solid` opens the window.
    """
    from jeit.cli.console import plain_console, print_written_files
    from jeit.plot.solid import interactive
    from jeit.plot.solid.scene import Camera
    from jeit.report import read_image, write_views
    from jeit.report.saved_image import VIEW_FILES, drawn_values

    camera, levels = Camera(azimuth, elevation), tuple(level or (0.5,))
    planes = [_parse_plane(text) for text in plane_mm or ()]
    console, saved_image = plain_console(), read_image(image)
    if output is None and saved_image.mesh.dimension == 3 and not planes:
        if not (unavailable_reason := interactive.can_view()):
            cell_values, colour_scale = drawn_values(saved_image)
            plot_options = {"inclusions": saved_image.inclusions, "levels": levels, "scale": colour_scale}
            interactive.view_solid(saved_image.mesh, cell_values, saved_image.electrodes, **plot_options).show()
            return
        if not quiet:
            console.print(f"  pictures, not a window: {unavailable_reason}", highlight=False, markup=False)
    folder = image.parent / "view" if output is None else output
    make_folder(folder, VIEW_FILES)
    with naming_options_in_errors({"levels": "--level", "at": "--slices", "plane": "--plane-mm"}):
        picture_names = write_views(
            saved_image, folder, camera=camera, levels=levels, planes=planes, axis=axis, slices=slices
        )
    if not quiet:
        print_written_files(console, folder / picture_names[0], *picture_names[1:])


def _parse_plane(text: str):
    """Parse a plane that slices a solid, with coordinates in millimetres. Raises `ValueError` for an invalid text."""
    from jeit.arguments import describe
    from jeit.image import Plane

    try:
        if "=" in text:
            axis, _, position_text = text.partition("=")
            return Plane.at(axis.strip(), float(position_text) / 1e3)
        point, normal = ([float(number) for number in vector.split(",")] for vector in text.split("/"))
        return Plane.through([coordinate / 1e3 for coordinate in point], normal)
    except ValueError:
        raise ValueError(
            f"--plane-mm must be such as z=20, or a point and a direction, 0,0,85/1,1,0, in millimetres; it is "
            f"{describe(text)}."
        ) from None
