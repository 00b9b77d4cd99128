"""The small TOML file beside measured data that says what a table of numbers means.

Sections (`tank6cm.toml` in this folder is an example; only `[protocol]` must be there):

- `[geometry]`: `shape` = "disk" (`radius`, `centre`), "rectangle" (`width`, `height`, `centre`) or "polygon"
  (`vertices`, `holes`), each with `thickness` a solid from z = 0 up; "box" (`width`, `depth`, `height`) or "cylinder"
  (`radius`, `height`). Metres. Or `mesh` = "tank.msh", a file beside the description, any that `jeit.mesh.read` knows,
  and `scale`, the length of its unit in metres (1e-3 for millimetres).
- `[electrodes]`: `kind` = "boundary" (`width`), "disc" (`radius`; in a sheet or on a solid's surface), "patch" (on a
  solid: `width`, `height`), "point", or "facets" (`tags`, the names of groups of a mesh's facets); `contact_impedance`,
  ohm·m² (on the edge of a sheet ohm·m); and where they are: `layout` = "ring" (disk, cylinder: `number`,
  `start_angle_degrees`, `clockwise`) or "perimeter" (`number`, `start`), on a solid at each height z of `levels`, one
  level after the other; or `positions`, of two or three coordinates.
- `[protocol]`: `kind` = name of a constructor in `jeit.protocol` with its arguments, or "matrices" with
  `drive` (S, L) in amperes and `measurement` (K, L), or "channels" with those and `drive_index` (M,) and
  `measurement_index` (M,), from 0. `current` in amperes, or `current_unit`; `current_from_name`, a regular
  expression that finds it in the file's name.
- `[data]`: `frames_in` = "columns" or "rows"; `delimiter`, `skip_rows`; `complex_pairs`, `component`; `gain`,
  `polarity`, `unit`, `saturation`; `frame_names`; `keys`, the variables to read from a .mat or .npz file.
- `[notes]`: `text`, a list of sentences to carry along.
"""

import re
import tomllib
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from jeit import protocol as protocols
from jeit.data._sections import choice, located, need, refuse_unknown
from jeit.data.described_body import KEYS as BODY_KEYS
from jeit.data.described_body import described_body, described_electrodes
from jeit.electrodes import AbstractElectrodes
from jeit.forward import ForwardModel
from jeit.mesh import Body
from jeit.protocol import Protocol

CURRENT_UNITS = {"A": 1.0, "mA": 1e-3, "uA": 1e-6, "µA": 1e-6}
VOLTAGE_UNITS = {"V": 1.0, "mV": 1e-3, "uV": 1e-6, "µV": 1e-6}
BUNDLED = ("tank6cm",)
PROTOCOL_ARRAYS = ("drive", "measurement", "drive_index", "measurement_index")

_KEYS = {
    **BODY_KEYS,
    "data": {
        "frames_in",
        "delimiter",
        "skip_rows",
        "complex_pairs",
        "component",
        "gain",
        "polarity",
        "unit",
        "saturation",
        "frame_names",
        "keys",
    },
    "notes": {"text"},
}
_PROTOCOL_OPTIONS = {
    "adjacent": {"driven_electrodes", "reciprocal", "order"},
    "skip": {"skipped", "measurement_skipped", "driven_electrodes", "reciprocal", "order"},
    "opposite": {"drives", "driven_electrodes", "order"},
    "all_against_one": {"common", "measurement", "driven_electrodes", "reciprocal"},
    "reference_electrode": {"skipped", "reference", "driven_electrodes", "order"},
    "two_terminal": {"pairs"},
    "trigonometric": {"measurement"},
    "bipolar": {"drive_pairs", "measurement_pairs", "driven_electrodes", "reciprocal"},
}


