"""Simulation of recordings of damaged skins and of skins with faulty electrodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from scipy.special import ndtr

from jeit.arguments import check_key, check_kind, check_name, describe, is_number, real_array
from jeit.forward import ForwardModel
from jeit.forward.model import check_model, select_channels
from jeit.touch.simulate.contact import MovingPress, PressedSkin
from jeit_solvers.engines import on_host
from jeit_solvers.module import Module

FaultKind = Literal["dead", "loose", "torn"]
FAULTS: tuple[FaultKind, ...] = ("dead", "loose", "torn")
# Factor by which the contact impedance of a dead electrode is multiplied.
_DEAD_CONTACT_FACTOR = 1e7
# Limit of the current source's voltage, relative to its maximum for the skin at rest.
_MAX_VOLTAGE_RATIO = 5.0
# Minimum and maximum factor by which the impedance of a loose contact is multiplied.
_LOOSE_CONTACT_FACTORS = (10.0, 1000.0)
# Time constant of the fluctuations of the logarithm of a loose contact's factor, in seconds.
_FLUCTUATION_TIME = 0.5
# Number of levels of a loose contact's factor for which voltages are solved.
_NUM_LEVELS = 7
# Voltage picked up by a disconnected wire, relative to the root mean square of all voltages.
_STRAY_VOLTAGE_FRACTION = 0.02


class ElectrodeFault(Module):
    """A fault of an electrode: dead, loose or torn.

    **Fields**

    - `electrode`: number of the electrode, from 0.
    - `kind`: "dead": the contact impedance is multiplied by 10⁷, and the voltage of the current source limited to five
      times its maximum at rest; measurements on the electrode read only noise. "loose": the factor of the contact
      impedance fluctuates between 10 and 1,000, with a time constant of half a second. "torn": the electrode is
      disconnected; channels with this electrode read noise, or the constant `rail`.
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
        """Compute the changes (T, M), volts, of the voltages of a skin at rest due to the fault.

        `seconds`: times (T,) of the frames; `conductivity`: conductivity of the skin, S/m (2-D: S). Raises `ValueError`
        for invalid arguments, and for an electrode that the model does not have.
        """
        check_key(key)
        check_model(model)
        protocol = model.protocol
        if self.electrode >= protocol.num_electrodes:
            raise ValueError(f"electrode {self.electrode}: the model has {protocol.num_electrodes}, counted from 0.")
        seconds = real_array("seconds", seconds, "times (T,) of the frames")
        fluctuation_key, stray_key = jax.random.split(key)
        rest_voltages = np.asarray(model.voltages(conductivity))
        if self.kind == "loose":
            return self._loose_contact_voltages(fluctuation_key, model, conductivity, seconds) - rest_voltages
        stray_voltages = (
            _STRAY_VOLTAGE_FRACTION
            * np.sqrt(np.mean(rest_voltages**2))
            * np.asarray(jax.random.normal(stray_key, (len(seconds), rest_voltages.size)))
        )
        is_driven = np.asarray(protocol.channel_drive)[:, self.electrode] != 0
        is_measured = np.asarray(protocol.channel_measurement)[:, self.electrode] != 0
        if self.kind == "torn":
            torn_readings = np.broadcast_to(stray_voltages if self.rail is None else self.rail, stray_voltages.shape)
            return np.where(is_driven | is_measured, torn_readings - rest_voltages, 0.0)
        dead_voltages = self._dead_electrode_voltages(model, conductivity)
        measured_changes = np.where(
            is_measured & ~is_driven, stray_voltages - rest_voltages, dead_voltages - rest_voltages
        )
        return np.where(
            is_driven | is_measured, measured_changes, (dead_voltages - rest_voltages) * np.ones_like(stray_voltages)
        )

    def _with_contact_factor(self, model: ForwardModel, contact_factor: float) -> ForwardModel:
        contact_impedances = np.array(
            np.broadcast_to(model.electrodes.contact_impedance, model.protocol.num_electrodes), float
        )
        contact_impedances[self.electrode] *= contact_factor
        faulty_electrodes = eqx.tree_at(
            lambda electrodes_to_change: electrodes_to_change.contact_impedance,
            model.electrodes,
            jax.numpy.asarray(contact_impedances),
        )
        return model.with_electrodes(faulty_electrodes)

    def _dead_electrode_voltages(self, model: ForwardModel, conductivity) -> Float[np.ndarray, " M"]:
        """Compute voltages (M,) of a skin with a dead electrode and a current source of limited voltage."""
        initial_impedance, faulty_impedance = (
            np.asarray(model_state.transfer_impedance(conductivity))
            for model_state in (model, self._with_contact_factor(model, _DEAD_CONTACT_FACTOR))
        )
        drive_patterns = np.asarray(model.protocol.drive)
        voltage_ranges = [
            np.ptp(np.where(drive_patterns != 0, drive_patterns @ transfer_impedance.T, 0.0), axis=1)
            for transfer_impedance in (initial_impedance, faulty_impedance)
        ]
        relative_currents = np.minimum(1.0, _MAX_VOLTAGE_RATIO * voltage_ranges[0].max() / voltage_ranges[1])
        full_current_voltages = np.asarray(select_channels(*on_host((model.protocol, faulty_impedance))))
        return full_current_voltages * relative_currents[np.asarray(model.protocol.drive_index)]

    def _loose_contact_voltages(self, key: Array, model: ForwardModel, conductivity, seconds: np.ndarray) -> np.ndarray:
        """Compute voltages (T, M) for a fluctuating contact impedance, interpolated between the voltages at a few
        levels of the impedance's logarithm."""
        min_log_factor, max_log_factor = np.log(_LOOSE_CONTACT_FACTORS)
        log_factor_levels = np.linspace(min_log_factor, max_log_factor, _NUM_LEVELS)
        voltages_of_levels = [
            np.asarray(self._with_contact_factor(model, float(np.exp(log_factor))).voltages(conductivity))
            for log_factor in log_factor_levels
        ]
        normal_draws = np.asarray(jax.random.normal(key, (len(seconds),)))
        fluctuation_values, time_steps = np.empty(len(seconds)), np.diff(seconds, prepend=seconds[:1])
        fluctuation_value = 0.0
        for frame_index, (time_step, log_factor) in enumerate(zip(time_steps, normal_draws, strict=True)):
            decay_factor = np.exp(-time_step / _FLUCTUATION_TIME) if frame_index else 0.0
            fluctuation_value = decay_factor * fluctuation_value + np.sqrt(1 - decay_factor**2) * log_factor
            fluctuation_values[frame_index] = fluctuation_value
        # The normal distribution function, applied to the fluctuation, makes the factor's logarithm uniformly
        # distributed.
        level_positions = ndtr(fluctuation_values) * (_NUM_LEVELS - 1)
        lower_level_indices = np.minimum(level_positions.astype(int), _NUM_LEVELS - 2)
        upper_weights = (level_positions - lower_level_indices)[:, None]
        voltage_table = np.array(voltages_of_levels)
        return (1 - upper_weights) * voltage_table[lower_level_indices] + upper_weights * voltage_table[
            lower_level_indices + 1
        ]


