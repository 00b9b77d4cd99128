"""A small skin, and a network trained on it."""

import jax
import pytest
from small_networks import PRESET, SHAPE, small_maps

from jeit.design import Skin
from jeit.layout import named_layout
from jeit.mesh import Rectangle
from jeit.touch.networks import ImageNetwork, learn_images, write_network
from jeit.touch.networks.linear_channels import LinearChannels
from jeit.touch.networks.unrolled_network import Unrolled
from jeit.touch.simulate.contact.indent_sets import image_places
from jeit.touch.simulate.contact.indents import resting_skin


@pytest.fixture(scope="module", autouse=True)
def _small_maps():
    with small_maps():
        yield


@pytest.fixture(scope="session")
def small_skin():
    return Skin.create(named_layout("grid-4x4", Rectangle(0.1, 0.1)), num_layers=0, cell_size=8e-3)


@pytest.fixture(scope="session")
def resting(small_skin):
    """The small skin at rest, for changes by touches without a program for each set of touches."""
    return resting_skin(small_skin, float(small_skin.thickness))


@pytest.fixture(scope="session")
def layer():
    """A skin that is solved in three dimensions."""
    return Skin.create(named_layout("grid-3x3", Rectangle(0.06, 0.06)), num_layers=3, cell_size=7e-3)


@pytest.fixture(scope="session")
def imaging(small_skin, tmp_path_factory):
    """A folder with an untrained network, whose maps are linear images, and the network."""
    folder, noise = tmp_path_factory.mktemp("imaging"), 1.5e-3
    network = Unrolled(small_skin.model.protocol.num_measurements, SHAPE, key=jax.random.key(0))
    places = image_places(small_skin, SHAPE[1], SHAPE[0])
    network = network.adapted_to_skin(
        LinearChannels.from_skin(small_skin, SHAPE), places, small_skin.layout.centres, noise
    )
    network = ImageNetwork.from_skin(network, small_skin, noise, SHAPE)
    write_network(network, folder / "network.jeit")
    return folder, network


@pytest.fixture(scope="session")
def learnt(small_skin, tmp_path_factory):
    folder = tmp_path_factory.mktemp("learnt")
    with small_maps():
        return folder, learn_images(small_skin, folder, preset=PRESET)
