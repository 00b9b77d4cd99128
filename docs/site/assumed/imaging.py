from pathlib import Path

import jax
import numpy as np

from jeit.data import RoundSkin, join, simulate_press
from jeit.imaging import ImagingSettings

skin = RoundSkin(num_points=400)
pressed, rest = simulate_press(skin, jax.random.key(0), (0.02, 0.01))
file = Path("tank.csv")  # of numbers, as an instrument writes them
np.savetxt(file, np.concatenate([rest.voltages, pressed.voltages]), delimiter=",")
quick = ImagingSettings(method="one-step", num_points=200)
