"""The network of Park et al. 2022 (Science Robotics 7, eabm7187): two autoencoders, and a projection between them.

What the paper does not print is chosen: hidden layers of 256 between 94 channels and 84 latent values, convolutions of
16, 32 and 64 channels.
"""

from __future__ import annotations

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jeit.touch.networks.layers import Chain, Convolution, Dense

_HIDDEN, _LATENT, _DROPOUT = 256, 84, 0.03
_CHANNELS, _CODE = (16, 32, 64), 128
# Noise of depths over the thickness, in the input of the autoencoder of depth maps.
_NOISE = 0.02


class VoltageAutoencoder(eqx.Module):
    """Standardised changes (b, M) to 84 latent values, and back."""

    encoder: Chain
    decoder: Chain

    def __init__(self, channels: int, *, key: Array):
        """Create an untrained autoencoder of `channels` channels."""
        inwards, outwards = jax.random.split(key)
        self.encoder = Chain.dense((channels, _HIDDEN, _LATENT), key=inwards, dropout=_DROPOUT)
        self.decoder = Chain.dense((_LATENT, _HIDDEN, channels), key=outwards, dropout=_DROPOUT)

    def __call__(self, changes: Float[Array, "b M"], key: Array | None = None) -> Float[Array, "b M"]:
        """Reconstruct changes without noise; with dropout where a key is given."""
        first, second = (None, None) if key is None else jax.random.split(key)
        return self.decoder(jax.nn.elu(self.encoder(changes, first)), second)


class DepthEncoder(eqx.Module):
    """Depth maps (b, rows, columns) to 128 values."""

    layers: tuple[Convolution, ...]
    last: Dense

    def __init__(self, shape: tuple[int, int], *, key: Array):
        """Of maps of this shape, multiples of 8."""
        *keys, last = jax.random.split(key, len(_CHANNELS) + 1)
        widths = (1, *_CHANNELS)
        self.layers = tuple(Convolution(i, o, 2, key=one) for (i, o), one in zip(pairwise(widths), keys, strict=True))
        self.last = Dense(shape[0] * shape[1] // 64 * _CHANNELS[-1], _CODE, key=last)

    def __call__(self, maps: Float[Array, "b r c"]) -> Float[Array, "b 128"]:
        """Encode a batch."""
        image = maps[..., None]
        for layer in self.layers:
            image = jax.nn.elu(layer(image))
        return self.last(image.reshape(len(maps), -1))


class DepthDecoder(eqx.Module):
    """128 values to depth maps (b, rows, columns)."""

    first: Dense
    layers: tuple[Convolution, ...]
    shape: tuple[int, int] = eqx.field(static=True)

    def __init__(self, shape: tuple[int, int], *, key: Array):
        """Of maps of this shape, multiples of 8."""
        first, *keys = jax.random.split(key, len(_CHANNELS) + 1)
        widths = (*_CHANNELS[::-1], 1)
        self.shape = (shape[0] // 8, shape[1] // 8)
        self.first = Dense(_CODE, self.shape[0] * self.shape[1] * widths[0], key=first)
        self.layers = tuple(Convolution(i, o, key=one) for (i, o), one in zip(pairwise(widths), keys, strict=True))

    def __call__(self, code: Float[Array, "b 128"]) -> Float[Array, "b r c"]:
        """Decode a batch."""
        image = self.first(code).reshape(len(code), *self.shape, -1)
        for layer in self.layers:
            image = layer.of_doubled(jax.nn.elu(image))
        return image[..., 0]


class DepthAutoencoder(eqx.Module):
    """Depth maps to 128 values, and back."""

    encoder: DepthEncoder
    decoder: DepthDecoder

    def __init__(self, shape: tuple[int, int], *, key: Array):
        """Of maps of this shape, multiples of 8."""
        inwards, outwards = jax.random.split(key)
        self.encoder, self.decoder = DepthEncoder(shape, key=inwards), DepthDecoder(shape, key=outwards)

    def __call__(self, maps: Float[Array, "b r c"], key: Array | None = None) -> Float[Array, "b r c"]:
        """Reconstruct maps; with noise on the input where a key is given."""
        if key is not None:
            maps = maps + _NOISE * jax.random.normal(key, maps.shape, maps.dtype)
        return self.decoder(jax.nn.elu(self.encoder(maps)))


class ThreeStages(eqx.Module):
    """Relative changes (b, M) → 84 latent values → 128 → depth maps (b, rows, columns); `mean` and `deviation` (M,) of
    the changes that it was trained on."""

    mean: Float[Array, " M"]
    deviation: Float[Array, " M"]
    encoder: Chain
    projection: Chain
    decoder: DepthDecoder

    def __init__(self, channels: int, shape: tuple[int, int], *, key: Array):
        """Untrained."""
        voltages, depth, between = jax.random.split(key, 3)
        self.mean, self.deviation = jnp.zeros(channels, jnp.float32), jnp.ones(channels, jnp.float32)
        self.encoder = VoltageAutoencoder(channels, key=voltages).encoder
        self.projection = Chain.dense((_LATENT, _HIDDEN, _HIDDEN, _CODE), key=between)
        self.decoder = DepthAutoencoder(shape, key=depth).decoder

    def standard(self, changes: Float[Array, "b M"]) -> Float[Array, "b M"]:
        """Standardise changes by the `mean` and `deviation` of the training set."""
        return (changes - self.mean) / self.deviation

    def __call__(self, changes: Float[Array, "b M"]) -> Float[Array, "b r c"]:
        """Depth maps, over the thickness of the skin."""
        latent = jax.nn.elu(self.encoder(self.standard(changes)))
        return self.decoder(jax.nn.elu(self.projection(latent)))
