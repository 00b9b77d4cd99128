import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jeit.acoustic import (
    Recording,
    SoundingPerson,
    SoundingSkin,
    microphone_grid,
    simulate_sound_clips,
    write_recording,
)
from jeit.data import FrameRecording, load_description
from jeit.design import Bell, Skin
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.imaging import StreamSettings
from jeit.inverse import one_step
from jeit.layout import grid, named_layout, ring
from jeit.mesh import Disk, Rectangle
from jeit.protocol import adjacent
from jeit.touch import (
    CellFinder,
    DiscIndenter,
    ImageNoise,
    LabelledClips,
    LearntSkin,
    Listener,
    MapSchedule,
    MovingPress,
    NetworkPreset,
    Person,
    PlacedMap,
    Press,
    PressedSkin,
    Presses,
    SelfOrganisingMap,
    SkinHealth,
    TouchImages,
    TouchLevel,
    TouchWatch,
    TrainingObjective,
    TrainingPlan,
    find_contacts,
    find_touches,
    learn_gestures,
    learn_images,
    material,
    simulate_gestures,
)

key = jax.random.key(0)

# A round skin, which is pressed and stroked, and images of it.
outline = Disk(0.05)
electrodes = BoundaryElectrodes(ring(0.05, 8), 0.008, 300.0)
model = ForwardModel(outline.mesh(num_points=200), electrodes, adjacent(8, current=1e-3))
skin = PressedSkin(key, model, material("velostat"))
empty = skin.frames(key, [()] * 30)  # untouched
frame = skin.frames(key, [Press(DiscIndenter(0.012), 5.0, (0.01, 0.015))])[0]
linear = one_step(model, 2e-5, noise=empty.std(axis=0))
noise, finder = ImageNoise.of_frames(linear, empty), CellFinder(model.mesh)
image = linear.image(frame - empty.mean(axis=0))
seconds = np.arange(20) / 30
stroke = MovingPress(DiscIndenter(0.012), 5.0 * (np.arange(20) % 19 > 3), np.linspace((-0.02, 0.01), (0.02, 0.01), 20))
film = skin.record(key, stroke, seconds)
film_contacts = [find_contacts(finder, one, noise) for one in linear.image(film - empty.mean(axis=0))]
loads = np.repeat([1.0, 3.0, 10.0, 20.0], 3)
places = [(place, 0.0) for place in (0.0, 0.012, 0.024)] * 4
pushed = skin.frames(key, [Press(DiscIndenter(0.012), *one) for one in zip(loads, places, strict=True)])
known = [find_contacts(finder, one, noise)[0] for one in linear.image(pushed - empty.mean(axis=0))]


def pressed(touches):  # or by a robot
    discs = [tuple(Press(DiscIndenter(d), load, place) for place, load, d in touch) for touch in touches]
    return skin.frames(key, discs)


# Its gestures.
Path("skin.toml").write_text("""
[geometry]
shape = "disk"
radius = 0.05
[electrodes]
layout = "ring"
number = 8
width = 0.008
contact_impedance = 300.0
[protocol]
kind = "adjacent"
current = 1e-3
""")
description, settings = load_description("skin.toml"), StreamSettings(solver="one-step", num_points=200)
people = [Person.draw(key)]
made = simulate_gestures(key, skin, outline, people, 3, gestures=("tap", "push"), rate=15.0)
gestures = learn_gestures(description, made, method="linear-svm", form="seven").model
images = TouchImages.prepare(description, empty, settings)
level = TouchLevel.of_untouched(images.mesh, images.changes(empty))
courses = [(times, images.changes(voltages)) for times, voltages in map(made.recording, range(6))]
touches = [find_touches(level, *course)[0] for course in courses]
watched = TouchWatch.create(images, gestures, empty, rate=15.0)
recorded = zip(*made.recording(0), strict=True)
named_touches = [touch for one in watched.follow(recorded) for touch in one.ended]

# Frames of presses at known places, and what learns from them.
map_positions = np.random.default_rng(0).uniform(-0.05, 0.05, (80, 2))
squared = ((map_positions[:, None] - grid(0.1, 0.1, 3, 3)) ** 2).sum(axis=2)
reference = np.ones(9)
map_frames = 1 + np.exp(-squared / 2e-3)
presses = Presses.create(map_frames, positions=map_positions, reference=reference)
learnt = LearntSkin.fit(presses, method="neighbours")
learnt_map = SelfOrganisingMap.fit(map_frames, key, shape=(6, 6), schedule=MapSchedule(500, 500))
placed = PlacedMap.learn(learnt_map, map_frames, map_positions)

# A healthy skin, and one that is damaged after half of the frames.
random = np.random.default_rng(0)
healthy = 1 + 1e-3 * random.normal(size=(800, 40))
damaged = 1 + 1e-3 * random.normal(size=(600, 40))
damaged[300:] += 0.03 * random.normal(size=40)
health, healthy_recording = SkinHealth.fit(healthy), FrameRecording(healthy, None, None, "healthy")
still = skin.record(key, [], np.arange(60) / 5)
modelled_health = SkinHealth.fit(still, np.arange(60) / 5, model=model, conductivity=skin.conductivity)

# A network that estimates depth, and one of a single number.
sheet = Skin.create(named_layout("grid-3x3", Rectangle(0.06, 0.06)), num_layers=0, cell_size=8e-3)
rest = np.asarray(sheet.model.voltages(sheet.model_conductivity))
learn_images(sheet, "network", preset=NetworkPreset(20, 10, TrainingPlan(batch=10, epochs=1)))
rows = (np.arange(32.0), 3 * np.arange(32.0))
objective = TrainingObjective(
    lambda network, batch, key: (jnp.mean((network * batch[0] - batch[1]) ** 2), network),
    lambda network, batch: (network * batch[0] - batch[1]) ** 2,
)

# Sounds of touches.
sounding = SoundingSkin(key, microphone_grid(2))
persons = [SoundingPerson.draw(one) for one in jax.random.split(key, 2)]
sounds = list(simulate_sound_clips(key, sounding, persons, 2, modalities=("pat", "stroke"), duration=1.0))
recordings = [Recording(clip.samples, sounding.rate) for clip in sounds]
labels = [clip.modality for clip in sounds]
clips = LabelledClips.from_recordings(recordings, labels)
listener = Listener.fit(clips, method="linear")
