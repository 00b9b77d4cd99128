"""Classify gestures on a skin while it is touched: train on simulated recordings, then classify in a program's loop.

The stream is read from a file; `jeit.live.prepare("serial:/dev/ttyACM0@115200", ...)` reads it from a device. See
`live_gestures.png`. Takes 50 s and 1 GB on two cores.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

import jeit.live
from jeit.data import load_description
from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.layout import perimeter
from jeit.mesh import Rectangle
from jeit.protocol import reference_electrode
from jeit.touch import Person, PressedSkin, learn_gestures, material, simulate_gesture_stream, simulate_gestures

SHEET = Rectangle(0.32, 0.2)
PLACES = np.vstack([perimeter(Rectangle(0.3, 0.18), 16, start=0.03), [[0.0, 0.0]]])
DESCRIPTION = f"""
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


def main() -> float:
    model = ForwardModel(SHEET.mesh(num_points=500), PointElectrodes(PLACES), reference_electrode(16, current=1.8e-3))
    skin = PressedSkin(jax.random.key(0), model, material("conductive fabric"))
    people = [Person.draw(key) for key in jax.random.split(jax.random.key(1), 2)]
    stream = simulate_gesture_stream(jax.random.key(3), skin, SHEET, people, 6)
    with open("sheet.toml", "w", encoding="utf-8") as file:
        file.write(DESCRIPTION)
    np.savez("stream.npz", frames=stream.voltages, seconds=stream.seconds)
    recorded = simulate_gestures(jax.random.key(2), skin, SHEET, people, 4)
    learn_gestures(load_description("sheet.toml"), recorded, method="linear-discriminant").model.write("gestures.skops")

    source, view, _ = jeit.live.prepare("stream.npz", description="sheet.toml", model="gestures.skops")
    seconds, strength, named = [], [], []
    for result in jeit.live.frames(source, view):
        picture = result.picture
        if picture.pixels is not None:
            seconds.append(result.frame.second)
            strength.append(float(np.nanmax(np.abs(picture.pixels))))
        for event in picture.events:
            print(f"{result.frame.second:6.2f} s  {event}")
            named.append((result.frame.second, event))

    figure, ax = plt.subplots(figsize=(10, 3.6), layout="constrained")
    ax.plot(seconds, 1e3 * np.array(strength), color="0.4", linewidth=1)
    for number, (second, event) in enumerate(named):
        ax.axvline(second, color="tab:blue", linewidth=1)
        ax.text(second, 1e3 * max(strength) * (1.02 + 0.09 * (number % 3)), event.split(" at ")[0], fontsize=8)
    ax.set(xlabel="time (s)", ylabel="largest change (mS)", ylim=(0, 1.3e3 * max(strength)))
    figure.savefig("live_gestures.png", dpi=110)
    # A touch is classified as soon as it ends. A touch that resumes is classified again.
    return max(min(abs(second - end) for second, _ in named) for end in stream.offset.tolist())


if __name__ == "__main__":
    main()
