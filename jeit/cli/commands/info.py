"""`jeit info`: the content and quality of a data file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from jeit.cli.options import Description, Format, Key, read_file

# Solids with a given outline: their name, and the words of a description for their sizes if they differ.
_SOLIDS = {
    "rectangle": ("box", {"height": "depth", "thickness": "height"}),
    "disk": ("cylinder", {"thickness": "height"}),
}


def info(
    data: Annotated[Path, typer.Argument(help="Measured file.", show_default=False)],
    key: Key = None,
    format: Format = None,
    description: Description = None,
) -> None:
    """Say what DATA holds: frames, electrodes, protocol, noise, and what was assumed or masked."""
    from jeit.arguments import counted, percent
    from jeit.cli.console import pairs, plain_console, scaled
    from jeit.data.imageable import MOST_IMPOSSIBLE_SIGNS
    from jeit.report import report_measurement

    measurement = read_file("DATA", data, format, description, key=key)
    found = report_measurement(measurement)
    body, noise = found["body"], found["noise"]
    names = f" ({', '.join(found['frame_names'])})" if found["frame_names"] else ""
    rate = f", {found['frame_rate']:.4g} a second" if found["frame_rate"] else ""
    known = noise and f"{scaled(noise['standard_deviation'], 'V')}, from {noise['method']}"
    rows = [
        ("frames", f"{found['frames']}{names}{rate}"),
        ("protocol", found["protocol"]),
        ("channels", f"{found['channels']}, of {counted(found['drives'], 'drive')}"),
        ("masked", f"{found['masked']} of {found['voltages']} voltages"),
        ("largest current", scaled(found["largest_current"], "A")),
        ("largest voltage", scaled(found["largest_voltage"], "V")),
        ("body", _body_text(body)),
        ("electrodes", f"{found['electrodes']['number']}, {found['electrodes']['kind']}"),
        ("reciprocity error", percent(found["reciprocity_error"])),
        ("noise", known or "not known"),
        ("impossible signs", percent(found["impossible_signs"])),
    ]
    if (found["impossible_signs"] or 0) > MOST_IMPOSSIBLE_SIGNS:
        rows.append(("doubt", "so many impossible signs are those of noise: frames with them are not imaged"))
    rows.append(("wiring", found["wiring"] or "not known: the file does not say where electrodes are"))
    rows += [("note", note) for note in found["notes"]]
    plain_console().print(pairs(measurement.name, rows))


def _body_text(body: dict[str, Any]) -> str:
    """Shape and size of a body, in the words of a description."""
    from jeit.arguments import counted

    if body["shape"] == "mesh":
        return f"mesh, {body['dimension']}-D, {counted(body['points'], 'node')}"
    names = {key: key for key in ("radius", "width", "height", "thickness")}
    shape = body["shape"]
    if "thickness" in body and shape in _SOLIDS:
        shape, renamed = _SOLIDS[shape]
        names |= renamed
    return ", ".join([shape, *(f"{name} {1e3 * body[key]:g} mm" for key, name in names.items() if key in body)])
