"""Reciprocity: driving at electrodes a and measuring at electrodes b yields the same voltage as driving at b and
measuring at a.

The transfer impedance S (L, L) of any body with (symmetric) conductivity is symmetric: `m @ S @ d = d @ S @ m` for a
drive pattern d and a measurement pattern m. Therefore, if two channels (d, m) and (d', m') satisfy d' = a m and m' = b
d, their voltages satisfy v' = a b v. Geselowitz 1971, Lehr 1972.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Inexact, Int


def _direction_keys(patterns: np.ndarray) -> tuple[list[bytes], np.ndarray]:
    """A hashable key of each pattern (row), the same for proportional patterns, and the scale of each pattern: pattern
    = scale * unit pattern."""
    # The first entry that is not tiny determines scale and sign, so that proportional rows have the same unit row.
    max_pattern_weights = np.max(np.abs(patterns), axis=1, keepdims=True)
    first_nonzero_indices = np.argmax(np.abs(patterns) > 1e-9 * max_pattern_weights, axis=1)
    pattern_scales = patterns[np.arange(len(patterns)), first_nonzero_indices]
    unit_patterns = np.round(patterns / pattern_scales[:, None], 9) + 0.0  # + 0.0 turns -0.0 into 0.0
    return [unit_pattern.tobytes() for unit_pattern in unit_patterns], pattern_scales


def reciprocal_channel_pairs(
    drive: np.ndarray, measurement: np.ndarray, drive_index: np.ndarray, measurement_index: np.ndarray
) -> tuple[Int[np.ndarray, "P 2"], Float[np.ndarray, " P"]]:
    """Pairs (P, 2) of reciprocal channels, first < second, and the ratios (P,) of their voltages: `v[second] = ratio *
    v[first]`.

    The arguments are those of `Protocol`. Each channel is paired only with the last of its reciprocal channels.
    """
    drive_keys, drive_scales = _direction_keys(drive)
    measurement_keys, measurement_scales = _direction_keys(measurement)
    channel_by_keys = {
        (drive_keys[d], measurement_keys[m]): k
        for k, (d, m) in enumerate(zip(drive_index, measurement_index, strict=True))
    }
    channel_gains = drive_scales[drive_index] * measurement_scales[measurement_index]
    reciprocal_pairs, voltage_ratios = [], []
    for first_channel, (d, m) in enumerate(zip(drive_index, measurement_index, strict=True)):
        reciprocal_channel = channel_by_keys.get((measurement_keys[m], drive_keys[d]))
        if reciprocal_channel is not None and first_channel < reciprocal_channel:
            reciprocal_pairs.append((first_channel, reciprocal_channel))
            voltage_ratios.append(channel_gains[reciprocal_channel] / channel_gains[first_channel])
    return np.array(reciprocal_pairs, dtype=int).reshape(-1, 2), np.array(voltage_ratios, dtype=float)


def transfer_between_drives(
    drive: np.ndarray,
    measurement: np.ndarray,
    drive_index: np.ndarray,
    measurement_index: np.ndarray,
    voltages: np.ndarray,
    mask: np.ndarray,
    deviation: np.ndarray | None = None,
) -> tuple[Inexact[np.ndarray, "F S S"], Bool[np.ndarray, "S S"], Float[np.ndarray, "S S"]]:
    """Compute the voltage that every drive pattern, used as a measurement pattern, would measure while the currents of
    each drive flow: a symmetric matrix for any body.

    `voltages` (F, M): voltages of F frames and M channels, volts; `mask` (M,): True for usable channels; `deviation`
    (M,): standard deviation of the independent noise of each channel, volts, by default one; the other arguments are
    those of `Protocol`. Returns, for S drive patterns:

    - `transfer` (F, S, S), watts: `drive[i] @ Z @ drive[j]` in entry (i, j), combined from the channels measured while
      drive j flows (Z: transfer impedance). For example, the voltage of a skip-1 pair is the sum of the voltages of two
      adjacent pairs.
    - `is_known` (S, S): whether drive i is a linear combination of the measurement patterns of drive j.
    - `transfer_noise` (S, S), watts: standard deviation of each entry of `transfer`.
    """
    num_drives = drive.shape[0]
    transfer = np.zeros((voltages.shape[0], num_drives, num_drives), dtype=voltages.dtype)
    is_known = np.zeros((num_drives, num_drives), dtype=bool)
    transfer_noise = np.zeros((num_drives, num_drives))
    deviation = np.ones(len(mask)) if deviation is None else deviation
    drive_norms = np.linalg.norm(drive, axis=1)
    for drive_number in range(num_drives):
        channels = np.flatnonzero((drive_index == drive_number) & mask)
        if channels.size == 0:
            continue
        measurement_rows, channel_deviations = measurement[measurement_index[channels]], deviation[channels]
        # Among all combinations of channels that equal a drive, choose the combination with the least noise.
        channel_combination = (
            drive @ np.linalg.pinv(measurement_rows / channel_deviations[:, None], rcond=1e-10) / channel_deviations
        )
        is_known[:, drive_number] = (
            np.linalg.norm(channel_combination @ measurement_rows - drive, axis=1) <= 1e-8 * drive_norms
        )
        transfer[:, :, drive_number] = voltages[:, channels] @ channel_combination.T
        transfer_noise[:, drive_number] = np.linalg.norm(channel_combination * channel_deviations, axis=1)
    return transfer, is_known, transfer_noise
