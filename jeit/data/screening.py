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
    frame_values = _convert_to_frames(voltages, protocol, name)
    usable_mask = np.ones(frame_values.shape, dtype=bool)
    screening_notes = list(notes)

    def exclude_channels(is_bad: np.ndarray, exclusion_reason: str) -> None:
        num_masked = int((usable_mask & is_bad).sum())
        if num_masked:
            usable_mask[is_bad] = False
            screening_notes.append(f"{num_masked} of {frame_values.size} voltages masked: {exclusion_reason}")

    if mask is not None:
        mask_array = np.broadcast_to(np.asarray(mask), frame_values.shape)
        if mask_array.dtype != bool:
            raise ValueError(f"mask is {mask_array.dtype}; give booleans, True where a voltage is usable.")
        exclude_channels(~mask_array, "excluded by the mask given.")
    frame_values = measurable_values(frame_values)
    is_missing = np.isnan(frame_values)
    exclude_channels(
        is_missing, f"NaN, infinite or beyond any instrument{_describe_missing_electrodes(is_missing, protocol)}."
    )
    is_dead = ~np.any(np.where(usable_mask, frame_values, 0) != 0, axis=1)
    if is_dead.all():
        raise ValueError(
            f"{name}: every usable voltage is zero, NaN or missing; there is nothing measured in it. Was the "
            "instrument on, and is this the right variable or column?"
        )
    exclude_channels(
        np.broadcast_to(is_dead[:, None], frame_values.shape),
        f"all zero: {int(is_dead.sum())} of {len(is_dead)} frames.",
    )
    exclude_channels(
        _find_saturated(frame_values, usable_mask, saturation), "saturated (stuck at an end of the instrument's range)."
    )
    is_dead, is_alive = _drives_without_and_with_current(frame_values, usable_mask, protocol)
    exclude_channels(is_dead[:, np.asarray(protocol.drive_index)], "their drive's current did not flow.")
    is_driven, is_measured = (
        np.asarray(pattern_matrix) != 0 for pattern_matrix in (protocol.drive, protocol.channel_measurement)
    )
    is_unconnected = (is_dead @ is_driven) & ~(is_alive @ is_driven)
    electrode_numbers = ", ".join(str(electrode + 1) for electrode in np.flatnonzero(is_unconnected.any(axis=0)))
    connection_note = (
        f"they read electrode {electrode_numbers}, through which no drive's current flowed: is it connected?"
    )
    exclude_channels(is_unconnected @ is_measured.T, connection_note)
    max_voltage = np.abs(frame_values[usable_mask]).max(initial=0)
    if max_voltage > _MAX_VOLTAGE:
        screening_notes.append(
            f"the largest voltage is {max_voltage:.3g} V: are voltages in volts, and currents in amperes?"
        )
    if not usable_mask.any():
        raise ValueError(f"{name}: no usable voltage is left. {' '.join(screening_notes)}")
    measurement_fields = {
        "electrodes": electrodes,
        "domain": domain,
        "name": name,
        "source": source,
        "frame_names": frame_names,
    }
    measurement = Measurement(frame_values, usable_mask, protocol, notes=tuple(screening_notes), **measurement_fields)
    order_text = describe_electrode_order(measurement)
    return measurement if order_text is None else replace(measurement, notes=(*measurement.notes, order_text))


