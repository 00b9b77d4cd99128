import jax
import numpy as np

from jeit.acoustic import (
    Localiser,
    Recording,
    SoundingSkin,
    Taps,
    calibrate_microphones,
    intensities,
    locate,
    microphone_grid,
    simulate_calibration_taps,
    simulate_pat,
)
from jeit.layout import grid

key = jax.random.key(0)
skin = SoundingSkin(key, microphone_grid(4))
outline = [(-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)]
tapped = simulate_calibration_taps(skin, key, grid(0.16, 0.16, 5, 5), repeats=2)
taps = Taps(skin.microphones, outline, tapped.positions, samples=tapped.samples, rate=tapped.rate)
fit = calibrate_microphones(taps, decay="inverse-square")
calibration = fit.calibration

touch = simulate_pat(skin, key, (0.03, 0.02))
recording = Recording(touch.samples, touch.rate)
locations = locate(recording, calibration)
loudest = intensities(recording).power.sum(axis=1).argmax()
power = intensities(recording).power[[loudest]]
loss_map = Localiser.create(calibration.microphone_array, map_shape=(50, 50)).maps(power)[0]
