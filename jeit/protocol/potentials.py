"""Measurement patterns for instruments that read the potentials of all electrodes at once."""

from __future__ import annotations

from typing import Literal

import numpy as np

from jeit.protocol._check import check_choice, check_count, electrode_indices
from jeit.protocol.patterns import pair_patterns, ring_pairs

Reading = Literal["adjacent", "mean", "mean-removed", "against"]
READINGS = ("adjacent", "mean", "mean-removed", "against")
"""What can be read of the potentials of all electrodes."""


def measurement_patterns(num_electrodes: int, measurement: Reading, reference: int | None = None) -> np.ndarray:
    """Measurement patterns (K, L) for the potentials of all electrodes.

    - "adjacent": each electrode against the next, K = L; their sum is zero for every body.
    - "mean-removed": each potential less the mean of all, K = L, as instruments publish that drive every electrode;
      their sum is zero too, so that L potentials hold L - 1 facts.
    - "mean": each against the mean of all others, L / (L - 1) times as large.
    - "against": each against electrode `reference` (0-based; the last unless given), K = L - 1.

    Raises `ValueError` for a bad count or option, and for a `reference` that has no use or does not exist.
    """
    count = check_count(num_electrodes, "measurement_patterns", 2)
    check_choice(measurement, READINGS, "measurement_patterns", "measurement")
    if measurement != "against" and reference is not None:
        raise ValueError(f"reference has no use with measurement = {measurement!r}; leave it out, or read against it.")
    if measurement == "adjacent":
        return pair_patterns(ring_pairs(count, 1), count)
    if measurement == "mean-removed":
        return np.eye(count) - 1 / count
    if measurement == "mean":
        return np.eye(count) - (1 - np.eye(count)) / (count - 1)
    last = count - 1 if reference is None else int(electrode_indices(reference, count)[0])
    others = np.delete(np.arange(count), last)
    return pair_patterns(np.stack([others, np.full(count - 1, last)], axis=1), count)
