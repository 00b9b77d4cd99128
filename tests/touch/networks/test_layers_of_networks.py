"""Layers of image networks, against what they stand for."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jeit.touch.networks.layers import Convolution, doubled


def test_a_convolution_of_a_doubled_image():
    """In four ninths of the products: the same, edges included, and the same slopes."""
    layer = Convolution(5, 4, key=jax.random.key(0))
    layer = eqx.tree_at(lambda one: one.bias, layer, jnp.arange(4, dtype=jnp.float32))
    image = jax.random.normal(jax.random.key(1), (3, 6, 7, 5), jnp.float32)
    np.testing.assert_allclose(layer.of_doubled(image), layer(doubled(image)), atol=1e-5)

    def total(layer, image, way):
        return jnp.sum(way(layer, image) ** 3)

    slopes = [
        jax.grad(total, argnums=(0, 1))(layer, image, way)
        for way in (Convolution.of_doubled, lambda layer, image: layer(doubled(image)))
    ]
    for one, other in zip(*map(jax.tree.leaves, slopes), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-3 * float(jnp.abs(other).max()))
