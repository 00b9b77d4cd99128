"""Descriptions: small TOML files beside measured data that state what the numbers in a table mean.

A description has these sections, of which only `[protocol]` is required (`tank6cm.toml` in this folder is an example):

- `[geometry]`: the body, in metres. `shape` = "disk" (`radius`, `centre`), "rectangle" (`width`, `height`, `centre`) or
  "polygon" (`vertices`, `holes`) is a sheet, or, with a `thickness`, a solid from z = 0 upwards; "box" (`width`,
  `depth`, `height`) and "cylinder" (`radius`, `height`) are solids. Alternatively `mesh` = "tank.msh" names a mesh file
  beside the description, in any format that `jeit.mesh.read` knows, and `scale` is the length of its unit in metres
  (1e-3 for millimetres).
- `[electrodes]`: `kind` = "boundary" (`width`), "disc" (`radius`; in a sheet or on the surface of a solid), "patch" (on
  a solid: `width`, `height`), "point", or "facets" (`tags`: names of groups of facets of the mesh); `contact_impedance`
  in ohm·m² (on the edge of a sheet in ohm·m). The positions of the electrodes follow from `layout` = "ring" (disk,
  cylinder: `number`, `start_angle_degrees`, `clockwise`) or "perimeter" (`number`, `start`), on a solid at each height
  z in `levels` (a number or a list), numbered level after level; or from `positions`, each of two or three coordinates.
- `[protocol]`: `kind` = name of a constructor in `jeit.protocol`, with its arguments and the amplitude: `current` in
  amperes, or in `current_unit`; or `current_from_name`, the name of the data file with {current} in place of the number
  and * for any text, such as "*_{current}uA_*". Or `kind` = "matrices" with `drive` (drives, electrodes) in amperes and
  `measurement` (measurement patterns, electrodes); "channels" with both matrices, and `drive_index` and
  `measurement_index` of each channel, counted from 0; or "optimal" with the transfer impedance `transfer`, optionally
  `other`, both (electrodes, electrodes) in ohm, and `current` or `power`. Or "measured", for a .mat or .npz data file
  that contains the currents in the variable `drive_key` (default "current_patterns"), one pattern per column, or per
  row with `patterns_in` = "rows". In that case `measurement` states how the potentials of all electrodes are read:
  "mean-removed" (each minus the mean of all potentials), "mean" (each against the mean of the other electrodes),
  "adjacent", or "against" an electrode `reference`; alternatively `measurement_key` names a matrix of measurement
  patterns in the file.
- `[data]`: `frames_in` = "columns" or "rows"; `delimiter`, `skip_rows`; `time_column`, whether the first number of a
  frame is its time; `complex_pairs`, `component`; `gain`, or `gains`, one for each measurement pattern of the protocol;
  `polarity`, `unit`, `saturation`; `frame_names`; `keys`: variables to read from a .mat or .npz file; `axes`: order of
  the axes of a three-dimensional array (default: electrodes, patterns, frames); `frames` = "all", or "mean" for their
  average; `frame_rate` in frames per second. If the arrangement or the `polarity` is not stated, it is detected from
  the numbers, and a note states the result.
- `[uncertainty]`: standard deviations: `position` of electrodes in metres, or `position_degrees` on a disk or cylinder;
  `contact_drift_percent`, change of contact impedances from the reference to a frame; `size_percent` of the body;
  `other_percent`, other errors of the difference between frame and reference. See `jeit.inverse.Uncertainty`.
- `[notes]`: `text`, a list of sentences that are copied to the notes of the measurement.
"""

from __future__ import annotations

import tomllib
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jeit.data.described_body import described_body, described_electrodes
from jeit.data.described_protocol import described_protocol, protocol_table_variants
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.face_patches import body_mesh
from jeit.files import read_toml
from jeit.forward import ForwardModel
from jeit.inverse import Uncertainty
from jeit.mesh import Body, Disk, Solid
from jeit.protocol import Protocol

if TYPE_CHECKING:
    from jeit.data.description_tables import DataTable, ProtocolTable, UncertaintyTable
    from jeit.protocol.all_at_once import Reading

BUNDLED_DESCRIPTIONS = ("tank6cm",)
_VOLTAGE_UNITS = {"V": 1.0, "mV": 1e-3, "uV": 1e-6, "µV": 1e-6}


