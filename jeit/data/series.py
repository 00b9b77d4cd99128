"""A series of measurements of one set-up as one: of instruments that write a file for every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jeit.data.measurement import Measurement


def join(measurements: Sequence[Measurement]) -> Measurement:
    """All frames of measurements of one set-up, one after the other, with their times if all have some that rise.

    What is said of the body, and notes, are those of the first. Raises `ValueError` for none, and where two drive or
    read differently.
    """
    if not measurements:
        raise ValueError("measurements: there is none; give at least one.")
    first, *others = measurements
    for one in others:
        if one.protocol is not first.protocol and not one.protocol.same_patterns(first.protocol):
            raise ValueError(
                f"'{one.name}' ({one.protocol.name}) is read otherwise than '{first.name}'; join one set-up's."
            )
    names = tuple(name for one in measurements for name in one.frame_names)
    held: list[Any] = [one.times for one in measurements]
    times = None if any(one is None for one in held) else np.concatenate([np.asarray(one) for one in held])
    mask = np.concatenate([np.asarray(one.mask) for one in measurements])
    return replace(
        first,
        voltages=np.concatenate([np.asarray(one.voltages) for one in measurements]),
        mask=mask,
        frame_names=names if len(names) == len(mask) else (),
        times=None if times is None or (np.diff(times) <= 0).any() else times,
    )
