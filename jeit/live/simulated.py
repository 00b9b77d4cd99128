"""Simulated sources of frames, which need no device: a tank in which a rod moves on a circle, and a skin that is
stroked."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_name
from jeit.data import Measurement, RoundSkin, screen
from jeit.data.round_skin import pressed_conductivity
from jeit.forward import ForwardModel
from jeit.live.pictures import LiveFrame
from jeit.live.sources import ENDED, AbstractSource
from jeit.mesh import Disk, centroids

# Number of frames of the reference.
_NUM_REFERENCE_FRAMES = 50
# Standard deviation of the noise of a voltage, relative to the root mean square of a frame.
_RELATIVE_NOISE = 1e-4
# Number of nodes of the meshes on which frames are simulated.
_NUM_NODES = 1800
# Tank: radius of the rod and of its path in metres; conductivity of the rod, relative to that of the water; time of a
# revolution in seconds; number of simulated positions between adjacent electrodes.
_ROD_RADIUS, _ROD_PATH_RADIUS, _ROD_CONDUCTIVITY, _ROD_REVOLUTION_TIME, _STEPS_PER_ELECTRODE = (
    0.012,
    0.05,
    0.05,
    8.0,
    20,
)
# Skin: radius of the finger's contact, half the length of a stroke, and distance of the stroke from the centre, in
# metres; relative change of conductivity; numbers of simulated states of a stroke and of the pause after the stroke;
# duration of stroke and pause together in seconds; and number of electrodes by which each stroke is rotated relative to
# the previous stroke.
(
    _FINGER_RADIUS,
    _HALF_STROKE_LENGTH,
    _STROKE_OFFSET,
    _RELATIVE_CHANGE,
    _NUM_STROKE_STATES,
    _NUM_PAUSE_STATES,
    _STROKE_TIME,
    _STROKE_PITCHES,
) = 0.008, 0.03, 0.015, 0.5, 30, 24, 1.2, 5


class SimulatedSensor(AbstractSource):
    """Source of frames of a simulated sensor whose states repeat periodically, with Gaussian noise.

    **Arguments:**

    - `name`: name of the sensor.
    - `reference`: a measurement of the undisturbed sensor.
    - `rest`: voltages (M,) of the M channels of the undisturbed sensor, volts.
    - `changes`: changes (K, M) of the voltages from `rest` in the K states of a period, volts.
    - `places`: positions (K, 2) of the rod or finger in the K states, metres; NaN for a state without a rod or finger.
    - `period`: duration of a period, seconds.
    - `rate`: frames/s.
    - `limit`: number of frames after which the source ends; by default it does not.
    - `seed`: random seed of the noise.

    **Attributes**: `reference`; `states` (K, M): voltages of the states of a period without noise, volts; `period`.

    **Example:**

    ```python
    changes, places = np.zeros((1, still.shape[1])), np.full((1, 2), np.nan)
    source = SimulatedSensor("at rest", reference, still.mean(axis=0), changes, places, period=1.0, limit=10)
    ```
    """

    def __init__(
        self,
        name: str,
        reference: Measurement,
        rest: Float[np.ndarray, " M"],
        changes: Float[np.ndarray, "K M"],
        places: Float[np.ndarray, "K 2"],
        *,
        period: float,
        rate: float = 60.0,
        limit: int | None = None,
        seed: int = 0,
    ):
        super().__init__(name)
        self.reference, self.rate, self.limit, self.period = reference, float(rate), limit, period
        self.states, self._positions = rest + changes, places
        self._noise = _noise_deviation(rest)
        self._random_generator = np.random.default_rng(seed)

    def truth(self, second: float) -> tuple[float, float] | None:
        """True position (x, y) of the rod or finger at the time `second`, in metres; None if nothing touches the
        sensor."""
        x, y = self._positions[self._state_index(second)].tolist()
        return None if np.isnan(x) else (x, y)

    def _state_index(self, elapsed_time: float) -> int:
        return int(elapsed_time / self.period * len(self.states)) % len(self.states)

    def __iter__(self) -> Iterator[LiveFrame]:
        self.begun = time.monotonic()
        frame_number = 0
        while self.limit is None or frame_number < self.limit:
            if self.closing.wait(max(0.0, self.begun + frame_number / self.rate - time.monotonic())):
                break
            arrival_time = time.monotonic()
            clean_voltages = self.states[self._state_index(arrival_time - self.begun)]
            yield self.frame(
                clean_voltages + self._noise * self._random_generator.standard_normal(clean_voltages.shape),
                arrival_time,
            )
            frame_number += 1
        self.connection = ENDED


def simulated_tank(rate: float = 60.0, *, limit: int | None = None, seed: int = 0) -> SimulatedSensor:
    """Create a simulated round tank: a sheet of diameter 200 mm with 16 electrodes and the adjacent protocol (208
    voltages). A poorly conducting rod of radius 12 mm moves on a circle of radius 50 mm, anticlockwise from the x axis,
    once in 8 s.

    **Arguments:**

    - `rate`: frames/s.
    - `limit`: number of frames after which the source ends; by default it does not.
    - `seed`: random seed of the noise.

    **Example:**

    ```python
    source = simulated_tank(100.0, limit=20)
    print(len(list(source)), source.truth(0.5))
    ```
    """
    round_tank = RoundSkin(
        radius=0.1, electrode_width=0.02, contact_impedance=1e-3, conductivity=0.01, num_points=_NUM_NODES
    )
    model = round_tank.model()
    cells = np.asarray(centroids(model.mesh))
    reference_voltages = np.asarray(model.voltages(np.full(len(cells), round_tank.conductivity)))
    electrode_pitch = 2 * np.pi / round_tank.num_electrodes
    rod_angles = electrode_pitch * np.arange(_STEPS_PER_ELECTRODE * round_tank.num_electrodes) / _STEPS_PER_ELECTRODE
    rod_positions = _ROD_PATH_RADIUS * np.stack([np.cos(rod_angles), np.sin(rod_angles)], axis=1)
    inside_masks = np.sum((cells - rod_positions[:_STEPS_PER_ELECTRODE, None]) ** 2, axis=2) < _ROD_RADIUS**2
    first_changes = [
        np.asarray(model.voltages(round_tank.conductivity * np.where(is_inside, _ROD_CONDUCTIVITY, 1.0)))
        for is_inside in inside_masks
    ] - reference_voltages
    voltage_changes = np.concatenate([_rotate_changes(first_changes, k) for k in range(round_tank.num_electrodes)])
    reference_recording = _simulate_reference(round_tank, model, reference_voltages, seed, "simulated tank")
    name = "demo: a tank in which a rod goes round"
    return SimulatedSensor(
        name,
        reference_recording,
        reference_voltages,
        voltage_changes,
        rod_positions,
        period=_ROD_REVOLUTION_TIME,
        rate=rate,
        limit=limit,
        seed=seed,
    )


def simulated_skin(rate: float = 60.0, *, limit: int | None = None, seed: int = 0) -> SimulatedSensor:
    """Create a simulated round skin of diameter 100 mm (`jeit.data.RoundSkin`), over which a finger strokes 60 mm every
    1.2 s, each time in a different direction.

    **Arguments:**

    - `rate`: frames/s.
    - `limit`: number of frames after which the source ends; by default it does not.
    - `seed`: random seed of the noise.

    **Example:**

    ```python
    source = simulated_skin(100.0, limit=20)
    print(len(list(source)), source.truth(0.5))
    ```
    """
    round_skin = RoundSkin(num_points=_NUM_NODES)
    model = round_skin.model()
    cells = centroids(model.mesh)
    reference_voltages = np.asarray(model.voltages(np.full(model.mesh.num_cells, round_skin.conductivity)))
    path = np.stack(
        [
            np.linspace(-_HALF_STROKE_LENGTH, _HALF_STROKE_LENGTH, _NUM_STROKE_STATES),
            np.full(_NUM_STROKE_STATES, _STROKE_OFFSET),
        ],
        axis=1,
    )
    # The finger is lowered and lifted at the ends of a stroke.
    stroke_strengths = _RELATIVE_CHANGE * np.minimum(
        1, 4 * np.sin(np.pi * (np.arange(_NUM_STROKE_STATES) + 0.5) / _NUM_STROKE_STATES)
    )
    stroke_conductivities = [
        pressed_conductivity(cells, round_skin.conductivity, touch_position, _FINGER_RADIUS, touch_strength)
        for touch_position, touch_strength in zip(path, stroke_strengths, strict=True)
    ]
    stroke_positions = (
        np.stack([np.asarray(model.voltages(np.asarray(conductivity))) for conductivity in stroke_conductivities])
        - reference_voltages
    )
    rotation_pitches = [_STROKE_PITCHES * k for k in range(round_skin.num_electrodes)]
    states_during_pause = (
        np.zeros((_NUM_PAUSE_STATES, len(reference_voltages))),
        np.full((_NUM_PAUSE_STATES, 2), np.nan),
    )
    voltage_changes = np.concatenate(
        [
            state_block
            for k in rotation_pitches
            for state_block in (_rotate_changes(stroke_positions, k), states_during_pause[0])
        ]
    )
    rotation_angles = 2 * np.pi / round_skin.num_electrodes * np.array(rotation_pitches)
    rotation_matrices = np.stack(
        [np.cos(rotation_angles), np.sin(rotation_angles), -np.sin(rotation_angles), np.cos(rotation_angles)], axis=1
    ).reshape(-1, 2, 2)
    touch_positions = np.concatenate(
        [
            state_block
            for rotation_matrix in rotation_matrices
            for state_block in (path @ rotation_matrix, states_during_pause[1])
        ]
    )
    reference_recording = _simulate_reference(round_skin, model, reference_voltages, seed, "simulated skin")
    name, stroke_period = "demo: a skin that is stroked", _STROKE_TIME * round_skin.num_electrodes
    return SimulatedSensor(
        name,
        reference_recording,
        reference_voltages,
        voltage_changes,
        touch_positions,
        period=stroke_period,
        rate=rate,
        limit=limit,
        seed=seed,
    )


_SIMULATED_SENSORS = {"tank": simulated_tank, "skin": simulated_skin}


def open_simulated(text: str, rate: float | None = None) -> SimulatedSensor:
    """Create the simulated source with the name "demo", "demo:tank" or "demo:skin". Raises `ValueError` for other
    names."""
    sensor_kind = text.partition(":")[2] or "tank"
    check_name("demo", sensor_kind, _SIMULATED_SENSORS)
    return _SIMULATED_SENSORS[sensor_kind](60.0 if rate is None else rate)


def _rotate_changes(voltage_changes: Float[np.ndarray, "n M"], num_pitches: int) -> Float[np.ndarray, "n M"]:
    """Return the voltage changes (states, channels) after an anticlockwise rotation of the touching bodies by
    `num_pitches` electrode spacings. The rotation permutes the channels, because the 16 electrodes are numbered
    clockwise, and each drive has equally many channels."""
    return np.roll(voltage_changes.reshape(len(voltage_changes), 16, -1), -num_pitches, axis=1).reshape(
        voltage_changes.shape
    )


def _noise_deviation(reference_voltages: Float[np.ndarray, " M"]) -> float:
    return _RELATIVE_NOISE * float(np.sqrt(np.mean(reference_voltages**2)))


def _simulate_reference(
    round_skin: RoundSkin, model: ForwardModel, reference_voltages: Float[np.ndarray, " M"], seed: int, name: str
) -> Measurement:
    noise = _noise_deviation(reference_voltages) * np.random.default_rng((seed, 1)).standard_normal(
        (_NUM_REFERENCE_FRAMES, len(reference_voltages))
    )
    return screen(
        reference_voltages + noise,
        model.protocol,
        electrodes=model.electrodes,
        domain=Disk(round_skin.radius),
        name=name,
        source="simulated",
        notes=("simulated, not measured.",),
    )