@dataclass(frozen=True)
class TableLayout:
    """Arrangement of the numbers in a data file, from the section `[data]` of the file's description. A property that
    is None is detected from the numbers."""

    frames_in: str | None = None
    delimiter: str | None = None
    skip_rows: int | None = None
    time_column: bool | None = None
    complex_pairs: bool = False
    component: str = "real"
    scale: float = 1.0
    polarity: str | None = None
    gains: tuple[float, ...] = ()
    saturation: float | None = None
    frame_names: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()
    axes: tuple[str, ...] = ()
    averaged: bool = False
    frame_rate: float | None = None


@dataclass(frozen=True)
class Description:
    """A checked description of measured data: the body, the electrodes and the protocol, as `load_description` reads
    them from a TOML file. docs/reference/description.md explains the sections of the file.

    **Fields**: `origin`: name of the TOML file, for messages; `title`; `domain`: the body, or None; `electrodes`: the
    electrodes, or None; `layout`: arrangement of the voltages in the data file; `notes`: assumptions, in sentences;
    `protocol_section`: the table that describes the protocol; `uncertainty`: how accurately electrodes and body are
    known, or None.

    **Example:**

    ```python
    description = load_description("tank6cm")
    description.title, description.electrodes
    ```
    """

    origin: str
    title: str
    domain: Body | None
    electrodes: AbstractElectrodes | None
    layout: TableLayout
    notes: tuple[str, ...]
    protocol_section: ProtocolTable | None = field(repr=False)
    uncertainty: Uncertainty | None = None

    def protocols(self, path: str | Path) -> list[tuple[Protocol, str]]:
        """Return the protocols that agree with the description for the data file at `path`, each with a text. The first
        protocol has the default values of all options that the description does not state. Further protocols have
        different values of these options, which the text states."""
        default_protocol = self.protocol(path)
        if default_protocol is None or self.protocol_section is None:
            return []
        num_electrodes, candidate_protocols = (
            None if self.electrodes is None else self.electrodes.num_electrodes,
            [(default_protocol, "")],
        )
        for table_variant, option_text in protocol_table_variants(self.protocol_section)[1:]:
            with suppress(ValueError):  # no channel is left
                candidate_protocols.append(
                    (described_protocol(table_variant, num_electrodes, Path(path), self.origin), option_text)
                )
        return candidate_protocols

    def protocol(self, path: str | Path) -> Protocol | None:
        """The protocol of the data file at `path`; None if no protocol is described. The name of the data file may
        state the current.

        Raises `ValueError`, with file and section named, if the section `[protocol]` is not a valid protocol.
        """
        if self.protocol_section is None:
            return None
        num_electrodes = None if self.electrodes is None else self.electrodes.num_electrodes
        return described_protocol(self.protocol_section, num_electrodes, Path(path), self.origin)

    @property
    def patterns_measured(self) -> bool:
        """Whether the current patterns are stored in the data file."""
        return self.protocol_section is not None and self.protocol_section.kind == "measured"

    @property
    def mean_removed(self) -> bool:
        """Whether the data file stores currents, and potentials of all electrodes from which their mean is
        subtracted."""
        protocol_table = self.protocol_section
        if protocol_table is None or protocol_table.kind != "measured" or protocol_table.measurement_key is not None:
            return False
        return protocol_table.measurement == "mean-removed"

    @property
    def reading(self) -> tuple[Reading, int | None]:
        """If current patterns are stored in the data file: the way in which the potentials of all electrodes are read,
        such as "adjacent", and the index of the reference electrode or None."""
        protocol_table = self.protocol_section
        if protocol_table is None or protocol_table.kind != "measured":
            return "mean-removed", None
        return protocol_table.measurement, protocol_table.reference

    def model(self, path: str | Path, *, num_points: int | None = None) -> ForwardModel:
        """A forward model of the described body with the protocol of the data file at `path`. A new mesh has about
        `num_points` nodes; `num_points` must be None for a body that is described by a mesh.

        Raises `ValueError` if geometry, electrodes or protocol are not described, if `num_points` is missing, and if
        `num_points` is specified for a mesh.
        """
        described_domain, described_electrode_set, file_protocol = self.domain, self.electrodes, self.protocol(path)
        if described_domain is None or described_electrode_set is None or file_protocol is None:
            parts_by_section = {
                "geometry": described_domain,
                "electrodes": described_electrode_set,
                "protocol": file_protocol,
            }
            missing_sections = ", ".join(
                f"[{section_name}]"
                for section_name, part_of_section in parts_by_section.items()
                if part_of_section is None
            )
            raise ValueError(f"{self.origin}: a model needs {missing_sections} too; describe it.")
        mesh = body_mesh(described_domain, described_electrode_set, num_points)
        return ForwardModel(mesh, described_electrode_set, file_protocol)


