"""Arguments inside JAX's transformations, which have no values yet where values are needed."""

from __future__ import annotations

from typing import Any

from jeit_solvers.engines import has_values


def check_has_values(name: str, given: Any, use: str, instead: str) -> None:
    """Raise `ValueError`, about the argument `name`, for a pytree in which anything is traced by `jax.jit`, `jax.vmap`
    or a derivative; `use` says what its values are needed for, `instead` what to give or do."""
    if not has_values(given):
        raise ValueError(
            f"{name} is traced, inside jax.jit, jax.vmap or a derivative, and {use} its values: {instead}."
        )
