from pathlib import Path

import jax
import numpy as np

from jeit.acoustic import SoundingSkin, Taps, calibrate_microphones, microphone_grid, simulate_calibration_taps
from jeit.data import load_description
from jeit.design import Skin
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.imaging import StreamSettings
from jeit.layout import grid, named_layout, ring
from jeit.live import ConductivityView, LiveFrame, frames, simulated_tank
from jeit.mesh import Disk, Rectangle
from jeit.protocol import adjacent
from jeit.touch import (
    LearntSkin,
    NetworkPreset,
    Person,
    PressedSkin,
    Presses,
    TrainingPlan,
    learn_gestures,
    learn_images,
    material,
    simulate_gestures,
)

key = jax.random.key(0)
reference = simulated_tank().reference  # of the undisturbed tank
still = np.asarray(reference.voltages)  # (N, M)
settings = StreamSettings(solver="one-step", num_points=300)
view = ConductivityView.prepare(reference, settings)
frame = next(iter(simulated_tank(limit=1)))

# A skin that learns from presses.
positions = np.random.default_rng(0).uniform(-0.05, 0.05, (60, 2))
squared = ((positions[:, None] - grid(0.1, 0.1, 3, 3)) ** 2).sum(axis=2)
presses = Presses.create(np.exp(-squared / 2e-3), positions=positions)
learnt = LearntSkin.fit(presses, method="neighbours")

# Microphones.
array = SoundingSkin(key, microphone_grid(3))
tapped = simulate_calibration_taps(array, key, grid(0.16, 0.16, 5, 5))
outline = [(-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)]
taps = Taps(array.microphones, outline, tapped.positions, samples=tapped.samples, rate=tapped.rate)
microphones = calibrate_microphones(taps, decay="inverse-square").calibration

# Gestures on a described skin.
Path("skin.toml").write_text("""
[geometry]
shape = "disk"
radius = 0.1
[electrodes]
layout = "ring"
number = 8
width = 0.01
contact_impedance = 1e-3
[protocol]
kind = "adjacent"
current = 1e-3
""")
description = load_description("skin.toml")
electrodes = BoundaryElectrodes(ring(0.1, 8), 0.01, 1e-3)
model = ForwardModel(Disk(0.1).mesh(num_points=200), electrodes, adjacent(8, current=1e-3))
skin = PressedSkin(key, model, material("velostat"))
made = simulate_gestures(key, skin, Disk(0.1), [Person.draw(key)], 3, gestures=("tap", "push"), rate=30.0)
untouched = made.untouched
gestures = learn_gestures(description, made, method="linear-svm", form="seven").model

# A network that estimates depth.
sheet = Skin.create(named_layout("grid-3x3", Rectangle(0.06, 0.06)), num_layers=0, cell_size=8e-3)
plan = TrainingPlan(batch=10, epochs=1)
network = learn_images(sheet, "network", preset=NetworkPreset(20, 10, plan)).network
rest = np.asarray(sheet.model.voltages(sheet.model_conductivity))
