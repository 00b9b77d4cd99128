"""A small skin and little to learn, for networks that image, and the bits of what was learnt."""

import equinox as eqx
import jax
import numpy as np

from jeit.touch.networks import Preset
from jeit.touch.training import Plan

SKIN = """
[skin]
width_mm = 100
height_mm = 100
[electrodes]
layout = "grid-4x4"
[mesh]
cell_mm = 6
"""
PRESET = Preset(200, 50, Plan(rate=2e-3, batch=25, epochs=15, patience=15, decay=0.9, seconds=0.0))


def bits(tree):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]
