"""Conversion of raw voltages to a `Measurement`: unusable voltages, and spikes in single channels, are masked, and the
notes state the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Inexact
from numpy.typing import ArrayLike

from jeit.arguments import counted, measurable_values
from jeit.data.frame_checks import rounding_of_difference
from jeit.data.measurement import Measurement
from jeit.data.quality import describe_electrode_order
from jeit.electrodes import AbstractElectrodes
from jeit.inverse import relative_noise
from jeit.mesh import Body, Mesh
from jeit.protocol import Protocol
from jeit_solvers.engines import as_array

# Maximum number of superfluous columns, such as times, that an error about the shape suggests as the cause.
_MAX_EXTRA_COLUMNS = 4
# Maximum plausible voltage on an electrode, in volts.
_MAX_VOLTAGE = 1000.0
# Minimum number of equal extreme values that count as saturated.
_MIN_EQUAL_SATURATED_VALUES = 4
# Minimum deviation of a spike from the value that the other channels imply, in robust standard deviations; minimum
# fraction of the unexplained power that a spike explains; maximum number of spikes in a frame. The deviation of a spike
# must also exceed the typical change of a channel.
_MIN_SPIKE_DEVIATIONS, _MIN_SPIKE_POWER_SHARE, _MAX_SPIKES = 10.0, 0.5, 8
# Of two channels that contradict each other, one is faulty if its change is larger than the change of the other channel
# by this factor.
_MIN_FAULTY_CHANGE_RATIO = 3.0
# Minimum fraction of a channel that the other channels leave undetermined; smaller fractions are rounding errors.
_MIN_UNDETERMINED_SHARE = 1e-6
# Maximum number of operations to find which voltage changes a body can cause; the search takes up to a second.
_MAX_OPERATIONS = 2e9
# Maximum number of distinct masks of frames for which the possible voltage changes are found.
_MAX_DISTINCT_MASKS = 8


def screen(
    voltages: ArrayLike,
    protocol: Protocol,
    *,
    electrodes: AbstractElectrodes | None = None,
    domain: Body | Mesh | None = None,
    mask: ArrayLike | None = None,
    saturation: float | None = None,
    name: str = "measurement",
    source: str = "",
    frame_names: tuple[str, ...] = (),
    notes: tuple[str, ...] = (),
) -> Measurement:
    """Convert raw voltages to a `Measurement`; unusable voltages are masked, and notes state why.

    Voltages are masked if they

    - are excluded by `mask`;
    - are NaN, infinite, or larger than 1e12 V;
    - are saturated;
    - belong to a drive whose voltages are all nearly zero because its current did not flow, or are read at an electrode
      through which no current flowed in any drive;
    - belong to a frame that is all zero.

    A note is also added if electrodes are not numbered in their order along the edge.

    **Arguments:**

    - `voltages` (M,) or (F, M): voltages of M channels, for one frame or F frames, in volts.
    - `protocol`: drive and measurement patterns of the M channels.
    - `electrodes`, `domain`: the electrodes and the body, if they are known.
    - `mask` (M,) or (F, M): True for usable voltages.
    - `saturation`: voltage at which the instrument saturates, in volts; by default, voltages that share exactly the
      same extreme value are considered saturated.
    - `name`, `source`, `frame_names`, `notes`: as in `Measurement`.

    Raises `ValueError` if the shape of `voltages` does not fit the protocol, or if no usable voltage is left.

    **Example:**

    ```python
    measurement = screen(pressed.voltages, pressed.protocol, electrodes=pressed.electrodes, domain=pressed.domain)
    ```
    """
    name = name.encode("utf-8", "backslashreplace").decode()  # the name of a file may not be valid text
    values = _convert_to_frames(voltages, protocol, name)
    usable = np.ones(values.shape, dtype=bool)
    note_list = list(notes)

    def exclude(is_bad: np.ndarray, reason: str) -> None:
        num_masked = int((usable & is_bad).sum())
        if num_masked:
            usable[is_bad] = False
            note_list.append(f"{num_masked} of {values.size} voltages masked: {reason}")

    if mask is not None:
        mask_array = np.broadcast_to(np.asarray(mask), values.shape)
        if mask_array.dtype != bool:
            raise ValueError(f"mask is {mask_array.dtype}; give booleans, True where a voltage is usable.")
        exclude(~mask_array, "excluded by the mask given.")
    values = measurable_values(values)
    is_missing = np.isnan(values)
    exclude(is_missing, f"NaN, infinite or beyond any instrument{_describe_missing_electrodes(is_missing, protocol)}.")
    is_dead = ~np.any(np.where(usable, values, 0) != 0, axis=1)
    if is_dead.all():
        raise ValueError(
            f"{name}: every usable voltage is zero, NaN or missing; there is nothing measured in it. Was the "
            "instrument on, and is this the right variable or column?"
        )
    exclude(
        np.broadcast_to(is_dead[:, None], values.shape), f"all zero: {int(is_dead.sum())} of {len(is_dead)} frames."
    )
    exclude(_find_saturated(values, usable, saturation), "saturated (stuck at an end of the instrument's range).")
    is_dead, is_alive = _drives_without_and_with_current(values, usable, protocol)
    exclude(is_dead[:, np.asarray(protocol.drive_index)], "their drive's current did not flow.")
    is_driven, is_measured = (np.asarray(patterns) != 0 for patterns in (protocol.drive, protocol.channel_measurement))
    unconnected = (is_dead @ is_driven) & ~(is_alive @ is_driven)
    numbers = ", ".join(str(electrode + 1) for electrode in np.flatnonzero(unconnected.any(axis=0)))
    connection_note = f"they read electrode {numbers}, through which no drive's current flowed: is it connected?"
    exclude(unconnected @ is_measured.T, connection_note)
    max_voltage = np.abs(values[usable]).max(initial=0)
    if max_voltage > _MAX_VOLTAGE:
        note_list.append(f"the largest voltage is {max_voltage:.3g} V: are voltages in volts, and currents in amperes?")
    if not usable.any():
        raise ValueError(f"{name}: no usable voltage is left. {' '.join(note_list)}")
    fields = {"electrodes": electrodes, "domain": domain, "name": name, "source": source, "frame_names": frame_names}
    measurement = Measurement(values, usable, protocol, notes=tuple(note_list), **fields)
    order_text = describe_electrode_order(measurement)
    return measurement if order_text is None else replace(measurement, notes=(*measurement.notes, order_text))


def _explain_number(number: int, channels: int) -> str:
    """Text on what may be wrong if `number` numbers are not complete frames of `channels` voltages: missing lines, or a
    different number of electrodes."""
    if 0 < channels - number <= channels // 4:
        return f" They are {number} numbers, {channels - number} fewer than a frame has: is a line missing?"
    counts = {
        electrodes * (electrodes - 3) // share: (electrodes, pair_text)
        for electrodes in range(64, 3, -1)
        for share, pair_text in ((2, "half of the adjacent pairs"), (1, "adjacent pairs"))
    } | {electrodes * (electrodes - 1) // 2: (electrodes, "all pairs") for electrodes in range(4, 65)}
    if number not in counts:
        return ""
    electrodes, pair_text = counts[number]
    return (
        f" {number} numbers are what {electrodes} electrodes give with {pair_text}: is the number of electrodes right?"
    )


def _describe_missing_electrodes(is_missing: Bool[np.ndarray, "F M"], protocol: Protocol) -> str:
    """Clause that names the electrodes without any usable channel in some frame, unless they are all; otherwise
    empty."""
    touching = np.array([protocol.channels_touching(electrode) for electrode in range(protocol.num_electrodes)])
    is_lost = [bool(channels.any()) and bool(is_missing[:, channels].all(axis=1).any()) for channels in touching]
    if not any(is_lost) or all(is_lost):
        return ""
    numbers = ", ".join(str(electrode + 1) for electrode in np.flatnonzero(is_lost))
    return f", among them all of electrode{'s' * (sum(is_lost) > 1)} {numbers}: check the connection"


def _convert_to_frames(voltages, protocol: Protocol, name: str) -> np.ndarray:
    values = np.asarray(voltages)
    if values.dtype.kind not in "fiuc":
        raise ValueError(f"{name}: voltages are {values.dtype}; they must be numbers, in volts.")
    values = np.atleast_2d(values.astype(complex if values.dtype.kind == "c" else float))
    num_channels = protocol.num_measurements
    if values.ndim != 2 or values.shape[0] == 0 or values.shape[1] != num_channels:
        shape_hint = " It looks transposed: give one row per frame." if values.shape[0] == num_channels else ""
        if values.ndim == 2 and 0 < (num_extra_columns := values.shape[1] - num_channels) <= _MAX_EXTRA_COLUMNS:
            shape_hint = (
                f" There are {num_extra_columns} too many: are there times, counters or states among them? Leave them "
                "out."
            )
        shape_hint = shape_hint or _explain_number(values.size, num_channels)
        raise ValueError(
            f"{name}: the data have shape {values.shape}, but the protocol '{protocol.name}' has {num_channels} "
            f"channels, so (frames, {num_channels}) is needed.{shape_hint} Or describe the protocol that the data "
            "were measured with."
        )
    return values


def _find_saturated(values: np.ndarray, usable: np.ndarray, saturation: float | None) -> Bool[np.ndarray, "F M"]:
    if saturation is not None:
        if not np.isfinite(saturation) or saturation <= 0:
            raise ValueError(f"saturation must be a positive voltage in volts; got {saturation!r}.")
        with np.errstate(invalid="ignore"):
            return np.abs(values) >= saturation * (1 - 1e-9)
    result = np.zeros(values.shape, dtype=bool)
    real_components = [np.real(values), np.imag(values)] if np.iscomplexobj(values) else [values]
    for component in real_components:
        usable_values = np.where(usable, component, np.nan)
        repeated = _is_minimum_repeated(usable_values) | _is_minimum_repeated(-usable_values)
        for frame in np.flatnonzero(repeated & (usable.sum(axis=1) >= 8)):
            row, row_usable = component[frame], usable[frame]
            levels, level_index, counts = np.unique(row[row_usable], return_inverse=True, return_counts=True)
            for extreme_index in (0, len(levels) - 1):
                # A coarse converter or a simulated symmetric body also produces exactly equal extremes, but then values
                # between them repeat as often; in saturated data only the extreme value repeats.
                other_counts = np.delete(counts, [0, len(levels) - 1]) if len(levels) > 2 else np.zeros(1)
                if (
                    levels[extreme_index] != 0
                    and counts[extreme_index] >= _MIN_EQUAL_SATURATED_VALUES
                    and counts[extreme_index] >= 4 * other_counts.max(initial=0)
                ):
                    result[frame, np.flatnonzero(row_usable)[level_index == extreme_index]] = True
    return result


def _is_minimum_repeated(rows: np.ndarray) -> Bool[np.ndarray, " F"]:
    """Whether at least `_MIN_EQUAL_SATURATED_VALUES` values of a row equal its minimum. NaN is left out."""
    if rows.shape[1] < _MIN_EQUAL_SATURATED_VALUES:
        return np.zeros(len(rows), bool)
    smallest_values = np.partition(rows, _MIN_EQUAL_SATURATED_VALUES - 1, axis=1)[:, :_MIN_EQUAL_SATURATED_VALUES]
    return smallest_values.min(axis=1) == smallest_values.max(axis=1)


def _drives_without_and_with_current(
    values: np.ndarray, usable: np.ndarray, protocol: Protocol
) -> tuple[Bool[np.ndarray, "F S"], Bool[np.ndarray, "F S"]]:
    """Masks (frames, drives) of the drives without current, whose voltages are a thousand times smaller than the
    voltages of the median drive, and of the drives with current. Both masks are False for drives without a usable
    voltage."""
    drive_indices = np.asarray(protocol.drive_index)
    max_magnitudes = np.full((values.shape[0], protocol.num_drives), -1.0)
    np.maximum.at(max_magnitudes.T, drive_indices, np.where(usable, np.abs(values), -1.0).T)
    if protocol.num_drives < 3:
        return np.zeros(max_magnitudes.shape, dtype=bool), max_magnitudes >= 0
    threshold = 1e-3 * np.median(np.maximum(max_magnitudes, 0), axis=1, keepdims=True)
    return (max_magnitudes >= 0) & (max_magnitudes < threshold), max_magnitudes >= threshold


def mask_spikes(measurement: Measurement, reference: Measurement, *, fill: bool = False) -> Measurement:
    """Mask spikes: single channels of a frame whose change from the mean of `reference` contradicts the changes of all
    other channels. A note lists the masked channels.

    The voltages of every body follow from its symmetric transfer impedance, which has fewer entries than most protocols
    have channels. The part of a frame's change that no symmetric matrix explains is noise, or a spike if one channel
    contributes more to this part than all other channels together. If it remains unknown which of two reciprocal
    channels is faulty, both are masked. No spikes are found in protocols whose channels are all independent, and in
    protocols of more than about 40 electrodes, for which the search would take too long.

    **Arguments:**

    - `measurement`: the frames.
    - `reference`: frames of the undisturbed body, from the same set-up.
    - `fill`: replace spikes by the values that the other channels determine, and mask only spikes that they do not
      determine.

    **Example:**

    ```python
    clean = mask_spikes(pressed, rest)
    ```
    """
    mean = reference.mean_frame()
    base_voltages, known_channels = np.asarray(mean.voltages)[0], np.asarray(mean.mask)[0]
    weight = np.asarray(
        relative_noise(as_array(np.abs(np.where(known_channels, base_voltages, 0))), as_array(known_channels))
    )
    voltages, masks = np.array(measurement.voltages), np.asarray(measurement.mask)
    spikes, is_filled_frame_channel = np.zeros(masks.shape, bool), np.zeros(masks.shape, bool)
    distinct_masks, mask_index, num_frames = np.unique(
        masks & known_channels, axis=0, return_inverse=True, return_counts=True
    )
    for pattern_index in np.argsort(-num_frames)[:_MAX_DISTINCT_MASKS]:
        mask = distinct_masks[pattern_index]
        basis = _possible_changes(measurement, weight, mask)
        if basis is None:
            continue
        for frame in np.flatnonzero(mask_index.ravel() == pattern_index):
            change = ((voltages[frame] - base_voltages) / weight)[mask]
            rounding_errors = rounding_of_difference(measurement.frame(int(frame)), mean) / weight
            is_spike = np.isin(np.arange(len(change)), _find_spikes(change, basis, rounding_errors[mask]))
            spikes[frame, mask] = is_spike
            if fill and is_spike.any():
                # A channel is determined by the other channels if their rows of the basis span its row.
                weights = basis[is_spike] @ np.linalg.pinv(basis[~is_spike])
                is_determined = (
                    np.linalg.norm(weights @ basis[~is_spike] - basis[is_spike], axis=1) < _MIN_UNDETERMINED_SHARE
                )
                determined_channels = np.flatnonzero(mask)[is_spike][is_determined]
                voltages[frame, determined_channels] = (
                    base_voltages[determined_channels]
                    + weight[determined_channels] * (weights @ change[~is_spike])[is_determined]
                )
                is_filled_frame_channel[frame, determined_channels] = True
    reason = f"spikes, which contradict the other channels ({_listed_spikes(spikes)})."
    if is_filled_frame_channel.any():
        spike_note = (
            f"{counted(int(is_filled_frame_channel.sum()), 'voltage')} replaced by what others determine: {reason}"
        )
        measurement = replace(measurement, voltages=voltages, notes=(*measurement.notes, spike_note))
    return (
        measurement.masked(~spikes | is_filled_frame_channel, reason)
        if (spikes & ~is_filled_frame_channel).any()
        else measurement
    )


def _listed_spikes(spikes: Bool[np.ndarray, "F M"]) -> str:
    """Text that lists the channels with spikes, and their frames if there are several frames."""
    frames, channels = np.nonzero(spikes)
    labels = [
        f"channel {k + 1}" + (f" of frame {f}" if len(spikes) > 1 else "")
        for f, k in zip(frames, channels, strict=True)
    ]
    return ", ".join(labels[:_MAX_SPIKES]) + (" …" if len(labels) > _MAX_SPIKES else "")


def _possible_changes(
    measurement: Measurement, weight: Float[np.ndarray, " M"], mask: Bool[np.ndarray, " M"]
) -> Float[np.ndarray, "n r"] | None:
    """Orthonormal basis (n, r) of the r-dimensional space of changes of the n usable channels, divided by `weight`,
    that a change of a symmetric transfer impedance can cause. None if every change is possible, or if the computation
    would take too long."""
    drive = np.asarray(measurement.protocol.channel_drive)[mask]
    measurements = np.asarray(measurement.protocol.channel_measurement)[mask]
    row, column = np.triu_indices(drive.shape[1])
    if len(drive) * len(row) * min(len(drive), len(row)) > _MAX_OPERATIONS or not len(drive):
        return None
    drive = drive / np.abs(drive).max()
    drive_measurement_products = drive[:, row] * measurements[:, column] + drive[:, column] * measurements[:, row]
    basis, size, _ = np.linalg.svd(drive_measurement_products / weight[mask, None], full_matrices=False)
    basis = basis[:, size > 1e-9 * size[0]]
    return basis if basis.shape[1] < len(drive) else None


def _find_spikes(
    change: Inexact[np.ndarray, " n"], basis: Float[np.ndarray, "n r"], rounding_errors: Float[np.ndarray, " n"]
) -> list[int]:
    """Indices of the channels with spikes in a weighted `change` (n,) of n channels; `rounding_errors` (n,): standard
    deviation of the change due to rounding.

    If a suspected channel may have any value, its unit vector is added to the basis. The power that this vector
    explains, `gain`, is compared with the power that the basis alone leaves unexplained.
    """
    residual, undetermined_share = change - basis @ (basis.T @ change), 1 - np.sum(basis**2, axis=1)
    is_remaining_channel, faulty_channels, spikes = np.ones(len(change), bool), [], []
    for _ in range(_MAX_SPIKES):
        is_predicted_by_others = is_remaining_channel & (undetermined_share > _MIN_UNDETERMINED_SHARE)
        size = np.where(
            is_predicted_by_others,
            np.abs(residual) / np.sqrt(np.maximum(undetermined_share, _MIN_UNDETERMINED_SHARE)),
            0,
        )
        worst_channels = np.flatnonzero(size > (1 - _MIN_UNDETERMINED_SHARE) * size.max())
        if not 0 < len(worst_channels) <= 2:
            break
        deviation = max(
            1.4826 * float(np.median(size[is_predicted_by_others])), float(rounding_errors[worst_channels].max())
        )
        if not size.max() > _MIN_SPIKE_DEVIATIONS * deviation:
            break
        direction = np.zeros(len(change))
        direction[worst_channels[0]] = 1
        for _ in range(2):  # projected twice, so that rounding errors do not destroy orthogonality
            direction = direction - basis @ (basis.T @ direction)
        direction = direction / np.linalg.norm(direction)
        unexplained_power, gain = float(np.sum(np.abs(residual) ** 2)), float(np.abs(direction @ residual) ** 2)
        spike_size = float((size[worst_channels] / np.sqrt(undetermined_share[worst_channels])).max())
        basis = np.column_stack([basis, direction])
        residual, undetermined_share = residual - direction * (direction @ residual), undetermined_share - direction**2
        faulty_channels += _faulty_channels(change, worst_channels)
        is_remaining_channel[worst_channels] = False
        root_mean_square_change = float(np.sqrt(np.mean(np.abs(change[is_remaining_channel]) ** 2)))
        if spike_size > root_mean_square_change and gain > _MIN_SPIKE_POWER_SHARE * unexplained_power:
            spikes = [*faulty_channels]
    return spikes


def _faulty_channels(change: Inexact[np.ndarray, " n"], channels: np.ndarray) -> list[int]:
    """Return the faulty channels among one or two channels that contradict the other channels or each other: the
    channel with the far larger change, or both channels if their changes are similar."""
    size = np.abs(change[channels])
    is_largest_only = size.max() > _MIN_FAULTY_CHANGE_RATIO * size.min()
    return [int(channels[size.argmax()])] if is_largest_only else channels.tolist()
