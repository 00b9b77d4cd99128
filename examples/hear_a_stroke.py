"""A pat, a tickle and a stroke on a simulated skin, tracked by 25 microphones; see `hear_a_stroke.png`. Takes 10 s and
0.7 GB on two cores."""

import jax
import numpy as np
from matplotlib.figure import Figure

from jeit.acoustic import (
    Burst,
    Localiser,
    Recording,
    SoundingSkin,
    Taps,
    calibrate_microphones,
    intensities,
    locate,
    map_brightness,
    overlay_images,
    plot_track,
    simulate_calibration_taps,
    simulate_pat,
    simulate_stroke,
    simulate_tickle,
)
from jeit.acoustic import track as follow
from jeit.layout import grid

OUTLINE = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]  # metres
KEYS = jax.random.split(jax.random.key(1), 4)
LASTS = 1.5  # duration of each touch in seconds


def main() -> float:
    skin = SoundingSkin(jax.random.key(0))
    taps = simulate_calibration_taps(skin, KEYS[0], grid(0.18, 0.18, 10, 10), repeats=2)
    known = Taps(skin.microphones, OUTLINE, taps.positions, samples=taps.samples, rate=taps.rate)
    calibration = calibrate_microphones(known).calibration

    touches = {
        "pat": simulate_pat(skin, KEYS[1], (0.03, 0.02), duration=LASTS),
        "tickle": simulate_tickle(skin, KEYS[2], (-0.04, 0.03), burst=Burst(1.5, 0.04), duration=LASTS),
        "stroke": simulate_stroke(
            skin, KEYS[3], [(-0.07, -0.06), (0.0, 0.06), (0.07, -0.05)], strength=1.5, duration=LASTS
        ),
    }
    samples = np.concatenate([touch.samples for touch in touches.values()], axis=1)
    levels = intensities(Recording(samples, skin.rate))
    found = locate(levels, calibration)
    localiser = Localiser.create(calibration.microphone_array, method="consistency", map_shape=(100, 100))
    images = map_brightness(localiser.maps(levels.power), method="consistency") * found.has_position[:, None, None]

    figure = Figure(figsize=(13.5, 4.8), layout="compressed")
    paths = {}
    for number, (ax, name) in enumerate(zip(figure.subplots(1, 3), touches, strict=True)):
        during = levels.times // LASTS == number
        places = jax.tree.map(lambda values, during=during: values[during], found)
        path = paths[name] = follow(places)
        seen = overlay_images(images[during], path.times, time_constant=0.7)[path.touches[-1].last]
        plot_track(path, places, calibration, overlay=seen, title=name.capitalize(), ax=ax)
    figure.savefig("hear_a_stroke.png", dpi=120)

    path, finger = paths["stroke"], touches["stroke"]
    truth = [np.interp(path.times - 2 * LASTS, finger.position_times, along) for along in finger.position.T]
    return float(np.nanmean(np.linalg.norm(path.position - np.transpose(truth), axis=1)))


if __name__ == "__main__":
    error = main()
    print(f"mean error of the stroke {1e3 * error:.1f} mm")
    assert error < 0.003  # metres; microphones are 40 mm apart
