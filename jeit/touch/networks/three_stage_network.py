"""A network of three stages for images of touch, after Park et al. 2022, and its layers.

The paper does not state the sizes of all layers. The sizes chosen here are hidden layers of 256 values between 94
channels and 84 latent values, and convolutions of 16, 32 and 64 channels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit_solvers.engines import has_values
from jeit_solvers.module import Module


class Dense(Module):
    """Dense layer x W + b for a batch of inputs x (rows, inputs), with the `weight` W and the `bias` b."""

    weight: Float[Array, "i o"]
    bias: Float[Array, " o"]

    def __init__(self, inputs: int, outputs: int, *, key: Array):
        """Create a dense layer with random weights after He et al. 2015, as in all layers here, and a bias of zero."""
        self.weight = _draw_weights(key, (inputs, outputs), inputs)
        self.bias = jnp.asarray(np.zeros(outputs, np.float32))

    def __call__(self, values: Float[Array, "b i"]) -> Float[Array, "b o"]:
        """Apply the layer to a batch of inputs (rows, inputs)."""
        return values @ self.weight + self.bias


class Convolution(Module):
    """Convolutional layer: 3 × 3 convolution of images padded with zeros, at every `stride`-th pixel."""

    weight: Float[Array, "3 3 i o"]
    bias: Float[Array, " o"]
    stride: int = eqx.field(static=True)

    def __init__(self, inputs: int, outputs: int, stride: int = 1, *, key: Array):
        """Create a convolutional layer from images with `inputs` channels to images with `outputs` channels."""
        self.weight = _draw_weights(key, (3, 3, inputs, outputs), 9 * inputs)
        self.bias = jnp.asarray(np.zeros(outputs, np.float32))
        self.stride = stride

    def __call__(self, image: Float[Array, "b r c i"]) -> Float[Array, "b p q o"]:
        """Apply the layer to a batch of images (images, rows, columns, channels)."""
        axis_layout = ("NHWC", "HWIO", "NHWC")
        convolution_strides = (self.stride, self.stride)
        return (
            jax.lax.conv_general_dilated(image, self.weight, convolution_strides, "SAME", dimension_numbers=axis_layout)
            + self.bias
        )

    def apply_to_repeated(self, image: Float[Array, "b r c i"]) -> Float[Array, "b s d o"]:
        """Compute the convolution of the enlarged image `repeat_pixels(image)` with four ninths of the multiplications.

        Of the three rows of the enlarged image that contribute to a pixel, two are equal, so the weights of these two
        rows are added before the multiplication. Columns are treated in the same way.
        """
        num_images, rows, columns, _ = image.shape
        row_weights = jnp.stack([self.weight.at[1].add(self.weight[2])[:2], self.weight.at[1].add(self.weight[0])[1:]])
        column_weights = [
            row_weights.at[:, :, 1].add(row_weights[:, :, 2])[:, :, :2],
            row_weights.at[:, :, 1].add(row_weights[:, :, 0])[:, :, 1:],
        ]
        pixel_weights = jnp.moveaxis(jnp.stack(column_weights, axis=1), (0, 1), (3, 4)).reshape(
            2, 2, image.shape[-1], -1
        )
        # The image is padded before the convolution: for a padded convolution of even size, XLA takes twenty times as
        # long to compute derivatives.
        padded_image = jnp.pad(image, ((0, 0), (1, 1), (1, 1), (0, 0)))
        axis_layout = ("NHWC", "HWIO", "NHWC")
        convolved_blocks = jax.lax.conv_general_dilated(
            padded_image, pixel_weights, (1, 1), "VALID", dimension_numbers=axis_layout
        )
        convolved_blocks = convolved_blocks.reshape(num_images, rows + 1, columns + 1, 2, 2, -1)
        output_rows = [[convolved_blocks[:, a : a + rows, b : b + columns, a, b] for b in (0, 1)] for a in (0, 1)]
        output_image = jnp.stack([jnp.stack(output_row, axis=3) for output_row in output_rows], axis=2)
        return output_image.reshape(num_images, 2 * rows, 2 * columns, -1) + self.bias


class Chain(Module):
    """Layers of a network in sequence, with exponential linear units between the layers.

    If a random key is given, a fraction `dropout` of the values is dropped before each layer but the first.
    """

    layers: tuple[eqx.Module, ...]
    dropout: float = eqx.field(static=True)

    @classmethod
    def dense(cls, widths: Sequence[int], *, key: Array, dropout: float = 0.0) -> "Chain":
        """Create dense layers in sequence, whose numbers of inputs and outputs are successive elements of `widths`."""
        layer_keys = jax.random.split(key, len(widths) - 1)
        return cls(
            tuple(Dense(i, o, key=layer_key) for (i, o), layer_key in zip(pairwise(widths), layer_keys, strict=True)),
            dropout,
        )

    def __call__(self, values: Array, key: Array | None = None) -> Array:
        """Apply the layers to a batch of inputs; no activation function follows the last layer."""
        for layer_index, layer in enumerate(self.layers):
            if layer_index:
                values = jax.nn.elu(values)
                if key is not None and self.dropout:
                    is_not_dropped = jax.random.bernoulli(
                        jax.random.fold_in(key, layer_index), 1 - self.dropout, values.shape
                    )
                    values = jnp.where(is_not_dropped, values / (1 - self.dropout), 0.0)
            values = layer(values)  # pyright: ignore[reportCallIssue]
        return values


def repeat_pixels(image: Float[Array, "b r c i"]) -> Float[Array, "b s d i"]:
    """Enlarge images to twice the rows and columns: each pixel becomes 2 × 2 equal pixels."""
    num_images, rows, columns, num_channels = image.shape
    repeated_image = jnp.broadcast_to(image[:, :, None, :, None], (num_images, rows, 2, columns, 2, num_channels))
    return repeated_image.reshape(num_images, 2 * rows, 2 * columns, num_channels)


def channels_to_pixels(image: Float[Array, "b r c 4"]) -> Float[Array, "b s d"]:
    """Arrange the four channels of each pixel of images as 2 × 2 pixels of one channel."""
    num_images, rows, columns, _ = image.shape
    pixel_blocks = image.reshape(num_images, rows, columns, 2, 2)
    return jnp.moveaxis(pixel_blocks, 3, 2).reshape(num_images, 2 * rows, 2 * columns)


# Minimum number of random numbers drawn for the weights of a layer.
_MIN_NUM_DRAWS = 8192


def _draw_weights(key: Array, weight_shape: tuple[int, ...], num_inputs: int) -> Array:
    """Draw random initial weights of a layer; each output depends on a number `num_inputs` of values (He et al. 2015).

    The number of draws is rounded up to a power of two, and to one number for all convolutions, so that JAX compiles
    fewer programs for layers of different sizes; the first draws are the same for any number.
    """
    num_weights = math.prod(weight_shape)
    num_draws = max(1 << max(num_weights - 1, 0).bit_length(), _MIN_NUM_DRAWS)
    normal_draws = jax.random.normal(key, (num_draws,), jnp.float32)
    normal_draws = np.asarray(normal_draws) if has_values(normal_draws) else normal_draws
    return jnp.asarray(normal_draws[:num_weights].reshape(weight_shape) * np.float32(np.sqrt(2 / num_inputs)))


# Autoencoder of voltages: size of the hidden layers, size of the latent vector, and dropout rate; autoencoder of depth
# maps: numbers of channels of the convolutions, and size of the code.
_HIDDEN_SIZE, _LATENT_SIZE, _DROPOUT_RATE = 256, 84, 0.03
_NUM_FILTERS, _CODE_SIZE = (16, 32, 64), 128
# Standard deviation of the noise added to depth maps at the input of their autoencoder, divided by the skin's
# thickness.
_DEPTH_NOISE = 0.02


class VoltageAutoencoder(Module):
    """Autoencoder of standardised voltage changes (frames, channels) with 84 latent values."""

    encoder: Chain
    decoder: Chain

    def __init__(self, num_channels: int, *, key: Array):
        """Create an untrained autoencoder for voltage changes of `num_channels` channels."""
        encoder_key, decoder_key = jax.random.split(key)
        self.encoder = Chain.dense((num_channels, _HIDDEN_SIZE, _LATENT_SIZE), key=encoder_key, dropout=_DROPOUT_RATE)
        self.decoder = Chain.dense((_LATENT_SIZE, _HIDDEN_SIZE, num_channels), key=decoder_key, dropout=_DROPOUT_RATE)

    def __call__(self, changes: Float[Array, "b M"], key: Array | None = None) -> Float[Array, "b M"]:
        """Reconstruct standardised voltage changes without their noise; dropout is applied if a random key is given."""
        encoder_key, decoder_key = (None, None) if key is None else jax.random.split(key)
        return self.decoder(jax.nn.elu(self.encoder(changes, encoder_key)), decoder_key)


class DepthEncoder(Module):
    """Convolutional encoder of depth maps (maps, rows, columns) to codes of 128 values."""

    layers: tuple[Convolution, ...]
    last: Dense

    def __init__(self, shape: tuple[int, int], *, key: Array):
        """Create an untrained network for depth maps of this shape; rows and columns are multiples of 8."""
        *layer_keys, last_key = jax.random.split(key, len(_NUM_FILTERS) + 1)
        layer_widths = (1, *_NUM_FILTERS)
        self.layers = tuple(
            Convolution(i, o, 2, key=layer_key)
            for (i, o), layer_key in zip(pairwise(layer_widths), layer_keys, strict=True)
        )
        self.last = Dense(shape[0] * shape[1] // 64 * _NUM_FILTERS[-1], _CODE_SIZE, key=last_key)

    def __call__(self, maps: Float[Array, "b r c"]) -> Float[Array, "b 128"]:
        """Encode a batch of depth maps as codes of 128 values."""
        image = maps[..., None]
        for layer in self.layers:
            image = jax.nn.elu(layer(image))
        return self.last(image.reshape(len(maps), -1))


class DepthDecoder(Module):
    """Convolutional decoder of codes of 128 values to depth maps (maps, rows, columns)."""

    first: Dense
    layers: tuple[Convolution, ...]
    shape: tuple[int, int] = eqx.field(static=True)

    def __init__(self, shape: tuple[int, int], *, key: Array):
        """Create an untrained network for depth maps of this shape; rows and columns are multiples of 8."""
        first_key, *layer_keys = jax.random.split(key, len(_NUM_FILTERS) + 1)
        layer_widths = (*_NUM_FILTERS[::-1], 1)
        self.shape = (shape[0] // 8, shape[1] // 8)
        self.first = Dense(_CODE_SIZE, self.shape[0] * self.shape[1] * layer_widths[0], key=first_key)
        self.layers = tuple(
            Convolution(i, o, key=layer_key)
            for (i, o), layer_key in zip(pairwise(layer_widths), layer_keys, strict=True)
        )

    def __call__(self, code: Float[Array, "b 128"]) -> Float[Array, "b r c"]:
        """Decode a batch of codes of 128 values to depth maps."""
        image = self.first(code).reshape(len(code), *self.shape, -1)
        for layer in self.layers:
            image = layer.apply_to_repeated(jax.nn.elu(image))
        return image[..., 0]


class DepthAutoencoder(Module):
    """Convolutional autoencoder of depth maps with a code of 128 values."""

    encoder: DepthEncoder
    decoder: DepthDecoder

    def __init__(self, shape: tuple[int, int], *, key: Array):
        """Create an untrained network for depth maps of this shape; rows and columns are multiples of 8."""
        encoder_key, decoder_key = jax.random.split(key)
        self.encoder, self.decoder = DepthEncoder(shape, key=encoder_key), DepthDecoder(shape, key=decoder_key)

    def __call__(self, maps: Float[Array, "b r c"], key: Array | None = None) -> Float[Array, "b r c"]:
        """Reconstruct depth maps; noise is added to the input maps if a random key is given."""
        if key is not None:
            maps = maps + _DEPTH_NOISE * jax.random.normal(key, maps.shape, maps.dtype)
        return self.decoder(jax.nn.elu(self.encoder(maps)))


class ThreeStages(Module):
    """Network of three stages: relative voltage changes → 84 latent values → code of 128 values → depth maps.

    **Fields**: `mean`, `deviation` (channels,): mean and standard deviation of the voltage changes in the training set,
    with noise; `encoder`, `projection`, `decoder`: the three stages. Input (frames, channels), output (frames, rows,
    columns).
    """

    mean: Float[Array, " M"]
    deviation: Float[Array, " M"]
    encoder: Chain
    projection: Chain
    decoder: DepthDecoder

    def __init__(self, num_channels: int, shape: tuple[int, int], *, key: Array):
        """Create an untrained network for `num_channels` channels and depth maps of the given shape."""
        encoder_key, decoder_key, projection_key = jax.random.split(key, 3)
        self.mean, self.deviation = jnp.zeros(num_channels, jnp.float32), jnp.ones(num_channels, jnp.float32)
        self.encoder = VoltageAutoencoder(num_channels, key=encoder_key).encoder
        self.projection = Chain.dense((_LATENT_SIZE, _HIDDEN_SIZE, _HIDDEN_SIZE, _CODE_SIZE), key=projection_key)
        self.decoder = DepthAutoencoder(shape, key=decoder_key).decoder

    def standardise(self, changes: Float[Array, "b M"]) -> Float[Array, "b M"]:
        """Standardise voltage changes by the `mean` and `deviation` of the training set."""
        return (changes - self.mean) / self.deviation

    def __call__(self, changes: Float[Array, "b M"]) -> Float[Array, "b r c"]:
        """Compute depth maps, divided by the thickness of the skin, from relative voltage changes."""
        latent_code = jax.nn.elu(self.encoder(self.standardise(changes)))
        return self.decoder(jax.nn.elu(self.projection(latent_code)))
