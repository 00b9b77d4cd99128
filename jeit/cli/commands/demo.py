"""`jeit demo`: simulate a press on a skin and image it; needs no data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.options import QuietOption, check_seed, make_folder, naming_options_in_errors

# Radius of the area that is pressed, metres.
_CONTACT_RADIUS = 0.008


def demo(
    x: Annotated[float, typer.Option(help="Where to press, metres from the middle.")] = 0.02,
    y: Annotated[float, typer.Option(help="Where to press, metres from the middle.")] = 0.012,
    noise: Annotated[float, typer.Option(help="Noise, relative to the voltages.")] = 1e-4,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 0,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the picture and the report.")] = Path(
        "jeit-demo"
    ),
    quiet: QuietOption = False,
) -> None:
    """Simulate a press on a skin (diameter 100 mm, 16 electrodes), image it, and compare image and truth. Needs no
    data."""
    import jax
    import numpy as np

    from jeit.cli.console import Steps, name_value_table, plain_console, print_written_files
    from jeit.data.round_skin import RoundSkin, simulate_press
    from jeit.imaging import image_difference
    from jeit.report import write_image

    check_seed(seed)
    make_folder(output)
    console = plain_console()
    skin = RoundSkin()
    with Steps(console, quiet=quiet) as step:
        step("simulate a press")
        with naming_options_in_errors({"position": "--x and --y"}):
            pressed, reference = simulate_press(skin, jax.random.key(seed), (x, y), radius=_CONTACT_RADIUS, noise=noise)
        result = image_difference(pressed, reference, progress=step)
        step("write")
        write_image(result, output, truth=(x, y, _CONTACT_RADIUS))
    if not result.inclusions:
        raise ValueError("the press was not found in the image; try less --noise.")
    if quiet:
        return
    centroid = result.inclusions[0].centroid
    error = float(np.hypot(centroid[0] - x, centroid[1] - y))
    rows = [
        ("pressed at", f"({1e3 * x:6.1f}, {1e3 * y:6.1f}) mm"),
        ("found at", f"({1e3 * centroid[0]:6.1f}, {1e3 * centroid[1]:6.1f}) mm"),
        ("error", f"{1e3 * error:.1f} mm, {100 * error / (2 * skin.radius):.1f} % of the diameter"),
    ]
    console.print()
    console.print(name_value_table("A simulated press", rows))
    console.print()
    print_written_files(console, output / "image.png", "image.npz", "report.json")
