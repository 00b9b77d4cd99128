"""Set-up of JAX on importing jeit: double precision, a place where compiled code is kept between runs, flags of its
compiler, and what happens in forked processes."""

from __future__ import annotations

from jeit.start.jax_setup import (
    discarded_damaged,
    keep_compiled_code,
    quick_compilation,
    refuse_compiled_code_in_forks,
    take_double_precision,
)

__all__ = [
    "discarded_damaged",
    "keep_compiled_code",
    "quick_compilation",
    "refuse_compiled_code_in_forks",
    "take_double_precision",
]