def _explain_number(number: int, num_channels: int) -> str:
    """Text on what may be wrong if `number` numbers are not complete frames of `num_channels` voltages: missing lines,
    or a different number of electrodes."""
    if 0 < num_channels - number <= num_channels // 4:
        return f" They are {number} numbers, {num_channels - number} fewer than a frame has: is a line missing?"
    likely_counts = {
        electrodes * (electrodes - 3) // reciprocal_share: (electrodes, pair_text)
        for electrodes in range(64, 3, -1)
        for reciprocal_share, pair_text in ((2, "half of the adjacent pairs"), (1, "adjacent pairs"))
    } | {electrodes * (electrodes - 1) // 2: (electrodes, "all pairs") for electrodes in range(4, 65)}
    if number not in likely_counts:
        return ""
    electrodes, pair_text = likely_counts[number]
    return (
        f" {number} numbers are what {electrodes} electrodes give with {pair_text}: is the number of electrodes right?"
    )


def _describe_missing_electrodes(is_missing: Bool[np.ndarray, "F M"], protocol: Protocol) -> str:
    """Clause that names the electrodes without any usable channel in some frame, unless they are all; otherwise
    empty."""
    touching_channels = np.array(
        [protocol.channels_touching(electrode) for electrode in range(protocol.num_electrodes)]
    )
    is_lost = [
        bool(electrode_channels.any()) and bool(is_missing[:, electrode_channels].all(axis=1).any())
        for electrode_channels in touching_channels
    ]
    if not any(is_lost) or all(is_lost):
        return ""
    electrode_numbers = ", ".join(str(electrode + 1) for electrode in np.flatnonzero(is_lost))
    return f", among them all of electrode{'s' * (sum(is_lost) > 1)} {electrode_numbers}: check the connection"


def _convert_to_frames(voltages, protocol: Protocol, name: str) -> np.ndarray:
    frame_values = np.asarray(voltages)
    if frame_values.dtype.kind not in "fiuc":
        raise ValueError(f"{name}: voltages are {frame_values.dtype}; they must be numbers, in volts.")
    frame_values = np.atleast_2d(frame_values.astype(complex if frame_values.dtype.kind == "c" else float))
    num_channels = protocol.num_measurements
    if frame_values.ndim != 2 or frame_values.shape[0] == 0 or frame_values.shape[1] != num_channels:
        shape_hint = " It looks transposed: give one row per frame." if frame_values.shape[0] == num_channels else ""
        if (
            frame_values.ndim == 2
            and 0 < (num_extra_columns := frame_values.shape[1] - num_channels) <= _MAX_EXTRA_COLUMNS
        ):
            shape_hint = (
                f" There are {num_extra_columns} too many: are there times, counters or states among them? Leave them "
                "out."
            )
        shape_hint = shape_hint or _explain_number(frame_values.size, num_channels)
        raise ValueError(
            f"{name}: the data have shape {frame_values.shape}, but the protocol '{protocol.name}' has {num_channels} "
            f"channels, so (frames, {num_channels}) is needed.{shape_hint} Or describe the protocol that the data "
            "were measured with."
        )
    return frame_values


def _find_saturated(
    frame_values: np.ndarray, usable_mask: np.ndarray, saturation_level: float | None
) -> Bool[np.ndarray, "F M"]:
    if saturation_level is not None:
        if not np.isfinite(saturation_level) or saturation_level <= 0:
            raise ValueError(f"saturation must be a positive voltage in volts; got {saturation_level!r}.")
        with np.errstate(invalid="ignore"):
            return np.abs(frame_values) >= saturation_level * (1 - 1e-9)
    is_saturated = np.zeros(frame_values.shape, dtype=bool)
    real_components = (
        [np.real(frame_values), np.imag(frame_values)] if np.iscomplexobj(frame_values) else [frame_values]
    )
    for real_component in real_components:
        usable_values = np.where(usable_mask, real_component, np.nan)
        is_repeated = _is_minimum_repeated(usable_values) | _is_minimum_repeated(-usable_values)
        for frame in np.flatnonzero(is_repeated & (usable_mask.sum(axis=1) >= 8)):
            frame_row, is_usable_in_row = real_component[frame], usable_mask[frame]
            distinct_levels, level_of_value, level_counts = np.unique(
                frame_row[is_usable_in_row], return_inverse=True, return_counts=True
            )
            for extreme_index in (0, len(distinct_levels) - 1):
                # A coarse converter or a simulated symmetric body also produces exactly equal extremes, but then values
                # between them repeat as often; in saturated data only the extreme value repeats.
                counts_of_other_levels = (
                    np.delete(level_counts, [0, len(distinct_levels) - 1]) if len(distinct_levels) > 2 else np.zeros(1)
                )
                if (
                    distinct_levels[extreme_index] != 0
                    and level_counts[extreme_index] >= _MIN_EQUAL_SATURATED_VALUES
                    and level_counts[extreme_index] >= 4 * counts_of_other_levels.max(initial=0)
                ):
                    is_saturated[frame, np.flatnonzero(is_usable_in_row)[level_of_value == extreme_index]] = True
    return is_saturated


def _is_minimum_repeated(value_rows: np.ndarray) -> Bool[np.ndarray, " F"]:
    """Whether at least `_MIN_EQUAL_SATURATED_VALUES` values of a row equal its minimum. NaN is left out."""
    if value_rows.shape[1] < _MIN_EQUAL_SATURATED_VALUES:
        return np.zeros(len(value_rows), bool)
    smallest_values = np.partition(value_rows, _MIN_EQUAL_SATURATED_VALUES - 1, axis=1)[:, :_MIN_EQUAL_SATURATED_VALUES]
    return smallest_values.min(axis=1) == smallest_values.max(axis=1)


def _drives_without_and_with_current(
    frame_values: np.ndarray, usable_mask: np.ndarray, protocol: Protocol
) -> tuple[Bool[np.ndarray, "F S"], Bool[np.ndarray, "F S"]]:
    """Masks (frames, drives) of the drives without current, whose voltages are a thousand times smaller than the
    voltages of the median drive, and of the drives with current. Both masks are False for drives without a usable
    voltage."""
    drive_indices = np.asarray(protocol.drive_index)
    max_magnitudes = np.full((frame_values.shape[0], protocol.num_drives), -1.0)
    np.maximum.at(max_magnitudes.T, drive_indices, np.where(usable_mask, np.abs(frame_values), -1.0).T)
    if protocol.num_drives < 3:
        return np.zeros(max_magnitudes.shape, dtype=bool), max_magnitudes >= 0
    dead_threshold = 1e-3 * np.median(np.maximum(max_magnitudes, 0), axis=1, keepdims=True)
    return (max_magnitudes >= 0) & (max_magnitudes < dead_threshold), max_magnitudes >= dead_threshold


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
    mean_reference = reference.mean_frame()
    base_voltages, known_channels = np.asarray(mean_reference.voltages)[0], np.asarray(mean_reference.mask)[0]
    channel_deviations = np.asarray(
        relative_noise(as_array(np.abs(np.where(known_channels, base_voltages, 0))), as_array(known_channels))
    )
    voltages, frame_masks = np.array(measurement.voltages), np.asarray(measurement.mask)
    is_spike_channel, is_filled_frame_channel = np.zeros(frame_masks.shape, bool), np.zeros(frame_masks.shape, bool)
    distinct_masks, mask_index, num_frames = np.unique(
        frame_masks & known_channels, axis=0, return_inverse=True, return_counts=True
    )
    for pattern_index in np.argsort(-num_frames)[:_MAX_DISTINCT_MASKS]:
        frame_mask = distinct_masks[pattern_index]
        change_basis = _possible_changes(measurement, channel_deviations, frame_mask)
        if change_basis is None:
            continue
        for frame in np.flatnonzero(mask_index.ravel() == pattern_index):
            weighted_change = ((voltages[frame] - base_voltages) / channel_deviations)[frame_mask]
            rounding_errors = rounding_of_difference(measurement.frame(int(frame)), mean_reference) / channel_deviations
            is_spike = np.isin(
                np.arange(len(weighted_change)),
                _find_spikes(weighted_change, change_basis, rounding_errors[frame_mask]),
            )
            is_spike_channel[frame, frame_mask] = is_spike
            if fill and is_spike.any():
                # A channel is determined by the other channels if their rows of the basis span its row.
                spike_predictors = change_basis[is_spike] @ np.linalg.pinv(change_basis[~is_spike])
                is_determined = (
                    np.linalg.norm(spike_predictors @ change_basis[~is_spike] - change_basis[is_spike], axis=1)
                    < _MIN_UNDETERMINED_SHARE
                )
                determined_channels = np.flatnonzero(frame_mask)[is_spike][is_determined]
                voltages[frame, determined_channels] = (
                    base_voltages[determined_channels]
                    + channel_deviations[determined_channels]
                    * (spike_predictors @ weighted_change[~is_spike])[is_determined]
                )
                is_filled_frame_channel[frame, determined_channels] = True
    spike_reason = f"spikes, which contradict the other channels ({_listed_spikes(is_spike_channel)})."
    if is_filled_frame_channel.any():
        spike_note = (
            f"{counted(int(is_filled_frame_channel.sum()), 'voltage')} replaced by what others determine: "
            f"{spike_reason}"
        )
        measurement = replace(measurement, voltages=voltages, notes=(*measurement.notes, spike_note))
    return (
        measurement.masked(~is_spike_channel | is_filled_frame_channel, spike_reason)
        if (is_spike_channel & ~is_filled_frame_channel).any()
        else measurement
    )


def _listed_spikes(is_spike_channel: Bool[np.ndarray, "F M"]) -> str:
    """Text that lists the channels with spikes, and their frames if there are several frames."""
    frames, spike_channels = np.nonzero(is_spike_channel)
    spike_labels = [
        f"channel {k + 1}" + (f" of frame {f}" if len(is_spike_channel) > 1 else "")
        for f, k in zip(frames, spike_channels, strict=True)
    ]
    return ", ".join(spike_labels[:_MAX_SPIKES]) + (" …" if len(spike_labels) > _MAX_SPIKES else "")


def _possible_changes(
    measurement: Measurement, channel_deviations: Float[np.ndarray, " M"], frame_mask: Bool[np.ndarray, " M"]
) -> Float[np.ndarray, "n r"] | None:
    """Orthonormal basis (n, r) of the r-dimensional space of changes of the n usable channels, divided by
    `channel_deviations`, that a change of a symmetric transfer impedance can cause. None if every change is possible,
    or if the computation would take too long."""
    channel_drives = np.asarray(measurement.protocol.channel_drive)[frame_mask]
    measurements = np.asarray(measurement.protocol.channel_measurement)[frame_mask]
    row_indices, column_indices = np.triu_indices(channel_drives.shape[1])
    if len(channel_drives) * len(row_indices) * min(len(channel_drives), len(row_indices)) > _MAX_OPERATIONS or not len(
        channel_drives
    ):
        return None
    channel_drives = channel_drives / np.abs(channel_drives).max()
    drive_measurement_products = (
        channel_drives[:, row_indices] * measurements[:, column_indices]
        + channel_drives[:, column_indices] * measurements[:, row_indices]
    )
    change_basis, singular_values, _ = np.linalg.svd(
        drive_measurement_products / channel_deviations[frame_mask, None], full_matrices=False
    )
    change_basis = change_basis[:, singular_values > 1e-9 * singular_values[0]]
    return change_basis if change_basis.shape[1] < len(channel_drives) else None


def _find_spikes(
    weighted_change: Inexact[np.ndarray, " n"],
    change_basis: Float[np.ndarray, "n r"],
    rounding_errors: Float[np.ndarray, " n"],
) -> list[int]:
    """Indices of the channels with spikes in a `weighted_change` (n,) of n channels; `rounding_errors` (n,):
    standard deviation of the change due to rounding.

    If a suspected channel may have any value, its unit vector is added to the basis. The power that this vector
    explains, `gain`, is compared with the power that the basis alone leaves unexplained.
    """
    change_residual, undetermined_share = (
        weighted_change - change_basis @ (change_basis.T @ weighted_change),
        1 - np.sum(change_basis**2, axis=1),
    )
    is_remaining_channel, faulty_channels, spike_channels = np.ones(len(weighted_change), bool), [], []
    for _ in range(_MAX_SPIKES):
        is_predicted_by_others = is_remaining_channel & (undetermined_share > _MIN_UNDETERMINED_SHARE)
        spike_sizes = np.where(
            is_predicted_by_others,
            np.abs(change_residual) / np.sqrt(np.maximum(undetermined_share, _MIN_UNDETERMINED_SHARE)),
            0,
        )
        worst_channels = np.flatnonzero(spike_sizes > (1 - _MIN_UNDETERMINED_SHARE) * spike_sizes.max())
        if not 0 < len(worst_channels) <= 2:
            break
        residual_deviation = max(
            1.4826 * float(np.median(spike_sizes[is_predicted_by_others])), float(rounding_errors[worst_channels].max())
        )
        if not spike_sizes.max() > _MIN_SPIKE_DEVIATIONS * residual_deviation:
            break
        fault_direction = np.zeros(len(weighted_change))
        fault_direction[worst_channels[0]] = 1
        for _ in range(2):  # projected twice, so that rounding errors do not destroy orthogonality
            fault_direction = fault_direction - change_basis @ (change_basis.T @ fault_direction)
        fault_direction = fault_direction / np.linalg.norm(fault_direction)
        unexplained_power, explained_power = (
            float(np.sum(np.abs(change_residual) ** 2)),
            float(np.abs(fault_direction @ change_residual) ** 2),
        )
        spike_size = float((spike_sizes[worst_channels] / np.sqrt(undetermined_share[worst_channels])).max())
        change_basis = np.column_stack([change_basis, fault_direction])
        change_residual, undetermined_share = (
            change_residual - fault_direction * (fault_direction @ change_residual),
            undetermined_share - fault_direction**2,
        )
        faulty_channels += _faulty_channels(weighted_change, worst_channels)
        is_remaining_channel[worst_channels] = False
        root_mean_square_change = float(np.sqrt(np.mean(np.abs(weighted_change[is_remaining_channel]) ** 2)))
        if spike_size > root_mean_square_change and explained_power > _MIN_SPIKE_POWER_SHARE * unexplained_power:
            spike_channels = [*faulty_channels]
    return spike_channels


def _faulty_channels(weighted_change: Inexact[np.ndarray, " n"], candidate_channels: np.ndarray) -> list[int]:
    """Return the faulty channels among one or two channels that contradict the other channels or each other: the
    channel with the far larger change, or both channels if their changes are similar."""
    change_sizes = np.abs(weighted_change[candidate_channels])
    is_largest_only = change_sizes.max() > _MIN_FAULTY_CHANGE_RATIO * change_sizes.min()
    return [int(candidate_channels[change_sizes.argmax()])] if is_largest_only else candidate_channels.tolist()
