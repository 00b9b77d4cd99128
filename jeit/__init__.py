"""jeit: differentiable electrical impedance tomography in JAX."""

import os

import jax

# A light touch changes voltages by 1e-4: single precision is not enough. A user who has set
# JAX_ENABLE_X64 has decided already.
if "JAX_ENABLE_X64" not in os.environ:
    jax.config.update("jax_enable_x64", True)
