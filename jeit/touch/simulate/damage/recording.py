"""Simulate frames of a skin through mishaps: whole, then cut, then mended, and with electrodes that fail."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_key, check_kind, describe, is_number
from jeit.touch.simulate.contact import MovingPress, PressedSkin
from jeit.touch.simulate.damage.electrode_fault import ElectrodeFault, check_fault


class Mishap(eqx.Module):
    """From `time` on, seconds: the skin is `skin`, of the same model and gains, if that is given; and `fault`s are
    there."""

    time: float
    skin: PressedSkin | None = None
    faults: tuple[ElectrodeFault, ...] = ()

    def __check_init__(self):
        """Raises `ValueError` for what is no time, skin or fault."""
        if not (is_number(self.time) and self.time >= 0):
            raise ValueError(f"time must be seconds, zero or more; it is {describe(self.time)}.")
        if self.skin is not None:
            check_kind("skin", self.skin, PressedSkin, "a PressedSkin, that with the damage")
        check_kind("faults", self.faults, tuple, "a tuple of them")
        for number, fault in enumerate(self.faults):
            check_fault(f"faults[{number}]", fault)


def record_mishaps(
    key: Array,
    skin: PressedSkin,
    motions: MovingPress | Sequence[MovingPress],
    seconds: Float[np.ndarray, " T"],
    mishaps: Sequence[Mishap],
) -> Float[np.ndarray, "T M"]:
    """Simulate voltages (T, M) at `seconds` (T,) of a skin under moving presses, `[]` for none, through its mishaps.

    From each mishap on, until the next, skin and faults are those of the mishap. Drift, gains and noise continue
    through all of them. Every frame is solved anew, as a skin with another conductivity. Raises `ValueError` for what
    are no mishaps, those of a skin with other channels, and as `PressedSkin.touched_in_time` does.
    """
    check_key(key)
    check_kind("skin", skin, PressedSkin, "a PressedSkin")
    check_kind("mishaps", mishaps, (list, tuple), "a list of them, [] for none")
    for number, one in enumerate(mishaps):
        check_kind(f"mishaps[{number}]", one, Mishap, "a Mishap(time, skin)")
        if one.skin is not None and one.skin.gain.shape != skin.gain.shape:
            raise ValueError(f"mishaps[{number}] has a skin of {one.skin.gain.size} channels, not of {skin.gain.size}.")
    seconds = np.asarray(seconds, float)
    ends = [*(one.time for one in mishaps), np.inf]
    if list(ends) != sorted(ends):
        raise ValueError("mishaps must be in order of their times.")
    stages = [Mishap(0.0, skin), *mishaps]
    found, now = np.zeros((len(seconds), skin.gain.size)), skin
    for number, (stage, end) in enumerate(zip(stages, ends, strict=True)):
        now = now if stage.skin is None else stage.skin
        there = (seconds >= stage.time if number else seconds >= 0) & (seconds < end)
        if not there.any():
            continue
        exact = exact_record(now, motions, seconds, there)
        for fault_key, fault in enumerate(stage.faults):
            own = jax.random.fold_in(jax.random.fold_in(key, number), fault_key)
            exact[there] += fault.changes(own, now.model, now.conductivity, seconds[there])
        # One key for every stage: their drift and noise are those of one recording.
        found[there] = now.read(key, exact, seconds)[there]
    return found


def exact_record(
    skin: PressedSkin,
    motions: MovingPress | Sequence[MovingPress],
    seconds: Float[np.ndarray, " T"],
    wanted: np.ndarray,
) -> Float[np.ndarray, "T M"]:
    """Voltages (T, M) of the model, undisturbed, in the frames that are `wanted` (T,); at rest in the others. Raises
    `ValueError` as `PressedSkin.touched_in_time` does."""
    voltages = np.tile(np.asarray(skin.model.voltages(skin.conductivity)), (len(seconds), 1))
    if not np.any([np.any(motion.load) for motion in ([motions] if isinstance(motions, MovingPress) else motions)]):
        return voltages
    touched = skin.touched_in_time(motions, seconds)
    cells, change = np.asarray(touched.cells), np.asarray(touched.change)
    rest = np.array(np.broadcast_to(skin.conductivity, skin.model.mesh.num_cells))
    for row in np.flatnonzero(wanted & (change != 0).any(axis=1)):
        conductivity = rest.copy()
        np.multiply.at(conductivity, cells[row], 1 + change[row])
        voltages[row] = np.asarray(skin.model.voltages(conductivity))
    return voltages
