import jax
import numpy as np

from jeit.data import RoundSkin, join, simulate_press
from jeit.imaging import (
    ImagingSettings,
    StreamSettings,
    compare_on_data,
    frames_of,
    image_difference,
    image_sequence,
    prepare_imager,
)
from jeit.inverse import stream
from jeit.mesh import disk

skin = RoundSkin(num_points=400)
pressed, rest = simulate_press(skin, jax.random.key(0), (0.02, 0.01))
settings = ImagingSettings(method="one-step", num_points=200)
imaged = image_difference(pressed, rest, settings)
compared = compare_on_data(pressed, rest, settings, rules=["gcv", "l-curve"])
series = image_sequence(join([rest, pressed]), rest, settings)
imager, calibration = prepare_imager(rest, StreamSettings(solver="one-step", num_points=200))
mesh = disk(0.1, num_points=100)
