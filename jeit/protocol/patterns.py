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
    row_indices = np.arange(len(pairs))
    patterns[row_indices, pairs[:, 0]] = 1.0
    patterns[row_indices, pairs[:, 1]] = -1.0
    return patterns


def ring_pairs(num_electrodes: int, offset: int) -> np.ndarray:
    """Pairs (L, 2) of every electrode of a ring with the electrode that is `offset` positions further along the
    ring."""
    first_electrodes = np.arange(num_electrodes)
    return np.stack([first_electrodes, (first_electrodes + offset) % num_electrodes], axis=1)


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
        num_measurement_patterns = len(self.measurement)
        drive_index = np.repeat(np.arange(len(self.drive)), num_measurement_patterns)
        measurement_index = np.tile(np.arange(num_measurement_patterns), len(self.drive))
        if order == "rotating":
            # Drive i begins with measurement pair i: the pairs are in ring order, one per electrode.
            measurement_index = (measurement_index + drive_index) % num_measurement_patterns
        # Channels are selected with NumPy at unit current, so that the argument `current` may be traced.
        drive_patterns = pair_patterns(self.drive, self.num_electrodes)
        measurement_patterns = pair_patterns(self.measurement, self.num_electrodes)
        is_selected = np.ones(len(drive_index), dtype=bool)
        if not driven_electrodes:
            is_selected &= ~shares_electrode(drive_patterns, measurement_patterns)[drive_index, measurement_index]
        if reciprocal == "half":
            reciprocal_pairs, _ = reciprocal_channel_pairs(
                drive_patterns, measurement_patterns, drive_index, measurement_index
            )
            is_selected[reciprocal_pairs[:, 1]] = False
        if not is_selected.any():
            raise ValueError(
                f"{self.where}: every channel measures on a driven electrode, so none is left. Pass "
                "driven_electrodes=True, or measure other pairs."
            )
        return Protocol(
            drive=current * drive_patterns,
            measurement=measurement_patterns,
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
    electrode_count = check_count(num_electrodes, function_name, 4)
    measurement_skipped = skipped if measurement_skipped is None else measurement_skipped
    _check_skipped(skipped, "skipped", electrode_count, "skip")
    _check_skipped(measurement_skipped, "measurement_skipped", electrode_count, "skip")
    skip_name = "adjacent" if skipped == 0 else f"skip-{skipped}"
    if measurement_skipped != skipped:
        skip_name += f", skip-{measurement_skipped} measurement"
    drive_pairs, measurement_pairs = (
        ring_pairs(electrode_count, skipped + 1),
        ring_pairs(electrode_count, measurement_skipped + 1),
    )
    return CrossedPairs(function_name, electrode_count, drive_pairs, measurement_pairs).protocol(
        f"{skip_name}, {electrode_count} electrodes",
        current=current,
        driven_electrodes=driven_electrodes,
        reciprocal=reciprocal,
        order=order,
    )


def _check_skipped(num_skipped, argument_name: str, electrode_count: int, function_name: str) -> None:
    """Raise `ValueError` unless the argument `argument_name` is a number of electrodes that a pair of a ring of
    `electrode_count` electrodes can skip."""
    if (
        isinstance(num_skipped, bool)
        or not isinstance(num_skipped, (int, np.integer))
        or not 0 <= num_skipped <= electrode_count - 2
    ):
        raise ValueError(
            f"{function_name}: {argument_name} must be an integer from 0 to {electrode_count - 2} for "
            f"{electrode_count} electrodes; got {num_skipped!r}."
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
    electrode_count = check_count(num_electrodes, "opposite", 4)
    if electrode_count % 2:
        raise ValueError(
            f"opposite: {electrode_count} electrodes have no opposite pairs. Use an even number, or `skip(..., "
            f"{electrode_count // 2 - 1})`."
        )
    check_choice(drives, ("distinct", "all"), "opposite", "drives")
    opposite_pairs = ring_pairs(electrode_count, electrode_count // 2)
    drive_pairs = opposite_pairs[: electrode_count // 2] if drives == "distinct" else opposite_pairs
    return CrossedPairs("opposite", electrode_count, drive_pairs, ring_pairs(electrode_count, 1)).protocol(
        f"opposite, {electrode_count} electrodes",
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
    electrode_count = check_count(num_electrodes, "all_against_one", 3)
    check_choice(measurement, ("common", "adjacent"), "all_against_one", "measurement")
    electrode_indices(common, electrode_count)
    drive_pairs = np.array([(k, common) for k in range(electrode_count) if k != common])
    if driven_electrodes is None:
        driven_electrodes = measurement == "common"
    measurement_pairs = drive_pairs if measurement == "common" else ring_pairs(electrode_count, 1)
    return CrossedPairs("all_against_one", electrode_count, drive_pairs, measurement_pairs).protocol(
        f"all against electrode {common}, {measurement} measurement, {electrode_count} electrodes",
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
    boundary_count = check_count(num_boundary, "reference_electrode", 4)
    reference = boundary_count if reference is None else reference
    electrode_indices(reference, boundary_count + 1)
    _check_skipped(skipped, "skipped", boundary_count, "reference_electrode")
    boundary_electrodes = np.array([k for k in range(boundary_count + 1) if k != reference])
    drive_name = "adjacent" if skipped == 0 else f"skip-{skipped}"
    drive_pairs, measurement_pairs = (
        boundary_electrodes[ring_pairs(boundary_count, skipped + 1)],
        np.stack([boundary_electrodes, np.full(boundary_count, reference)], axis=1),
    )
    return CrossedPairs("reference_electrode", boundary_count + 1, drive_pairs, measurement_pairs).protocol(
        f"{drive_name} drive against reference electrode, {boundary_count} + 1 electrodes",
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
    electrode_count = check_count(num_electrodes, "two_terminal", 2)
    check_current(current, "two_terminal")
    if pairs is None:
        pairs = np.array([(i, j) for i in range(electrode_count) for j in range(i + 1, electrode_count)])
    checked_pairs = check_pairs(pairs, electrode_count, "two_terminal")
    pair_pattern_matrix = pair_patterns(checked_pairs, electrode_count)
    pair_indices = np.arange(len(checked_pairs))
    return Protocol(
        drive=current * pair_pattern_matrix,
        measurement=pair_pattern_matrix,
        drive_index=pair_indices,
        measurement_index=pair_indices,
        name=f"two-terminal, {len(checked_pairs)} pairs, {electrode_count} electrodes",
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
    electrode_count = check_count(num_electrodes, "bipolar", 2)
    checked_drive_pairs = check_pairs(drive_pairs, electrode_count, "bipolar: drive_pairs")
    checked_measurement_pairs = check_pairs(measurement_pairs, electrode_count, "bipolar: measurement_pairs")
    return CrossedPairs("bipolar", electrode_count, checked_drive_pairs, checked_measurement_pairs).protocol(
        name,
        current=current,
        driven_electrodes=driven_electrodes,
        reciprocal=reciprocal,
    )
