"""Protocols with drive patterns that use all electrodes at once, from matrices or named families, and measurement
patterns for the potentials of all electrodes.

Each of the named protocols can use any of the measurement patterns of `measurement_patterns`. Electrodes are numbered
along a ring, or in any order on a solid. With L electrodes, any L - 1 independent drive patterns determine the transfer
impedance, and thereby the voltages of every other protocol (`jeit.data.driven_by`).
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from jeit.arguments import counted
from jeit.protocol.patterns import Current, pair_patterns, ring_pairs
from jeit.protocol.protocol import (
    Protocol,
    check_amplitude,
    check_choice,
    check_count,
    check_current,
    electrode_indices,
)
from jeit_solvers.engines import has_values

Reading = Literal["adjacent", "mean", "mean-removed", "against"]
READINGS = ("adjacent", "mean", "mean-removed", "against")
"""Ways to measure the potentials of all electrodes."""


def measurement_patterns(num_electrodes: int, measurement: Reading, reference: int | None = None) -> np.ndarray:
    """Measurement patterns (K, L) that together measure the potentials of all L electrodes.

    - "adjacent": each electrode against the next, K = L; the L voltages sum to zero for every body.
    - "mean-removed": each potential minus the mean of all potentials, K = L, as published for instruments that drive
      every electrode; these voltages also sum to zero, so only L - 1 of the L values are independent.
    - "mean": each potential minus the mean of all other potentials, K = L; L / (L - 1) times the "mean-removed" values.
    - "against": each electrode against electrode `reference` (0-based, by default the last), K = L - 1.

    **Arguments:**

    - `num_electrodes`: L.
    - `measurement`: one of the four names above.
    - `reference`: reference electrode of "against".

    Raises `ValueError` for an invalid number of electrodes or option, for a `reference` that is not an electrode, and
    for a `reference` if `measurement` is not "against".

    **Example:**

    ```python
    patterns = measurement_patterns(16, "against", reference=0)
    ```
    """
    electrode_count = check_count(num_electrodes, "measurement_patterns", 2)
    check_choice(measurement, READINGS, "measurement_patterns", "measurement")
    if measurement != "against" and reference is not None:
        raise ValueError(f"reference has no use with measurement = {measurement!r}; leave it out, or read against it.")
    if measurement == "adjacent":
        return pair_patterns(ring_pairs(electrode_count, 1), electrode_count)
    if measurement == "mean-removed":
        return np.eye(electrode_count) - 1 / electrode_count
    if measurement == "mean":
        return np.eye(electrode_count) - (1 - np.eye(electrode_count)) / (electrode_count - 1)
    reference_index = (
        electrode_count - 1 if reference is None else int(electrode_indices(reference, electrode_count)[0])
    )
    other_indices = np.delete(np.arange(electrode_count), reference_index)
    return pair_patterns(
        np.stack([other_indices, np.full(electrode_count - 1, reference_index)], axis=1), electrode_count
    )


def from_matrices(
    drive: ArrayLike,
    measurement: ArrayLike,
    select: ArrayLike | None = None,
    *,
    name: str = "custom",
    large_currents: bool = False,
) -> Protocol:
    """Create a protocol that combines every drive pattern with every measurement pattern. Channels are in the order of
    `select.ravel()`: all measurements of the first drive, then all measurements of the second drive, and so on.

    **Arguments:**

    - `drive` (S, L): currents in amperes, one row per drive.
    - `measurement` (K, L): weights of the electrode potentials, one row per measurement pattern.
    - `select` (S, K): True for the combinations of drive and measurement pattern that are measured; by default all.
    - `name`: name in reports.
    - `large_currents`: accept currents above 1 A, which are otherwise rejected as probable errors of units.

    Raises `ValueError` for patterns that `Protocol` rejects, currents above 1 A (unless `large_currents`), and a
    `select` whose shape is not (S, K).

    **Example:**

    ```python
    pairs = np.eye(8) - np.roll(np.eye(8), 1, axis=1)
    protocol = from_matrices(1e-3 * pairs, pairs)
    ```
    """
    drive, measurement = _convert_to_matrix(drive, "drive"), _convert_to_matrix(measurement, "measurement")
    if not large_currents:
        _check_currents(drive, "from_matrices")
    selection_shape = (drive.shape[0], measurement.shape[0])
    is_selected = np.ones(selection_shape, dtype=bool) if select is None else np.asarray(select)
    if is_selected.shape != selection_shape or is_selected.dtype != bool:
        raise ValueError(
            f"from_matrices: select has shape {is_selected.shape} of {is_selected.dtype}; give booleans of shape "
            f"{selection_shape}, one per drive (rows) and measurement pattern (columns)."
        )
    if not is_selected.any():
        raise ValueError("from_matrices: select chooses no channel. Set at least one entry to True.")
    drive_index, measurement_index = np.nonzero(is_selected)
    return Protocol(drive, measurement, drive_index, measurement_index, name)


def from_channels(
    drive: ArrayLike,
    channel_measurement: ArrayLike,
    drive_index: ArrayLike,
    *,
    name: str = "custom",
    large_currents: bool = False,
) -> Protocol:
    """Create a protocol from one measurement pattern and one drive index per channel, as is common for measured data.

    **Arguments:**

    - `drive` (S, L): currents in amperes, one row per drive.
    - `channel_measurement` (M, L): weights of the electrode potentials, one row per channel; equal rows are stored
      once.
    - `drive_index` (M,): 0-based index of the drive of each channel.
    - `name`: name in reports.
    - `large_currents`: accept currents above 1 A, which are otherwise rejected as probable errors of units.

    Raises `ValueError` for patterns that `Protocol` rejects, currents above 1 A (unless `large_currents`), and a
    `drive_index` whose length is not M.

    **Example:**

    ```python
    known = adjacent(8)
    protocol = from_channels(known.drive, known.channel_measurement, known.drive_index)
    ```
    """
    drive, measurement_rows = _convert_to_matrix(drive, "drive"), _convert_to_matrix(channel_measurement, "measurement")
    if not large_currents:
        _check_currents(drive, "from_channels")
    drive_indices = np.asarray(drive_index)
    if drive_indices.shape != (len(measurement_rows),):
        raise ValueError(
            f"from_channels: drive_index has shape {drive_indices.shape}; give one drive number for each of the "
            f"{len(measurement_rows)} channels."
        )
    if not np.all(np.isfinite(measurement_rows)):
        raise ValueError("from_channels: the measurement patterns contain NaN or infinity. Mask channels instead.")
    _, first_row_indices, distinct_row_indices = np.unique(
        measurement_rows, axis=0, return_index=True, return_inverse=True
    )
    # Keep the order of first appearance, so that a file's numbering of its patterns is preserved.
    order_of_appearance = np.argsort(first_row_indices)
    appearance_ranks = np.empty_like(order_of_appearance)
    appearance_ranks[order_of_appearance] = np.arange(len(order_of_appearance))
    return Protocol(
        drive,
        measurement_rows[first_row_indices[order_of_appearance]],
        drive_indices,
        appearance_ranks[distinct_row_indices.ravel()],
        name,
    )


def _convert_to_matrix(pattern_values: Any, pattern_kind: str) -> np.ndarray:
    if not has_values(pattern_values):
        return pattern_values
    if hasattr(pattern_values, "toarray"):  # a scipy.sparse matrix, as loadmat returns for EIDORS patterns
        pattern_values = pattern_values.toarray()
    matrix = np.asarray(pattern_values)
    if matrix.ndim != 2 or matrix.dtype.kind not in "fiu":
        raise ValueError(
            f"Protocol: {pattern_kind} patterns must be a matrix of real numbers, one row per pattern; got shape "
            f"{matrix.shape} of {matrix.dtype}."
        )
    return matrix.astype(float)


def _check_currents(drive_patterns, function_name: str) -> None:
    if has_values(drive_patterns) and drive_patterns.size and np.all(np.isfinite(drive_patterns)):
        check_amplitude(float(np.max(np.abs(drive_patterns))), function_name)


# Drive patterns whose distinguishability, relative to the maximum, is below this value are due to rounding.
_MIN_DISTINGUISHABILITY = 1e-12


def trigonometric(
    num_electrodes: int,
    *,
    measurement: Reading = "adjacent",
    reference: int | None = None,
    current: Current = 1e-3,
) -> Protocol:
    """Protocol that drives sinusoidal currents through all L electrodes at once: L - 1 drives, L(L - 1) channels.

    The drives are cos(θ), sin(θ), cos(2θ), sin(2θ), ... with θ = 2πl/L at electrode l. These patterns best distinguish
    a disk with a centred inclusion from a homogeneous disk (Isaacson 1986; Gisser, Isaacson and Newell 1988). 16
    electrodes give 240 channels. On a solid, θ still follows the electrodes' numbers; the drives then still determine
    the transfer impedance, but are not optimal.

    **Arguments:**

    - `num_electrodes`: L.
    - `measurement`, `reference`: as in `measurement_patterns`.
    - `current`: amplitude in amperes.

    Raises `ValueError` for an invalid count, current or option.

    **Example:**

    ```python
    protocol = trigonometric(16)
    ```
    """
    electrode_count = check_count(num_electrodes, "trigonometric", 3)
    electrode_angles = 2 * np.pi * np.arange(electrode_count) / electrode_count
    wave_patterns = [
        wave_function(k * electrode_angles)
        for k in range(1, electrode_count // 2 + 1)
        for wave_function in (np.cos, np.sin)
    ]
    drive_patterns = np.array(wave_patterns[: electrode_count - 1])
    drive_patterns -= drive_patterns.mean(axis=1, keepdims=True)  # removes rounding errors that violate Kirchhoff's law
    return _combine_all_patterns("trigonometric", drive_patterns, measurement, reference, current)


def haar(
    num_electrodes: int,
    *,
    measurement: Reading = "mean-removed",
    reference: int | None = None,
    current: Current = 1e-3,
) -> Protocol:
    """Protocol whose drives are Haar wavelets over the numbers of the L electrodes: L - 1 orthogonal drives, from
    coarse to fine.

    The first drive sends current from the first half of the electrodes to the second half, the next two drives send
    current between the quarters of each half, and so on (Haar 1910). If L is not a power of two, halves differ by one
    electrode, and each electrode of the larger half carries less current, so that the currents sum to zero (unbalanced
    wavelets: Girardi and Sweldens 1997).

    **Arguments:**

    - `num_electrodes`: L, at least 2.
    - `measurement`, `reference`: as in `measurement_patterns`.
    - `current`: maximum current of an electrode in each drive, amperes.

    Raises `ValueError` for an invalid count, current or option.

    **Example:**

    ```python
    protocol = haar(16)
    ```
    """
    electrode_count = check_count(num_electrodes, "haar", 2)
    electrode_groups, drive_rows = [np.arange(electrode_count)], []
    while electrode_groups:
        electrode_group = electrode_groups.pop(0)
        first_electrodes, second_electrodes = np.array_split(electrode_group, 2)
        drive_pattern = np.zeros(electrode_count)
        drive_pattern[first_electrodes], drive_pattern[second_electrodes] = (
            len(second_electrodes),
            -len(first_electrodes),
        )
        drive_rows.append(drive_pattern / len(first_electrodes))  # the first half is at least as large as the second
        electrode_groups += [half_group for half_group in (first_electrodes, second_electrodes) if len(half_group) > 1]
    drive_patterns = np.array(drive_rows)
    return _combine_all_patterns(
        "haar", drive_patterns / np.abs(drive_patterns).max(axis=1, keepdims=True), measurement, reference, current
    )


def optimal(
    transfer: ArrayLike,
    other: ArrayLike | None = None,
    *,
    number: int | None = None,
    power: float | None = None,
    measurement: Reading = "mean-removed",
    reference: int | None = None,
    current: Current = 1e-3,
) -> Protocol:
    """Protocol of the drive patterns that best distinguish two bodies, the best pattern first: at most L - 1 drives.

    **Arguments:**

    - `transfer`, `other` (L, L): transfer impedances Z₁ and Z₂ of the first and second body, ohm
      (`ForwardModel.transfer_impedance`, or measured: `jeit.data.transfer_impedance`). Without `other`, the drives are
      the eigenvectors of `transfer`.
    - `number`: maximum number of drives, by default L - 1; if Z₁ - Z₂ has a lower rank, there are fewer drives.
    - `power`: if specified, in watts, the drives I maximise ‖(Z₁ - Z₂) I‖ for fixed power Iᵀ Z₁ I (Cheney and Isaacson
      1992), and each drive dissipates `power` in the first body. `power` requires `other`, and `current` is then not
      used.
    - `measurement`, `reference`: as in `measurement_patterns`.
    - `current`: unless `power` is specified, the drives I maximise ‖(Z₁ - Z₂) I‖ for fixed ‖I‖. These drives are
      singular vectors of Z₁ - Z₂ (Isaacson 1986; Gisser, Isaacson and Newell 1990), each scaled so that the maximum
      current of an electrode is `current` amperes.

    Raises `ValueError` for matrices that are not square, real, finite, and symmetric to within a tenth; for equal
    matrices; if `power` is specified and some currents dissipate no power in `transfer`; and for invalid options.

    **Example:**

    ```python
    protocol = optimal(transfer, number=5)
    ```
    """
    first_transfer = _check_transfer_impedance("transfer", transfer)
    electrode_count = len(first_transfer)
    check_current(current, "optimal")
    max_drives = electrode_count - 1 if number is None else check_count(number, "optimal: number", 1)
    # Project the matrices to an orthonormal basis of the currents that sum to zero.
    current_basis = scipy.linalg.null_space(np.ones((1, electrode_count)))
    power_matrix = current_basis.T @ first_transfer @ current_basis
    transfer_change = power_matrix
    if other is not None:
        second_transfer = _check_transfer_impedance("other", other)
        if second_transfer.shape != first_transfer.shape:
            raise ValueError(
                f"other: its shape is {second_transfer.shape}, and that of transfer {first_transfer.shape}; give one "
                "body's."
            )
        transfer_change = power_matrix - current_basis.T @ second_transfer @ current_basis
    if np.linalg.norm(transfer_change) <= _MIN_DISTINGUISHABILITY * np.linalg.norm(power_matrix):
        raise ValueError("other: it equals transfer, and no current distinguishes them.")
    if power is None:
        eigenvalues, drive_directions = _sort_by_eigenvalue(np.linalg.eigh(transfer_change @ transfer_change))
    else:
        drive_directions, eigenvalues = _drives_for_power(power_matrix, transfer_change, power, other is None)
    is_distinguishing = eigenvalues > _MIN_DISTINGUISHABILITY * eigenvalues[0]
    drive_patterns = (current_basis @ drive_directions[:, is_distinguishing][:, :max_drives]).T
    # The sign of an eigenvector is arbitrary: make its largest component positive.
    drive_patterns *= np.sign(drive_patterns[np.arange(len(drive_patterns)), np.abs(drive_patterns).argmax(axis=1)])[
        :, None
    ]
    if power is None:
        drive_patterns /= np.abs(drive_patterns).max(axis=1, keepdims=True)
        return _combine_all_patterns("optimal", drive_patterns, measurement, reference, current)
    drive_patterns *= np.sqrt(power / np.einsum("si,ij,sj->s", drive_patterns, first_transfer, drive_patterns))[:, None]
    check_amplitude(float(np.abs(drive_patterns).max()), "optimal: power")
    return _combine_all_patterns("optimal for a given power", drive_patterns, measurement, reference, 1.0)


def _drives_for_power(
    power_matrix, transfer_change, drive_power: float, has_one_body: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the drives that maximise distinguishability for fixed power, and their squared
    distinguishabilities, the largest first."""
    if has_one_body:
        raise ValueError("power needs other: with one body alone the currents for a given power are those of no power.")
    if isinstance(drive_power, bool) or not isinstance(drive_power, int | float) or not 0 < drive_power < np.inf:
        raise ValueError(f"power must be a positive number of watts; it is {drive_power!r}.")
    symmetric_power_matrix = (power_matrix + power_matrix.T) / 2
    if np.linalg.eigvalsh(symmetric_power_matrix)[0] <= 0:
        raise ValueError("transfer: some currents dissipate no power in it; is it the transfer impedance of a body?")
    eigenvalues, drive_directions = _sort_by_eigenvalue(
        scipy.linalg.eigh(transfer_change @ transfer_change, symmetric_power_matrix)
    )
    return drive_directions, eigenvalues


