"""Quality of voltages, computed from themselves alone: reciprocity, noise, and signs that no passive body gives.

Everything here works on one measurement alone; no model of the body is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jeit.data.measurement import Measurement
from jeit.electrodes import BoundaryElectrodes
from jeit.mesh.loops import along
from jeit.protocol import Protocol
from jeit.protocol.reciprocity import transfer_between_drives

# Enough frames to judge a recording by; a long one is sampled evenly.
_MOST_FRAMES = 32


@dataclass(frozen=True)
class NoiseEstimate:
    """The noise of one voltage.

    - `standard_deviation`: volts (root mean square).
    - `relative`: the same, over the root mean square of the usable voltages.
    - `method`: "reciprocity" or "repeated frames".
    """

    standard_deviation: float
    relative: float
    method: str


def reciprocity_error(measurement: Measurement, deviation: Float[np.ndarray, " M"] | None = None) -> float | None:
    """Relative departure from reciprocity: ‖T - Tᵀ‖ / ‖T‖ with T the transfer between drives.

    `deviation` (M,): expected errors of the channels, relative to each other; T is divided by its errors for those. All
    alike unless given.

    T_ij is what drive pattern i would read while drive j flows, combined from the measured channels (see
    `jeit.protocol.reciprocity.transfer_between_drives`); it is symmetric for every body, so that what is left is
    noise, drift and gain error, or a wrong protocol. Independent noise of relative size ε gives about √2 ε.

    Returns None when the protocol ties no two usable channels together.
    """
    error, noise, signal = _asymmetry(measurement, deviation)
    if error.size == 0:
        return None
    if deviation is not None:
        error = error / noise
    size = np.linalg.norm(signal)
    return float(np.linalg.norm(error) / size) if size > 0 else 0.0


def channel_reciprocity_error(measurement: Measurement) -> Float[np.ndarray, "F M"]:
    """(F, M) volts: each voltage minus the value predicted by its reciprocal channel; NaN without one."""
    pairs, ratio = measurement.protocol.reciprocal_pairs()
    voltages, mask = np.asarray(measurement.voltages), np.asarray(measurement.mask)
    result = np.full(voltages.shape, np.nan, dtype=voltages.dtype)
    if len(pairs) == 0:
        return np.abs(result)
    first, second = pairs.T
    both = mask[:, first] & mask[:, second]
    error = voltages[:, first] - voltages[:, second] / ratio
    result[:, first] = np.where(both, error, np.nan)
    result[:, second] = np.where(both, -error * ratio, np.nan)
    return np.real(result) if np.isrealobj(voltages) else np.abs(result)


def estimate_noise(measurement: Measurement) -> NoiseEstimate | None:
    """The noise of one voltage, from reciprocity or else from repeated frames; None without either.

    - Reciprocity: two channels that must be equal differ by √2 standard deviations; combinations of channels
      accordingly. Includes drift and gain errors, which cancel in a difference of two frames: estimate the
      noise of a difference from the difference.
    - Repeated frames (8 or more, no frame names): differences of successive frames.

    Robust: 1.4826 times the median absolute value, which half of the channels cannot upset.
    """
    voltages, mask = np.asarray(measurement.voltages), np.asarray(measurement.mask)
    size = float(np.sqrt(np.mean(np.abs(voltages[mask]) ** 2))) if mask.any() else 0.0
    error, gain, _ = _asymmetry(measurement)
    if error.size:
        deviation = _robust_deviation(error / gain)
        method = "reciprocity"
    elif measurement.num_frames >= 8 and not measurement.frame_names:
        step = np.diff(voltages, axis=0)[mask[1:] & mask[:-1]]
        deviation = _robust_deviation(step / np.sqrt(2)) if step.size else 0.0
        method = "repeated frames"
    else:
        return None
    return NoiseEstimate(deviation, deviation / size if size > 0 else float("inf"), method)


def expected_signs(protocol: Protocol, order: Int[np.ndarray, " L"]) -> Int[np.ndarray, " M"]:
    """(M,) the sign that each voltage has on every passive body; 0 where it depends on the body.

    On the boundary of a simply connected sheet the potential falls monotonically from source to sink along
    both arcs between them: a local extremum elsewhere would contradict the maximum principle, whatever the
    (positive) conductivity. So a voltage between two electrodes of one arc has a known sign. `order` lists
    the electrodes as they follow each other along the boundary; channels that drive or measure otherwise than
    in pairs get 0.
    """
    count = protocol.num_electrodes
    rank = np.empty(count, dtype=int)
    rank[order] = np.arange(len(order))
    drive, measurement = np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement)
    pairs = (np.count_nonzero(drive, axis=1) == 2) & (np.count_nonzero(measurement, axis=1) == 2)
    source = rank[drive.argmax(axis=1)]
    # Ranks counted from the source: 0 ... sink is the falling arc, sink ... count the rising one.
    sink = (rank[drive.argmin(axis=1)] - source) % count
    plus = (rank[measurement.argmax(axis=1)] - source) % count
    minus = (rank[measurement.argmin(axis=1)] - source) % count
    falling = (plus <= sink) & (minus <= sink)
    signs = np.where(falling, np.sign(minus - plus), 0)
    plus, minus = np.where(plus == 0, count, plus), np.where(minus == 0, count, minus)
    rising = (plus >= sink) & (minus >= sink) & ~falling
    return np.where(pairs, np.where(rising, np.sign(plus - minus), signs), 0)


def impossible_signs(
    measurement: Measurement, order: Int[np.ndarray, " L"] | None = None
) -> Float[np.ndarray, " F"] | None:
    """(F,) fraction of the usable voltages whose sign no passive body gives (real part of complex voltages).

    Voltages that are nothing but noise have the wrong sign half the time: the fraction of such channels is
    about twice the value returned. `order` lists the electrodes as they follow each other along the boundary; by their
    positions unless given. None when the electrodes are not known to lie around the boundary of an
    outline, or no channel has a known sign. See `expected_signs`.
    """
    order = boundary_order(measurement) if order is None else order
    if order is None:
        return None
    signs = expected_signs(measurement.protocol, order)
    known = np.asarray(measurement.mask) & (signs != 0)
    wrong = known & (np.sign(np.real(np.asarray(measurement.voltages))) == -signs)
    count = known.sum(axis=1)
    if not count.any():
        return None
    return wrong.sum(axis=1) / np.maximum(count, 1)


def boundary_order(measurement: Measurement) -> Int[np.ndarray, " L"] | None:
    """(L,) the electrodes as they follow each other along the outer edge, by their positions; None where they are not
    known to lie on it."""
    electrodes, domain = measurement.electrodes, measurement.domain
    if not isinstance(electrodes, BoundaryElectrodes) or domain is None:
        return None
    loops = domain.loops()
    if not loops:
        return None
    return np.argsort(along(np.asarray(electrodes.position), np.asarray(loops[0])), kind="stable")


def reciprocity_noise(measurement: Measurement, deviation: Float[np.ndarray, " M"]) -> float | None:
    """The noise of channels by reciprocity, in units of `deviation` (M,), their expected errors relative to each other;
    None where the protocol ties no two usable channels together. Robust, as `estimate_noise` is."""
    error, noise, _ = _asymmetry(measurement, deviation)
    return _robust_deviation(error / noise) if error.size else None


def _asymmetry(
    measurement: Measurement, deviation: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Entries of T - Tᵀ (watts); what noise of such `deviation`, or of one volt per channel, adds to them; and what
    they are compared with: those entries of T and its diagonal, over that noise where `deviation` is given.

    With the currents that show a change best (`jeit.protocol.optimal`), the change lies in the diagonal alone.
    """
    protocol = measurement.protocol
    frames = np.unique(np.linspace(0, measurement.num_frames - 1, _MOST_FRAMES).round().astype(int))
    voltages = np.nan_to_num(np.asarray(measurement.voltages)[frames])
    masks = np.asarray(measurement.mask)[frames]
    parts = []
    for mask in np.unique(masks, axis=0):
        transfer, known, gain = transfer_between_drives(
            np.asarray(protocol.drive),
            np.asarray(protocol.measurement),
            np.asarray(protocol.drive_index),
            np.asarray(protocol.measurement_index),
            voltages[np.all(masks == mask, axis=1)],
            mask,
            deviation,
        )
        row, column = np.nonzero(np.triu(known & known.T, k=1))
        upper, lower = transfer[:, row, column], transfer[:, column, row]
        noise = np.hypot(gain[row, column], gain[column, row])
        size = np.sqrt((np.abs(upper) ** 2 + np.abs(lower) ** 2) / 2)
        own = np.flatnonzero(np.diag(known))
        # In ‖T‖² the diagonal is counted once, and each pair, here one entry, twice.
        diagonal = np.abs(transfer[:, own, own]) / np.sqrt(2)
        if deviation is not None:
            size, diagonal = size / noise, diagonal / (np.sqrt(2) * gain[own, own])
        parts.append((upper - lower, np.broadcast_to(noise, upper.shape), np.concatenate([size, diagonal], axis=1)))
    error, noise, signal = (np.concatenate([part[k].ravel() for part in parts]) for k in range(3))
    return error, noise, signal


def _robust_deviation(values: np.ndarray) -> float:
    if np.iscomplexobj(values):
        values = np.concatenate([np.real(values), np.imag(values)])
    return float(1.4826 * np.median(np.abs(values)))
