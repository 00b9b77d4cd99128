"""A small skin, and a network that learnt it."""

import pytest
from small_networks import PRESET, small_maps

from jeit.design import Skin
from jeit.layout import named_layout
from jeit.mesh import Rectangle
from jeit.touch.networks import learn_images


@pytest.fixture(scope="module", autouse=True)
def _small_maps():
    with small_maps():
        yield


@pytest.fixture(scope="session")
def small_skin():
    return Skin.create(named_layout("grid-4x4", Rectangle(0.1, 0.1)), num_layers=0, cell_size=8e-3)


@pytest.fixture(scope="session")
def layer():
    """A skin that is solved in three dimensions."""
    return Skin.create(named_layout("grid-3x3", Rectangle(0.06, 0.06)), num_layers=3, cell_size=7e-3)


@pytest.fixture(scope="session")
def learnt(small_skin, tmp_path_factory):
    folder = tmp_path_factory.mktemp("learnt")
    with small_maps():
        return folder, learn_images(small_skin, folder, preset=PRESET)
