"""Pairs of electrodes: as patterns, round a ring, and drive pairs crossed with measurement pairs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Array, Float, Int

from jeit.protocol._check import check_choice, check_current
from jeit.protocol.protocol import Protocol, shares_electrode
from jeit.protocol.reciprocity import reciprocal_channel_pairs

Order = Literal["rotating", "fixed"]
Reciprocal = Literal["all", "half"]
# Amperes; an array, possibly traced, when something is differentiated with respect to it.
Current = float | Float[Array, ""]


def pair_patterns(pairs: np.ndarray, num_electrodes: int) -> np.ndarray:
    """Pairs (P, 2) as patterns (P, L): +1 on the first electrode, -1 on the second."""
    patterns = np.zeros((len(pairs), num_electrodes))
    rows = np.arange(len(pairs))
    patterns[rows, pairs[:, 0]] = 1.0
    patterns[rows, pairs[:, 1]] = -1.0
    return patterns


def ring_pairs(count: int, step: int) -> np.ndarray:
    """Every electrode of a ring with the one `step` further on, (L, 2)."""
    start = np.arange(count)
    return np.stack([start, (start + step) % count], axis=1)


@dataclass(frozen=True)
class CrossedPairs:
    """Every drive pair with every measurement pair, as the protocol function called `where` makes them.

    - `num_electrodes`: L; `drive` (S, 2) and `measurement` (K, 2): electrodes, counted from 0.
    - `where`: what errors begin with.
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
        """The channels asked for, in the order asked for; options as in `jeit.protocol.adjacent`.

        Raises `ValueError` for a bad current or option, and where no channel is left.
        """
        check_current(current, self.where)
        check_choice(reciprocal, ("all", "half"), self.where, "reciprocal")
        check_choice(order, ("rotating", "fixed"), self.where, "order")
        num_rows = len(self.measurement)
        drive_index = np.repeat(np.arange(len(self.drive)), num_rows)
        measurement_index = np.tile(np.arange(num_rows), len(self.drive))
        if order == "rotating":
            # Drive i begins with measurement pair i: pairs are in ring order, one per electrode.
            measurement_index = (measurement_index + drive_index) % num_rows
        # Channels are chosen with NumPy at unit current, so that the current itself may be traced.
        drive = pair_patterns(self.drive, self.num_electrodes)
        measurement = pair_patterns(self.measurement, self.num_electrodes)
        keep = np.ones(len(drive_index), dtype=bool)
        if not driven_electrodes:
            keep &= ~shares_electrode(drive, measurement)[drive_index, measurement_index]
        if reciprocal == "half":
            pairs, _ = reciprocal_channel_pairs(drive, measurement, drive_index, measurement_index)
            keep[pairs[:, 1]] = False
        if not keep.any():
            raise ValueError(
                f"{self.where}: every channel measures on a driven electrode, so none is left. Pass "
                "driven_electrodes=True, or measure other pairs."
            )
        return Protocol(
            drive=current * drive,
            measurement=measurement,
            drive_index=drive_index[keep],
            measurement_index=measurement_index[keep],
            name=name,
        )
