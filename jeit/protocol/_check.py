"""Checks of patterns, currents and indices, with errors that say what to do."""

from __future__ import annotations

import numpy as np

from jeit.arguments import did_you_mean
from jeit_solvers.engines import has_values


def check_patterns(patterns, what: str) -> None:
    """Patterns (rows, L): finite, no zero row, every row summing to zero."""
    if patterns.ndim != 2 or patterns.shape[0] == 0 or patterns.shape[1] < 2:
        raise ValueError(
            f"Protocol: {what} patterns have shape {tuple(patterns.shape)}. Give a matrix with one row per "
            "pattern and one column per electrode, at least 1 x 2."
        )
    if not has_values(patterns):
        return
    values = np.asarray(patterns)
    bad = np.flatnonzero(~np.all(np.isfinite(values), axis=1))
    if bad.size:
        raise ValueError(
            f"Protocol: {what} pattern {bad[0]} contains NaN or infinity. Leave missing electrodes out of "
            "the patterns with 0, and mask their channels."
        )
    size = np.max(np.abs(values), axis=1)
    bad = np.flatnonzero(size == 0)
    if bad.size:
        raise ValueError(
            f"Protocol: {what} pattern {bad[0]} is all zero: it drives or measures nothing. Remove it "
            f"({bad.size} such rows)."
        )
    total = np.abs(values.sum(axis=1)) / size
    bad = np.flatnonzero(total > 1e-9)
    if bad.size:
        reason = (
            "current that goes in must come out"
            if what == "drive"
            else "only differences of potential can be measured; subtract a reference electrode"
        )
        raise ValueError(
            f"Protocol: {what} pattern {bad[0]} sums to {values[bad[0]].sum():.6g}, not to zero ({reason}). "
            "If the matrix has one row per electrode, transpose it."
        )


def check_indices(index, size: int, name: str, of: str) -> None:
    """Indices (M,), 0-based, into `size` patterns."""
    if index.ndim != 1 or index.shape[0] == 0:
        raise ValueError(
            f"Protocol: {name} has shape {tuple(index.shape)}; give one integer per channel, at least one."
        )
    if not has_values(index):
        return
    values = np.asarray(index)
    if values.min() < 0 or values.max() >= size:
        raise ValueError(
            f"Protocol: {name} runs from {values.min()} to {values.max()}, but there are {size} {of} "
            f"patterns, numbered 0 to {size - 1}. Indices are 0-based: subtract 1 from MATLAB's."
        )


def check_current(current, where: str) -> None:
    """Check one amplitude in amperes: positive, and not milliamperes by mistake."""
    if not has_values(current):
        return
    value = np.asarray(current)
    if value.ndim != 0 or value.dtype.kind not in "fiu" or not np.isfinite(value) or value <= 0:
        raise ValueError(f"{where}: current must be one positive, finite number in amperes; got {current!r}.")
    check_amplitude(float(value), where)


def check_amplitude(value: float, where: str) -> None:
    """Above one ampere a tank or skin would boil: the number is in milliamperes or microamperes."""
    if value > 1.0 + 1e-9:
        raise ValueError(
            f"{where}: a current of {value:.6g} A is far above what a tank or a skin carries. Currents are "
            f"in amperes: if you meant {value:.6g} mA, write {value:.6g}e-3 (microamperes: {value:.6g}e-6); "
            "1.0 is accepted as a unit current."
        )


def check_count(number, where: str, least: int) -> int:
    """The number of electrodes, as an int of at least `least`."""
    if isinstance(number, bool) or not isinstance(number, (int, np.integer)) or number < least:
        raise ValueError(f"{where}: the number of electrodes must be an integer of at least {least}; got {number!r}.")
    return int(number)


def electrode_indices(electrodes, num_electrodes: int) -> np.ndarray:
    """0-based electrode indices as an array, each of them existing."""
    values = np.atleast_1d(np.asarray(electrodes))
    if values.size == 0:
        return np.zeros(0, dtype=int)
    if values.ndim != 1 or values.dtype.kind not in "iu" or values.min() < 0 or values.max() >= num_electrodes:
        raise ValueError(
            f"electrodes {electrodes!r}: give integers from 0 to {num_electrodes - 1} "
            f"(0-based; there are {num_electrodes} electrodes)."
        )
    return values


def check_pairs(pairs, num_electrodes: int, what: str) -> np.ndarray:
    """Electrode pairs (P, 2), 0-based, of two different electrodes each."""
    values = np.asarray(pairs)
    if values.ndim != 2 or values.shape[1] != 2 or values.shape[0] == 0 or values.dtype.kind not in "iu":
        raise ValueError(
            f"{what}: give pairs of electrodes as integers of shape (P, 2); got shape {values.shape} of {values.dtype}."
        )
    electrode_indices(values.ravel(), num_electrodes)
    same = np.flatnonzero(values[:, 0] == values[:, 1])
    if same.size:
        raise ValueError(
            f"{what}: pair {same[0]} is electrode {values[same[0], 0]} with itself. Use two different electrodes."
        )
    return values


def check_choice(value, choices: tuple[str, ...], where: str, name: str) -> None:
    """Raise `ValueError` unless the argument `name` is one of `choices`."""
    if value not in choices:
        meant = did_you_mean(value, choices)
        raise ValueError(f"{where}: {name} must be one of {', '.join(map(repr, choices))}; got {value!r}{meant}.")
