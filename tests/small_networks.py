"""Shared by tests of image networks: a small skin with a short training, and the bits of the trained parameters."""

from contextlib import contextmanager
from functools import cache

import equinox as eqx
import jax
import numpy as np
import pytest

from jeit.design.skin import voltage_changes
from jeit.touch.networks import NetworkPreset, learn, linear_channels
from jeit.touch.simulate import DiscIndenter, relative_changes
from jeit.touch.simulate.contact.indent_sets import _SkinAndDepth
from jeit.touch.simulate.contact.indents import resting_skin
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
PRESET = NetworkPreset(100, 30, TrainingPlan(rate=2e-3, batch=25, epochs=5, patience=5, decay=0.9, seconds=0.0))
SHAPE = (24, 24)


def shared_changes():
    """Return `relative_changes` that prepares each skin at rest once, so that all touches share one program."""
    prepared = cache(lambda key: resting_skin(key.skin, key.depth))
    return lambda skin, touches: relative_changes(skin, touches, prepared(_SkinAndDepth(skin, float(skin.thickness))))


@contextmanager
def small_maps():
    """Maps with half the usual numbers of rows and columns, bodies of one kind, and one program for touches of all
    sizes, to limit compilation."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learn, "DEPTH_MAP_SHAPE", SHAPE)
        patch.setattr(learn, "_BALL_PLACES_PER_SIDE", 5)
        patch.setattr(linear_channels, "_BALL_PLACES_PER_SIDE", 5)
        patch.setattr(linear_channels, "_MAX_SIMULTANEOUS_BODIES", 1)
        padded = voltage_changes._padded_size
        patch.setattr(voltage_changes, "_padded_size", lambda count, ratio: np.maximum(padded(count, ratio), 64))
        changes = shared_changes()
        patch.setattr(learn, "relative_changes", changes)
        patch.setattr(linear_channels, "relative_changes", changes)
        patch.setattr(linear_channels, "touching_bodies", lambda: [DiscIndenter(0.02)])
        yield


def bits(tree):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]
