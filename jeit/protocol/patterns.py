"""Protocols with drive and measurement patterns that are pairs of electrodes.

Electrodes are counted from 0. For each drive pair, `+current` enters at the first electrode and leaves at the second.
The voltage of each measurement pair is the potential of the first electrode minus the potential of the second.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.protocol.protocol import (
    Protocol,
    check_choice,
    check_count,
    check_current,
    check_pairs,
    electrode_indices,
    shares_electrode,
)
from jeit.protocol.reciprocity import reciprocal_channel_pairs

Order = Literal["rotating", "fixed"]
Reciprocal = Literal["all", "half"]
# Current in amperes: a number or an array. The array may be traced, to differentiate with respect to the current.
Current = float | Float[Array, ""]


def pair_patterns(pairs: np.ndarray, num_electrodes: int) -> np.ndarray:
    """Convert electrode pairs (P, 2) to patterns (P, L) over L electrodes: +1 at the first electrode of the pair, -1 at
    the second."""
    patterns = np.zeros((len(pairs), num_electrodes))
    rows = np.arange(len(pairs))
    patterns[rows, pairs[:, 0]] = 1.0
    patterns[rows, pairs[:, 1]] = -1.0
    return patterns


def ring_pairs(num_electrodes: int, offset: int) -> np.ndarray:
    """Pairs (L, 2) of every electrode of a ring with the electrode that is `offset` positions further along the
    ring."""
    start = np.arange(num_electrodes)
    return np.stack([start, (start + offset) % num_electrodes], axis=1)


@dataclass(frozen=True)
class CrossedPairs:
    """Combinations of every drive pair with every measurement pair.

    - `where`: name of the protocol function, with which error messages begin.
    - `num_electrodes`: number of electrodes L.
    - `drive` (S, 2) and `measurement` (K, 2): pairs of electrodes, counted from 0.
    """

    where: str
    num_electrodes: int
    drive: Int[np.ndarray, "S 2"]
    measurement: Int[np.ndarray, "K 2"]

    def protocol(
        self,
        name: str,
        *,
        current: Current,
        driven_electrodes: bool,
        reciprocal: Reciprocal = "all",
        order: Order = "fixed",
    ) -> Protocol:
        """Create the protocol of the pairs, with the requested channels in the requested order; options as in
        `jeit.protocol.adjacent`.

        Raises `ValueError` for an invalid current or option, and if the options leave no channel.
        """
        check_current(current, self.where)
        check_choice(reciprocal, ("all", "half"), self.where, "reciprocal")
        check_choice(order, ("rotating", "fixed"), self.where, "order")
        num_rows = len(self.measurement)
        drive_index = np.repeat(np.arange(len(self.drive)), num_rows)
        measurement_index = np.tile(np.arange(num_rows), len(self.drive))
        if order == "rotating":
            # Drive i begins with measurement pair i: the pairs are in ring order, one per electrode.
            measurement_index = (measurement_index + drive_index) % num_rows
        # Channels are selected with NumPy at unit current, so that the argument `current` may be traced.
        drive = pair_patterns(self.drive, self.num_electrodes)
        measurement = pair_patterns(self.measurement, self.num_electrodes)
        is_selected = np.ones(len(drive_index), dtype=bool)
        if not driven_electrodes:
            is_selected &= ~shares_electrode(drive, measurement)[drive_index, measurement_index]
        if reciprocal == "half":
            pairs, _ = reciprocal_channel_pairs(drive, measurement, drive_index, measurement_index)
            is_selected[pairs[:, 1]] = False
        if not is_selected.any():
            raise ValueError(
                f"{self.where}: every channel measures on a driven electrode, so none is left. Pass "
                "driven_electrodes=True, or measure other pairs."
            )
        return Protocol(
            drive=current * drive,
            measurement=measurement,
            drive_index=drive_index[is_selected],
            measurement_index=measurement_index[is_selected],
            name=name,
        )


def adjacent(
    num_electrodes: int,
    *,
    current: Current = 1e-3,
    driven_electrodes: bool = False,
    reciprocal: Reciprocal = "all",
    order: Order = "rotating",
) -> Protocol:
    """Protocol of adjacent drive and adjacent measurement: neighbouring electrodes drive and measure; L(L - 3)
    channels.

    16 electrodes give 208 voltages, or 104 with `reciprocal="half"`. Brown and Seagar 1987.

    **Arguments:**

    - `num_electrodes`: number of electrodes L, at least 4.
    - `current`: amplitude in amperes.
    - `driven_electrodes`: whether to measure also on electrodes that carry current (L² channels).
    - `reciprocal`: "half" measures only the first of every two channels that are equal by reciprocity, "all" measures
      both channels.
    - `order`: "rotating" starts the measurements of each drive at the driven pair, "fixed" starts them at electrode 0.

    Raises `ValueError` for an invalid number of electrodes, current or option.

    **Example:**

    ```python
    protocol = adjacent(16, current=5e-3)
    protocol.num_measurements
    ```
    """
    return skip(
        num_electrodes,
        0,
        current=current,
        driven_electrodes=driven_electrodes,
        reciprocal=reciprocal,
        order=order,
    )


def skip(
    num_electrodes: int,
    skipped: int,
    *,
    measurement_skipped: int | None = None,
    current: Current = 1e-3,
    driven_electrodes: bool = False,
    reciprocal: Reciprocal = "all",
    order: Order = "rotating",
) -> Protocol:
    """Protocol whose drive pairs and measurement pairs skip electrodes. Skip-0 is the `adjacent` protocol.

    **Arguments:**

    - `skipped`: number of electrodes between the two driven electrodes.
    - `measurement_skipped`: number of electrodes between the two measured electrodes, by default `skipped`.
    - `num_electrodes`, `current`, `driven_electrodes`, `reciprocal`, `order`: as in `adjacent`.

    Raises `ValueError` for a number of skipped electrodes that is negative or pairs an electrode with itself, and as
    `adjacent` does.

    **Example:**

    ```python
    protocol = skip(16, 4)
    ```
    """
    function_name = "adjacent" if skipped == 0 else "skip"
    count = check_count(num_electrodes, function_name, 4)
    measurement_skipped = skipped if measurement_skipped is None else measurement_skipped
    _check_skipped(skipped, "skipped", count, "skip")
    _check_skipped(measurement_skipped, "measurement_skipped", count, "skip")
    kind = "adjacent" if skipped == 0 else f"skip-{skipped}"
    if measurement_skipped != skipped:
        kind += f", skip-{measurement_skipped} measurement"
    drive, measurement = ring_pairs(count, skipped + 1), ring_pairs(count, measurement_skipped + 1)
    return CrossedPairs(function_name, count, drive, measurement).protocol(
        f"{kind}, {count} electrodes",
        current=current,
        driven_electrodes=driven_electrodes,
        reciprocal=reciprocal,
        order=order,
    )


def _check_skipped(value, name: str, count: int, function_name: str) -> None:
    """Raise `ValueError` unless the argument `name` is a number of electrodes that a pair of a ring of `count`
    electrodes can skip."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value <= count - 2:
        raise ValueError(
            f"{function_name}: {name} must be an integer from 0 to {count - 2} for {count} electrodes; got {value!r}."
        )


