"""The store of a study: its points and their results in the Zarr format.

A `Store` contains the results of a study, or of a different computation in chunks, on disk. Each chunk has separate
files. A single file lists the finished chunks with their checksums, and is replaced as a whole after the files of a
chunk are written; a chunk that is not in the list counts as unfinished.

The metadata of a store are checked as plain JSON before Zarr opens the store. Zarr looks up codecs by the names in a
file, and the codec pickle executes code from the file. A store is therefore opened only if it has the form that jeit
writes: Zarr format 3, the expected arrays and no others, only numbers and text, codecs that only encode or compress
bytes, and no links to other paths.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import math
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from jeit.arguments import check_kind
from jeit.arguments.extras import import_optional
from jeit.design.study.contents import Contents, study_contents
from jeit.design.study.lock import lock_store
from jeit.design.study.spec import Study

# Codecs allowed in a store, which only encode or compress bytes. Sharding is excluded, since it contains further
# codecs.
CODECS = frozenset({"blosc", "bytes", "crc32c", "transpose", "vlen-utf8", "zstd"})
# Maximum unpacked size of a chunk of text, and maximum overhead of a chunk of numbers, bytes.
_MAX_TEXT_CHUNK, _MAX_CHUNK_OVERHEAD = 2**24, 2**12

_NUMBER_TYPES = tuple(f"{kind}{bits}" for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64))
_ALLOWED_TYPES = frozenset({"bool", "string", *_NUMBER_TYPES})
_FORMAT_2_FILES = (".zarray", ".zattrs", ".zgroup", ".zmetadata")
_METADATA_FILE = "zarr.json"
_UNREADABLE_METADATA = f"has a {_METADATA_FILE} that is no JSON object, or nested too deep"


class ArrayShape(NamedTuple):
    """Size of an array of a store: number of values along each axis, in total and per chunk, and Zarr's name of the
    data type."""

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    data_type: str


def find_unsafe_content(path: Path) -> str | None:
    """Reason why a store must not be opened; None if nothing in the store can run code or link to other paths. Raises
    `OSError` for files that cannot be read."""
    for parent, subfolder_names, file_names in os.walk(path):
        for name in [*subfolder_names, *file_names]:
            entry_path = Path(parent, name)
            if entry_path.is_symlink():
                return f"'{entry_path.relative_to(path)}' is a link to another place"
            if name in _FORMAT_2_FILES:
                return f"'{entry_path.relative_to(path)}' is of Zarr's format 2, which jeit does not write"
    for file in path.rglob(_METADATA_FILE):
        metadata = _read_json_object(file)  # a file that Zarr cannot read is damaged, but not dangerous
        for location, node in [] if metadata is None else _metadata_nodes(metadata, str(file.relative_to(path))):
            danger = _find_node_danger(node)
            if danger:
                return f"{location} {danger}"
    return None


def find_damage(path: Path, expected_arrays: Mapping[str, ArrayShape]) -> str | None:
    """Describe the first difference between a store and a store with the arrays `expected_arrays` (by name); None if
    there is no difference. Raises `OSError` for files that cannot be read."""
    metadata = _read_json_object(path / _METADATA_FILE)
    if metadata is None:
        return _UNREADABLE_METADATA
    array_names = {folder.name for folder in path.iterdir() if folder.is_dir()}
    if array_names != set(expected_arrays):
        return f"its arrays are not those of its contents: {_short_text(array_names ^ set(expected_arrays))}"
    if metadata.get("zarr_format") != 3 or metadata.get("node_type") != "group":
        return "it is no group of Zarr's format 3"
    group_metadata = metadata.get("consolidated_metadata")
    consolidated_nodes = group_metadata.get("metadata") if isinstance(group_metadata, dict) else None
    if not isinstance(consolidated_nodes, dict) or set(consolidated_nodes) != set(expected_arrays):
        return "it does not name the arrays of its contents"
    for name, array in expected_arrays.items():
        if [*(path / name).rglob(_METADATA_FILE)] != [path / name / _METADATA_FILE]:
            return f"array '{name}' has not one {_METADATA_FILE}"
        array_node = _read_json_object(path / name / _METADATA_FILE)
        damage = (
            _UNREADABLE_METADATA
            if array_node is None
            else _find_node_damage(consolidated_nodes[name], array) or _find_node_damage(array_node, array)
        )
        damage = damage or _chunk_damage(path / name, array)
        if damage:
            return f"array '{name}' {damage}"
    return None


def _chunk_damage(folder: Path, array: ArrayShape) -> str | None:
    """Description of the first chunk whose unpacked size is unknown or larger than a chunk of the array can be; None
    without such a chunk."""
    max_bytes = _MAX_TEXT_CHUNK if array.data_type == "string" else 8 * math.prod(array.chunks) + _MAX_CHUNK_OVERHEAD
    for file in folder.rglob("*"):
        if file.is_file() and file.name != _METADATA_FILE:
            with file.open("rb") as chunk_file:
                num_bytes = _unpacked_size(chunk_file.read(18), file.stat().st_size)
            if num_bytes is None or num_bytes > max_bytes:
                return (
                    f"has a chunk, '{file.relative_to(folder)}', of {num_bytes or 'unknown'} bytes, more than "
                    f"{max_bytes}"
                )
    return None


def _unpacked_size(first_bytes: bytes, packed_size: int) -> int | None:
    """Unpacked size in bytes of a chunk, from its `first_bytes` and its `packed_size` on disk: as stated in a zstd
    frame (RFC 8878) or a blosc header, otherwise `packed_size` itself. None if a frame does not state its size."""
    if first_bytes.startswith(b"\x28\xb5\x2f\xfd") and len(first_bytes) > 5:
        frame_descriptor = first_bytes[4]
        is_single_segment = frame_descriptor >> 5 & 1
        size_field_start = 5 + (1 - is_single_segment) + (0, 1, 2, 4)[frame_descriptor & 3]
        num_size_bytes = (is_single_segment, 2, 4, 8)[frame_descriptor >> 6]
        content_size = int.from_bytes(first_bytes[size_field_start : size_field_start + num_size_bytes], "little")
        return content_size + (256 if num_size_bytes == 2 else 0) if num_size_bytes else None
    if first_bytes[:1] == b"\x02" and len(first_bytes) >= 16:
        return max(packed_size, int.from_bytes(first_bytes[4:8], "little"))
    return packed_size


def _metadata_nodes(metadata: Any, location: str) -> Iterator[tuple[str, Any]]:
    """Yield the location and the metadata of every group and array that `metadata` describes, including consolidated
    metadata at any depth."""
    yield f"'{location}'", metadata
    group_metadata = metadata.get("consolidated_metadata") if isinstance(metadata, dict) else None
    nested_nodes = group_metadata.get("metadata") if isinstance(group_metadata, dict) else None
    for name, nested_node in (nested_nodes if isinstance(nested_nodes, dict) else {}).items():
        yield from _metadata_nodes(nested_node, f"{location}: {name}")


def _find_node_danger(node: Any) -> str | None:
    if not isinstance(node, dict):
        return "describes neither a group nor an array"
    if any(name in node for name in ("dtype", "filters", "compressor")) or node.get("zarr_format") == 2:
        return "is of Zarr's format 2, which jeit does not write"
    if node.get("storage_transformers"):
        return "asks for storage transformers"
    data_type = node.get("data_type")
    if "data_type" in node and not (isinstance(data_type, str) and data_type in _ALLOWED_TYPES):
        return f"holds neither numbers nor text but {_short_text([data_type])}"
    codecs = node.get("codecs", [])
    codec_names = [codec.get("name") if isinstance(codec, dict) else codec for codec in _as_list(codecs)]
    unknown_codecs = [name for name in codec_names if not (isinstance(name, str) and name in CODECS)]
    return (
        f"asks for {_short_text(unknown_codecs)}, and not only for codecs that pack bytes" if unknown_codecs else None
    )


def _find_node_damage(node: Any, array_shape: ArrayShape) -> str | None:
    grid = node.get("chunk_grid")
    configuration = grid.get("configuration") if isinstance(grid, dict) and grid.get("name") == "regular" else None
    chunks = configuration.get("chunk_shape") if isinstance(configuration, dict) else None
    if node.get("zarr_format") != 3 or node.get("node_type") != "array":
        return "is no array of Zarr's format 3"
    if node.get("shape") != [*array_shape.shape] or chunks != [*array_shape.chunks]:
        return f"is {node.get('shape')} in chunks of {chunks}, not {[*array_shape.shape]} in {[*array_shape.chunks]}"
    if node.get("data_type") != array_shape.data_type:
        return f"is of {node.get('data_type')}, not {array_shape.data_type}"
    return None


def _read_json_object(file: Path) -> dict[str, Any] | None:
    """Read the JSON object in a file; None without a JSON object. Raises `OSError` if the file cannot be read."""
    try:
        json_value = json.loads(file.read_bytes())
    except (ValueError, RecursionError):
        return None
    return json_value if isinstance(json_value, dict) else None


def _as_list(values: Any) -> list[Any]:
    return values if isinstance(values, list) else [values]


def _short_text(values: Any) -> str:
    """Format up to three names from an untrusted file as a short text on one line."""
    return ", ".join(ascii(value)[:60] for value in [*values][:3])


_RECORDED_PACKAGES = ("jeit", "jax", "numpy", "scipy")
_EXTRA_PURPOSE = "a store of results"
_PATH_DESCRIPTION = "that of the store, such as 'results.zarr'"


class DifferentContentsError(ValueError):
    """Raised if the contents of a store differ from the requested study or work."""


class Store:
    """The store of results of a study, or of other `Contents`, at `path`.

    With `create`, the store is opened for writing, and created empty if it does not exist. Without `create`, the store
    is opened for reading only. Use `writing` to write a store.
    """

    def __init__(self, work: Study | Contents, path: str | Path, *, create: bool = True):
        """Raises `FileNotFoundError` if there is no store and `create` is False. Raises `ValueError` if the path is not
        a store or is the store of a different study, if the store is damaged, or if opening the store might run code.
        Raises `ImportError` without the extra `cluster`, and `OSError` if the store cannot be written."""
        zarr = import_optional("zarr", _EXTRA_PURPOSE)
        self.contents = work if isinstance(work, Contents) else study_contents(work)
        check_kind("path", path, (str, os.PathLike), _PATH_DESCRIPTION)
        self.path, kind = Path(path), self.contents.kind
        if not self.path.exists():
            if not create:
                raise FileNotFoundError(f"path: there is no {kind} at {self.path}; run it first.")
            try:
                _create_store(zarr, self.contents, self.path)
            except OSError as error:
                raise OSError(
                    error.errno, f"the {kind}'s store cannot be made ({error.strerror})", str(path)
                ) from error
        attributes = self._read_attributes()
        if not attributes:
            raise ValueError(
                f"{self.path} holds no {kind}: name the store that {self.contents.made_by} wrote, or, for a new one, a "
                "place where nothing is."
            )
        if attributes.get("fingerprint") != self.contents.fingerprint:
            raise DifferentContentsError(
                f"{self.path} holds the results of another {kind}, or of this one before it was changed; move it away "
                "or choose another path."
            )
        self._check_metadata(_store_shapes(zarr, self.contents))
        try:
            self._zarr = zarr.open_group(str(self.path), mode="r+" if create else "r", zarr_format=3)
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise self._damage_error(error) from None

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the packages that created the store, by the packages' names."""
        return self._read_attributes()["versions"]

    def finished_checksums(self) -> dict[int, str]:
        """Checksum of every finished chunk, by the chunk's number."""
        return {int(number): checksum for number, checksum in self._read_attributes()["finished"].items()}

    def intact_chunks(self) -> list[int]:
        """Numbers of the finished chunks whose results match their checksums."""
        return [number for number, checksum in self.finished_checksums().items() if self._checksum(number) == checksum]

    def write(self, number: int, results: Mapping[str, np.ndarray]) -> None:
        """Write the results of chunk `number`, then mark the chunk as finished. Raises `OSError` if the results cannot
        be written; the chunk then counts as unfinished."""
        try:
            for name, values in results.items():
                self.write_array(name, self.contents.chunks[number], values)
            self._mark_finished(number, _checksum(results))
        except OSError as error:
            progress_text = (
                f"{len(self.finished_checksums())} of {len(self.contents.chunks)} chunks are finished and kept"
            )
            raise OSError(
                error.errno,
                f"{error.strerror}: a chunk could not be written; {progress_text}. Mend that, then resume the "
                f"{self.contents.kind}",
                str(self.path),
            ) from error

    def write_array(self, name: str, points: Sequence[int], values: np.ndarray) -> None:
        """Write `values` (k, …) of the array `name` for the k `points`."""
        array, first_row = self._zarr[name], 0
        for rows in _consecutive_runs(points):
            last_row = first_row + rows.stop - rows.start
            array[rows] = values[first_row:last_row]  # pyright: ignore[reportIndexIssue]
            first_row = last_row

    def _mark_finished(self, number: int, checksum: str) -> None:
        metadata = _read_json(self.path)
        finished_checksums = metadata["attributes"]["finished"] | {str(number): checksum}
        metadata["attributes"]["finished"] = dict(sorted(finished_checksums.items(), key=lambda entry: int(entry[0])))
        # The temporary file is beside the store, since Zarr would not recognise a file left behind inside the store.
        temporary_path = self.path.with_name(f".{self.path.name}.{os.getpid()}.tmp")
        try:
            with open(temporary_path, "w", encoding="utf-8") as temporary_file:
                json.dump(metadata, temporary_file, indent=1, ensure_ascii=False)
                temporary_file.flush()
                os.fsync(temporary_file.fileno())
            os.replace(temporary_path, self.path / "zarr.json")
        finally:
            temporary_path.unlink(missing_ok=True)

    def _checksum(self, number: int) -> str | None:
        slices = _consecutive_runs(self.contents.chunks[number])
        try:
            return _checksum(
                {name: np.concatenate([self._zarr[name][rows] for rows in slices]) for name in self.contents.arrays}
            )  # pyright: ignore
        except (OSError, ValueError, RuntimeError):
            return None  # a file of the chunk cannot be decoded

    def open_dataset(self):
        """Open the whole store as an `xarray.Dataset`, whose values are read from disk when they are needed."""
        return import_optional("xarray", _EXTRA_PURPOSE).open_zarr(str(self.path), chunks=None, zarr_format=3)

    def _check_metadata(self, expected_arrays: Mapping[str, ArrayShape]) -> None:
        """Check the metadata before Zarr opens the store. Raises `ValueError` if the store is dangerous or damaged."""
        try:
            danger_text = find_unsafe_content(self.path)
            damage_text = None if danger_text else find_damage(self.path, expected_arrays)
        except OSError as error:
            raise self._damage_error(error) from None
        if danger_text:
            raise ValueError(
                f"{self.path} is not opened, because it might run code or write elsewhere: {danger_text}. No "
                f"{self.contents.kind} that jeit wrote is like that. Delete it if it came from somebody else, and run "
                f"the {self.contents.kind} yourself, to another place."
            )
        if damage_text:
            raise self._damage_error(damage_text)

    def _read_attributes(self) -> dict:
        """Read the attributes of the store; empty if the path is not a store. Raises `ValueError` if the attributes
        cannot be read.
        """
        try:
            metadata = _read_json(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except (OSError, ValueError) as error:
            raise self._damage_error(error) from None
        attributes = metadata.get("attributes") if isinstance(metadata, dict) else None
        if not isinstance(attributes, dict) or "finished" not in attributes:
            return {}
        if not all(isinstance(attributes.get(name), dict) for name in ("finished", "versions")):
            raise self._damage_error("what it says of finished chunks makes no sense")
        return attributes

    def _damage_error(self, damage: object) -> ValueError:
        reason_text = " ".join(str(damage).split()).rstrip(".")
        return ValueError(
            f"{self.path / 'zarr.json'} cannot be read ({reason_text}): the store is damaged, and does not say what is "
            f"finished. Put that file back from a copy; or move the store away and run the {self.contents.kind} again."
        )


@contextlib.contextmanager
def writing(work: Study | Contents, path: str | Path) -> Iterator[Store]:
    """Context with the store of `work` at `path`, which no other process can write. The store is created empty if it
    does not exist.

    Temporary files of killed runs are removed. Raises the errors of `Store`, and `ValueError` if another process writes
    the store.
    """
    check_kind("path", path, (str, os.PathLike), _PATH_DESCRIPTION)
    contents = work if isinstance(work, Contents) else study_contents(work)
    path = Path(path)
    with lock_store(path, contents.kind):
        _remove_temporary_stores(path)
        store = Store(contents, path)
        for partial_file in path.rglob("*.partial"):  # temporary files of Zarr
            partial_file.unlink(missing_ok=True)
        yield store


def open_results(study: Study, path: str | Path):
    """Open the results of a study as an `xarray.Dataset` with dimensions "point" and "place"; the values of unfinished
    points are NaN.

    `xarray.open_zarr(path)` opens the same store, but detects neither half-written chunks of an interrupted run nor
    code that a store from another source may execute.

    **Arguments:**

    - `study`: the study.
    - `path`: path of the Zarr store.

    Raises the errors of `Store`.

    **Example:**

    ```python
    run_study(study, "study.zarr")  # with zarr
    results = open_results(study, "study.zarr")
    ```
    """
    xarray = import_optional("xarray", _EXTRA_PURPOSE)
    store = Store(study, path, create=False)
    is_finished = np.zeros(len(study.points), bool)
    for number in store.intact_chunks():
        is_finished[list(study.chunks[number])] = True
    result_arrays = {}
    with store.open_dataset() as dataset:
        for name, stored_array in dataset.data_vars.items():
            values = np.full(stored_array.shape, np.nan)
            values[is_finished] = stored_array[np.flatnonzero(is_finished)]
            result_arrays[name] = (stored_array.dims, values, stored_array.attrs)
        coordinates = {name: coordinate.load() for name, coordinate in dataset.coords.items()}
        return xarray.Dataset(result_arrays, {**coordinates, "finished": ("point", is_finished)}, dataset.attrs)


def _store_shapes(zarr: ModuleType, contents: Contents) -> dict[str, ArrayShape]:
    """Sizes of the arrays of `contents`, by name, determined from a store in memory that has no values."""
    zarr_group = zarr.open_group(zarr.storage.MemoryStore(), mode="w", zarr_format=3)
    contents.fill(zarr_group)
    return {
        name: ArrayShape(array.shape, array.chunks, array.metadata.to_dict()["data_type"])
        for name, array in zarr_group.arrays()
    }


def _consecutive_runs(points: Sequence[int]) -> list[slice]:
    """Group numbers of points into slices of consecutive numbers."""
    point_numbers = np.asarray(points)
    end_indices = np.flatnonzero(np.diff(point_numbers) != 1) + 1
    return [slice(int(run[0]), int(run[-1]) + 1) for run in np.split(point_numbers, end_indices)]


def _create_store(zarr: ModuleType, contents: Contents, path: Path) -> None:
    """Create the store atomically: it is written under a temporary name, and then renamed."""
    temporary_path = path.with_name(f".{path.name}.{os.getpid()}.new")
    shutil.rmtree(temporary_path, ignore_errors=True)
    attributes = {
        **contents.attributes,
        "fingerprint": contents.fingerprint,
        "finished": {},
        "versions": {name: metadata.version(name) for name in _RECORDED_PACKAGES},
    }
    try:
        zarr_group = zarr.open_group(
            str(temporary_path), mode="w", zarr_format=3, attributes=dict(sorted(attributes.items()))
        )
        contents.fill(zarr_group)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
            zarr.consolidate_metadata(str(temporary_path))
        os.rename(temporary_path, path)
    finally:
        shutil.rmtree(temporary_path, ignore_errors=True)


def _remove_temporary_stores(path: Path) -> None:
    """Remove temporary files beside the store that killed runs have left."""
    for temporary_path in path.parent.glob(f".{glob.escape(path.name)}.*"):
        process_id, _, suffix = temporary_path.name.removeprefix(f".{path.name}.").partition(".")
        if process_id.isdecimal() and suffix == "new":
            shutil.rmtree(temporary_path, ignore_errors=True)
        elif process_id.isdecimal() and suffix == "tmp":
            temporary_path.unlink(missing_ok=True)


def _checksum(results: Mapping[str, np.ndarray]) -> str:
    results_hash = hashlib.sha256()
    for name in sorted(results):
        results_hash.update(name.encode() + np.ascontiguousarray(results[name], dtype=float).tobytes())
    return results_hash.hexdigest()


def _read_json(path: Path) -> dict:
    try:
        return json.loads((path / "zarr.json").read_bytes())
    except RecursionError:
        raise ValueError("it is nested too deep") from None
