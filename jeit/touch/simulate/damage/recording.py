"""Simulated recordings of damaged skins and of skins with faulty electrodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_key, check_kind, check_name, describe, is_number, real_array
from jeit.forward import ForwardModel
from jeit.forward.model import check_model, select_channels
from jeit.touch.simulate.contact import MovingPress, PressedSkin
from jeit_solvers.module import Module

FaultKind = Literal["dead", "loose", "torn"]
FAULTS: tuple[FaultKind, ...] = ("dead", "loose", "torn")
# Factor of the contact impedance of a dead electrode; and limit of the source's voltage, relative to its maximum for
# the skin at rest.
_DEAD, _RAIL = 1e7, 5.0
# Minimum and maximum factor of the impedance of a loose contact; time constant of the fluctuations of its logarithm, in
# seconds; number of levels for which voltages are solved.
_LOOSE, _FLUCTUATION_TIME, _LEVELS = (10.0, 1000.0), 0.5, 7
# Voltage picked up by a disconnected wire, relative to the root mean square of all voltages.
_STRAY = 0.02


class ElectrodeFault(Module):
    """A fault of an electrode.

    **Fields**

    - `electrode`: its number, from 0.
    - `kind`: "dead": the contact impedance is multiplied by 10⁷, the source is limited to five times its maximum
      voltage at rest, and measurements on the electrode read only noise. "loose": the factor of the contact impedance
      fluctuates between 10 and 1,000, with a time constant of half a second. "torn": the electrode is disconnected; its
      channels read noise, or the constant `rail`.
    - `rail`: constant reading of the channels of a torn electrode, volts, or None.

    **Example:**

    ```python
    event = DamageEvent(1.0, faults=(ElectrodeFault(3, "dead"),))
    frames = record_damage(key, skin, [], np.arange(4.0), [event])
    ```
    """

    electrode: int
    kind: FaultKind = "dead"
    rail: float | None = None

    def __check_init__(self):
        """Check the fields. Raises `ValueError` for an invalid electrode, kind or rail."""
        if not (isinstance(self.electrode, (int, np.integer)) and self.electrode >= 0):
            raise ValueError(f"electrode must be its number, from 0; it is {describe(self.electrode)}.")
        check_name("kind", self.kind, FAULTS)
        if self.rail is not None and not is_number(self.rail):
            raise ValueError(f"rail must be volts, or None; it is {describe(self.rail)}.")

    def changes(
        self, key: Array, model: ForwardModel, conductivity: ArrayLike, seconds: Float[np.ndarray, " T"]
    ) -> Float[np.ndarray, "T M"]:
        """Change of the voltages (T, M) of a skin at rest due to the fault, at times `seconds` (T,), volts.

        `conductivity` of the skin, S/m (2-D: S). Raises `ValueError` for invalid arguments, and for an electrode that
        the model does not have.
        """
        check_key(key)
        check_model(model)
        protocol = model.protocol
        if self.electrode >= protocol.num_electrodes:
            raise ValueError(f"electrode {self.electrode}: the model has {protocol.num_electrodes}, counted from 0.")
        seconds = real_array("seconds", seconds, "times (T,) of the frames")
        for_wandering, for_strays = jax.random.split(key)
        rest = np.asarray(model.voltages(conductivity))
        if self.kind == "loose":
            return self._loose_contact_voltages(for_wandering, model, conductivity, seconds) - rest
        stray = (
            _STRAY * np.sqrt(np.mean(rest**2)) * np.asarray(jax.random.normal(for_strays, (len(seconds), rest.size)))
        )
        driving = np.asarray(protocol.channel_drive)[:, self.electrode] != 0
        reading = np.asarray(protocol.channel_measurement)[:, self.electrode] != 0
        if self.kind == "torn":
            silent = np.broadcast_to(stray if self.rail is None else self.rail, stray.shape)
            return np.where(driving | reading, silent - rest, 0.0)
        dead = self._dead_electrode_voltages(model, conductivity)
        changed = np.where(reading & ~driving, stray - rest, dead - rest)
        return np.where(driving | reading, changed, (dead - rest) * np.ones_like(stray))

    def _with_contact_factor(self, model: ForwardModel, factor: float) -> ForwardModel:
        impedance = np.array(np.broadcast_to(model.electrodes.contact_impedance, model.protocol.num_electrodes), float)
        impedance[self.electrode] *= factor
        worse = eqx.tree_at(lambda one: one.contact_impedance, model.electrodes, jax.numpy.asarray(impedance))
        return model.with_electrodes(worse)

    def _dead_electrode_voltages(self, model: ForwardModel, conductivity) -> Float[np.ndarray, " M"]:
        """Voltages (M,) with a dead electrode and a source of limited voltage."""
        before, after = (
            np.asarray(one.transfer_impedance(conductivity)) for one in (model, self._with_contact_factor(model, _DEAD))
        )
        drive = np.asarray(model.protocol.drive)
        spans = [np.ptp(np.where(drive != 0, drive @ z.T, 0.0), axis=1) for z in (before, after)]
        current = np.minimum(1.0, _RAIL * spans[0].max() / spans[1])
        voltages = np.asarray(select_channels(model.protocol, after))
        return voltages * current[np.asarray(model.protocol.drive_index)]

    def _loose_contact_voltages(self, key: Array, model: ForwardModel, conductivity, seconds: np.ndarray) -> np.ndarray:
        """Voltages (T, M) for a fluctuating contact impedance, interpolated between solutions at a few levels of its
        logarithm."""
        low, high = np.log(_LOOSE)
        levels = np.linspace(low, high, _LEVELS)
        solved = [
            np.asarray(self._with_contact_factor(model, float(np.exp(one))).voltages(conductivity)) for one in levels
        ]
        normal = np.asarray(jax.random.normal(key, (len(seconds),)))
        place, steps = np.empty(len(seconds)), np.diff(seconds, prepend=seconds[:1])
        now = 0.0
        for number, (step, one) in enumerate(zip(steps, normal, strict=True)):
            kept = np.exp(-step / _FLUCTUATION_TIME) if number else 0.0
            now = kept * now + np.sqrt(1 - kept**2) * one
            place[number] = now
        # The distribution function of the normal variable makes the logarithm uniformly distributed.
        share = np.asarray(jax.scipy.stats.norm.cdf(place)) * (_LEVELS - 1)
        below = np.minimum(share.astype(int), _LEVELS - 2)
        part = (share - below)[:, None]
        table = np.array(solved)
        return (1 - part) * table[below] + part * table[below + 1]


def check_fault(name: str, value) -> None:
    """Check that the argument `name` is an `ElectrodeFault`. Raises `ValueError` otherwise."""
    check_kind(name, value, ElectrodeFault, 'an ElectrodeFault(3, "dead")')


class DamageEvent(Module):
    """A change of a skin during a recording.

    **Fields**: `time`: when it happens, seconds; `skin`: the skin from then on, with the same channels and gains, or
    None for no change of the skin; `faults`: faults of electrodes from then on.

    **Example:**

    ```python
    event = DamageEvent(time=1.0, faults=(ElectrodeFault(3, "torn"),))
    frames = record_damage(key, skin, [], np.arange(4.0), [event])
    ```
    """

    time: float
    skin: PressedSkin | None = None
    faults: tuple[ElectrodeFault, ...] = ()

    def __check_init__(self):
        """Check the fields. Raises `ValueError` for an invalid time, skin or fault."""
        if not (is_number(self.time) and self.time >= 0):
            raise ValueError(f"time must be seconds, zero or more; it is {describe(self.time)}.")
        if self.skin is not None:
            check_kind("skin", self.skin, PressedSkin, "a PressedSkin, that with the damage")
        check_kind("faults", self.faults, tuple, "a tuple of them")
        for number, fault in enumerate(self.faults):
            check_fault(f"faults[{number}]", fault)


def record_damage(
    key: Array,
    skin: PressedSkin,
    motions: MovingPress | Sequence[MovingPress],
    seconds: Float[np.ndarray, " T"],
    events: Sequence[DamageEvent],
) -> Float[np.ndarray, "T M"]:
    """Simulate voltages (T, M) of a skin under moving presses with events.

    Each event sets the skin and the faults until the next one. Drift, gains and noise continue through all of them.
    Every frame is solved with its own conductivity.

    **Arguments:**

    - `key`: random key.
    - `skin`: the skin.
    - `motions`: the presses; `[]` for none.
    - `seconds`: times (T,), seconds.
    - `events`: the events, in order of time.

    Raises `ValueError` for invalid events, for a skin with other channels, and as `PressedSkin.touched_in_time`.

    **Example:**

    ```python
    event = DamageEvent(2.0, faults=(ElectrodeFault(3, "torn"),))
    frames = record_damage(key, skin, [], np.arange(4.0), [event])
    ```
    """
    check_key(key)
    check_kind("skin", skin, PressedSkin, "a PressedSkin")
    check_kind("events", events, (list, tuple), "a list of them, [] for none")
    for number, one in enumerate(events):
        check_kind(f"events[{number}]", one, DamageEvent, "a DamageEvent(time, skin)")
        if one.skin is not None and one.skin.gain.shape != skin.gain.shape:
            raise ValueError(f"events[{number}] has a skin of {one.skin.gain.size} channels, not of {skin.gain.size}.")
    seconds = np.asarray(seconds, float)
    ends = [*(one.time for one in events), np.inf]
    if list(ends) != sorted(ends):
        raise ValueError("events must be in order of their times.")
    stages = [DamageEvent(0.0, skin), *events]
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
        # The same key for all stages, so that drift and noise continue through the recording.
        found[there] = now.read(key, exact, seconds)[there]
    return found


def exact_record(
    skin: PressedSkin,
    motions: MovingPress | Sequence[MovingPress],
    seconds: Float[np.ndarray, " T"],
    selected_frames: np.ndarray,
) -> Float[np.ndarray, "T M"]:
    """Voltages (T, M) of the model without drift and noise in the `selected_frames` (T,) frames, and voltages at rest
    in the others. Raises `ValueError` as `PressedSkin.touched_in_time`."""
    voltages = np.tile(np.asarray(skin.model.voltages(skin.conductivity)), (len(seconds), 1))
    if not np.any([np.any(motion.load) for motion in ([motions] if isinstance(motions, MovingPress) else motions)]):
        return voltages
    touched = skin.touched_in_time(motions, seconds)
    cells, change = np.asarray(touched.cells), np.asarray(touched.change)
    rest = np.array(np.broadcast_to(skin.conductivity, skin.model.mesh.num_cells))
    for row in np.flatnonzero(selected_frames & (change != 0).any(axis=1)):
        conductivity = rest.copy()
        np.multiply.at(conductivity, cells[row], 1 + change[row])
        voltages[row] = np.asarray(skin.model.voltages(conductivity))
    return voltages
