"""`jeit info`: the content and quality of a data file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from jeit.cli.options import DescriptionOption, FormatOption, KeyOption, read_file

# For each outline, the name of the upright solid with this outline as its base, and the keys of the solid's sizes in a
# description if they differ from those of the outline.
_SOLID_NAMES_AND_SIZE_KEYS = {
    "rectangle": ("box", {"height": "depth", "thickness": "height"}),
    "disk": ("cylinder", {"thickness": "height"}),
}


def info(
    data: Annotated[Path, typer.Argument(help="Measured file.", show_default=False)],
    key: KeyOption = None,
    format: FormatOption = None,
    description: DescriptionOption = None,
) -> None:
    """Print what DATA contains: frames, electrodes, protocol, noise, assumptions, and masked voltages."""
    from jeit.arguments import counted, percent
    from jeit.cli.console import format_with_unit, name_value_table, plain_console, smallest_body_text
    from jeit.data.frame_checks import MAX_IMPOSSIBLE_SIGN_SHARE
    from jeit.report import report_measurement

    measurement = read_file("DATA", data, format, description, key=key)
    report = report_measurement(measurement)
    body, noise, smallest_body = report["body"], report["noise"], report["smallest_detectable_body"]
    frame_names_text = f" ({', '.join(report['frame_names'])})" if report["frame_names"] else ""
    frame_rate_text = f", {report['frame_rate']:.4g} a second" if report["frame_rate"] else ""
    noise_text = noise and f"{format_with_unit(noise['standard_deviation'], 'V')}, from {noise['method']}"
    rows = [
        ("frames", f"{report['frames']}{frame_names_text}{frame_rate_text}"),
        ("protocol", report["protocol"]),
        ("channels", f"{report['channels']}, of {counted(report['drives'], 'drive')}"),
        ("masked", f"{report['masked']} of {report['voltages']} voltages"),
        ("largest current", format_with_unit(report["largest_current"], "A")),
        ("largest voltage", format_with_unit(report["largest_voltage"], "V")),
        ("body", _body_text(body)),
        ("electrodes", f"{report['electrodes']['number']}, {report['electrodes']['kind']}"),
        ("reciprocity error", percent(report["reciprocity_error"])),
        ("noise", noise_text or "not known"),
        ("smallest body", smallest_body_text(smallest_body)),
        ("impossible signs", percent(report["impossible_signs"])),
    ]
    if (report["impossible_signs"] or 0) > MAX_IMPOSSIBLE_SIGN_SHARE:
        rows.append(("doubt", "so many impossible signs are those of noise: frames with them are not imaged"))
    rows.append(("wiring", report["wiring"] or "not known: the file does not say where electrodes are"))
    rows += [("note", note) for note in report["notes"]]
    plain_console().print(name_value_table(measurement.name, rows))


def _body_text(body: dict[str, Any]) -> str:
    """Text that states the shape and the sizes of a body by their names in a description file."""
    from jeit.arguments import counted

    if body["shape"] == "mesh":
        return f"mesh, {body['dimension']}-D, {counted(body['points'], 'node')}"
    size_names = {key: key for key in ("radius", "width", "height", "thickness")}
    shape_name = body["shape"]
    if "thickness" in body and shape_name in _SOLID_NAMES_AND_SIZE_KEYS:
        shape_name, solid_size_names = _SOLID_NAMES_AND_SIZE_KEYS[shape_name]
        size_names |= solid_size_names
    return ", ".join(
        [shape_name, *(f"{name} {1e3 * body[key]:g} mm" for key, name in size_names.items() if key in body)]
    )
