"""Set-up of JAX on importing jeit: double precision, a cache of compiled code, compiler flags, and errors in forked
processes."""

from __future__ import annotations

from jeit.start.jax_setup import (
    discard_damaged_cache_files,
    keep_compiled_code,
    quick_compilation,
    refuse_compiled_code_in_forks,
    take_double_precision,
)

__all__ = [
    "discard_damaged_cache_files",
    "keep_compiled_code",
    "quick_compilation",
    "refuse_compiled_code_in_forks",
    "take_double_precision",
]
