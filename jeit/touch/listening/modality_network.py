"""The network of Park et al. (2022) that classifies touch by its sound: trained with equinox and optax, run in NumPy.

The network has two layers, each a convolution without padding, batch normalisation, rectification and max-pooling. The
convolutions have 32 kernels of 5 × 5 pixels, then 64 kernels of 3 × 3 pixels. A dense layer and softmax follow.
Training uses Adam with a learning rate of 2e-4, divided by ten after every five epochs, and batches of 64; the held-out
loss is evaluated every 50 batches, and training ends after 20 evaluations without a decrease. Chosen here, not taken
from the paper, are the kernel size of the second convolution, the sizes of the pools, 3 × 3 and 2 × 2, and the noise
added to images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from jeit.touch.training import TrainingObjective, TrainingPlan, TrainingResult, fit_network
from jeit_solvers.module import Module

# Sizes of the kernels and of the pools in pixels, and numbers of channels, of the first and second layer.
_KERNEL_SIZES, _POOL_SIZES, _NUM_CHANNELS = (5, 3), (3, 2), (32, 64)
# Weight of the mean and variance of a batch in the update of the running mean and variance.
_RUNNING_MEAN_UPDATE_WEIGHT = 0.05
# Constant added to variances.
_VARIANCE_FLOOR = 1e-5
NOISE_DEVIATION, NUM_COPIES = 0.2, 5
"""Standard deviation of the normal noise added to images, whose own standard deviation is 1; number of noisy copies of
each image in an epoch, as in the paper."""
# Number of windows evaluated at once.
_MAX_BLOCK_WINDOWS = 32


class ModalityNetwork(Module):
    """Convolutional network that classifies feature images of sound: its weights, in single precision.

    `first` (5, 5, 1, 32) and `second` (3, 3, 32, 64): kernels of the two convolutions; `gain`, `shift`, running `mean`
    and `variance`: batch normalisation after the first and the second convolution; `dense` (n, C) and `bias` (C,):
    weights of the last layer, from n values to C classes.
    """

    first: Float[Array, "5 5 1 32"]
    second: Float[Array, "3 3 32 64"]
    gain: tuple[Array, Array]
    shift: tuple[Array, Array]
    mean: tuple[Array, Array]
    variance: tuple[Array, Array]
    dense: Float[Array, "n C"]
    bias: Float[Array, " C"]

    @classmethod
    def draw(cls, key: Array, rows: int, columns: int, classes: int) -> "ModalityNetwork":
        """Create an untrained network for images (rows, columns).

        Kernels are drawn from normal distributions with the variance of He et al. (2015).
        """
        for kernel_size, pool_size in zip(_KERNEL_SIZES, _POOL_SIZES, strict=True):
            rows, columns = ((image_side - kernel_size + 1) // pool_size for image_side in (rows, columns))
        layer_keys = jax.random.split(key, 3)
        first_kernel_size, second_kernel_size = _KERNEL_SIZES
        kernel_shapes = (
            (first_kernel_size, first_kernel_size, 1, _NUM_CHANNELS[0]),
            (second_kernel_size, second_kernel_size, *_NUM_CHANNELS),
            (rows * columns * _NUM_CHANNELS[1], classes),
        )
        first_kernels, second_kernels, dense_weights = (
            jax.random.normal(layer_key, kernel_shape, jnp.float32)
            * jnp.float32(np.sqrt(2 / np.prod(kernel_shape[:-1])))
            for layer_key, kernel_shape in zip(layer_keys, kernel_shapes, strict=True)
        )
        num_first_channels, num_second_channels = _NUM_CHANNELS
        channel_ones, channel_zeros = (
            (
                jnp.full(num_first_channels, fill_value, jnp.float32),
                jnp.full(num_second_channels, fill_value, jnp.float32),
            )
            for fill_value in (1.0, 0.0)
        )
        dense_weights, dense_bias = 0.1 * dense_weights, jnp.zeros(classes, jnp.float32)
        return cls(
            first_kernels,
            second_kernels,
            channel_ones,
            channel_zeros,
            channel_zeros,
            channel_ones,
            dense_weights,
            dense_bias,
        )

    def log_odds(self, images: Float[Array, "b rows columns"]) -> Float[Array, "b C"]:
        """Compute the log-odds (b, C) of C classes for b images, with batch normalisation by running statistics."""
        return self._forward_pass(images, self.mean, self.variance)[0]

    def log_odds_in_training(
        self, images: Float[Array, "b rows columns"]
    ) -> tuple[Float[Array, "b C"], "ModalityNetwork"]:
        """Compute the log-odds (b, C) of C classes for a batch of b images, normalised by the batch's own statistics.

        Also returns the network with updated running means and variances.
        """
        class_log_odds, batch_means, batch_variances = self._forward_pass(images, None, None)
        running_statistics = jax.tree.map(
            lambda running_value, batch_value: (
                (1 - _RUNNING_MEAN_UPDATE_WEIGHT) * running_value
                + _RUNNING_MEAN_UPDATE_WEIGHT * jax.lax.stop_gradient(batch_value)
            ),
            (self.mean, self.variance),
            (batch_means, batch_variances),
        )
        return class_log_odds, eqx.tree_at(lambda network: (network.mean, network.variance), self, running_statistics)

    def _forward_pass(self, images, running_means, running_variances):
        activations, layer_means, layer_variances = images[..., None], [], []
        for layer_index, layer_kernel in enumerate((self.first, self.second)):
            activations = jax.lax.conv_general_dilated(
                activations, layer_kernel, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
            if running_means is None:
                batch_mean = activations.mean((0, 1, 2))
                mean_and_variance = batch_mean, (activations**2).mean((0, 1, 2)) - batch_mean**2
            else:
                mean_and_variance = running_means[layer_index], running_variances[layer_index]
            layer_means.append(mean_and_variance[0])
            layer_variances.append(mean_and_variance[1])
            channel_factors = self.gain[layer_index] / jnp.sqrt(mean_and_variance[1] + _VARIANCE_FLOOR)
            activations = activations * channel_factors + (
                self.shift[layer_index] - mean_and_variance[0] * channel_factors
            )
            activations = _max_pool(jnp.maximum(activations, 0), _POOL_SIZES[layer_index], jnp)
        return activations.reshape(len(images), -1) @ self.dense + self.bias, tuple(layer_means), tuple(layer_variances)


def _max_pool(activations, pool_size: int, array_namespace):
    """Compute the maximum of every `pool_size` × `pool_size` block of values (b, h, w, c). Rows and columns that do not
    fill a block are left out."""
    used_height, used_width = (image_side // pool_size * pool_size for image_side in activations.shape[1:3])
    activations = activations[:, :used_height, :used_width]
    row_maxima = reduce(
        array_namespace.maximum, [activations[:, row_offset::pool_size] for row_offset in range(pool_size)]
    )
    return reduce(
        array_namespace.maximum, [row_maxima[:, :, column_offset::pool_size] for column_offset in range(pool_size)]
    )


class NetworkAnswers:
    """A trained network that is evaluated in NumPy, without compilation, in a few milliseconds for one window."""

    def __init__(self, network: ModalityNetwork):
        host_network = jax.tree.map(np.asarray, network)
        # Batch normalisation multiplies each channel by a factor and adds an offset; the factor is merged into the
        # kernels.
        layer_factors = [
            channel_gains / np.sqrt(channel_variances + _VARIANCE_FLOOR)
            for channel_gains, channel_variances in zip(host_network.gain, host_network.variance, strict=True)
        ]
        self.kernels = [
            np.ascontiguousarray(
                (layer_kernel * channel_factors).transpose(2, 0, 1, 3).reshape(-1, layer_kernel.shape[-1])
            )
            for layer_kernel, channel_factors in zip(
                (host_network.first, host_network.second), layer_factors, strict=True
            )
        ]
        self.offsets = [
            channel_shifts - channel_factors * channel_means
            for channel_shifts, channel_factors, channel_means in zip(
                host_network.shift, layer_factors, host_network.mean, strict=True
            )
        ]
        self.dense, self.bias = host_network.dense, host_network.bias

    def log_odds(self, images: Float[np.ndarray, "W rows columns"]) -> Float[np.ndarray, "W C"]:
        """Compute the log-odds (W, C) of C classes for W images."""
        log_odds_of_blocks = [
            self._evaluate_block(images[block_start : block_start + _MAX_BLOCK_WINDOWS])
            for block_start in range(0, len(images), _MAX_BLOCK_WINDOWS)
        ]
        return np.concatenate([np.zeros((0, len(self.bias)), np.float32), *log_odds_of_blocks]).astype(float)

    def _evaluate_block(self, images: np.ndarray) -> np.ndarray:
        activations = images[..., None]
        for layer_kernel, layer_offset, kernel_size, pool_size in zip(
            self.kernels, self.offsets, _KERNEL_SIZES, _POOL_SIZES, strict=True
        ):
            image_patches = sliding_window_view(activations, (kernel_size, kernel_size), axis=(1, 2))
            activations = image_patches.reshape(*image_patches.shape[:3], -1) @ layer_kernel
            activations += layer_offset
            activations = _max_pool(np.maximum(activations, 0, out=activations), pool_size, np)
        return activations.reshape(len(images), -1) @ self.dense + self.bias


def paper_plan(windows: int, *, batches: int, batch: int = 64) -> TrainingPlan:
    """Return the training schedule of Park et al. (2022) for a training set of `windows` windows.

    Training has at most `batches` batches of `batch` windows, but at least one pass through the windows. Noise is drawn
    anew in every batch, so that no image is repeated; `NUM_COPIES` passes through the windows correspond to one epoch
    of the paper, which contains as many noisy copies.
    """
    batch_size = min(batch, windows)
    return TrainingPlan(
        rate=2e-4,
        batch=batch_size,
        epochs=max(1, round(batches / (windows // batch_size))),
        patience=20,
        look_every=50,
        decay=0.1,
        decay_epochs=5 * NUM_COPIES,
    )


def library_plan(windows: int, *, batches: int, batch: int = 64) -> TrainingPlan:
    """Return the library's own training schedule, which needs fewer batches for the same accuracy on small sets.

    The learning rate is 1e-3, and 1e-4 in the last third of the training.
    """
    plan = paper_plan(windows, batches=batches, batch=batch)
    return replace(plan, rate=1e-3, decay_epochs=max(1, round(2 * plan.epochs / 3)))


def train_network(
    images: Float[np.ndarray, "N rows 41"],
    labels: Int[np.ndarray, " N"],
    validation_set: tuple[Float[np.ndarray, "n rows 41"], Int[np.ndarray, " n"]],
    *,
    classes: int,
    key: Array,
    plan: TrainingPlan,
    noise: float = NOISE_DEVIATION,
    checkpoint: str | Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> TrainingResult:
    """Train a network on images with the classes `labels`, until its loss on held-out images no longer decreases.

    `validation_set`: the held-out images and their classes; `plan`: training schedule, as returned by `library_plan`;
    `noise`: standard deviation of the noise added to images; `checkpoint` and `progress`: as for
    `jeit.touch.fit_network`. Raises the errors of that function. The same `key` gives identical results.
    """
    draw_key, training_key = jax.random.split(key)
    network = ModalityNetwork.draw(draw_key, images.shape[1], images.shape[2], classes)
    is_running_statistic = eqx.tree_at(
        lambda network_tree: (network_tree.mean, network_tree.variance),
        jax.tree.map(lambda _: True, network),
        ((False, False), (False, False)),
    )

    def training_loss(network: ModalityNetwork, batch: Any, key: Array):
        batch_images, batch_labels = batch
        class_log_odds, updated_network = network.log_odds_in_training(
            batch_images + noise * jax.random.normal(key, batch_images.shape, jnp.float32)
        )
        return _cross_entropy(class_log_odds, batch_labels).mean(), updated_network

    def validation_loss(network: ModalityNetwork, batch: Any):
        return _cross_entropy(network.log_odds(batch[0]), batch[1])

    training_arrays = (np.asarray(images, np.float32), np.asarray(labels, np.int32))
    validation_arrays = (np.asarray(validation_set[0], np.float32), np.asarray(validation_set[1], np.int32))
    return fit_network(
        network,
        TrainingObjective(training_loss, validation_loss, is_running_statistic),
        training_arrays,
        validation_arrays,
        plan,
        key=training_key,
        checkpoint=checkpoint,
        progress=progress,
    )


def _cross_entropy(class_log_odds: Float[Array, "b C"], class_labels: Int[Array, " b"]) -> Float[Array, " b"]:
    return -jnp.take_along_axis(jax.nn.log_softmax(class_log_odds), class_labels[:, None], axis=1)[:, 0]
