"""Random keys."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeit.arguments.kinds import told


def check_key(key: Any, name: str = "key") -> None:
    """Raise `ValueError`, about the argument `name`, for what is no single key of JAX, of the new kind or the old."""
    if isinstance(key, (jax.Array, np.ndarray)):
        new = jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0
        if new or (key.dtype == np.uint32 and key.ndim == 1):
            return
    seed = key if isinstance(key, int) and not isinstance(key, bool) else 0
    raise ValueError(f"{name} must be one random key, such as jax.random.key({seed}); it is {told(key)}.")