@dataclass(frozen=True)
class TableLayout:
    """How numbers lie in a file (section `[data]`)."""

    frames_in: str = "rows"
    delimiter: str = ","
    skip_rows: int = 0
    complex_pairs: bool = False
    component: str = "real"
    scale: float = 1.0
    saturation: float | None = None
    frame_names: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()


@dataclass(frozen=True)
class Description:
    """A description read and checked: see the module's docstring."""

    origin: str
    title: str
    domain: Body | None
    electrodes: AbstractElectrodes | None
    layout: TableLayout
    notes: tuple[str, ...]
    protocol_section: dict[str, Any] = field(repr=False)

    def protocol(self, path: str | Path) -> Protocol | None:
        """The protocol of the file at `path` (whose name may hold the current), or None if not described.

        Raises `ValueError`, with file and section named, if what is described makes no protocol.
        """
        if not self.protocol_section:
            return None
        return _protocol(self.protocol_section, self.electrodes, Path(path), self.origin)

    def model(self, path: str | Path, *, num_points: int) -> ForwardModel:
        """A model, on a new mesh of about `num_points` nodes, of what the file at `path` was measured on.

        Raises `ValueError` where geometry, electrodes or protocol are not described.
        """
        domain, electrodes, protocol = self.domain, self.electrodes, self.protocol(path)
        if domain is None or electrodes is None or protocol is None:
            said = {"geometry": domain, "electrodes": electrodes, "protocol": protocol}
            missing = ", ".join(f"[{section}]" for section, one in said.items() if one is None)
            raise ValueError(f"{self.origin}: a model needs {missing} too; describe it.")
        mesh = domain.mesh(num_points=num_points, refine=electrodes.refinement(domain) or None)
        return ForwardModel(mesh, electrodes, protocol)


def load_description(which: str | Path) -> Description:
    """Read a description: a path to a TOML file, or the name of a bundled one ("tank6cm").

    Raises `ValueError` with the section and key at fault.
    """
    if str(which) in BUNDLED:
        origin = f"{which}.toml"
        text, folder = resources.files("jeit.data").joinpath(origin).read_text("utf-8"), Path()
    else:
        path = Path(which)
        if not path.is_file():
            raise ValueError(
                f"description {path}: there is no such file. Give a TOML file, or one of {', '.join(BUNDLED)}."
            )
        text, origin, folder = path.read_text("utf-8"), path.name, path.parent
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{origin} is not valid TOML: {error}.") from None
    return parse_description(table, origin, folder)


def parse_description(table: dict[str, Any], origin: str, folder: str | Path = ".") -> Description:
    """Check a description given as nested dictionaries; files that it names are looked for in `folder`.

    Raises `ValueError` with the section and key at fault.
    """
    known = {"title", "protocol", *_KEYS}
    refuse_unknown(table, known, origin, "the file")
    sections = {name: table.get(name, {}) for name in (*_KEYS, "protocol")}
    for name, section in sections.items():
        if not isinstance(section, dict):
            raise ValueError(f"{origin}: '{name}' must be a section, [{name}].")
        if name in _KEYS:
            refuse_unknown(section, _KEYS[name], origin, f"[{name}]")
    domain = described_body(sections["geometry"], Path(folder), origin) if sections["geometry"] else None
    return Description(
        origin=origin,
        title=str(table.get("title", "")),
        domain=domain,
        electrodes=described_electrodes(sections["electrodes"], domain, origin) if sections["electrodes"] else None,
        layout=_layout(sections["data"], origin),
        notes=tuple(str(note) for note in sections["notes"].get("text", ())),
        protocol_section=sections["protocol"],
    )


