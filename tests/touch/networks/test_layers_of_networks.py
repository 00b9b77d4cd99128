"""Layers of image networks, against their definitions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jeit.touch.networks.three_stage_network import (
    Convolution,
    DepthAutoencoder,
    repeat_pixels,
)


def test_weights_are_the_first_of_more_draws():
    """Of normal numbers whose variance is 2 over the number of values that each output depends on."""
    key = jax.random.key(0)
    drawn = np.asarray(jax.random.normal(key, (256,), np.float32))[:180].reshape(3, 3, 5, 4)
    np.testing.assert_allclose(Convolution(5, 4, key=key).weight, drawn * np.sqrt(2 / 45), rtol=1e-6)


def test_a_convolution_of_a_doubled_image():
    """With four ninths of the products the results are the same, including the edges, and so are the derivatives."""
    random = np.random.default_rng(0)
    layer = Convolution(5, 4, key=jax.random.key(0))
    layer = eqx.tree_at(lambda one: one.bias, layer, np.arange(4, dtype=np.float32))
    image = random.normal(size=(3, 6, 7, 5)).astype(np.float32)

    def of_way(way):
        def both(layer, image):
            answer = way(layer, image)
            return jnp.sum(answer**3), answer

        return jax.value_and_grad(both, argnums=(0, 1), has_aux=True)

    ways = Convolution.apply_to_repeated, lambda layer, image: layer(repeat_pixels(image))
    found = jax.jit(lambda *at: [of_way(way)(*at) for way in ways])
    ((_, one), slopes), ((_, other), right) = found(layer, image)
    np.testing.assert_allclose(one, other, atol=1e-5)
    for slope, own in zip(*map(jax.tree.leaves, (slopes, right)), strict=True):
        np.testing.assert_allclose(slope, own, rtol=1e-4, atol=1e-3 * float(np.abs(own).max()))


def test_maps_keep_their_numbers_of_rows_and_columns():
    """Their code has 128 values."""

    def encoded_and_decoded(maps):
        network = DepthAutoencoder((16, 40), key=jax.random.key(0))
        code = network.encoder(maps)
        return code, network.decoder(code)

    code, maps = jax.eval_shape(encoded_and_decoded, jnp.zeros((3, 16, 40), jnp.float32))
    assert (code.shape, maps.shape) == ((3, 128), (3, 16, 40))
