"""`jeit info`: what a file holds, and how good it is."""

from pathlib import Path
from typing import Annotated

import typer

from jeit.cli.options import Description, Format


def info(
    data: Annotated[Path, typer.Argument(help="Measured file.", show_default=False)],
    format: Format = None,
    description: Description = None,
) -> None:
    """Say what DATA holds: frames, electrodes, protocol, noise, and what was assumed or masked."""
    import numpy as np
    from rich.console import Console

    from jeit.cli.console import pairs, percent, scaled
    from jeit.data import estimate_noise, impossible_signs, read, reciprocity_error
    from jeit.report.describe import describe_domain, describe_electrodes

    measurement = read(data, format, description)
    protocol, mask = measurement.protocol, np.asarray(measurement.mask)
    voltages = np.abs(np.asarray(measurement.filled()))
    noise, signs = estimate_noise(measurement), impossible_signs(measurement)
    names = f" ({', '.join(measurement.frame_names)})" if measurement.frame_names else ""
    shape = describe_domain(measurement.domain)
    electrodes = describe_electrodes(measurement.electrodes)
    size = ", ".join(
        f"{key.replace('_', ' ')} {1e3 * shape[key]:g} mm" for key in ("radius", "width", "height") if key in shape
    )
    rows = [
        ("frames", f"{measurement.num_frames}{names}"),
        ("protocol", protocol.name),
        ("channels", f"{measurement.num_channels}, of {protocol.num_drives} drives"),
        ("masked", f"{int((~mask).sum())} of {mask.size} voltages"),
        ("largest current", scaled(float(np.abs(np.asarray(protocol.drive)).max()), "A")),
        ("largest voltage", scaled(float(voltages.max()), "V")),
        ("body", f"{shape['shape']}, {size}" if size else shape["shape"]),
        ("electrodes", f"{protocol.num_electrodes}, {electrodes['kind']}"),
        ("reciprocity error", percent(reciprocity_error(measurement))),
        ("noise", "not known" if noise is None else f"{scaled(noise.standard_deviation, 'V')}, from {noise.method}"),
        ("impossible signs", percent(None if signs is None else float(signs.max()))),
    ]
    rows += [("note", note) for note in measurement.notes]
    Console(highlight=False).print(pairs(measurement.name, rows))
