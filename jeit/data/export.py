"""Export of a measurement to NPZ with a TOML description beside it, for `read` and for other software."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from jeit.data.described_body import ELECTRODES
from jeit.data.described_protocol import PROTOCOL_ARRAYS
from jeit.data.measurement import Measurement
from jeit.electrodes import AbstractElectrodes
from jeit.files import whole_files
from jeit.mesh import Body
from jeit.mesh.outline import OUTLINES
from jeit.protocol import Protocol


def write_table(measurement: Measurement, path: str | Path) -> tuple[Path, Path]:
    """Write a measurement to `path` (.npz) and its description to a file of the same name (.toml); return both paths.

    The NPZ file holds `voltages` (F, M) in volts, `mask` (F, M), `frame_names`, `notes`, `times` (F,) in seconds if
    known, and the protocol: `drive` (S, L) in amperes, `measurement` (K, L), `drive_index` (M,), `measurement_index`
    (M,), `protocol_name`. The TOML file holds geometry, electrodes, protocol and uncertainty, so it also describes
    other tables of the same sensor. `read` restores the measurement.

    Raises `ValueError` for another suffix, and for electrodes or bodies that a description cannot express (a mesh or an
    outline of your own, and electrodes on its facets).
    """
    file = Path(path)
    if file.suffix.lower() != ".npz":
        raise ValueError(f"write_table: {file.name} must end in .npz.")
    lines = [f"title = {_toml(measurement.name)}"]
    if measurement.domain is not None:
        lines += ["", "[geometry]", *_assignments(_geometry(measurement.domain))]
    if measurement.electrodes is not None:
        lines += ["", "[electrodes]", *_assignments(_electrodes(measurement.electrodes))]
    protocol = measurement.protocol
    lines += ["", "[protocol]", *_assignments(_protocol(protocol))]
    if (known := measurement.uncertainty) is not None:
        shares = {"contact_drift": known.drift, "size": known.size, "other": known.other}
        said = {} if known.position is None else {"position": known.position}
        said |= {f"{name}_percent": 100 * share for name, share in shares.items()}
        lines += ["", "[uncertainty]", *_assignments(said)]
    component = "complex" if np.iscomplexobj(measurement.voltages) else "real"
    lines += ["", "[data]", *_assignments({"frames_in": "rows", "component": component})]
    arrays: dict[str, Any] = {part: np.asarray(getattr(protocol, part)) for part in PROTOCOL_ARRAYS}
    if measurement.times is not None:
        arrays["times"] = np.asarray(measurement.times)
    description = file.with_suffix(".toml")
    with whole_files(file.parent) as made:
        np.savez_compressed(
            made / file.name,
            voltages=np.asarray(measurement.voltages),
            mask=np.asarray(measurement.mask),
            frame_names=np.array(measurement.frame_names, str),
            notes=np.array(measurement.notes, str),
            protocol_name=np.asarray(protocol.name),
            **arrays,
        )
        (made / description.name).write_text("\n".join(lines) + "\n", "utf-8")
    return file, description


def _geometry(domain: Body) -> dict:
    described = domain.describe()
    if described["shape"] not in OUTLINES:
        raise ValueError(
            f"write_table: a description cannot say {type(domain).__name__}; it knows {', '.join(OUTLINES)} and solids "
            "above them. Set domain to None; save a mesh with jeit.mesh.write, and name it in [geometry] mesh."
        )
    return described


def _electrodes(electrodes: AbstractElectrodes) -> dict:
    kind = next((name for name, known in ELECTRODES.items() if type(electrodes) in known.values()), None)
    geometry = {name: np.asarray(values).tolist() for name, values in electrodes.geometry().items()} if kind else {}
    positions = geometry.pop("position", None)
    if positions is None:
        raise ValueError(
            f"write_table: a description cannot say {type(electrodes).__name__}; it knows {', '.join(ELECTRODES)}. Set "
            "electrodes to None, or save the model instead."
        )
    described = {"kind": kind, **geometry, "positions": positions}
    if electrodes.is_point:
        return described
    return {**described, "contact_impedance": np.asarray(electrodes.contact_impedance).tolist()}


def _protocol(protocol: Protocol) -> dict:
    parts = {part: np.asarray(getattr(protocol, part)).tolist() for part in PROTOCOL_ARRAYS}
    return {"kind": "channels", "name": protocol.name, **parts}


def _assignments(section: dict) -> list[str]:
    return [f"{key} = {_toml(value)}" for key, value in section.items()]


def _toml(value) -> str:
    """TOML text of a string, a number or a nested list, as JSON writes it; floats are written by `repr`, so no digits
    are lost."""
    return json.dumps(value, ensure_ascii=False)
