"""A small simulated sheet touched by two people: a set of their gestures, a stream of six touches, and its description.

One version simulates a pressed skin; the other is linear and takes a tenth of the time.
"""

import functools
from types import SimpleNamespace

import jax
import numpy as np

from jeit.data import GestureSet
from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.layout import perimeter
from jeit.mesh import Rectangle, centroids
from jeit.protocol import reference_electrode
from jeit.touch.simulate import Person, PressedSkin, material, simulate_gesture_stream, simulate_gestures

SHEET, RATE = Rectangle(0.32, 0.2), 60.0
PLACES = np.vstack([perimeter(Rectangle(0.3, 0.18), 8, start=0.06), [[0.0, 0.0]]])
TOML = f"""
[geometry]
shape = "rectangle"
width = 0.32
height = 0.2
[electrodes]
kind = "point"
positions = {PLACES.tolist()}
[protocol]
kind = "reference_electrode"
current = 1.8e-3
"""

# Seconds, strength, and metres travelled of each gesture.
GESTURES = {"tap": (0.15, 0.4, 0.0), "push": (1.0, 0.8, 0.0), "stroke": (0.7, 0.6, 0.14)}


@functools.cache
def gestures_and_stream():
    """Return three recordings of each gesture by each person as a `GestureSet`, and a `GestureStream`."""
    model = ForwardModel(SHEET.mesh(num_points=300), PointElectrodes(PLACES), reference_electrode(8, current=1.8e-3))
    skin = PressedSkin(jax.random.key(0), model, material("conductive fabric"))
    people = [Person.draw(key) for key in jax.random.split(jax.random.key(1), 2)]
    made = simulate_gestures(jax.random.key(2), skin, SHEET, people, 3)
    return made, simulate_gesture_stream(jax.random.key(3), skin, SHEET, people, 6)


@functools.cache
def linear_gestures_and_stream():
    """Return recordings of a linear skin, whose touches are spots of higher conductivity.

    Four recordings of each gesture by each of two people, and a stream of six gestures with their onsets and ends.
    """
    model = ForwardModel(SHEET.mesh(num_points=150), PointElectrodes(PLACES), reference_electrode(8, current=1.8e-3))
    rest, jacobian = np.asarray(model.voltages(0.1)), np.asarray(model.jacobian(0.1))
    cells, rng = np.asarray(centroids(model.mesh)), np.random.default_rng(0)

    def touch(gesture):
        """Voltage changes (T, 48) during a gesture at a random place."""
        lasts, strength, way = GESTURES[gesture]
        share = np.linspace(0, 1, round(lasts * rng.uniform(0.9, 1.1) * RATE))[:, None]
        place = rng.uniform([-0.06, -0.05], [0.06, 0.05]) + way * (share - 0.5) * [1.0, 0.0]
        spots = np.exp(-np.sum((cells - place[:, None]) ** 2, axis=-1) / 0.02**2)
        return 0.1 * strength * rng.uniform(0.8, 1.2) * np.sqrt(np.sin(np.pi * share)) * spots @ jacobian.T

    def recorded(changes):
        return rest + changes + 1e-4 * np.abs(rest).mean() * rng.normal(size=changes.shape)

    def pause(seconds):
        return np.zeros((round(seconds * RATE), len(rest)))

    rows = [(gesture, person) for person in range(2) for gesture in GESTURES for _ in range(4)]
    each = [recorded(np.concatenate([pause(0.3), touch(gesture), pause(0.3)])) for gesture, _ in rows]
    made = GestureSet(
        gesture=np.array([gesture for gesture, _ in rows]),
        person=np.array([person for _, person in rows]),
        start=np.cumsum([0, *map(len, each)]),
        seconds=np.concatenate([np.arange(len(one)) / RATE for one in each]),
        voltages=np.concatenate(each),
        reference=recorded(pause(1.0)).mean(axis=0),
        untouched=recorded(pause(3.0)),
    )
    parts, onset, offset = [pause(2.0)], [], []
    for gesture in 2 * list(GESTURES):
        onset.append(sum(map(len, parts)) / RATE)
        parts.append(touch(gesture))
        offset.append(sum(map(len, parts)) / RATE)
        parts.append(pause(1.2))
    voltages = recorded(np.concatenate(parts))
    seconds = np.arange(len(voltages)) / RATE
    return made, SimpleNamespace(voltages=voltages, seconds=seconds, onset=np.array(onset), offset=np.array(offset))
