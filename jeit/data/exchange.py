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
    toml_lines = [f"title = {_toml_text(measurement.name)}"]
    if measurement.domain is not None:
        toml_lines += ["", "[geometry]", *assignments(_geometry_section(measurement.domain))]
    if measurement.electrodes is not None:
        toml_lines += ["", "[electrodes]", *assignments(_electrodes_section(measurement.electrodes))]
    protocol = measurement.protocol
    toml_lines += ["", "[protocol]", *assignments(_protocol_section(protocol))]
    if (measurement_uncertainty := measurement.uncertainty) is not None:
        relative_errors = {
            "contact_drift": measurement_uncertainty.drift,
            "size": measurement_uncertainty.size,
            "other": measurement_uncertainty.other,
        }
        uncertainty_section = (
            {} if measurement_uncertainty.position is None else {"position": measurement_uncertainty.position}
        )
        uncertainty_section |= {
            f"{name}_percent": 100 * relative_error for name, relative_error in relative_errors.items()
        }
        toml_lines += ["", "[uncertainty]", *assignments(uncertainty_section)]
    voltage_component = "complex" if np.iscomplexobj(measurement.voltages) else "real"
    toml_lines += [
        "",
        "[data]",
        *assignments({"frames_in": "rows", "component": voltage_component, "polarity": "normal"}),
    ]
    stored_arrays: dict[str, Any] = {
        array_name: np.asarray(getattr(protocol, array_name)) for array_name in PROTOCOL_ARRAYS
    }
    if measurement.times is not None:
        stored_arrays["times"] = np.asarray(measurement.times)
    description_path = data_path.with_suffix(".toml")
    with atomically_written_files(data_path.parent) as temporary_folder:
        np.savez_compressed(
            temporary_folder / data_path.name,
            voltages=np.asarray(measurement.voltages),
            mask=np.asarray(measurement.mask),
            frame_names=np.array(measurement.frame_names, str),
            notes=np.array(measurement.notes, str),
            protocol_name=np.asarray(protocol.name),
            **stored_arrays,
        )
        (temporary_folder / description_path.name).write_text("\n".join(toml_lines) + "\n", "utf-8")
    return data_path, description_path


def _geometry_section(domain: Body) -> dict:
    geometry_section = domain.describe()
    if geometry_section["shape"] not in OUTLINES:
        raise ValueError(
            f"write_table: a description cannot say {type(domain).__name__}; it knows {', '.join(OUTLINES)} and solids "
            "above them. Set domain to None; save a mesh with jeit.mesh.write, and name it in [geometry] mesh."
        )
    return geometry_section


def _electrodes_section(electrodes: AbstractElectrodes) -> dict:
    electrode_kind = next(
        (name for name, electrode_classes in ELECTRODES.items() if type(electrodes) in electrode_classes.values()), None
    )
    electrode_geometry = (
        {name: np.asarray(geometry_values).tolist() for name, geometry_values in electrodes.geometry().items()}
        if electrode_kind
        else {}
    )
    electrode_positions = electrode_geometry.pop("position", None)
    if electrode_positions is None:
        raise ValueError(
            f"write_table: a description cannot say {type(electrodes).__name__}; it knows {', '.join(ELECTRODES)}. Set "
            "electrodes to None, or save the model instead."
        )
    electrode_section = {"kind": electrode_kind, **electrode_geometry, "positions": electrode_positions}
    if electrodes.is_point:
        return electrode_section
    return {**electrode_section, "contact_impedance": np.asarray(electrodes.contact_impedance).tolist()}


def _protocol_section(protocol: Protocol) -> dict:
    protocol_arrays = {name: np.asarray(getattr(protocol, name)).tolist() for name in PROTOCOL_ARRAYS}
    return {"kind": "channels", "name": protocol.name, **protocol_arrays}


def assignments(section: dict[str, Any]) -> list[str]:
    """Lines of a TOML table, one for each key; values are text, booleans, numbers and nested lists."""
    return [f"{table_key} = {_toml_text(table_value)}" for table_key, table_value in section.items()]


