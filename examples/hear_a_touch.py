"""A light tap on a simulated skin, located by 25 microphones with two methods; see `hear_a_touch.png`. Takes 15 s and
0.8 GB on two cores."""

import jax
import numpy as np
from matplotlib.figure import Figure

from jeit.acoustic import (
    Burst,
    Localiser,
    MapMarks,
    Recording,
    SoundingSkin,
    Taps,
    calibrate_microphones,
    intensities,
    plot_loss_map,
    simulate_calibration_taps,
    simulate_tap,
)
from jeit.layout import grid

OUTLINE = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]  # metres
TITLES = {"consistency": "Intensity consistency (Park 2022)", "likelihood": "Likelihood"}


def main() -> float:
    skin = SoundingSkin(jax.random.key(0))
    taps = simulate_calibration_taps(skin, jax.random.key(1), grid(0.18, 0.18, 10, 10), repeats=2)
    known = Taps(skin.microphones, OUTLINE, taps.positions, samples=taps.samples, rate=taps.rate)
    microphone_array = calibrate_microphones(known).calibration.microphone_array

    truth = np.array([0.031, -0.022])
    light = simulate_tap(skin, jax.random.key(2), truth, burst=Burst(0.7), duration=0.5)
    levels = intensities(Recording(light.samples, light.rate))
    loudest = levels.power[[levels.power.sum(axis=1).argmax()]]

    figure = Figure(figsize=(11.2, 5.2), layout="compressed")
    error = {}
    for ax, (method, title) in zip(figure.subplots(1, 2), TITLES.items(), strict=True):
        localiser = Localiser.create(microphone_array, method=method, map_shape=(200, 200))
        found, maps = localiser.with_maps(loudest)
        place, spread = np.asarray(found.position[0]), found.covariance[0]
        error[method] = float(np.hypot(*(place - truth)))
        marks = MapMarks(truth, estimate=place, covariance=spread)
        title = f"{title}: {1e3 * error[method]:.1f} mm off"
        plot_loss_map(maps[0], microphone_array, received=loudest[0], marks=marks, method=method, title=title, ax=ax)
    figure.savefig("hear_a_touch.png", dpi=120)
    return error["likelihood"]


if __name__ == "__main__":
    error = main()
    print(f"position error {1e3 * error:.1f} mm")
    assert error < 0.01  # metres; microphones are 40 mm apart
