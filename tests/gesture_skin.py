"""A small simulated sheet that two people touch: a set of their gestures, a stream of six touches, its description."""

import functools

import jax
import numpy as np

from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.layout import perimeter
from jeit.mesh import Rectangle
from jeit.protocol import reference_electrode
from jeit.simulate import Person, PressedSkin, material, simulate_gesture_stream, simulate_gestures

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


@functools.cache
def gestures_and_stream():
    """Three of each gesture by each, as a `GestureSet`; and a `GestureStream`."""
    model = ForwardModel(SHEET.mesh(num_points=300), PointElectrodes(PLACES), reference_electrode(8, current=1.8e-3))
    skin = PressedSkin(jax.random.key(0), model, material("conductive fabric"))
    people = [Person.draw(key) for key in jax.random.split(jax.random.key(1), 2)]
    made = simulate_gestures(jax.random.key(2), skin, SHEET, people, 3)
    return made, simulate_gesture_stream(jax.random.key(3), skin, SHEET, people, 6)
