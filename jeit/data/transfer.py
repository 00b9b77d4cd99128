"""The transfer impedance of a measured body, and the voltages of the body for other patterns.

The transfer impedance Z (L, L) of L electrodes is symmetric with rows that sum to zero, so it has L (L - 1) / 2
independent entries. Any set of patterns that determines Z, such as L - 1 independent currents on all electrodes,
therefore determines the voltages of every other set of patterns.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from jaxtyping import Inexact

from jeit.data.measurement import Measurement
from jeit.files import check_memory
from jeit.protocol import Protocol

# Singular values smaller than this fraction of the largest singular value belong to combinations of entries of the
# transfer impedance that were not measured.
_MIN_SINGULAR_VALUE = 1e-9
# Estimated number of copies of the equations' matrix in memory while the equations are solved.
_NUM_MEMORY_COPIES = 4


def transfer_impedance(measurement: Measurement) -> Inexact[np.ndarray, "F L L"]:
    """Compute the transfer impedance (F, L, L) of F frames and L electrodes, in ohm: column l contains the potentials
    of all electrodes, minus their mean, per ampere into electrode l.

    The transfer impedance is the symmetric matrix that fits the usable voltages in the least-squares sense.

    **Arguments:**

    - `measurement`: the frames.

    Raises `ValueError` if the voltages do not determine the transfer impedance, because there are too few patterns or
    the voltages of driven electrodes are missing.

    **Example:**

    ```python
    impedance = transfer_impedance(complete)
    ```
    """
    protocol, num_electrodes = measurement.protocol, measurement.protocol.num_electrodes
    current_basis = scipy.linalg.null_space(np.ones((1, num_electrodes)))
    row_indices, column_indices = np.triu_indices(num_electrodes - 1)
    check_memory(
        f"the transfer impedance of '{measurement.name}'",
        8 * _NUM_MEMORY_COPIES * len(row_indices) * measurement.num_channels,
    )
    channel_drives, measurement_patterns = (
        np.asarray(protocol.channel_drive) @ current_basis,
        np.asarray(protocol.channel_measurement) @ current_basis,
    )
    drive_measurement_products = channel_drives[:, row_indices] * measurement_patterns[:, column_indices] + np.where(
        row_indices == column_indices, 0, channel_drives[:, column_indices] * measurement_patterns[:, row_indices]
    )
    largest_current = np.abs(channel_drives).max()
    voltages, frame_masks = np.asarray(measurement.filled()), np.asarray(measurement.mask)
    transfer_impedances = np.empty((measurement.num_frames, num_electrodes, num_electrodes), voltages.dtype)
    for frame_mask in np.unique(frame_masks, axis=0):
        inverse_products = (
            np.linalg.pinv(drive_measurement_products[frame_mask] / largest_current, rcond=_MIN_SINGULAR_VALUE)
            / largest_current
        )
        if np.linalg.norm(
            inverse_products @ drive_measurement_products[frame_mask] - np.eye(len(row_indices))
        ) > 1e-6 * len(row_indices):
            raise ValueError(
                f"'{measurement.name}': its {int(frame_mask.sum())} usable channels leave the transfer impedance open, "
                f"{len(row_indices)} numbers. It takes {num_electrodes - 1} independent currents, read on all "
                "electrodes."
            )
        for frame in np.flatnonzero((frame_masks == frame_mask).all(axis=1)):
            upper_triangle_entries = np.zeros((num_electrodes - 1, num_electrodes - 1), voltages.dtype)
            upper_triangle_entries[row_indices, column_indices] = inverse_products @ voltages[frame, frame_mask]
            transfer_impedances[frame] = (
                current_basis @ (upper_triangle_entries + np.triu(upper_triangle_entries, 1).T) @ current_basis.T
            )
    return transfer_impedances


def converted_to_protocol(reference: Measurement, measurement: Measurement) -> Measurement:
    """Convert the reference to the protocol of a measurement on the same electrodes. The reference is returned
    unchanged if only the amplitude of the currents differs, or if its patterns do not determine the voltages of that
    protocol."""
    measurement_protocol, reference_protocol = measurement.protocol, reference.protocol
    if (
        measurement_protocol.num_electrodes != reference_protocol.num_electrodes
        or measurement_protocol.same_patterns(reference_protocol)
        or _are_proportional(measurement_protocol, reference_protocol)
    ):
        return reference
    try:
        return driven_by(reference, measurement_protocol)
    except ValueError:
        return reference


def _are_proportional(first_protocol: Protocol, second_protocol: Protocol) -> bool:
    """Whether two protocols have the same measurement patterns, and drive patterns that differ by a common factor."""
    if first_protocol.num_measurements != second_protocol.num_measurements:
        return False
    first_drives, second_drives = np.asarray(first_protocol.channel_drive), np.asarray(second_protocol.channel_drive)
    drive_ratio = np.linalg.norm(first_drives) / np.linalg.norm(second_drives)
    return np.allclose(
        first_drives, drive_ratio * second_drives, rtol=1e-6, atol=1e-6 * np.abs(first_drives).max()
    ) and np.allclose(first_protocol.channel_measurement, second_protocol.channel_measurement, rtol=1e-6)


def driven_by(measurement: Measurement, protocol: Protocol) -> Measurement:
    """Compute the voltages that a different `protocol` on the same electrodes would have measured.

    A typical use is a reference that was measured with currents that differ from those of the frames. Noise is
    amplified if the measured patterns barely determine the new voltages. Raises `ValueError` if the numbers of
    electrodes differ, and if the measured voltages do not determine the transfer impedance.

    **Arguments:**

    - `measurement`: the frames.
    - `protocol`: drive and measurement patterns of the voltages to compute.

    **Example:**

    ```python
    converted = driven_by(complete, adjacent(16, current=2e-3))
    ```
    """
    if protocol.num_electrodes != measurement.protocol.num_electrodes:
        raise ValueError(
            f"protocol has {protocol.num_electrodes} electrodes, and '{measurement.name}' "
            f"{measurement.protocol.num_electrodes}; both must be of the same body."
        )
    drive_patterns, measurement_patterns = np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement)
    frame_impedances = transfer_impedance(measurement)
    voltages = np.stack(
        [
            np.einsum("km,km->k", measurement_patterns @ frame_transfer, drive_patterns)
            for frame_transfer in frame_impedances
        ]
    )
    has_same_name = protocol.name == measurement.protocol.name
    difference_text = "other currents of that name read" if has_same_name else f"'{protocol.name}' reads"
    transfer_note = (
        f"'{measurement.name}' was measured with '{measurement.protocol.name}', and turned into what {difference_text}."
    )
    return Measurement(
        voltages,
        np.ones(voltages.shape, bool),
        protocol,
        electrodes=measurement.electrodes,
        domain=measurement.domain,
        name=measurement.name,
        source=measurement.source,
        frame_names=measurement.frame_names,
        notes=(*measurement.notes, transfer_note),
        times=measurement.times,
        uncertainty=measurement.uncertainty,
    )
