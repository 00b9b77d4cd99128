import jax
import numpy as np

from jeit.data import RoundSkin, screen, simulate_press
from jeit.protocol import adjacent

skin = RoundSkin(num_points=400)
pressed, rest = simulate_press(skin, jax.random.key(0), (0.02, 0.01))
protocol = adjacent(16, driven_electrodes=True)
complete = screen(skin.model().with_protocol(protocol).voltages(1e-3), protocol)
