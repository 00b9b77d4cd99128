"""Exchange with other programs: export of measurements to NPZ with a TOML description, and import of forward models of
EIDORS and pyEIT."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from jeit.arguments import check_kind, names_text
from jeit.data.described_body import ELECTRODES
from jeit.data.described_protocol import PROTOCOL_ARRAYS
from jeit.data.measurement import Measurement
from jeit.electrodes import AbstractElectrodes, NodeElectrodes, electrodes_from_nodes
from jeit.files import atomically_written_files, check_memory, read_as
from jeit.forward import ForwardModel
from jeit.mesh import Body, Mesh
from jeit.mesh.outline import OUTLINES
from jeit.protocol import Protocol, from_channels
from jeit.protocol.patterns import pair_patterns


def write_table(measurement: Measurement, path: str | Path) -> tuple[Path, Path]:
    """Write a measurement to an NPZ file, and its description to a TOML file of the same name; return the paths of both
    files.

    The NPZ file contains, for F frames, M channels, S drives, K measurement patterns and L electrodes, `voltages` (F,
    M) in volts, `mask` (F, M), `frame_names`, `notes`, `times` (F,) in seconds if known, and the protocol: `drive` (S,
    L) in amperes, `measurement` (K, L), `drive_index` (M,), `measurement_index` (M,), `protocol_name`. The TOML file
    contains geometry, electrodes, protocol and uncertainty, so it also describes other data files of the same sensor.
    `read` restores the measurement.

    **Arguments:**

    - `measurement`: the measurement.
    - `path`: path of the .npz file.

    Raises `ValueError` for a suffix other than .npz, and for a body or electrodes that a description cannot express (a
    mesh, an outline of a user's class, and electrodes on facets of a mesh).

    **Example:**

    ```python
    write_table(pressed, "pressed.npz")
    ```
    """
    data_path = Path(path)
    if data_path.suffix.lower() != ".npz":
        raise ValueError(f"write_table: {data_path.name} must end in .npz.")
    lines = [f"title = {_toml(measurement.name)}"]
    if measurement.domain is not None:
        lines += ["", "[geometry]", *assignments(_geometry(measurement.domain))]
    if measurement.electrodes is not None:
        lines += ["", "[electrodes]", *assignments(_electrodes(measurement.electrodes))]
    protocol = measurement.protocol
    lines += ["", "[protocol]", *assignments(_protocol(protocol))]
    if (uncertainty := measurement.uncertainty) is not None:
        relative_errors = {"contact_drift": uncertainty.drift, "size": uncertainty.size, "other": uncertainty.other}
        section = {} if uncertainty.position is None else {"position": uncertainty.position}
        section |= {f"{name}_percent": 100 * relative_error for name, relative_error in relative_errors.items()}
        lines += ["", "[uncertainty]", *assignments(section)]
    component = "complex" if np.iscomplexobj(measurement.voltages) else "real"
    lines += ["", "[data]", *assignments({"frames_in": "rows", "component": component, "polarity": "normal"})]
    arrays: dict[str, Any] = {array: np.asarray(getattr(protocol, array)) for array in PROTOCOL_ARRAYS}
    if measurement.times is not None:
        arrays["times"] = np.asarray(measurement.times)
    description_path = data_path.with_suffix(".toml")
    with atomically_written_files(data_path.parent) as temporary_folder:
        np.savez_compressed(
            temporary_folder / data_path.name,
            voltages=np.asarray(measurement.voltages),
            mask=np.asarray(measurement.mask),
            frame_names=np.array(measurement.frame_names, str),
            notes=np.array(measurement.notes, str),
            protocol_name=np.asarray(protocol.name),
            **arrays,
        )
        (temporary_folder / description_path.name).write_text("\n".join(lines) + "\n", "utf-8")
    return data_path, description_path


def _geometry(domain: Body) -> dict:
    section = domain.describe()
    if section["shape"] not in OUTLINES:
        raise ValueError(
            f"write_table: a description cannot say {type(domain).__name__}; it knows {', '.join(OUTLINES)} and solids "
            "above them. Set domain to None; save a mesh with jeit.mesh.write, and name it in [geometry] mesh."
        )
    return section


def _electrodes(electrodes: AbstractElectrodes) -> dict:
    kind = next((name for name, classes in ELECTRODES.items() if type(electrodes) in classes.values()), None)
    geometry = {name: np.asarray(values).tolist() for name, values in electrodes.geometry().items()} if kind else {}
    positions = geometry.pop("position", None)
    if positions is None:
        raise ValueError(
            f"write_table: a description cannot say {type(electrodes).__name__}; it knows {', '.join(ELECTRODES)}. Set "
            "electrodes to None, or save the model instead."
        )
    section = {"kind": kind, **geometry, "positions": positions}
    if electrodes.is_point:
        return section
    return {**section, "contact_impedance": np.asarray(electrodes.contact_impedance).tolist()}


def _protocol(protocol: Protocol) -> dict:
    arrays = {name: np.asarray(getattr(protocol, name)).tolist() for name in PROTOCOL_ARRAYS}
    return {"kind": "channels", "name": protocol.name, **arrays}


def assignments(section: dict[str, Any]) -> list[str]:
    """Lines of a TOML table, one for each key; values are text, booleans, numbers and nested lists."""
    return [f"{key} = {_toml(value)}" for key, value in section.items()]


def _toml(value) -> str:
    """TOML text of a string, a number or a nested list, in the form of JSON; floats are written with all digits
    (`repr`)."""
    return json.dumps(value, ensure_ascii=False)


def from_pyeit(mesh: Any, protocol: Any, *, current: float = 1.0) -> ForwardModel:
    """Convert a mesh and a protocol of pyEIT to a forward model with point electrodes and the same order of channels.
    With the conductivity `mesh.perm`, the model yields the voltages of pyEIT's `EITForward.solve_eit`.

    **Arguments:**

    - `mesh`: a `pyeit.mesh.PyEITMesh`.
    - `protocol`: a `pyeit.eit.protocol.PyEITProtocol`.
    - `current`: amplitude of the drive current in amperes; pyEIT uses 1 A.

    Raises `ValueError` for objects without the fields of these classes, and for an invalid mesh (see `Mesh.create`).

    **Example:**

    ```python
    import pyeit.mesh as shapes  # with pyeit
    from pyeit.eit.protocol import create
    model = from_pyeit(shapes.create(16), create(16))
    ```
    """
    fields = {"mesh": (mesh, ("node", "element", "el_pos")), "protocol": (protocol, ("ex_mat", "meas_mat"))}
    for name, (instance, attributes) in fields.items():
        missing_attributes = [attribute for attribute in attributes if not hasattr(instance, attribute)]
        if missing_attributes:
            raise ValueError(
                f"{name} has no {missing_attributes[0]}; give the {name} that pyEIT made, such as of its `create`."
            )
    points, electrode_nodes = np.asarray(mesh.node, float), np.asarray(mesh.el_pos, int)
    cells = np.asarray(mesh.element, int)
    points = points[:, : cells.shape[1] - 1]  # in pyEIT, the nodes of two-dimensional meshes have a coordinate z = 0
    drive = current * pair_patterns(np.asarray(protocol.ex_mat, int), len(electrode_nodes))
    pairs = [np.asarray(drive_pairs, int)[:, :2] for drive_pairs in protocol.meas_mat]
    measurement = pair_patterns(np.concatenate(pairs), len(electrode_nodes))
    drive_index = np.repeat(np.arange(len(pairs)), [len(drive_pairs) for drive_pairs in pairs])
    jeit_protocol = from_channels(drive, measurement, drive_index, name="pyEIT's protocol")
    return ForwardModel(Mesh.create(points, cells), NodeElectrodes(electrode_nodes), jeit_protocol)


def from_eidors(path: str | Path, variable: str | None = None) -> ForwardModel:
    """Read a forward model of EIDORS, saved by `save('tank.mat', 'fwd_model', '-v7')`: nodes, elements, electrodes with
    their contact impedances, and stimulation and measurement patterns with their signs.

    If all electrodes consist of one node, they become point electrodes. SciPy reads the file, so read only files from
    people you trust. Lengths in the file must be in metres.

    **Arguments:**

    - `path`: the .mat file.
    - `variable`: name of the variable that is a `fwd_model`, or a model or image that contains one; needed only if the
      file has several such variables.

    Raises `ValueError` for a file without a forward model, and for electrodes that consist of no boundary facets.

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
        variables = scipy.io.loadmat(str(file), simplify_cells=True, spmatrix=False)
    models = {name: model for name, value in variables.items() if (model := _forward_model(value)) is not None}
    if variable is None and len(models) != 1:
        problem = (
            f"has the models {names_text(sorted(models))}; name one" if models else "has no model; save a fwd_model"
        )
        raise ValueError(f"variable: {file.name} {problem}.")
    name = next(iter(models)) if variable is None else variable
    if name not in models:
        raise ValueError(f"variable: {file.name} has no model {name!r}; it has {names_text(sorted(models)) or 'none'}.")
    fwd_model = models[name]
    mesh = Mesh.create(np.asarray(fwd_model["nodes"], float), np.asarray(fwd_model["elems"], int) - 1)
    electrode_tables = (
        [fwd_model["electrode"]] if isinstance(fwd_model["electrode"], dict) else list(fwd_model["electrode"])
    )
    electrode_nodes = [np.atleast_1d(np.asarray(table["nodes"], int)) - 1 for table in electrode_tables]
    if all(len(node_list) == 1 for node_list in electrode_nodes):
        electrodes: AbstractElectrodes = NodeElectrodes(np.concatenate(electrode_nodes))
    else:
        electrodes = electrodes_from_nodes(
            mesh, electrode_nodes, np.array([float(table["z_contact"]) for table in electrode_tables])
        )
    stimulation = fwd_model["stimulation"]
    stimulations = [stimulation] if isinstance(stimulation, dict) else list(stimulation)
    drive = np.stack([_dense(entry["stim_pattern"]).ravel() for entry in stimulations])
    measurement_patterns = [_dense(entry["meas_pattern"]).reshape(-1, drive.shape[1]) for entry in stimulations]
    drive_index = np.repeat(np.arange(len(stimulations)), [len(rows) for rows in measurement_patterns])
    return ForwardModel(
        mesh,
        electrodes,
        from_channels(drive, np.concatenate(measurement_patterns), drive_index, name=f"of {file.stem}"),
    )


def _forward_model(value: Any) -> dict[str, Any] | None:
    """Return the EIDORS forward model (`fwd_model`) that a variable is or contains; None if there is none."""
    if not isinstance(value, dict):
        return None
    if {"nodes", "elems", "electrode", "stimulation"} <= value.keys():
        return value
    return _forward_model(value.get("fwd_model"))


def _dense(matrix: Any) -> np.ndarray:
    return np.asarray(matrix.toarray() if hasattr(matrix, "toarray") else matrix, float)
