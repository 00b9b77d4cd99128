"""Double precision, as far as the user has not decided."""

import os

import jax


def take_double_precision() -> None:
    """A light touch changes voltages by 1e-4, for which single precision is not enough. A user who has set
    JAX_ENABLE_X64 has decided already."""
    if "JAX_ENABLE_X64" not in os.environ:
        jax.config.update("jax_enable_x64", True)
