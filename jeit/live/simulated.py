"""Simulated sources, which need no device: a tank in which a rod goes round, and a skin that is stroked."""

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

# Frames of the reference; noise of a voltage, relative to the root mean square of a frame.
_STILL, _NOISE = 50, 1e-4
# Nodes of the meshes on which frames are simulated.
_NODES = 1800
# The tank: radius of the rod and of its path, metres; its conductivity, relative to the water's; seconds for a turn;
# positions simulated from one electrode to the next.
_ROD, _ORBIT, _RELATIVE, _TURN, _STEPS = 0.012, 0.05, 0.05, 8.0, 20
# The skin: radius of the finger's contact, and half the length of a stroke and its distance from the middle, metres;
# relative change of conductivity; positions of a stroke, and of the pause after it; seconds of both; and electrodes by
# which one stroke is turned from the last.
_FINGER, _HALF, _OFF, _STRENGTH, _STROKE, _PAUSE, _SPAN, _TURNED = 0.008, 0.03, 0.015, 0.5, 30, 24, 1.2, 5


class SimulatedSensor(AbstractSource):
    """Frames of a simulated sensor whose state repeats itself, with Gaussian noise.

    **Arguments:**

    - `name`: name of the sensor.
    - `reference`: a measurement of the undisturbed sensor.
    - `rest`: voltages (M,) of the undisturbed sensor, volts.
    - `changes`: what the K states of a period add to them, (K, M), volts.
    - `places`: where the rod or finger is in these states, (K, 2), metres, NaN for nowhere.
    - `period`: seconds after which all is repeated.
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
        self.states, self._places = rest + changes, places
        self._noise = _noise_of(rest)
        self._random = np.random.default_rng(seed)

    def truth(self, second: float) -> tuple[float, float] | None:
        """Place (x, y) of the rod or the finger in the frame of that `second`, metres; None if nothing touches."""
        x, y = self._places[self._state(second)].tolist()
        return None if np.isnan(x) else (x, y)

    def _state(self, second: float) -> int:
        return int(second / self.period * len(self.states)) % len(self.states)

    def __iter__(self) -> Iterator[LiveFrame]:
        self.begun = time.monotonic()
        number = 0
        while self.limit is None or number < self.limit:
            if self.closing.wait(max(0.0, self.begun + number / self.rate - time.monotonic())):
                break
            arrived = time.monotonic()
            values = self.states[self._state(arrived - self.begun)]
            yield self.frame(values + self._noise * self._random.standard_normal(values.shape), arrived)
            number += 1
        self.connection = ENDED


def simulated_tank(rate: float = 60.0, *, limit: int | None = None, seed: int = 0) -> SimulatedSensor:
    """A simulated round tank, a sheet 200 mm across with 16 electrodes and the adjacent protocol (208 voltages), in
    which an insulating rod, 12 mm in radius, goes round at radius 50 mm, anticlockwise from the x axis, in 8 s.

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
    tank = RoundSkin(radius=0.1, electrode_width=0.02, contact_impedance=1e-3, conductivity=0.01, num_points=_NODES)
    model = tank.model()
    cells = np.asarray(centroids(model.mesh))
    rest = np.asarray(model.voltages(np.full(len(cells), tank.conductivity)))
    pitch = 2 * np.pi / tank.num_electrodes
    angles = pitch * np.arange(_STEPS * tank.num_electrodes) / _STEPS
    places = _ORBIT * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    inside = np.sum((cells - places[:_STEPS, None]) ** 2, axis=2) < _ROD**2
    first = [np.asarray(model.voltages(tank.conductivity * np.where(one, _RELATIVE, 1.0))) for one in inside] - rest
    changes = np.concatenate([_turned(first, k) for k in range(tank.num_electrodes)])
    reference = _reference(tank, model, rest, seed, "simulated tank")
    name = "demo: a tank in which a rod goes round"
    return SimulatedSensor(name, reference, rest, changes, places, period=_TURN, rate=rate, limit=limit, seed=seed)


def simulated_skin(rate: float = 60.0, *, limit: int | None = None, seed: int = 0) -> SimulatedSensor:
    """A simulated round skin 100 mm across (`jeit.data.RoundSkin`), over which a finger strokes 60 mm every 1.2 s, each
    time in another direction.

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
    skin = RoundSkin(num_points=_NODES)
    model = skin.model()
    cells = centroids(model.mesh)
    rest = np.asarray(model.voltages(np.full(model.mesh.num_cells, skin.conductivity)))
    path = np.stack([np.linspace(-_HALF, _HALF, _STROKE), np.full(_STROKE, _OFF)], axis=1)
    # The finger is lowered and lifted at the ends of a stroke.
    strengths = _STRENGTH * np.minimum(1, 4 * np.sin(np.pi * (np.arange(_STROKE) + 0.5) / _STROKE))
    pressed = [
        pressed_conductivity(cells, skin.conductivity, place, _FINGER, strength)
        for place, strength in zip(path, strengths, strict=True)
    ]
    stroke = np.stack([np.asarray(model.voltages(np.asarray(one))) for one in pressed]) - rest
    turns = [_TURNED * k for k in range(skin.num_electrodes)]
    none = np.zeros((_PAUSE, len(rest))), np.full((_PAUSE, 2), np.nan)
    changes = np.concatenate([part for k in turns for part in (_turned(stroke, k), none[0])])
    angles = 2 * np.pi / skin.num_electrodes * np.array(turns)
    around = np.stack([np.cos(angles), np.sin(angles), -np.sin(angles), np.cos(angles)], axis=1).reshape(-1, 2, 2)
    places = np.concatenate([part for one in around for part in (path @ one, none[1])])
    reference = _reference(skin, model, rest, seed, "simulated skin")
    name, period = "demo: a skin that is stroked", _SPAN * skin.num_electrodes
    return SimulatedSensor(name, reference, rest, changes, places, period=period, rate=rate, limit=limit, seed=seed)


_KINDS = {"tank": simulated_tank, "skin": simulated_skin}


def simulated(text: str, rate: float | None = None) -> SimulatedSensor:
    """The simulated source that "demo", "demo:tank" or "demo:skin" names. Raises `ValueError` for another name."""
    kind = text.partition(":")[2] or "tank"
    check_name("demo", kind, _KINDS)
    return _KINDS[kind](60.0 if rate is None else rate)


def _turned(changes: Float[np.ndarray, "n M"], pitches: int) -> Float[np.ndarray, "n M"]:
    """Changes of voltages by bodies that are turned anticlockwise by a number of pitches of the electrodes: the same,
    in other channels. The 16 electrodes follow each other clockwise, and as many channels belong to each drive."""
    return np.roll(changes.reshape(len(changes), 16, -1), -pitches, axis=1).reshape(changes.shape)


def _noise_of(rest: Float[np.ndarray, " M"]) -> float:
    return _NOISE * float(np.sqrt(np.mean(rest**2)))


def _reference(
    skin: RoundSkin, model: ForwardModel, rest: Float[np.ndarray, " M"], seed: int, name: str
) -> Measurement:
    noise = _noise_of(rest) * np.random.default_rng((seed, 1)).standard_normal((_STILL, len(rest)))
    return screen(
        rest + noise,
        model.protocol,
        electrodes=model.electrodes,
        domain=Disk(skin.radius),
        name=name,
        source="simulated",
        notes=("simulated, not measured.",),
    )
