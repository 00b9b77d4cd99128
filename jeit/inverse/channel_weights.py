"""How much each channel is to be trusted."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.protocol import Protocol
from jeit_solvers.engines import either_engine, namespace


@either_engine
def relative_noise(
    voltages: Float[Array, " M"], mask: Bool[Array, " M"] | None = None, *, relative: float = 0.01, floor: float = 0.3
) -> Float[Array, " M"]:
    """Standard deviation of channels whose errors grow with what they read: relative · √(v² + (floor · median|v|)²).

    What spoils a difference image of a real tank is rarely the voltmeter: gains, electrode shapes and depth that the
    model lacks leave errors in proportion to the voltage, largest where the driven electrodes are read. `voltages` (M,)
    of the reference, volts; `mask`: True for usable channels, the others do not count in the median and come out as 1.
    """
    xp = namespace(voltages, mask)
    size = abs(xp.asarray(voltages))
    used = xp.isfinite(size) if mask is None else xp.asarray(mask) & xp.isfinite(size)
    typical = xp.nanmedian(xp.where(used, size, xp.nan))
    return xp.where(used, relative * xp.sqrt(xp.where(used, size, 0) ** 2 + (floor * typical) ** 2), 1.0)


def electrode_misfits(
    protocol: Protocol, residual: Float[Array, " M"], noise: Float[Array, " M"], mask: Bool[Array, " M"]
) -> Float[np.ndarray, " L"]:
    """How much of the channels that read an electrode a model misses, (L,), over the median of all electrodes.

    `residual` (M,): predicted less measured, volts; `noise` (M,) volts, see `relative_noise`; `mask`: True for usable
    channels. 1 for electrodes that none of those reads. An electrode far above 1 has a gain, an offset or a place of
    its own.
    """
    used = np.asarray(mask)
    reads = (np.asarray(protocol.channel_measurement) != 0) & used[:, None]
    square = np.where(used, np.abs(np.asarray(residual) / np.asarray(noise)) ** 2, 0) @ reads
    count = reads.sum(axis=0)
    missed = np.sqrt(square / np.maximum(count, 1))
    typical = np.median(missed[count > 0])
    return np.where((count > 0) & (typical > 0), missed / max(typical, 1e-300), 1.0)


def repeated_noise(frames, mask=None, *, prior_frames: float = 4.0) -> Float[np.ndarray, " M"]:
    """Standard deviation of a single frame's channels (M,), volts, measured from repeated frames of a body at rest.

    `frames` (F, M) volts, F at least 2. `mask` (F, M) or (M,): True for usable voltages; a channel with fewer than two
    comes out as 1. A deviation of few frames is itself uncertain: variances are drawn towards the channels' median
    as if that had been seen in `prior_frames` frames more. Raises `ValueError` for other shapes, for frames that are
    all alike, and for NaN in what is used.
    """
    if np.iscomplexobj(frames):
        raise ValueError("frames are complex; give their real part or magnitude.")
    if not (np.isfinite(prior_frames) and prior_frames >= 0):
        raise ValueError(f"prior_frames must be a number from 0; it is {prior_frames}.")
    values = np.asarray(frames, float)
    if values.ndim != 2 or len(values) < 2:
        raise ValueError(f"frames has shape {values.shape}; give at least two repeated frames, (frames, channels).")
    used = np.ones(values.shape, bool) if mask is None else np.asarray(mask)
    if used.dtype != bool or used.shape not in (values.shape, values.shape[1:]):
        raise ValueError(f"mask must be booleans of shape {values.shape} or {values.shape[1:]}.")
    used = np.broadcast_to(used, values.shape)
    if not np.isfinite(values[used]).all():
        raise ValueError("frames: some voltages in use are NaN or infinite; mask them.")
    count = used.sum(axis=0)
    mean = np.where(used, values, 0).sum(axis=0) / np.maximum(count, 1)
    squares = np.where(used, (values - mean) ** 2, 0).sum(axis=0)
    known = count >= 2
    if not known.any():
        raise ValueError("mask: it leaves no channel with two frames.")
    if not squares[known].any():
        raise ValueError("frames: all are alike, so they tell nothing of the noise; is one frame repeated?")
    typical = np.median((squares[known] / (count[known] - 1))[squares[known] > 0])
    freedom = np.where(known, count - 1, 1) + prior_frames
    return np.where(known, np.sqrt((squares + prior_frames * typical) / freedom), 1.0)