def opposite(
    num_electrodes: int,
    *,
    drives: Literal["distinct", "all"] = "distinct",
    current: Current = 1e-3,
    driven_electrodes: bool = False,
    order: Order = "rotating",
) -> Protocol:
    """Protocol of opposite drive and adjacent measurement on L electrodes: L(L - 4)/2 channels from the L/2 distinct
    drives. 16 electrodes give 96 voltages, 8 electrodes 16 voltages.

    **Arguments:**

    - `num_electrodes`, `current`, `driven_electrodes`, `order`: as in `adjacent`.
    - `drives`: "distinct" drives each opposite pair once. "all" also drives each pair in the opposite direction, which
      doubles the number of voltages (to 192 and 32) without adding information.

    Raises `ValueError` for an odd number of electrodes, and as `adjacent` does.

    **Example:**

    ```python
    protocol = opposite(16)
    ```
    """
    count = check_count(num_electrodes, "opposite", 4)
    if count % 2:
        raise ValueError(
            f"opposite: {count} electrodes have no opposite pairs. Use an even number, or `skip(..., "
            f"{count // 2 - 1})`."
        )
    check_choice(drives, ("distinct", "all"), "opposite", "drives")
    pairs = ring_pairs(count, count // 2)
    drive = pairs[: count // 2] if drives == "distinct" else pairs
    return CrossedPairs("opposite", count, drive, ring_pairs(count, 1)).protocol(
        f"opposite, {count} electrodes",
        current=current,
        driven_electrodes=driven_electrodes,
        order=order,
    )


def all_against_one(
    num_electrodes: int,
    *,
    common: int = 0,
    measurement: Literal["common", "adjacent"] = "common",
    current: Current = 1e-3,
    driven_electrodes: bool | None = None,
    reciprocal: Reciprocal = "all",
) -> Protocol:
    """Protocol that drives every electrode in turn against the electrode `common`: L - 1 drives for L electrodes.

    **Arguments:**

    - `num_electrodes`, `current`, `reciprocal`: as in `adjacent`.
    - `common`: index of the electrode against which all others are driven.
    - `measurement`: "common" also measures every electrode against `common` ((L - 1)² channels, all of which use a
      driven electrode); "adjacent" measures pairs of neighbouring electrodes.
    - `driven_electrodes`: whether to measure also on electrodes that carry current. The default is True for
      `measurement="common"`, which requires True, and False otherwise.

    Raises `ValueError` if `common` is not an electrode, for `measurement="common"` with `driven_electrodes=False`, and
    as `adjacent` does.

    **Example:**

    ```python
    protocol = all_against_one(16, common=0, measurement="adjacent")
    ```
    """
    count = check_count(num_electrodes, "all_against_one", 3)
    check_choice(measurement, ("common", "adjacent"), "all_against_one", "measurement")
    electrode_indices(common, count)
    pairs = np.array([(k, common) for k in range(count) if k != common])
    if driven_electrodes is None:
        driven_electrodes = measurement == "common"
    measurement_pairs = pairs if measurement == "common" else ring_pairs(count, 1)
    return CrossedPairs("all_against_one", count, pairs, measurement_pairs).protocol(
        f"all against electrode {common}, {measurement} measurement, {count} electrodes",
        current=current,
        driven_electrodes=driven_electrodes,
        reciprocal=reciprocal,
    )


def reference_electrode(
    num_boundary: int,
    *,
    skipped: int = 0,
    reference: int | None = None,
    current: Current = 1e-3,
    driven_electrodes: bool = False,
    order: Order = "rotating",
) -> Protocol:
    """Protocol that drives pairs of boundary electrodes, and measures each boundary electrode against one reference
    electrode.

    The protocol has `num_boundary + 1` electrodes. 16 boundary electrodes and a central reference electrode give 16 ·
    14 = 224 voltages with adjacent drive (Silvera Tawil et al. 2011, "centre measurement pattern").

    **Arguments:**

    - `num_boundary`: number of boundary electrodes, at least 4.
    - `skipped`: number of electrodes between the two driven electrodes.
    - `reference`: index of the reference electrode among the `num_boundary + 1` electrodes; by default the last.
    - `current`, `driven_electrodes`, `order`: as in `adjacent`.

    Raises `ValueError` for a `reference` that is not an electrode, and as `adjacent` does.

    **Example:**

    ```python
    protocol = reference_electrode(16)
    ```
    """
    count = check_count(num_boundary, "reference_electrode", 4)
    reference = count if reference is None else reference
    electrode_indices(reference, count + 1)
    _check_skipped(skipped, "skipped", count, "reference_electrode")
    boundary = np.array([k for k in range(count + 1) if k != reference])
    drive_name = "adjacent" if skipped == 0 else f"skip-{skipped}"
    drive, measurement = (
        boundary[ring_pairs(count, skipped + 1)],
        np.stack([boundary, np.full(count, reference)], axis=1),
    )
    return CrossedPairs("reference_electrode", count + 1, drive, measurement).protocol(
        f"{drive_name} drive against reference electrode, {count} + 1 electrodes",
        current=current,
        driven_electrodes=driven_electrodes,
        order=order,
    )


def two_terminal(
    num_electrodes: int,
    pairs: ArrayLike | None = None,
    *,
    current: Current = 1e-3,
) -> Protocol:
    """Two-terminal protocol: drives and measures on the same pair of electrodes, pair by pair. Each voltage includes
    the voltage drop at the contact impedances of both electrodes.

    **Arguments:**

    - `num_electrodes`: L.
    - `pairs` (P, 2): indices of electrodes from 0; by default all L(L - 1)/2 pairs.
    - `current`: amplitude in amperes.

    Raises `ValueError` if a pair contains an electrode twice, or an electrode that does not exist.

    **Example:**

    ```python
    protocol = two_terminal(8)
    ```
    """
    count = check_count(num_electrodes, "two_terminal", 2)
    check_current(current, "two_terminal")
    if pairs is None:
        pairs = np.array([(i, j) for i in range(count) for j in range(i + 1, count)])
    checked_pairs = check_pairs(pairs, count, "two_terminal")
    patterns = pair_patterns(checked_pairs, count)
    channels = np.arange(len(checked_pairs))
    return Protocol(
        drive=current * patterns,
        measurement=patterns,
        drive_index=channels,
        measurement_index=channels,
        name=f"two-terminal, {len(checked_pairs)} pairs, {count} electrodes",
    )


def bipolar(
    num_electrodes: int,
    drive_pairs: ArrayLike,
    measurement_pairs: ArrayLike,
    *,
    current: Current = 1e-3,
    driven_electrodes: bool = False,
    reciprocal: Reciprocal = "all",
    name: str = "bipolar",
) -> Protocol:
    """Protocol that combines any drive pairs of electrodes with any measurement pairs, drive by drive.

    **Arguments:**

    - `num_electrodes`, `current`, `driven_electrodes`, `reciprocal`: as in `adjacent`.
    - `drive_pairs` (S, 2), `measurement_pairs` (K, 2): indices of electrodes from 0, the positive electrode first.
    - `name`: name of the protocol in reports.

    Raises `ValueError` if a pair contains an electrode twice, or an electrode that does not exist.

    **Example:**

    ```python
    protocol = bipolar(8, [[0, 4], [2, 6]], [[1, 2], [3, 4], [5, 6]])
    ```
    """
    count = check_count(num_electrodes, "bipolar", 2)
    drive = check_pairs(drive_pairs, count, "bipolar: drive_pairs")
    measurement = check_pairs(measurement_pairs, count, "bipolar: measurement_pairs")
    return CrossedPairs("bipolar", count, drive, measurement).protocol(
        name,
        current=current,
        driven_electrodes=driven_electrodes,
        reciprocal=reciprocal,
    )
