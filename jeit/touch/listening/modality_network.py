"""The network of Park et al. (2022) that classifies touch by its sound: trained with equinox and optax, run in NumPy.

The network has two layers, each a convolution without padding, batch normalisation, rectification and max-pooling:
5 × 5 to 32 channels, then 3 × 3 to 64. A dense layer and softmax follow. Training uses Adam with a rate of 2e-4,
divided by ten after every five epochs, and batches of 64; the held-out loss is evaluated every 50 batches, and training
ends after 20 evaluations without a decrease. This library's own choices are the size of the second convolution and of
the pools, 3 × 3 and 2 × 2, and the noise added to images.
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

# For the two layers: sizes of kernels and of pools, in pixels, and numbers of channels.
_KERNELS, _POOLS, _CHANNELS = (5, 3), (3, 2), (32, 64)
# Weight of a batch's mean and variance in the running ones; constant added to variances.
_RUNNING_WEIGHT, _VARIANCE_FLOOR = 0.05, 1e-5
NOISE, COPIES = 0.2, 5
"""Standard deviation of the normal noise added to images, whose own standard deviation is 1; number of noisy copies of
each image in an epoch, as in the paper."""
# Number of windows evaluated at once.
_AT_ONCE = 32


class ModalityNetwork(Module):
    """Weights of the network, in single precision.

    `first` (5, 5, 1, 32) and `second` (3, 3, 32, 64): kernels of the two convolutions; `gain`, `shift`, running `mean`
    and `variance`: batch normalisation after the first and the second; `dense` (n, C) and `bias` (C,): the last layer.
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
        for size, pool in zip(_KERNELS, _POOLS, strict=True):
            rows, columns = ((side - size + 1) // pool for side in (rows, columns))
        keys = jax.random.split(key, 3)
        one, two = _KERNELS
        shapes = (one, one, 1, _CHANNELS[0]), (two, two, *_CHANNELS), (rows * columns * _CHANNELS[1], classes)
        first, second, dense = (
            jax.random.normal(one, shape, jnp.float32) * jnp.float32(np.sqrt(2 / np.prod(shape[:-1])))
            for one, shape in zip(keys, shapes, strict=True)
        )
        few, many = _CHANNELS
        ones, zeros = ((jnp.full(few, own, jnp.float32), jnp.full(many, own, jnp.float32)) for own in (1.0, 0.0))
        dense, bias = 0.1 * dense, jnp.zeros(classes, jnp.float32)
        return cls(first, second, ones, zeros, zeros, ones, dense, bias)

    def log_odds(self, images: Float[Array, "b rows columns"]) -> Float[Array, "b C"]:
        """Compute the log-odds (b, C) of the classes, normalised by the running means and variances."""
        return self._forward(images, self.mean, self.variance)[0]

    def log_odds_in_training(
        self, images: Float[Array, "b rows columns"]
    ) -> tuple[Float[Array, "b C"], "ModalityNetwork"]:
        """Compute the log-odds (b, C) of the classes, normalised by the batch's own means and variances.

        Also returns the network with updated running means and variances.
        """
        said, means, variances = self._forward(images, None, None)
        kept = jax.tree.map(
            lambda old, new: (1 - _RUNNING_WEIGHT) * old + _RUNNING_WEIGHT * jax.lax.stop_gradient(new),
            (self.mean, self.variance),
            (means, variances),
        )
        return said, eqx.tree_at(lambda one: (one.mean, one.variance), self, kept)

    def _forward(self, images, mean, variance):
        values, means, variances = images[..., None], [], []
        for layer, kernel in enumerate((self.first, self.second)):
            values = jax.lax.conv_general_dilated(
                values, kernel, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
            if mean is None:
                middle = values.mean((0, 1, 2))
                own = middle, (values**2).mean((0, 1, 2)) - middle**2
            else:
                own = mean[layer], variance[layer]
            means.append(own[0])
            variances.append(own[1])
            factor = self.gain[layer] / jnp.sqrt(own[1] + _VARIANCE_FLOOR)
            values = values * factor + (self.shift[layer] - own[0] * factor)
            values = _max_pool(jnp.maximum(values, 0), _POOLS[layer], jnp)
        return values.reshape(len(images), -1) @ self.dense + self.bias, tuple(means), tuple(variances)


def _max_pool(values, pool_size: int, namespace):
    """Maximum of every `pool_size` × `pool_size` block (b, h, w, c); rows and columns that do not fill a block are left
    out."""
    height, width = (side // pool_size * pool_size for side in values.shape[1:3])
    values = values[:, :height, :width]
    taller = reduce(namespace.maximum, [values[:, row::pool_size] for row in range(pool_size)])
    return reduce(namespace.maximum, [taller[:, :, column::pool_size] for column in range(pool_size)])


class NetworkAnswers:
    """A trained network that is evaluated in NumPy: a few milliseconds for one window, without compilation."""

    def __init__(self, network: ModalityNetwork):
        whole = jax.tree.map(np.asarray, network)
        # The normalisation is a factor and an offset for each channel; the factor is merged into the kernels.
        factors = [gain / np.sqrt(own + _VARIANCE_FLOOR) for gain, own in zip(whole.gain, whole.variance, strict=True)]
        self.kernels = [
            np.ascontiguousarray((kernel * factor).transpose(2, 0, 1, 3).reshape(-1, kernel.shape[-1]))
            for kernel, factor in zip((whole.first, whole.second), factors, strict=True)
        ]
        self.offsets = [
            shift - factor * mean for shift, factor, mean in zip(whole.shift, factors, whole.mean, strict=True)
        ]
        self.dense, self.bias = whole.dense, whole.bias

    def log_odds(self, images: Float[np.ndarray, "W rows columns"]) -> Float[np.ndarray, "W C"]:
        """Compute the log-odds (W, C) of the classes."""
        parts = [self._evaluate_block(images[first : first + _AT_ONCE]) for first in range(0, len(images), _AT_ONCE)]
        return np.concatenate([np.zeros((0, len(self.bias)), np.float32), *parts]).astype(float)

    def _evaluate_block(self, images: np.ndarray) -> np.ndarray:
        values = images[..., None]
        for kernel, offset, size, pool in zip(self.kernels, self.offsets, _KERNELS, _POOLS, strict=True):
            patches = sliding_window_view(values, (size, size), axis=(1, 2))
            values = patches.reshape(*patches.shape[:3], -1) @ kernel
            values += offset
            values = _max_pool(np.maximum(values, 0, out=values), pool, np)
        return values.reshape(len(images), -1) @ self.dense + self.bias


def paper_plan(windows: int, *, batches: int, batch: int = 64) -> TrainingPlan:
    """Training schedule of the paper for a training set of `windows` windows.

    Training has at most `batches`, but at least one pass through the windows. Noise is drawn anew in every batch, so
    that no image is repeated; `COPIES` passes through the windows correspond to one epoch of noisy copies.
    """
    least = min(batch, windows)
    return TrainingPlan(
        rate=2e-4,
        batch=least,
        epochs=max(1, round(batches / (windows // least))),
        patience=20,
        look_every=50,
        decay=0.1,
        decay_epochs=5 * COPIES,
    )


def library_plan(windows: int, *, batches: int, batch: int = 64) -> TrainingPlan:
    """Training schedule of this library, which needs fewer batches for the same accuracy on small sets.

    The rate is 1e-3, and a tenth of it in the last third of the training.
    """
    plan = paper_plan(windows, batches=batches, batch=batch)
    return replace(plan, rate=1e-3, decay_epochs=max(1, round(2 * plan.epochs / 3)))


def train_network(
    images: Float[np.ndarray, "N rows 41"],
    right: Int[np.ndarray, " N"],
    held: tuple[Float[np.ndarray, "n rows 41"], Int[np.ndarray, " n"]],
    *,
    classes: int,
    key: Array,
    plan: TrainingPlan,
    noise: float = NOISE,
    checkpoint: str | Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> TrainingResult:
    """Train a network on images of the classes `right`, until its loss on held-out images no longer decreases.

    `held`: the held-out images and their classes; `plan`: as from `library_plan`; `noise`: standard deviation of the
    noise added to images; `checkpoint` and `progress` as in `jeit.touch.fit_network`, whose errors are raised. The
    same `key` gives identical results.
    """
    drawn, trained = jax.random.split(key)
    network = ModalityNetwork.draw(drawn, images.shape[1], images.shape[2], classes)
    moving = eqx.tree_at(
        lambda one: (one.mean, one.variance), jax.tree.map(lambda _: True, network), ((False, False), (False, False))
    )

    def loss(network: ModalityNetwork, batch: Any, key: Array):
        shown, label = batch
        said, after = network.log_odds_in_training(shown + noise * jax.random.normal(key, shown.shape, jnp.float32))
        return _cross_entropy(said, label).mean(), after

    def held_out(network: ModalityNetwork, batch: Any):
        return _cross_entropy(network.log_odds(batch[0]), batch[1])

    data = (np.asarray(images, np.float32), np.asarray(right, np.int32))
    validation = (np.asarray(held[0], np.float32), np.asarray(held[1], np.int32))
    return fit_network(
        network,
        TrainingObjective(loss, held_out, moving),
        data,
        validation,
        plan,
        key=trained,
        checkpoint=checkpoint,
        progress=progress,
    )


def _cross_entropy(log_odds: Float[Array, "b C"], label: Int[Array, " b"]) -> Float[Array, " b"]:
    return -jnp.take_along_axis(jax.nn.log_softmax(log_odds), label[:, None], axis=1)[:, 0]