def _toml_text(toml_value) -> str:
    """TOML text of a string, a number or a nested list, in the form of JSON; floats are written with all digits
    (`repr`)."""
    return json.dumps(toml_value, ensure_ascii=False)


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
    required_attributes = {
        "mesh": (mesh, ("node", "element", "el_pos")),
        "protocol": (protocol, ("ex_mat", "meas_mat")),
    }
    for name, (given_object, attribute_names) in required_attributes.items():
        missing_attributes = [
            attribute_name for attribute_name in attribute_names if not hasattr(given_object, attribute_name)
        ]
        if missing_attributes:
            raise ValueError(
                f"{name} has no {missing_attributes[0]}; give the {name} that pyEIT made, such as of its `create`."
            )
    points, electrode_nodes = np.asarray(mesh.node, float), np.asarray(mesh.el_pos, int)
    cells = np.asarray(mesh.element, int)
    points = points[:, : cells.shape[1] - 1]  # in pyEIT, the nodes of two-dimensional meshes have a coordinate z = 0
    drive_currents = current * pair_patterns(np.asarray(protocol.ex_mat, int), len(electrode_nodes))
    measurement_pairs = [np.asarray(drive_pairs, int)[:, :2] for drive_pairs in protocol.meas_mat]
    measurement = pair_patterns(np.concatenate(measurement_pairs), len(electrode_nodes))
    drive_index = np.repeat(np.arange(len(measurement_pairs)), [len(drive_pairs) for drive_pairs in measurement_pairs])
    jeit_protocol = from_channels(drive_currents, measurement, drive_index, name="pyEIT's protocol")
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
        file_variables = scipy.io.loadmat(str(file), simplify_cells=True, spmatrix=False)
    forward_models = {
        name: model
        for name, variable_value in file_variables.items()
        if (model := _forward_model(variable_value)) is not None
    }
    if variable is None and len(forward_models) != 1:
        problem_text = (
            f"has the models {names_text(sorted(forward_models))}; name one"
            if forward_models
            else "has no model; save a fwd_model"
        )
        raise ValueError(f"variable: {file.name} {problem_text}.")
    name = next(iter(forward_models)) if variable is None else variable
    if name not in forward_models:
        raise ValueError(
            f"variable: {file.name} has no model {name!r}; it has {names_text(sorted(forward_models)) or 'none'}."
        )
    fwd_model = forward_models[name]
    mesh = Mesh.create(np.asarray(fwd_model["nodes"], float), np.asarray(fwd_model["elems"], int) - 1)
    electrode_tables = (
        [fwd_model["electrode"]] if isinstance(fwd_model["electrode"], dict) else list(fwd_model["electrode"])
    )
    electrode_nodes = [
        np.atleast_1d(np.asarray(electrode_table["nodes"], int)) - 1 for electrode_table in electrode_tables
    ]
    if all(len(node_list) == 1 for node_list in electrode_nodes):
        electrodes: AbstractElectrodes = NodeElectrodes(np.concatenate(electrode_nodes))
    else:
        electrodes = electrodes_from_nodes(
            mesh,
            electrode_nodes,
            np.array([float(electrode_table["z_contact"]) for electrode_table in electrode_tables]),
        )
    stimulation_entries = fwd_model["stimulation"]
    stimulation_list = [stimulation_entries] if isinstance(stimulation_entries, dict) else list(stimulation_entries)
    drive_currents = np.stack(
        [_dense_matrix(stimulation_entry["stim_pattern"]).ravel() for stimulation_entry in stimulation_list]
    )
    measurement_patterns = [
        _dense_matrix(stimulation_entry["meas_pattern"]).reshape(-1, drive_currents.shape[1])
        for stimulation_entry in stimulation_list
    ]
    drive_index = np.repeat(
        np.arange(len(stimulation_list)), [len(pattern_rows) for pattern_rows in measurement_patterns]
    )
    return ForwardModel(
        mesh,
        electrodes,
        from_channels(drive_currents, np.concatenate(measurement_patterns), drive_index, name=f"of {file.stem}"),
    )


def _forward_model(variable_value: Any) -> dict[str, Any] | None:
    """Return the EIDORS forward model (`fwd_model`) that a variable is or contains; None if there is none."""
    if not isinstance(variable_value, dict):
        return None
    if {"nodes", "elems", "electrode", "stimulation"} <= variable_value.keys():
        return variable_value
    return _forward_model(variable_value.get("fwd_model"))


def _dense_matrix(matrix: Any) -> np.ndarray:
    return np.asarray(matrix.toarray() if hasattr(matrix, "toarray") else matrix, float)
