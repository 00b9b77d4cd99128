"""Changes of a skin's channels under a depth map, against exact voltages."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.touch.networks.linear_channels import LinearChannels, depth_from_strength, strength, touching_bodies
from jeit.touch.simulate import DiscIndenter, Indent, depth_maps, indented_cells, relative_changes
from jeit.touch.simulate.contact.indent_sets import image_places


@pytest.fixture(scope="module")
def sensed(small_skin):
    return LinearChannels.from_skin(small_skin)


def channel_changes(sensed, depth):
    return np.asarray(strength(jnp.asarray(depth))).reshape(len(depth), -1) @ sensed.operator.T


def missed(found, right):
    return np.linalg.norm(found - right) / np.linalg.norm(right)


@pytest.mark.parametrize(("depth", "most"), [(0.5e-3, 0.04), (4e-3, 0.12), (7e-3, 0.25)])
def test_changes_are_nearly_exact(small_skin, resting, sensed, depth, most):
    """For a disc of 24 mm. Without the square root the error at 7 mm is a half."""
    touches = [[Indent(DiscIndenter(0.024), depth, place)] for place in [(0.0, 0.005), (0.02, -0.018), (-0.03, 0.01)]]
    maps = depth_maps(touches, image_places(small_skin, 48, 48)) / float(small_skin.thickness)
    exact = relative_changes(small_skin, touches, resting)
    assert missed(channel_changes(sensed, maps), exact) < most
    if depth == 7e-3:
        assert missed(maps.reshape(3, -1) @ sensed.operator.T, exact) > 0.4


def test_halved_pixels_give_the_same_changes(sensed):
    """For a map that is constant in each 2 × 2 block."""
    coarse = np.random.default_rng(0).uniform(size=(24, 24))
    fine = coarse.repeat(2, axis=0).repeat(2, axis=1)
    assert np.allclose(sensed.coarser_operator() @ coarse.ravel(), sensed.operator @ fine.ravel(), rtol=1e-12)


def test_contact_impedance(small_skin, sensed):
    """Against a skin with other contacts: 1 % more at electrode 5."""
    impedance = np.full(16, 1e-4)
    impedance[5] *= np.exp(0.01)
    other = small_skin.with_layout(small_skin.layout, impedance)
    rest, changed = (np.asarray(one.model.voltages(one.model_conductivity)) for one in (small_skin, other))
    assert missed(0.01 * sensed.contacts[5], (changed - rest) / rest) < 0.01


def test_strength():
    """At most √ε away from 2 sinh(s / 2) of e^−s = 1 − δ, and smooth beyond the clipping."""
    depth = np.linspace(0, 0.9, 10)
    assert np.allclose(strength(jnp.asarray(depth)), 2 * np.sinh(-np.log1p(-depth) / 2), rtol=1e-12)
    assert np.allclose(depth_from_strength(strength(jnp.asarray(depth))), depth, rtol=1e-6)
    slopes = jax.vmap(jax.grad(strength))(jnp.asarray([-0.1, 0.95, 1.2]))
    assert np.isfinite(slopes).all()


def test_a_layer_changes_less_at_the_same_depth(layer):
    """Its electrodes are at the bottom, and material is removed at the top."""
    own = LinearChannels.from_skin(layer, (24, 24))
    touches = [[Indent(DiscIndenter(0.02), 2.5e-3, (0.002, 0.004))]]
    maps = depth_maps(touches, image_places(layer, 24, 24)) / float(layer.thickness)
    touched, conductivity = (
        indented_cells(layer, touches),
        np.full(layer.model.mesh.num_cells, float(layer.conductivity)),
    )
    rest = np.asarray(layer.model.voltages(conductivity))
    np.multiply.at(conductivity, np.asarray(touched.cells)[0], np.maximum(1 + np.asarray(touched.change)[0], 1e-9))
    assert missed(channel_changes(own, maps), (np.asarray(layer.model.voltages(conductivity)) / rest - 1)[None]) < 0.6


def test_indenters():
    """All reach their depth near the origin. The largest is the wrench, 100 mm long."""
    places = np.stack(np.meshgrid(np.linspace(-0.07, 0.07, 141), np.linspace(-0.03, 0.03, 61)), axis=-1)
    maps = depth_maps([[Indent(one, 2e-3)] for one in touching_bodies()], places)
    assert np.allclose(maps.max(axis=(1, 2)), 2e-3, rtol=0.1)
    length = [np.ptp(places[one > 0][:, 0]) for one in maps]
    assert length[-1] == max(length) == pytest.approx(0.1, abs=3e-3)