def check_fault(name: str, value) -> None:
    """Check that the argument `name` is an `ElectrodeFault`. Raises `ValueError` otherwise."""
    check_kind(name, value, ElectrodeFault, 'an ElectrodeFault(3, "dead")')


class DamageEvent(Module):
    """Damage or repair of a skin, or faults of its electrodes, at a time of a recording.

    **Fields**: `time`: time of the event, seconds; `skin`: the changed skin from this time on, with the same channels
    and gains, or None for no change of the skin; `faults`: faults of electrodes from this time on.

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
        for fault_index, fault in enumerate(self.faults):
            check_fault(f"faults[{fault_index}]", fault)


def record_damage(
    key: Array,
    skin: PressedSkin,
    motions: MovingPress | Sequence[MovingPress],
    seconds: Float[np.ndarray, " T"],
    events: Sequence[DamageEvent],
) -> Float[np.ndarray, "T M"]:
    """Simulate voltages (T, M) of a skin under moving presses that is damaged or repaired during the recording.

    Each event sets the skin and the faults of electrodes until the next event. Drift, gains and noise continue through
    all events. The forward problem is solved for the conductivity of each frame.

    **Arguments:**

    - `key`: random key.
    - `skin`: the skin before the first event.
    - `motions`: a moving press, or a list of simultaneous moving presses, `[]` for none.
    - `seconds`: times (T,) of the frames, seconds.
    - `events`: the events, in order of time.

    Raises `ValueError` for invalid events, for an event whose skin has a different number of channels, and as
    `PressedSkin.touched_in_time` does.

    **Example:**

    ```python
    event = DamageEvent(2.0, faults=(ElectrodeFault(3, "torn"),))
    frames = record_damage(key, skin, [], np.arange(4.0), [event])
    ```
    """
    check_key(key)
    check_kind("skin", skin, PressedSkin, "a PressedSkin")
    check_kind("events", events, (list, tuple), "a list of them, [] for none")
    for event_index, event in enumerate(events):
        check_kind(f"events[{event_index}]", event, DamageEvent, "a DamageEvent(time, skin)")
        if event.skin is not None and event.skin.gain.shape != skin.gain.shape:
            raise ValueError(
                f"events[{event_index}] has a skin of {event.skin.gain.size} channels, not of {skin.gain.size}."
            )
    seconds = np.asarray(seconds, float)
    end_times = [*(event.time for event in events), np.inf]
    if list(end_times) != sorted(end_times):
        raise ValueError("events must be in order of their times.")
    damage_stages = [DamageEvent(0.0, skin), *events]
    voltages, current_skin = np.zeros((len(seconds), skin.gain.size)), skin
    for event_index, (damage_stage, end_time) in enumerate(zip(damage_stages, end_times, strict=True)):
        current_skin = current_skin if damage_stage.skin is None else damage_stage.skin
        is_frame_of_stage = (seconds >= damage_stage.time if event_index else seconds >= 0) & (seconds < end_time)
        if not is_frame_of_stage.any():
            continue
        exact_voltages = exact_record(current_skin, motions, seconds, is_frame_of_stage)
        for fault_index, fault in enumerate(damage_stage.faults):
            stage_fault_key = jax.random.fold_in(jax.random.fold_in(key, event_index), fault_index)
            exact_voltages[is_frame_of_stage] += fault.changes(
                stage_fault_key, current_skin.model, current_skin.conductivity, seconds[is_frame_of_stage]
            )
        # The same key for all stages, so that drift and noise continue through the recording.
        voltages[is_frame_of_stage] = current_skin.read(key, exact_voltages, seconds)[is_frame_of_stage]
    return voltages


def exact_record(
    skin: PressedSkin,
    motions: MovingPress | Sequence[MovingPress],
    seconds: Float[np.ndarray, " T"],
    selected_frames: np.ndarray,
) -> Float[np.ndarray, "T M"]:
    """Compute voltages (T, M) of a skin without drift and noise in the frames that the mask `selected_frames` (T,)
    selects; in all other frames, the voltages are those at rest. Raises `ValueError` as `PressedSkin.touched_in_time`
    does."""
    voltages = np.tile(np.asarray(skin.model.voltages(skin.conductivity)), (len(seconds), 1))
    if not np.any([np.any(motion.load) for motion in ([motions] if isinstance(motions, MovingPress) else motions)]):
        return voltages
    changed_cells = skin.touched_in_time(motions, seconds)
    touched_numbers, relative_changes = np.asarray(changed_cells.cells), np.asarray(changed_cells.change)
    rest_conductivity = np.array(np.broadcast_to(skin.conductivity, skin.model.mesh.num_cells))
    for frame_index in np.flatnonzero(selected_frames & (relative_changes != 0).any(axis=1)):
        frame_conductivity = rest_conductivity.copy()
        np.multiply.at(frame_conductivity, touched_numbers[frame_index], 1 + relative_changes[frame_index])
        voltages[frame_index] = np.asarray(skin.model.voltages(frame_conductivity))
    return voltages
