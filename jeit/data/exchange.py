"""Exchange with other programs: measurements written to NPZ with a TOML description, and models of EIDORS and pyEIT."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from jeit.arguments import check_kind, listed
from jeit.data.described_body import ELECTRODES
from jeit.data.described_protocol import PROTOCOL_ARRAYS
from jeit.data.measurement import Measurement
from jeit.electrodes import AbstractElectrodes, NodeElectrodes, electrodes_from_nodes
from jeit.files import check_memory, read_as, whole_files
from jeit.forward import ForwardModel
from jeit.mesh import Body, Mesh
from jeit.mesh.outline import OUTLINES
from jeit.protocol import Protocol, from_channels
from jeit.protocol.patterns import pair_patterns


def write_table(measurement: Measurement, path: str | Path) -> tuple[Path, Path]:
    """Write a measurement to an NPZ file and its description to a TOML file of the same name; return both paths.

    The NPZ file holds `voltages` (F, M) in volts, `mask` (F, M), `frame_names`, `notes`, `times` (F,) in seconds if
    known, and the protocol: `drive` (S, L) in amperes, `measurement` (K, L), `drive_index` (M,), `measurement_index`
    (M,), `protocol_name`. The TOML file holds geometry, electrodes, protocol and uncertainty, so it also describes
    other tables of the same sensor. `read` restores the measurement.

    **Arguments:**

    - `measurement`: the measurement.
    - `path`: the .npz file.

    Raises `ValueError` for another suffix, and for electrodes or bodies that a description cannot express (a mesh or an
    outline of your own, and electrodes on its facets).

    **Example:**

    ```python
    write_table(pressed, "pressed.npz")
    ```
    """
    file = Path(path)
    if file.suffix.lower() != ".npz":
        raise ValueError(f"write_table: {file.name} must end in .npz.")
    lines = [f"title = {_toml(measurement.name)}"]
    if measurement.domain is not None:
        lines += ["", "[geometry]", *assignments(_geometry(measurement.domain))]
    if measurement.electrodes is not None:
        lines += ["", "[electrodes]", *assignments(_electrodes(measurement.electrodes))]
    protocol = measurement.protocol
    lines += ["", "[protocol]", *assignments(_protocol(protocol))]
    if (known := measurement.uncertainty) is not None:
        shares = {"contact_drift": known.drift, "size": known.size, "other": known.other}
        said = {} if known.position is None else {"position": known.position}
        said |= {f"{name}_percent": 100 * share for name, share in shares.items()}
        lines += ["", "[uncertainty]", *assignments(said)]
    component = "complex" if np.iscomplexobj(measurement.voltages) else "real"
    lines += ["", "[data]", *assignments({"frames_in": "rows", "component": component, "polarity": "normal"})]
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


def assignments(section: dict[str, Any]) -> list[str]:
    """Lines of a TOML table, one for each key; values are text, booleans, numbers and nested lists."""
    return [f"{key} = {_toml(value)}" for key, value in section.items()]


def _toml(value) -> str:
    """TOML text of a string, a number or a nested list, as JSON writes it; floats are written by `repr`, so no digits
    are lost."""
    return json.dumps(value, ensure_ascii=False)


def from_pyeit(mesh: Any, protocol: Any, *, current: float = 1.0) -> ForwardModel:
    """The forward model of a mesh and a protocol of pyEIT: point electrodes, drive and measurement pairs in the same
    order. With the conductivity `mesh.perm`, voltages are those of `EITForward.solve_eit`.

    **Arguments:**

    - `mesh`: a `pyeit.mesh.PyEITMesh`.
    - `protocol`: a `pyeit.eit.protocol.PyEITProtocol`.
    - `current`: amplitude, amperes; pyEIT drives 1 A.

    Raises `ValueError` for objects without the fields of these classes, and as `Mesh.create`.

    **Example:**

    ```python
    import pyeit.mesh as shapes  # with pyeit
    from pyeit.eit.protocol import create
    model = from_pyeit(shapes.create(16), create(16))
    ```
    """
    fields = {"mesh": (mesh, ("node", "element", "el_pos")), "protocol": (protocol, ("ex_mat", "meas_mat"))}
    for name, (given, needed) in fields.items():
        missing = [one for one in needed if not hasattr(given, one)]
        if missing:
            raise ValueError(f"{name} has no {missing[0]}; give the {name} that pyEIT made, such as of its `create`.")
    points, nodes = np.asarray(mesh.node, float), np.asarray(mesh.el_pos, int)
    cells = np.asarray(mesh.element, int)
    points = points[:, : cells.shape[1] - 1]  # pyEIT gives meshes of the plane a coordinate z = 0
    drive = current * pair_patterns(np.asarray(protocol.ex_mat, int), len(nodes))
    pairs = [np.asarray(one, int)[:, :2] for one in protocol.meas_mat]
    measurement = pair_patterns(np.concatenate(pairs), len(nodes))
    index = np.repeat(np.arange(len(pairs)), [len(one) for one in pairs])
    made = from_channels(drive, measurement, index, name="pyEIT's protocol")
    return ForwardModel(Mesh.create(points, cells), NodeElectrodes(nodes), made)


def from_eidors(path: str | Path, variable: str | None = None) -> ForwardModel:
    """The forward model of a `fwd_model` of EIDORS, saved by `save('tank.mat', 'fwd_model', '-v7')`: nodes, elements,
    electrodes with their contact impedances, and stimulation with its signs.

    Electrodes of one node are point electrodes. Files are read by SciPy; take them from people you trust. Lengths are
    those of the file, in metres.

    **Arguments:**

    - `path`: the .mat file.
    - `variable`: name in the file of a `fwd_model`, or of a model or image that has one; by default the only such
      variable.

    Raises `ValueError` for files without a model, and for electrodes of no boundary facets.

    **Example:**

    ```python
    model = from_eidors("tank.mat")  # with tank.mat
    ```
    """
    check_kind("path", path, (str, Path), "the name of a .mat file")
    file = Path(path)
    if not file.is_file():
        raise ValueError(f"path: there is no file {file}. Check the name and the working directory.")
    check_memory(file.name, file.stat().st_size)
    with read_as(f"{file.name} is not a readable .mat file of version 7 or less"):
        held = scipy.io.loadmat(str(file), simplify_cells=True, spmatrix=False)
    models = {name: found for name, one in held.items() if (found := _forward_model(one)) is not None}
    if variable is None and len(models) != 1:
        said = f"has the models {listed(sorted(models))}; name one" if models else "has no model; save a fwd_model"
        raise ValueError(f"variable: {file.name} {said}.")
    name = next(iter(models)) if variable is None else variable
    if name not in models:
        raise ValueError(f"variable: {file.name} has no model {name!r}; it has {listed(sorted(models)) or 'none'}.")
    given = models[name]
    mesh = Mesh.create(np.asarray(given["nodes"], float), np.asarray(given["elems"], int) - 1)
    parts = [given["electrode"]] if isinstance(given["electrode"], dict) else list(given["electrode"])
    nodes = [np.atleast_1d(np.asarray(one["nodes"], int)) - 1 for one in parts]
    if all(len(one) == 1 for one in nodes):
        electrodes: AbstractElectrodes = NodeElectrodes(np.concatenate(nodes))
    else:
        electrodes = electrodes_from_nodes(mesh, nodes, np.array([float(one["z_contact"]) for one in parts]))
    stimulation = given["stimulation"]
    steps = [stimulation] if isinstance(stimulation, dict) else list(stimulation)
    drive = np.stack([_dense(one["stim_pattern"]).ravel() for one in steps])
    patterns = [_dense(one["meas_pattern"]).reshape(-1, drive.shape[1]) for one in steps]
    index = np.repeat(np.arange(len(steps)), [len(one) for one in patterns])
    return ForwardModel(mesh, electrodes, from_channels(drive, np.concatenate(patterns), index, name=f"of {file.stem}"))


def _forward_model(one: Any) -> dict[str, Any] | None:
    """The `fwd_model` that a variable is or has; None if it has none."""
    if not isinstance(one, dict):
        return None
    if {"nodes", "elems", "electrode", "stimulation"} <= one.keys():
        return one
    return _forward_model(one.get("fwd_model"))


def _dense(matrix: Any) -> np.ndarray:
    return np.asarray(matrix.toarray() if hasattr(matrix, "toarray") else matrix, float)
