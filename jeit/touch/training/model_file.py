"""Read and write files of trained networks, and checkpoint files of a network's training."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jeit.arguments import describe
from jeit.files import atomically_written_file, error_text
from jeit_solvers.engines import as_array

# First bytes of a model file; maximum size of its header, and of all its arrays together, bytes.
_FILE_SIGNATURE, _MAX_HEADER_SIZE, _MAX_ARRAY_SIZE = b"jeit model\n", 2**20, 2**31


def write_model(path: str | Path, kind: str, version: int, header: dict[str, Any], model: Any) -> None:
    """Write the arrays of a `model`, any tree of arrays, to a file; an earlier file is replaced only when the new file
    is complete.

    `kind` and `version`: type of the file, such as "a jeit network of images", which `read_model` checks; `header`: all
    other data that are needed to create the model again and to know the model's purpose, as JSON values. Raises
    `ValueError` if `path` is a folder, or the header or the model is too large; `OSError` if the file cannot be
    written.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"'{path}' is a folder; give a file, such as {path / 'network.jeit'}.")
    header_text = json.dumps({"kind": kind, "version": version, **header}, allow_nan=True).encode()
    if len(header_text) > _MAX_HEADER_SIZE:
        raise ValueError(
            f"header has {len(header_text)} bytes as JSON, more than {_MAX_HEADER_SIZE}; put arrays into the model."
        )
    model_arrays = [model_leaf for model_leaf in jax.tree.leaves(model) if eqx.is_array(model_leaf)]
    if _num_bytes(model_arrays) > _MAX_ARRAY_SIZE:
        raise ValueError(f"model has {_num_bytes(model_arrays)} bytes of arrays, and a file {_MAX_ARRAY_SIZE} at most.")
    with atomically_written_file(path) as file:
        file.write(_FILE_SIGNATURE + header_text + b"\n")
        for array in model_arrays:
            np.lib.format.write_array(file, np.asarray(array), allow_pickle=False)


def read_file_header(path: str | Path, kind: str, version: int) -> dict[str, Any]:
    """Read the header of a file that `write_model` wrote, but not its arrays.

    Raises `FileNotFoundError` if the file does not exist, and `ValueError` if the file is of another kind or version,
    or was not written by jeit.
    """
    with _open_file(Path(path), kind) as file:
        return _read_header(file, kind, version)


