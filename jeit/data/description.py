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
  number or a list, one level after the other; or `positions`, of two or three coordinates.
- `[protocol]`: `kind` = name of a constructor in `jeit.protocol` with its arguments, or "matrices" with
  `drive` (S, L) in amperes and `measurement` (K, L), or "channels" with those and `drive_index` (M,) and
  `measurement_index` (M,), from 0. `current` in amperes, or `current_unit`; or `current_from_name`, the name of
  the file with {current} in place of the number and * for anything, such as "*_{current}uA_*". Or "optimal" with
  `transfer`, and `other`, (L, L) ohm, and `current` or `power`; or "measured", of a .mat or .npz file that holds its
  currents in `drive_key` ("current_patterns" unless given, a column a pattern; `patterns_in` = "rows" otherwise), and
  `measurement`, what is read of all potentials: "mean-removed" (less their mean), "mean", "adjacent" or "against" an
  electrode `reference`; or `measurement_key`, a matrix of the file.
- `[data]`: `frames_in` = "columns" or "rows"; `delimiter`, `skip_rows`; `complex_pairs`, `component`; `gain`,
  `polarity`, `unit`, `saturation`; `frame_names`; `keys`, the variables to read from a .mat or .npz file, of three
  axes if they are as `axes` says (electrodes, patterns, frames unless given); `frames` = "all", or "mean" of them;
  `frame_rate`, in a second.
- `[notes]`: `text`, a list of sentences to carry along.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jeit.data.described_body import described_body, described_electrodes
from jeit.data.described_protocol import described_protocol
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.body_mesh import body_mesh
from jeit.files import read_toml
from jeit.forward import ForwardModel
from jeit.mesh import Body
from jeit.protocol import Protocol

if TYPE_CHECKING:
    from jeit.data.description_tables import DataTable, ProtocolTable
    from jeit.protocol.all_at_once import Reading

BUNDLED = ("tank6cm",)
_VOLTAGE_UNITS = {"V": 1.0, "mV": 1e-3, "uV": 1e-6, "µV": 1e-6}


@dataclass(frozen=True)
class TableLayout:
    """Arrangement of the numbers in a file (section `[data]`)."""

    frames_in: str = "rows"
    delimiter: str = ","
    skip_rows: int = 0
    complex_pairs: bool = False
    component: str = "real"
    scale: float = 1.0
    saturation: float | None = None
    frame_names: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()
    axes: tuple[str, ...] = ()
    averaged: bool = False
    frame_rate: float | None = None


@dataclass(frozen=True)
class Description:
    """A description read and checked: see the module's docstring."""

    origin: str
    title: str
    domain: Body | None
    electrodes: AbstractElectrodes | None
    layout: TableLayout
    notes: tuple[str, ...]
    protocol_section: ProtocolTable | None = field(repr=False)

    def protocol(self, path: str | Path) -> Protocol | None:
        """The protocol of the file at `path` (whose name may hold the current), or None if not described.

        Raises `ValueError`, with file and section named, if what is described makes no protocol.
        """
        if self.protocol_section is None:
            return None
        number = None if self.electrodes is None else self.electrodes.num_electrodes
        return described_protocol(self.protocol_section, number, Path(path), self.origin)

    @property
    def patterns_measured(self) -> bool:
        """Whether the currents lie in the data file."""
        return self.protocol_section is not None and self.protocol_section.kind == "measured"

    @property
    def mean_removed(self) -> bool:
        """Whether the file has the potentials of all electrodes less their mean, beside the currents."""
        section = self.protocol_section
        if section is None or section.kind != "measured" or section.measurement_key is not None:
            return False
        return section.measurement == "mean-removed"

    @property
    def reading(self) -> tuple[Reading, int | None]:
        """Reading of the potentials of all electrodes where the currents lie in the data file, and the electrode they
        are read against."""
        section = self.protocol_section
        if section is None or section.kind != "measured":
            return "mean-removed", None
        return section.measurement, section.reference

    def model(self, path: str | Path, *, num_points: int | None = None) -> ForwardModel:
        """A model of what the file at `path` was measured on: on a new mesh of about `num_points` nodes, or, without
        them, on a mesh of one's own.

        Raises `ValueError` where geometry, electrodes or protocol are not described, and for `num_points` where it is
        missing or has no effect.
        """
        domain, electrodes, protocol = self.domain, self.electrodes, self.protocol(path)
        if domain is None or electrodes is None or protocol is None:
            said = {"geometry": domain, "electrodes": electrodes, "protocol": protocol}
            missing = ", ".join(f"[{section}]" for section, one in said.items() if one is None)
            raise ValueError(f"{self.origin}: a model needs {missing} too; describe it.")
        mesh = body_mesh(domain, electrodes, num_points)
        return ForwardModel(mesh, electrodes, protocol)


def load_description(which: str | Path) -> Description:
    """Read a description: a path to a TOML file, or the name of a bundled one ("tank6cm").

    Raises `ValueError` with the section and key at fault.
    """
    if str(which) in BUNDLED:
        origin = f"{which}.toml"
        text = resources.files("jeit.data").joinpath(origin).read_text("utf-8")
        return parse_description(tomllib.loads(text), origin)
    path = Path(which)
    if not path.is_file():
        raise ValueError(
            f"description {path}: there is no such file. Give a TOML file, or one of {', '.join(BUNDLED)}."
        )
    return parse_description(read_toml(path), path.name, path.parent)


def parse_description(table: dict[str, Any], origin: str, folder: str | Path = ".") -> Description:
    """Check a description given as nested dictionaries; files that it names are looked for in `folder`.

    Raises `ValueError` with the keys at fault.
    """
    # pydantic takes longer to import than most of what jeit does with a description.
    from jeit.data.description_tables import DescriptionTable
    from jeit.files.schema import validated

    tables = validated(DescriptionTable, table, origin)
    domain = None if tables.geometry is None else described_body(tables.geometry, Path(folder), origin)
    electrodes = None if tables.electrodes is None else described_electrodes(tables.electrodes, domain, origin)
    return Description(
        origin=origin,
        title=tables.title,
        domain=domain,
        electrodes=electrodes,
        layout=_layout(tables.data),
        notes=tuple(tables.notes.text),
        protocol_section=tables.protocol,
    )


def _layout(data: DataTable) -> TableLayout:
    scale = _VOLTAGE_UNITS[data.unit] / data.gain * (-1 if data.polarity == "reversed" else 1)
    return TableLayout(
        frames_in=data.frames_in,
        delimiter=data.delimiter,
        skip_rows=data.skip_rows,
        complex_pairs=data.complex_pairs,
        component=data.component,
        scale=scale,
        # Given as the instrument reads it, compared after the gain is taken out.
        saturation=None if data.saturation is None else data.saturation * abs(scale),
        frame_names=tuple(data.frame_names),
        keys=tuple(data.keys),
        axes=tuple(data.axes),
        averaged=data.frames == "mean",
        frame_rate=data.frame_rate,
    )
