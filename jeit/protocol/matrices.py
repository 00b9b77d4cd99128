"""Protocols from matrices: of one's own design, or as found in a data file."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jeit.protocol._check import check_amplitude
from jeit.protocol.protocol import Protocol
from jeit_solvers.engines import has_values


def from_matrices(
    drive: ArrayLike,
    measurement: ArrayLike,
    select: ArrayLike | None = None,
    *,
    name: str = "custom",
    large_currents: bool = False,
) -> Protocol:
    """Every drive pattern crossed with every measurement pattern, drive by drive.

    - `drive`: (S, L) currents in amperes, one row per drive.
    - `measurement`: (K, L) weights, one row per measurement.
    - `select`: (S, K) boolean, which combinations are read; all when not given.
    - `large_currents`: accept currents above 1 A (else taken for a mistake of units).

    Channels are in the order of `select.ravel()`: all measurements of the first drive, then of the second.

    Raises `ValueError` for patterns that `Protocol` refuses, currents above 1 A and a `select` of another
    shape.
    """
    drive, measurement = _as_matrix(drive, "drive"), _as_matrix(measurement, "measurement")
    if not large_currents:
        _check_currents(drive, "from_matrices")
    shape = (drive.shape[0], measurement.shape[0])
    chosen = np.ones(shape, dtype=bool) if select is None else np.asarray(select)
    if chosen.shape != shape or chosen.dtype != bool:
        raise ValueError(
            f"from_matrices: select has shape {chosen.shape} of {chosen.dtype}; give booleans of shape "
            f"{shape}, one per drive (rows) and measurement pattern (columns)."
        )
    if not chosen.any():
        raise ValueError("from_matrices: select chooses no channel. Set at least one entry to True.")
    drive_index, measurement_index = np.nonzero(chosen)
    return Protocol(drive, measurement, drive_index, measurement_index, name)


def from_channels(
    drive: ArrayLike,
    channel_measurement: ArrayLike,
    drive_index: ArrayLike,
    *,
    name: str = "custom",
    large_currents: bool = False,
) -> Protocol:
    """One measurement row and one drive number per channel, as measured data often come.

    - `drive`: (S, L) currents in amperes, one row per drive.
    - `channel_measurement`: (M, L) weights, one row per channel; equal rows are stored once.
    - `drive_index`: (M,) 0-based index of the drive of each channel.

    Raises `ValueError` for patterns that `Protocol` refuses, currents above 1 A (unless `large_currents`),
    and a `drive_index` of another length.
    """
    drive, rows = _as_matrix(drive, "drive"), _as_matrix(channel_measurement, "measurement")
    if not large_currents:
        _check_currents(drive, "from_channels")
    index = np.asarray(drive_index)
    if index.shape != (len(rows),):
        raise ValueError(
            f"from_channels: drive_index has shape {index.shape}; give one drive number for each of the "
            f"{len(rows)} channels."
        )
    if not np.all(np.isfinite(rows)):
        raise ValueError("from_channels: the measurement patterns contain NaN or infinity. Mask channels instead.")
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    # In order of first appearance, so that a file's own numbering of its patterns survives.
    appearance = np.argsort(first)
    rank = np.empty_like(appearance)
    rank[appearance] = np.arange(len(appearance))
    return Protocol(drive, rows[first[appearance]], index, rank[inverse.ravel()], name)


def _as_matrix(values: Any, what: str) -> np.ndarray:
    if not has_values(values):
        return values
    if hasattr(values, "toarray"):  # a scipy.sparse matrix, as loadmat returns EIDORS patterns
        values = values.toarray()
    matrix = np.asarray(values)
    if matrix.ndim != 2 or matrix.dtype.kind not in "fiu":
        raise ValueError(
            f"Protocol: {what} patterns must be a matrix of real numbers, one row per pattern; got shape "
            f"{matrix.shape} of {matrix.dtype}."
        )
    return matrix.astype(float)


def _check_currents(drive, where: str) -> None:
    if has_values(drive) and drive.size and np.all(np.isfinite(drive)):
        check_amplitude(float(np.max(np.abs(drive))), where)
