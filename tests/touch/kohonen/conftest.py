"""A map of touches all over a disk, and its estimates of places."""

import jax
import numpy as np
import pytest
from ringed_sensors import CHANNELS, NOISE, drawn_places, frames_at

from jeit.touch import PlacedMap, SelfOrganisingMap
from jeit.touch.kohonen import MapSchedule


@pytest.fixture(scope="session")
def places():
    return drawn_places(0, 1500)


@pytest.fixture(scope="session")
def pressed(places):
    """Frames (n, 208) of touches at the places, with noise."""
    return frames_at(places) + np.random.default_rng(9).normal(0, NOISE, (len(places), CHANNELS))


@pytest.fixture(scope="session")
def learnt(pressed):
    return SelfOrganisingMap.fit(pressed, jax.random.key(0), shape=(16, 16), schedule=MapSchedule(6000, 6000))


@pytest.fixture(scope="session")
def placed(learnt, pressed, places):
    return PlacedMap.learn(learnt, pressed, places)
