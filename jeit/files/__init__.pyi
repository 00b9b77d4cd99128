from .atomic_write import atomically_written_file, atomically_written_files, remove_unfinished_files
from .limits import (
    MAX_ELECTRODES,
    check_electrodes,
    check_memory,
    check_size,
    error_text,
    parsed_toml,
    read_as,
    read_json,
    read_text,
    read_toml,
)
from .npz_file import check_archive, npy_array, npz_arrays, npz_shapes, require_arrays

__all__ = [
    "MAX_ELECTRODES",
    "atomically_written_file",
    "atomically_written_files",
    "check_archive",
    "check_electrodes",
    "check_memory",
    "check_size",
    "error_text",
    "npy_array",
    "npz_arrays",
    "npz_shapes",
    "parsed_toml",
    "read_as",
    "read_json",
    "read_text",
    "read_toml",
    "remove_unfinished_files",
    "require_arrays",
]
