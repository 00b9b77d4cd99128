from .atomic_write import clear_unfinished, whole_files, written_whole
from .limits import (
    MOST_ELECTRODES,
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
    "MOST_ELECTRODES",
    "check_archive",
    "check_electrodes",
    "check_memory",
    "check_size",
    "clear_unfinished",
    "error_text",
    "npy_array",
    "npz_arrays",
    "npz_shapes",
    "parsed_toml",
    "read_as",
    "read_json",
    "read_text",
    "read_toml",
    "require_arrays",
    "whole_files",
    "written_whole",
]