def load_description(which: str | Path) -> Description:
    """Read a description of measured data from a TOML file, or a description that is part of jeit by its name
    ("tank6cm").

    **Arguments:**

    - `which`: path of a TOML file, or name of a description that is part of jeit.

    Raises `ValueError`, with the faulty section and key, for an invalid description.

    **Example:**

    ```python
    description = load_description("tank6cm")
    ```
    """
    if str(which) in BUNDLED_DESCRIPTIONS:
        file_name = f"{which}.toml"
        text = resources.files("jeit.data").joinpath(file_name).read_text("utf-8")
        return parse_description(tomllib.loads(text), file_name)
    path = Path(which)
    if not path.is_file():
        raise ValueError(
            f"description {path}: there is no such file. Give a TOML file, or the name of a description that "
            f"jeit has: {', '.join(BUNDLED_DESCRIPTIONS)}."
        )
    return parse_description(read_toml(path), path.name, path.parent)


def parse_description(table: dict[str, Any], origin: str, folder: str | Path = ".") -> Description:
    """Check nested dictionaries that specify a description, and create the description; relative file names in the
    description refer to `folder`.

    Raises `ValueError`, with the faulty keys, for an invalid description.
    """
    # Imported here because importing pydantic takes longer than most operations on a description.
    from jeit.data.description_tables import DescriptionTable
    from jeit.files.schema import validated

    checked_tables = validated(DescriptionTable, table, origin)
    described_domain = (
        None if checked_tables.geometry is None else described_body(checked_tables.geometry, Path(folder), origin)
    )
    electrodes = (
        None
        if checked_tables.electrodes is None
        else described_electrodes(checked_tables.electrodes, described_domain, origin)
    )
    return Description(
        origin=origin,
        title=checked_tables.title,
        domain=described_domain,
        electrodes=electrodes,
        layout=_described_layout(checked_tables.data),
        notes=tuple(checked_tables.notes.text),
        protocol_section=checked_tables.protocol,
        uncertainty=None
        if checked_tables.uncertainty is None
        else _described_uncertainty(checked_tables.uncertainty, described_domain, origin),
    )


def _described_uncertainty(
    uncertainty_table: UncertaintyTable, described_domain: Body | None, file_name: str
) -> Uncertainty:
    """Uncertainty from the section `[uncertainty]`. Raises `ValueError` if `position_degrees` is specified for a body
    that is not round."""
    position_error = uncertainty_table.position
    if uncertainty_table.position_degrees is not None:
        body_outline = described_domain.outline if isinstance(described_domain, Solid) else described_domain
        if not isinstance(body_outline, Disk):
            raise ValueError(
                f"{file_name}: [uncertainty] position_degrees is of a disk or a cylinder; give position, in metres."
            )
        position_error = float(np.deg2rad(uncertainty_table.position_degrees) * np.asarray(body_outline.radius))
    contact_drift, size_error, other_relative_error = (
        error_percentage / 100
        for error_percentage in (
            uncertainty_table.contact_drift_percent,
            uncertainty_table.size_percent,
            uncertainty_table.other_percent,
        )
    )
    return Uncertainty(position_error, contact_drift, size_error, other_relative_error)


def _described_layout(data_table: DataTable) -> TableLayout:
    volts_per_unit = (
        _VOLTAGE_UNITS[data_table.unit] / data_table.gain * (-1 if data_table.polarity == "reversed" else 1)
    )
    return TableLayout(
        frames_in=data_table.frames_in,
        delimiter=data_table.delimiter,
        skip_rows=data_table.skip_rows,
        time_column=data_table.time_column,
        complex_pairs=data_table.complex_pairs,
        component=data_table.component,
        scale=volts_per_unit,
        polarity=data_table.polarity,
        gains=() if data_table.gains is None else tuple(data_table.gains.tolist()),
        # The saturation level is stated in the unit of the file, but compared with voltages from which the gain is
        # removed.
        saturation=None if data_table.saturation is None else data_table.saturation * abs(volts_per_unit),
        frame_names=tuple(data_table.frame_names),
        keys=tuple(data_table.keys),
        axes=tuple(data_table.axes),
        averaged=data_table.frames == "mean",
        frame_rate=data_table.frame_rate,
    )
