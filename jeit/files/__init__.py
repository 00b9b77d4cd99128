"""Files from anywhere: what is read, within limits and as plain numbers and text; what is written, whole or not at all.

Nothing that a file holds is executed, and nothing in it decides how much memory is taken before its size has been
looked at: see `jeit/files/limits.py` for how much, and how to allow more.
"""

from __future__ import annotations

from jeit.files.foreign import read_as, reason
from jeit.files.limits import MOST_ELECTRODES, check_electrodes, check_memory
from jeit.files.npz_file import check_archive, need, npy_array, npz_arrays
from jeit.files.text import check_size, parsed_toml, read_json, read_text, read_toml
from jeit.files.whole import clear_unfinished, whole_files, written_whole

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
