from .limits import (
    MOST_ELECTRODES,
    check_electrodes,
    check_memory,
    check_size,
    parsed_toml,
    read_as,
    read_json,
    read_text,
    read_toml,
    reason,
)
from .npz_file import check_archive, need, npy_array, npz_arrays
from .whole import clear_unfinished, whole_files, written_whole

__all__ = [
    "MOST_ELECTRODES",
    "check_archive",
    "check_electrodes",
    "check_memory",
    "check_size",
    "clear_unfinished",
    "need",
    "npy_array",
    "npz_arrays",
    "parsed_toml",
    "read_as",
    "read_json",
    "read_text",
    "read_toml",
    "reason",
    "whole_files",
    "written_whole",
]
