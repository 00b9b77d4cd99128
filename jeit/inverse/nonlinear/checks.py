"""Checks of the arguments of reconstructions, before anything is compiled: errors that say what to give."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import describe
from jeit.forward import ForwardModel
from jeit.forward.model import check_model
from jeit.inverse.channels import relative_noise
from jeit.inverse.linearisation import check_mask
from jeit_solvers.engines import has_values, host, namespace


def check_frame(model: ForwardModel, voltages, mask) -> tuple[Float[Array, " M"], np.ndarray]:
    """Voltages as an array with zeros for what is left out, and which channels are used; raises `ValueError`.

    Values of tracers are not checked.
    """
    check_model(model)
    check_mask(mask)
    voltages = _array(voltages)
    if voltages.dtype.kind == "c":
        raise ValueError("voltages are complex; reconstruct from their real part or magnitude.")
    if voltages.dtype.kind not in "biuf":
        raise ValueError(f"voltages are {voltages.dtype}; give real numbers, in volts.")
    shape = (model.protocol.num_measurements,)
    measured = voltages.astype(float)
    used = np.ones(shape, bool) if mask is None else np.asarray(mask)
    if measured.shape != shape or used.shape != shape or used.dtype != bool:
        raise ValueError(
            f"voltages has shape {measured.shape} and mask {used.shape} of {used.dtype}; protocol "
            f"'{model.protocol.name}' has {shape[0]} channels, and the mask must be booleans."
        )
    if not used.any():
        raise ValueError("mask: every channel is left out, so there is nothing to reconstruct from.")
    if not has_values(measured):
        return jnp.where(used, measured, 0), used
    values = np.asarray(measured)[used]
    if not np.isfinite(values).all():
        raise ValueError(
            f"voltages: NaN or infinite in {(~np.isfinite(values)).sum()} of the channels in use; mask them."
        )
    if not values.any():
        raise ValueError("voltages: all channels in use read zero; was the current source on?")
    return host.where(used, measured, 0), used


def check_background(model: ForwardModel, background) -> Float[Array, " m"]:
    """The background per cell; raises `ValueError` for what is not one positive number or one for each cell."""
    background = _array(background)
    if background.dtype.kind not in "biuf" or background.shape not in ((), (model.mesh.num_cells,)):
        raise ValueError(
            f"background must be one real conductivity, or one for each of the {model.mesh.num_cells} cells; it is "
            f"{background.dtype} of shape {background.shape}."
        )
    values = np.asarray(background) if has_values(background) else np.ones(())
    if (wrong := values[~((values > 0) & np.isfinite(values))]).size:
        raise ValueError(
            f"background must be positive and finite everywhere, S/m (2-D: S); {describe(wrong[0])} is not."
        )
    return namespace(background).broadcast_to(background.astype(float), (model.mesh.num_cells,))


def check_noise(noise, measured: Float[Array, " M"], used: np.ndarray) -> Float[Array, " M"]:
    """Standard deviation of every channel, volts (1 where left out); raises `ValueError`."""
    given = np.zeros(()) if noise is None else _array(noise)
    if given.shape not in ((), measured.shape) or given.dtype.kind not in "iuf":
        raise ValueError(
            f"noise is {given.dtype} of shape {given.shape}; give one real number, or one for each channel."
        )
    xp = namespace(given, measured)
    deviation = relative_noise(measured, xp.asarray(used)) if noise is None else xp.broadcast_to(given, measured.shape)
    if has_values(deviation) and not (np.isfinite(deviation)[used] & (np.asarray(deviation)[used] > 0)).all():
        raise ValueError("noise must be positive and finite for every channel in use.")
    return xp.where(used, deviation, 1)


def _array(values):
    """A NumPy copy of an array that has values."""
    return host.array(values) if has_values(values) else jnp.asarray(values)


def check_steps(name: str, steps) -> int:
    """A whole number from 1. Raises `ValueError` otherwise."""
    if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1:
        raise ValueError(f"{name} must be a whole number from 1; it is {steps!r}.")
    return int(steps)


def check_tolerance(name: str, tolerance) -> float:
    """A number from 0 up to, but not including, 1. Raises `ValueError` otherwise."""
    if not isinstance(tolerance, (int, float, np.number)) or not 0 <= tolerance < 1:
        raise ValueError(f"{name} must be a number from 0 and less than 1; it is {tolerance!r}.")
    return float(tolerance)