def _sort_by_eigenvalue(eigenpairs) -> tuple[np.ndarray, np.ndarray]:
    """Sort eigenvalues and eigenvectors by eigenvalue, with the largest first."""
    eigenvalues, eigenvectors = eigenpairs
    return eigenvalues[::-1], eigenvectors[:, ::-1]


def _check_transfer_impedance(name: str, transfer_impedance: ArrayLike) -> np.ndarray:
    matrix = np.asarray(transfer_impedance)
    if matrix.ndim == 3 and matrix.shape[1] == matrix.shape[2]:
        raise ValueError(
            f"{name} has shape {matrix.shape}, of {counted(len(matrix), 'frame')}; give one, (L, L): {name}[0] of the "
            "first, or their mean over axis 0."
        )
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or len(matrix) < 2 or matrix.dtype.kind not in "fiu":
        raise ValueError(f"{name} has shape {matrix.shape} of {matrix.dtype}; give real ohms, one row per electrode.")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name} contains NaN or infinity; leave out electrodes that are not known.")
    matrix = matrix.astype(float)
    if np.linalg.norm(matrix - matrix.T) > 0.1 * np.linalg.norm(matrix):
        raise ValueError(f"{name} is not symmetric, as the transfer impedance of every body is; is it one?")
    return (matrix + matrix.T) / 2


def _combine_all_patterns(
    protocol_name: str, drive_patterns, measurement: Reading, reference: int | None, current: Current
) -> Protocol:
    """Protocol that combines every drive pattern with every measurement pattern of the kind `measurement`."""
    check_current(current, protocol_name)
    measurement_rows = measurement_patterns(drive_patterns.shape[1], measurement, reference)
    return from_matrices(
        current * drive_patterns,
        measurement_rows,
        name=f"{protocol_name}, {measurement} measurement, {drive_patterns.shape[1]} electrodes",
    )
