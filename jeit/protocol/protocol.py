"""`Protocol`: drive patterns, measurement patterns and channels; and checks of a protocol's arguments."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import did_you_mean, object_text
from jeit.protocol.reciprocity import reciprocal_channel_pairs
from jeit_solvers.engines import as_array, has_values, numpy_or_compiled
from jeit_solvers.module import Module


def check_patterns(patterns, pattern_kind: str) -> None:
    """Raise `ValueError` unless drive or measurement patterns (patterns, electrodes) are finite, no pattern is zero,
    and every pattern sums to zero."""
    if patterns.ndim != 2 or patterns.shape[0] == 0 or patterns.shape[1] < 2:
        raise ValueError(
            f"Protocol: {pattern_kind} patterns have shape {tuple(patterns.shape)}. Give a matrix with one row per "
            "pattern and one column per electrode, at least 1 x 2."
        )
    if not has_values(patterns):
        return
    pattern_array = np.asarray(patterns)
    invalid_rows = np.flatnonzero(~np.all(np.isfinite(pattern_array), axis=1))
    if invalid_rows.size:
        raise ValueError(
            f"Protocol: {pattern_kind} pattern {invalid_rows[0]} contains NaN or infinity. Leave missing electrodes "
            "out of the patterns with 0, and mask their channels."
        )
    max_pattern_weights = np.max(np.abs(pattern_array), axis=1)
    invalid_rows = np.flatnonzero(max_pattern_weights == 0)
    if invalid_rows.size:
        raise ValueError(
            f"Protocol: {pattern_kind} pattern {invalid_rows[0]} is all zero: it drives or measures nothing. Remove it "
            f"({invalid_rows.size} such rows)."
        )
    relative_pattern_sums = np.abs(pattern_array.sum(axis=1)) / max_pattern_weights
    invalid_rows = np.flatnonzero(relative_pattern_sums > 1e-9)
    if invalid_rows.size:
        zero_sum_reason = (
            "current that goes in must come out"
            if pattern_kind == "drive"
            else "only differences of potential can be measured; subtract a reference electrode"
        )
        raise ValueError(
            f"Protocol: {pattern_kind} pattern {invalid_rows[0]} sums to {pattern_array[invalid_rows[0]].sum():.6g}, "
            f"not to zero ({zero_sum_reason}). If the matrix has one row per electrode, transpose it."
        )


def check_indices(index, num_patterns: int, name: str, pattern_kind: str) -> None:
    """Raise `ValueError` unless `index` (M,) contains 0-based indices of patterns, as integers below `num_patterns`."""
    if index.ndim != 1 or index.shape[0] == 0:
        raise ValueError(
            f"Protocol: {name} has shape {tuple(index.shape)}; give one integer per channel, at least one."
        )
    if not has_values(index):
        return
    index_array = np.asarray(index)
    if index_array.min() < 0 or index_array.max() >= num_patterns:
        raise ValueError(
            f"Protocol: {name} runs from {index_array.min()} to {index_array.max()}, but there are {num_patterns} "
            f"{pattern_kind} patterns, numbered 0 to {num_patterns - 1}. Indices are 0-based: subtract 1 from MATLAB's."
        )


def check_current(current, function_name: str) -> None:
    """Raise `ValueError` unless a current amplitude in amperes is positive and at most 1 A. A larger number is probably
    in milliamperes."""
    if not has_values(current):
        return
    amplitude = np.asarray(current)
    if amplitude.ndim != 0 or amplitude.dtype.kind not in "fiu" or not np.isfinite(amplitude) or amplitude <= 0:
        raise ValueError(f"{function_name}: current must be one positive, finite number in amperes; got {current!r}.")
    check_amplitude(float(amplitude), function_name)


def check_amplitude(value: float, function_name: str) -> None:
    """Raise `ValueError` for a current amplitude above 1 A. Such a number is probably in milliamperes or
    microamperes."""
    if value > 1.0 + 1e-9:
        raise ValueError(
            f"{function_name}: a current of {value:.6g} A is far above what a tank or a skin carries. Currents are "
            f"in amperes: if you meant {value:.6g} mA, write {value:.6g}e-3 (microamperes: {value:.6g}e-6); "
            "1.0 is accepted as a unit current."
        )


def check_count(num_electrodes, function_name: str, minimum: int) -> int:
    """Return the number of electrodes. Raises `ValueError` unless the number is an integer of at least `minimum`."""
    if (
        isinstance(num_electrodes, bool)
        or not isinstance(num_electrodes, (int, np.integer))
        or num_electrodes < minimum
    ):
        raise ValueError(
            f"{function_name}: the number of electrodes must be an integer of at least {minimum}; got "
            f"{num_electrodes!r}."
        )
    return int(num_electrodes)


def electrode_indices(electrodes, num_electrodes: int) -> np.ndarray:
    """Return 0-based electrode indices as an array. Raises `ValueError` for an index that is not an electrode."""
    index_array = np.atleast_1d(np.asarray(electrodes))
    if index_array.size == 0:
        return np.zeros(0, dtype=int)
    if (
        index_array.ndim != 1
        or index_array.dtype.kind not in "iu"
        or index_array.min() < 0
        or index_array.max() >= num_electrodes
    ):
        raise ValueError(
            f"electrodes {electrodes!r}: give integers from 0 to {num_electrodes - 1} "
            f"(0-based; there are {num_electrodes} electrodes)."
        )
    return index_array


def check_pairs(pairs, num_electrodes: int, argument_name: str) -> np.ndarray:
    """Return electrode pairs (P, 2) as 0-based indices. Raises `ValueError` for arrays of a different shape or type,
    electrodes that do not exist, and an electrode paired with itself."""
    pair_array = np.asarray(pairs)
    if (
        pair_array.ndim != 2
        or pair_array.shape[1] != 2
        or pair_array.shape[0] == 0
        or pair_array.dtype.kind not in "iu"
    ):
        raise ValueError(
            f"{argument_name}: give pairs of electrodes as integers of shape (P, 2); got shape {pair_array.shape} of "
            f"{pair_array.dtype}."
        )
    electrode_indices(pair_array.ravel(), num_electrodes)
    equal_pairs = np.flatnonzero(pair_array[:, 0] == pair_array[:, 1])
    if equal_pairs.size:
        raise ValueError(
            f"{argument_name}: pair {equal_pairs[0]} is electrode {pair_array[equal_pairs[0], 0]} with itself. Use two "
            "different electrodes."
        )
    return pair_array


def check_choice(value, choices: tuple[str, ...], function_name: str, name: str) -> None:
    """Raise `ValueError` unless the value of the argument `name` is one of `choices`."""
    if value not in choices:
        suggestion = did_you_mean(value, choices)
        raise ValueError(
            f"{function_name}: {name} must be one of {', '.join(map(repr, choices))}; got {value!r}{suggestion}."
        )


def _convert_to_float(pattern_values) -> Array:
    return as_array(pattern_values, float)


def _convert_to_indices(index_values) -> Array:
    if not isinstance(index_values, jax.Array) and np.asarray(index_values).dtype.kind not in "iub":
        raise ValueError("Protocol: drive_index and measurement_index must be integers (0-based).")
    return as_array(index_values, np.int32)


@numpy_or_compiled
def _select_rows(pattern_matrix, row_indices):
    return pattern_matrix[row_indices]


class Protocol(Module):
    """Drive patterns, measurement patterns, and channels, each of which combines a drive with a measurement pattern.

    Channel `k` measures `measurement[measurement_index[k]] @ U`, where `U` (L,) are the electrode potentials in volts
    while the currents `drive[drive_index[k]]` flow. Positive current enters the body.

    Protocols are best created by functions such as `adjacent`, `opposite` or `from_matrices`; use this class if all
    four arrays are known.

    **Fields**

    - `drive`: (S, L) currents into the electrodes for each of S drive patterns, amperes; each row sums to zero.
    - `measurement`: (K, L) dimensionless weights of the K distinct measurement patterns; each row sums to zero.
    - `drive_index`: (M,) row of `drive` for each channel.
    - `measurement_index`: (M,) row of `measurement` for each channel.
    - `name`: name of the protocol in reports.

    **Raises** `ValueError` for patterns with NaN, with a zero row, with a row that does not sum to zero, or with
    different numbers of electrodes, and for indices out of range.

    **Example:**

    ```python
    pairs = np.array([[1.0, -1, 0, 0], [0, 1, -1, 0], [0, 0, 1, -1]])
    protocol = Protocol(1e-3 * pairs[:1], pairs[1:], drive_index=[0, 0], measurement_index=[0, 1])
    ```
    """

    drive: Float[Array, "S L"] = eqx.field(converter=_convert_to_float)
    measurement: Float[Array, "K L"] = eqx.field(converter=_convert_to_float)
    drive_index: Int[Array, " M"] = eqx.field(converter=_convert_to_indices)
    measurement_index: Int[Array, " M"] = eqx.field(converter=_convert_to_indices)
    name: str = eqx.field(static=True, default="custom")

    def __check_init__(self):
        check_patterns(self.drive, "drive")
        check_patterns(self.measurement, "measurement")
        if self.drive.shape[1] != self.measurement.shape[1]:
            raise ValueError(
                f"Protocol: drive patterns have {self.drive.shape[1]} electrodes (columns) but measurement "
                f"patterns have {self.measurement.shape[1]}. Both need one column per electrode; transpose "
                "the one that has one row per electrode."
            )
        check_indices(self.drive_index, self.drive.shape[0], "drive_index", "drive")
        check_indices(self.measurement_index, self.measurement.shape[0], "measurement_index", "measurement")
        if self.drive_index.shape != self.measurement_index.shape:
            raise ValueError(
                f"Protocol: drive_index has {self.drive_index.shape[0]} entries and measurement_index "
                f"{self.measurement_index.shape[0]}. Both need one entry per channel."
            )

    def __repr__(self) -> str:
        return object_text(
            lambda: (
                f"Protocol({self.name!r}: {self.num_electrodes} electrodes, {self.num_drives} drives, "
                f"{self.num_measurements} channels)"
            ),
            self,
        )

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L."""
        return self.drive.shape[-1]

    @property
    def num_drives(self) -> int:
        """Number of drive patterns S."""
        return self.drive.shape[-2]

    @property
    def num_measurements(self) -> int:
        """Number of channels M, i.e. of voltages in one frame."""
        return self.drive_index.shape[-1]

    @property
    def channel_drive(self) -> Float[Array, "M L"]:
        """Currents (M, L), in amperes, that flow while each channel is measured."""
        return _select_rows(self.drive, self.drive_index)

    @property
    def channel_measurement(self) -> Float[Array, "M L"]:
        """Weights (M, L) of the electrode potentials in the voltage of each channel, dimensionless."""
        return _select_rows(self.measurement, self.measurement_index)

    def channels_touching(self, electrodes: int | Sequence[int]) -> Bool[np.ndarray, " M"]:
        """Whether each channel (M,) drives or measures any of `electrodes` (0-based indices).

        Raises `ValueError` for an index that is not an electrode.
        """
        checked_electrodes = electrode_indices(electrodes, self.num_electrodes)
        has_driven_electrode = np.any(np.asarray(self.drive)[:, checked_electrodes] != 0, axis=1)
        has_measured_electrode = np.any(np.asarray(self.measurement)[:, checked_electrodes] != 0, axis=1)
        return np.logical_or(
            has_driven_electrode[np.asarray(self.drive_index)],
            has_measured_electrode[np.asarray(self.measurement_index)],
        )

    def mask_without(self, electrodes: int | Sequence[int]) -> Bool[np.ndarray, " M"]:
        """Whether each channel (M,) is still usable when `electrodes` (0-based) are missing or broken."""
        return ~self.channels_touching(electrodes)

    def channels_on_driven_electrodes(self) -> Bool[np.ndarray, " M"]:
        """Whether each channel (M,) measures on an electrode that carries current.

        The voltage of such a channel includes the voltage drop at the contact impedance.
        """
        has_shared_electrode = shares_electrode(np.asarray(self.drive), np.asarray(self.measurement))
        return has_shared_electrode[np.asarray(self.drive_index), np.asarray(self.measurement_index)]

    def subset(self, keep: ArrayLike) -> "Protocol":
        """Create a protocol with only the channels selected by `keep`, and the drive and measurement patterns that they
        use.

        `keep` is a boolean mask (M,) or a sequence of channel indices; the corresponding voltages are `voltages[...,
        keep]`. Raises `ValueError` for a mask of a wrong length, or if no channel is selected.
        """
        kept_channels = np.asarray(keep)
        if kept_channels.dtype == bool:
            if kept_channels.shape != (self.num_measurements,):
                raise ValueError(
                    f"subset: the mask has shape {kept_channels.shape}, the protocol {self.num_measurements} "
                    "channels. Give one True or False per channel."
                )
            kept_channels = np.flatnonzero(kept_channels)
        elif kept_channels.size and (
            kept_channels.dtype.kind not in "iu"
            or kept_channels.min() < 0
            or kept_channels.max() >= self.num_measurements
        ):
            raise ValueError(
                f"subset: channels must be integers from 0 to {self.num_measurements - 1}, or a boolean mask."
            )
        if kept_channels.size == 0:
            raise ValueError("subset: no channel is left. Keep at least one.")
        drive_rows, drive_index = np.unique(np.asarray(self.drive_index)[kept_channels], return_inverse=True)
        measurement_rows, measurement_index = np.unique(
            np.asarray(self.measurement_index)[kept_channels], return_inverse=True
        )
        return Protocol(
            drive=_select_rows(self.drive, drive_rows),
            measurement=_select_rows(self.measurement, measurement_rows),
            drive_index=drive_index,
            measurement_index=measurement_index,
            name=f"{self.name}, {kept_channels.size} of {self.num_measurements} channels",
        )

    def repeated_facts(self, channels: ArrayLike | None = None) -> int:
        """Number of redundant channels: channels whose measurement patterns are linear combinations of the measurement
        patterns of other channels of the same drive.

        `channels` (K,): indices of the channels that are considered, by default all. If L voltages are computed from
        the potentials of many electrodes, for example by subtracting the mean potential, they contain L - 1 independent
        values with L - 1 independent noise values. If all measurements of a drive are differences of two electrodes,
        they are assumed to be measured one by one with independent noise, even if the pairs form a ring. No channel of
        such a drive is counted.
        """
        measurement_rows = np.asarray(self.measurement)
        used_channels = np.arange(self.num_measurements) if channels is None else np.asarray(channels)
        drive_indices, measurement_indices = (
            np.asarray(self.drive_index)[used_channels],
            np.asarray(self.measurement_index)[used_channels],
        )
        # Differences of two electrodes are independent, so only drives with other measurements need be examined.
        has_many_electrodes = np.count_nonzero(measurement_rows, axis=1) > 2
        num_redundant_channels, ranks_by_rows = 0, {}
        for drive_number in np.unique(drive_indices[has_many_electrodes[measurement_indices]]):
            rows_of_drive = np.sort(measurement_indices[drive_indices == drive_number])
            rows_key = rows_of_drive.tobytes()
            if rows_key not in ranks_by_rows:
                ranks_by_rows[rows_key] = int(np.linalg.matrix_rank(measurement_rows[rows_of_drive], tol=1e-9))
            num_redundant_channels += len(rows_of_drive) - ranks_by_rows[rows_key]
        return num_redundant_channels

    def reciprocal_pairs(self) -> tuple[Int[np.ndarray, "P 2"], Float[np.ndarray, " P"]]:
        """Pairs of channels whose voltages are proportional by reciprocity, and the ratios of their voltages.

        Returns `pairs` (P, 2) and `ratio` (P,) such that `v[pairs[:, 1]] = ratio * v[pairs[:, 0]]` for any body without
        magnetic bias. In each pair, the drive pattern of either channel is proportional to the measurement pattern of
        the other channel. Some protocols have no such pairs, for example opposite drive with adjacent measurement. See
        `jeit.protocol.reciprocity` for reciprocity between combinations of channels.
        """
        return reciprocal_channel_pairs(
            np.asarray(self.drive),
            np.asarray(self.measurement),
            np.asarray(self.drive_index),
            np.asarray(self.measurement_index),
        )

    def same_patterns(self, other: "Protocol") -> bool:
        """Whether `other` has the same channels in the same order; names of the protocols are ignored."""
        return (
            self.num_electrodes == other.num_electrodes
            and self.num_measurements == other.num_measurements
            and bool(
                np.allclose(
                    _pattern_rows(self.drive, self.drive_index), _pattern_rows(other.drive, other.drive_index), 1e-9, 0
                )
            )
            and bool(
                np.allclose(
                    _pattern_rows(self.measurement, self.measurement_index),
                    _pattern_rows(other.measurement, other.measurement_index),
                    rtol=1e-9,
                    atol=0,
                )
            )
        )


def _pattern_rows(pattern_matrix, pattern_indices) -> np.ndarray:
    """Pattern of each channel: the rows `pattern_indices` of `pattern_matrix`. NumPy is used, because JAX would compile
    the indexing."""
    return np.asarray(pattern_matrix)[np.asarray(pattern_indices)]


def shares_electrode(drive: Float[np.ndarray, "S L"], measurement: Float[np.ndarray, "K L"]) -> Bool[np.ndarray, "S K"]:
    """Mask (S, K): whether measurement pattern k uses an electrode that drive pattern s drives."""
    return (drive != 0).astype(int) @ (measurement != 0).T.astype(int) > 0