def read_model(
    path: str | Path, kind: str, version: int, make: Callable[[dict[str, Any]], Any]
) -> tuple[dict[str, Any], Any]:
    """Read the header and the model of a file that `write_model` wrote.

    `make`: function that returns a model of the architecture that a header describes; only the shapes of the model's
    arrays are evaluated, so that no header can cause large use of memory. Nothing in the file is executed: before an
    array is read, its shape and dtype must be those of the architecture. Raises `FileNotFoundError` if the file does
    not exist, and `ValueError` if the file is of another kind or version, is cut short or too long, or has arrays of a
    different architecture.
    """
    with _open_file(Path(path), kind) as file:
        header = _read_header(file, kind, version)
        try:
            model_structure = eqx.filter_eval_shape(make, header)
        except (KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
            raise ValueError(
                f"its header does not describe such a model ({type(error).__name__}: {error_text(error)})"
            ) from None
        described_arrays = [
            model_leaf
            for model_leaf in jax.tree.leaves(model_structure)
            if isinstance(model_leaf, jax.ShapeDtypeStruct)
        ]
        remaining_bytes = os.fstat(file.fileno()).st_size - file.tell()
        if not _num_bytes(described_arrays) <= min(remaining_bytes, _MAX_ARRAY_SIZE):
            raise ValueError(
                f"it has {remaining_bytes} bytes of arrays, fewer than the {_num_bytes(described_arrays)} that its "
                "header describes"
            )
        model = jax.tree.map(lambda model_leaf: _read_array(file, model_leaf), model_structure)
        if file.read(1):
            raise ValueError("it has more bytes after its last array")
    return header, model


def check_same(path: str | Path, actual_description: dict[str, Any], expected_description: dict[str, Any]) -> None:
    """Check that a model is used under the conditions of its training, such as for the same skin and protocol.

    `actual_description`, `expected_description`: descriptions of the skin and protocol in training and in use, as
    dictionaries of JSON values, in which numbers may differ by a millionth. Raises `ValueError`, which states the first
    difference.
    """
    for property_name in expected_description:
        if not _are_equal(actual_description.get(property_name), expected_description[property_name]):
            actual_text, expected_text = (
                _short_text(actual_description.get(property_name)),
                _short_text(expected_description[property_name]),
            )
            raise ValueError(
                f"'{path}' was trained for another skin or protocol: its {property_name} is {actual_text}, and here "
                f"it is {expected_text}; train one for this."
            )


@contextmanager
def _open_file(path: Path, kind: str) -> Iterator[BinaryIO]:
    """Open a model file for reading; any error is raised as `ValueError` with the name of the file."""
    if path.is_dir():
        raise ValueError(f"'{path}' is a folder; give a file, {kind}.")
    if not path.is_file():
        raise FileNotFoundError(f"'{path}': there is no such file.")
    try:
        with path.open("rb") as file:
            yield file
    except Exception as error:  # any exception: the model of the header is created before it can be checked
        raise ValueError(f"'{path}' is not {kind} that can be read: {error_text(error)}.") from None


def _read_header(file: BinaryIO, kind: str, version: int) -> dict[str, Any]:
    """Read the header of a model file. Raises `ValueError` if the file is of another kind or version."""
    if file.read(len(_FILE_SIGNATURE)) != _FILE_SIGNATURE:
        raise ValueError("it is a file of another kind")
    header_line = file.readline(_MAX_HEADER_SIZE + 1)
    if not header_line.endswith(b"\n"):
        raise ValueError("its header is truncated, or too long")
    try:
        header = json.loads(header_line)
    except (ValueError, RecursionError):
        raise ValueError("its header is not JSON") from None
    if not isinstance(header, dict) or header.get("kind") != kind:
        stored_kind = header.get("kind") if isinstance(header, dict) else header
        raise ValueError(f"it is {describe(stored_kind)}")
    if header.get("version") != version:
        raise ValueError(f"it is of version {describe(header.get('version'))}, and this jeit reads {version}")
    return header


def _num_bytes(sized_arrays) -> int:
    return sum(math.prod(sized_array.shape) * np.dtype(sized_array.dtype).itemsize for sized_array in sized_arrays)


def _read_array(file: BinaryIO, described_array: Any) -> Any:
    """Read an array with the shape and dtype of `described_array`; a leaf that is no array is returned unchanged."""
    if not isinstance(described_array, jax.ShapeDtypeStruct):
        return described_array
    array_version = np.lib.format.read_magic(file)
    if array_version != (1, 0):
        raise ValueError(f"one of its arrays is in format {array_version}")
    stored_shape, is_fortran_order, stored_dtype = np.lib.format.read_array_header_1_0(file)
    if (stored_shape, stored_dtype, is_fortran_order) != (
        described_array.shape,
        described_array.dtype,
        is_fortran_order and len(described_array.shape) > 1,
    ):
        raise ValueError(
            f"one of its arrays is {stored_dtype} of shape {stored_shape}, and its header says "
            f"{described_array.dtype} of {described_array.shape}"
        )
    array_bytes = file.read(_num_bytes([described_array]))
    if len(array_bytes) != _num_bytes([described_array]):
        raise ValueError("it is truncated")
    array_values = np.frombuffer(array_bytes, stored_dtype).reshape(
        stored_shape, order="F" if is_fortran_order else "C"
    )
    if np.isnan(array_values).any():
        raise ValueError("some of its numbers are NaN")
    return as_array(array_values)


def _are_equal(first_value: Any, second_value: Any) -> bool:
    if isinstance(first_value, list | tuple) and isinstance(second_value, list | tuple):
        return len(first_value) == len(second_value) and all(map(_are_equal, first_value, second_value))
    if isinstance(first_value, int | float) and isinstance(second_value, int | float):
        return math.isclose(first_value, second_value, rel_tol=1e-6, abs_tol=1e-12)
    return first_value == second_value


def _short_text(described_value: Any) -> str:
    value_text = "not given" if described_value is None else str(described_value)
    return value_text if len(value_text) <= 60 else f"{value_text[:59]}…"


_CHECKPOINT_KIND, _CHECKPOINT_VERSION = "a jeit training under way", 1


class Course(NamedTuple):
    """History of a network's training: losses at each evaluation of the held-out rows.

    `steps`: number of batches processed until each evaluation; `training`: mean loss of the batches since the last
    evaluation; `validation`: loss of the held-out rows.
    """

    steps: list[int]
    training: list[float]
    validation: list[float]

    @property
    def best(self) -> int:
        """Index of the evaluation with the lowest loss of the held-out rows; 0 if there was no evaluation."""
        return min(range(len(self.validation)), key=self.validation.__getitem__, default=0)


class TrainingState(NamedTuple):
    """The whole state of a network's training, from which the training can be resumed.

    `step`: number of batches processed; `course`: history of the losses; `arrays`: current arrays of the network,
    trained or not; `optimiser`: state of the optimiser; `best`: arrays of the network with the lowest loss of held-out
    rows so far; `total`: sum of the batch losses since the last evaluation.
    """

    step: int
    course: Course
    arrays: Any
    optimiser: Any
    best: Any
    total: Any


class Checkpoint:
    """A checkpoint file of one training, which is identified by its `fingerprint`."""

    def __init__(self, path: str | Path, fingerprint: dict[str, Any]):
        self.path, self.fingerprint = Path(path), fingerprint

    def write(self, state: TrainingState) -> None:
        """Write the state of the training; an earlier file is replaced only when the new file is complete."""
        header = {"training": self.fingerprint, "step": state.step, "course": list(state.course)}
        write_model(self.path, _CHECKPOINT_KIND, _CHECKPOINT_VERSION, header, state[2:])

    def read(self, initial_state: TrainingState) -> TrainingState:
        """Read the state of the training; without a file, return `initial_state`, the state before the first batch.

        Raises `ValueError`, which states the first difference, if the file belongs to a different training.
        """
        if not self.path.exists():
            return initial_state

        def make_state(header: dict[str, Any]) -> Any:
            for field_name, field_value in json.loads(json.dumps(self.fingerprint)).items():
                if header["training"].get(field_name) != field_value:
                    raise ValueError(
                        f"it is of another training ({field_name} was {header['training'].get(field_name)}, and is "
                        f"{field_value} now); delete it, or give another file"
                    )
            return jax.tree.map(lambda state_leaf: state_leaf, initial_state[2:])

        header, state_arrays = read_model(self.path, _CHECKPOINT_KIND, _CHECKPOINT_VERSION, make_state)
        return TrainingState(header["step"], Course(*header["course"]), *state_arrays)
