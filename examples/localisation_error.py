"""A vibrator at 169 places of a simulated skin, located by two methods; see `localisation_error.png`. Takes 15 s and
0.6 GB on two cores."""

import jax
import numpy as np
from matplotlib.figure import Figure

from jeit.acoustic import (
    Intensities,
    SoundingSkin,
    Taps,
    calibrate_microphones,
    locate,
    plot_position_errors,
    simulate_calibration_taps,
    tap_intensities,
)
from jeit.layout import grid

OUTLINE = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]  # metres
TITLES = {"consistency": "Intensity consistency (Park 2022)", "likelihood": "Likelihood"}
BURSTS = 10  # a second at 10 Hz


def tapped(skin: SoundingSkin, key, places, repeats: int) -> Taps:
    """Intensities recorded from several taps at each place."""
    taps = simulate_calibration_taps(skin, key, places, repeats=repeats)
    return Taps(skin.microphones, OUTLINE, taps.positions, samples=taps.samples, rate=taps.rate)


def main() -> float:
    skin = SoundingSkin(jax.random.key(0))
    calibration = calibrate_microphones(tapped(skin, jax.random.key(1), grid(0.18, 0.18, 13, 13), 3)).calibration

    truth = grid(0.15, 0.15, 13, 13)
    rows = zip(jax.random.split(jax.random.key(2), 13), np.split(truth, 13), strict=True)
    levels = [tap_intensities(tapped(skin, key, row, BURSTS)) for key, row in rows]
    power = np.concatenate([row.power for row in levels]).reshape(len(truth), BURSTS, -1).mean(axis=1)
    floor = np.mean([row.floor for row in levels], axis=0)
    freedom = BURSTS * float(np.median([row.freedom for row in levels]))
    vibrations = Intensities(np.arange(len(truth), dtype=float), power, floor=floor, freedom=freedom)

    figure = Figure(figsize=(11, 6.2), layout="compressed")
    error = {}
    for ax, (method, title) in zip(figure.subplots(1, 2), TITLES.items(), strict=True):
        found = locate(vibrations, calibration, method=method).position
        error[method] = np.linalg.norm(found - truth, axis=1)
        summary = f"{1e3 * np.nanmean(error[method]):.1f} ± {1e3 * np.nanstd(error[method]):.1f} mm"
        plot_position_errors(truth, found, skin.microphones, OUTLINE, title=f"{title}: {summary}", ax=ax)
    figure.savefig("localisation_error.png", dpi=120)
    return float(np.nanmean(error["likelihood"]))


if __name__ == "__main__":
    error = main()
    print(f"mean error {1e3 * error:.1f} mm")
    assert error < 0.0025  # metres; the real skin with the paper's loss function: 6.6 mm
