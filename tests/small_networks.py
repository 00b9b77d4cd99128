"""Shared by tests of image networks: a small skin with a short training, and the bits of the trained parameters."""

from contextlib import contextmanager

import equinox as eqx
import jax
import numpy as np
import pytest

from jeit.design.skin import voltage_changes
from jeit.touch.networks import NetworkPreset, learn, linear_channels
from jeit.touch.simulate import DiscIndenter
from jeit.touch.training import TrainingPlan

SKIN = """
[skin]
width_mm = 100
height_mm = 100
[electrodes]
layout = "grid-4x4"
[mesh]
cell_mm = 8
"""
PRESET = NetworkPreset(100, 30, TrainingPlan(rate=2e-3, batch=25, epochs=10, patience=10, decay=0.9, seconds=0.0))
SHAPE = (24, 24)


@contextmanager
def small_maps():
    """Maps with half the usual numbers of rows and columns, bodies of one kind, and one program for touches of all
    sizes, to limit compilation."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learn, "SHAPE", SHAPE)
        patch.setattr(learn, "_PLACES_PER_SIDE", 5)
        patch.setattr(linear_channels, "_PLACES_PER_SIDE", 5)
        patch.setattr(linear_channels, "_MAX_BODIES", 1)
        padded = voltage_changes._padded_size
        patch.setattr(voltage_changes, "_padded_size", lambda count, ratio: np.maximum(padded(count, ratio), 64))
        patch.setattr(linear_channels, "touching_bodies", lambda: [DiscIndenter(0.02)])
        yield


def bits(tree):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]