def _layout(section: dict, origin: str) -> TableLayout:
    where = "[data]"
    unit = choice(section.get("unit", "V"), VOLTAGE_UNITS, origin, f"{where} unit")
    gain = section.get("gain", 1.0)
    if not isinstance(gain, (int, float)) or not np.isfinite(gain) or gain <= 0:
        raise ValueError(f"{origin}: {where} gain must be a positive number; got {gain!r}. For signs, use polarity.")
    polarity = choice(section.get("polarity", "normal"), ("normal", "reversed"), origin, f"{where} polarity")
    frames_in = choice(section.get("frames_in", "rows"), ("rows", "columns"), origin, f"{where} frames_in")
    components = ("real", "imaginary", "magnitude", "complex")
    scale = VOLTAGE_UNITS[unit] / gain * (-1 if polarity == "reversed" else 1)
    saturation = section.get("saturation")
    return TableLayout(
        frames_in=frames_in,
        delimiter=section.get("delimiter", ","),
        skip_rows=int(section.get("skip_rows", 0)),
        complex_pairs=bool(section.get("complex_pairs", False)),
        component=choice(section.get("component", "real"), components, origin, f"{where} component"),
        scale=scale,
        # Given as the instrument reads it, compared after the gain is taken out.
        saturation=None if saturation is None else float(saturation) * abs(scale),
        frame_names=tuple(section.get("frame_names", ())),
        keys=tuple(section.get("keys", ())),
    )


def _protocol(section: dict, electrodes, path: Path, origin: str) -> Protocol:
    where = "[protocol]"
    kinds = (*_PROTOCOL_OPTIONS, "matrices", "channels")
    kind = choice(need(section, "kind", origin, where), kinds, origin, f"{where} kind")
    try:
        if kind == "matrices":
            return _from_matrices(section, origin)
        if kind == "channels":
            return _from_channels(section, origin)
        return _constructed(kind, section, electrodes, path, origin)
    except (ValueError, TypeError) as error:
        raise located(error, origin, where) from None


def _from_matrices(section: dict, origin: str) -> Protocol:
    where = "[protocol]"
    refuse_unknown(section, {"kind", "name", "drive", "measurement", "select"}, origin, f"{where} matrices")
    select = section.get("select")
    return protocols.from_matrices(
        need(section, "drive", origin, where),
        need(section, "measurement", origin, where),
        None if select is None else np.asarray(select, bool),
        name=section.get("name", "matrices"),
    )


def _from_channels(section: dict, origin: str) -> Protocol:
    where = "[protocol]"
    refuse_unknown(section, {"kind", "name", *PROTOCOL_ARRAYS}, origin, f"{where} channels")
    arrays = {part: np.asarray(need(section, part, origin, where)) for part in PROTOCOL_ARRAYS}
    return Protocol(**arrays, name=section.get("name", "channels"))


def _constructed(kind: str, section: dict, electrodes, path: Path, origin: str) -> Protocol:
    """By the constructor of that name."""
    where = "[protocol]"
    common = {"kind", "number", "current", "current_from_name", "current_unit", "name"}
    refuse_unknown(section, common | _PROTOCOL_OPTIONS[kind], origin, f"{where} {kind}")
    number = section.get("number", None if electrodes is None else electrodes.num_electrodes)
    if number is None:
        raise ValueError(f"{origin}: {where} needs 'number' (of electrodes), or an [electrodes] section.")
    if kind == "reference_electrode" and "number" not in section:
        number -= 1  # that constructor counts the boundary only
    options = {key: value for key, value in section.items() if key in _PROTOCOL_OPTIONS[kind]}
    return getattr(protocols, kind)(number, current=_current(section, path, origin), **options)


def _current(section: dict, path: Path, origin: str) -> float:
    name = choice(section.get("current_unit", "A"), CURRENT_UNITS, origin, "[protocol] current_unit")
    unit = CURRENT_UNITS[name]
    if "current_from_name" in section:
        found = re.search(section["current_from_name"], path.name)
        if found is None or not found.groups():
            raise ValueError(
                f"{origin}: [protocol] current_from_name = {section['current_from_name']!r} finds no current "
                f"in the name {path.name!r}. Give 'current' instead."
            )
        return float(found.group(1)) * unit
    return need(section, "current", origin, "[protocol]") * unit
