"""Double precision, as far as the user has not decided."""

from __future__ import annotations

import os
import warnings

import jax


def take_double_precision() -> None:
    """A light touch changes voltages by 1e-4, for which single precision is not enough. A user who has set
    JAX_ENABLE_X64 has decided already, and is warned of what single precision costs (docs/numerics.md)."""
    if "JAX_ENABLE_X64" not in os.environ:
        jax.config.update("jax_enable_x64", True)
    elif not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        warnings.warn(
            f"JAX_ENABLE_X64={os.environ['JAX_ENABLE_X64'][:20]}: jeit computes in single precision, where voltages "
            "are wrong by 1e-5 of the largest (1e-14 in double precision), a tenth of what a light touch changes, and "
            "contacts and conductivities must not differ by more than some thousand times; unset it for double "
            "precision.",
            UserWarning,
            stacklevel=3,
        )
