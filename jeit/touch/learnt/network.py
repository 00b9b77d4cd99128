"""A small fully connected neural network, trained with equinox and optax, and evaluated in NumPy in microseconds per
frame."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

_HIDDEN_SIZE, _BATCH_SIZE, _NUM_EPOCHS, _LEARNING_RATE, _WEIGHT_DECAY = 64, 64, 150, 3e-3, 1e-2
# Standard deviation of the noise added to features in each batch, relative to their scale.
_FEATURE_NOISE = 0.1


@dataclass(frozen=True)
class Network:
    """A fully connected neural network with tanh between layers.

    `weights` (outputs, inputs) and `biases` (outputs,) of each layer; `scale`: number by which each feature is divided
    before the first layer.
    """

    weights: list[Float[np.ndarray, "o i"]]
    biases: list[Float[np.ndarray, " o"]]
    scale: Float[np.ndarray, " k"]

    def predict(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Predict targets (frames, targets) from features (frames, features)."""
        values = features / self.scale
        for layer_index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = values @ weight.T + bias
            values = np.tanh(values) if layer_index + 1 < len(self.weights) else values
        return values

    @classmethod
    def train(cls, features, targets) -> "Network":
        """Train a network by Adam with weight decay and a decreasing learning rate, with noise added to the features of
        each batch."""
        import jax
        import jax.numpy as jnp

        size = float(np.sqrt(np.mean(features**2))) or 1.0
        scale = np.full(features.shape[1], size)
        num_steps = _NUM_EPOCHS * max(1, -(-len(features) // _BATCH_SIZE))
        rng = np.random.default_rng(0)
        order = np.concatenate([rng.permutation(len(features)) for _ in range(_NUM_EPOCHS)])
        # The number of presses is padded to a multiple of the batch size, so that cross-validation folds of about the
        # same size share the compiled function; no batch uses the added rows.
        row_padding = ((0, -len(features) % _BATCH_SIZE), (0, 0))
        layers = _compiled_training(num_steps)(
            jnp.asarray(np.pad(features / scale, row_padding), jnp.float32),
            jnp.asarray(np.pad(targets, row_padding), jnp.float32),
            jnp.asarray(np.resize(order, (num_steps, _BATCH_SIZE))),
            jax.random.split(jax.random.key(0)),
        )
        layers = [(np.asarray(layer.weight, float), np.asarray(layer.bias, float)) for layer in layers]
        return cls([weight for weight, _ in layers], [bias for _, bias in layers], scale)


@functools.cache
def _compiled_training(num_steps: int) -> Callable[..., Any]:
    """Return a function that trains a network in `num_steps` steps of Adam, compiled once for each shape of its
    arguments.

    The arguments of the function are features, targets, the rows of each batch, and two random keys; the function
    returns the layers.
    """
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import optax

    optimiser = optax.adamw(optax.cosine_decay_schedule(_LEARNING_RATE, num_steps), weight_decay=_WEIGHT_DECAY)

    @jax.jit
    def train(features, targets, batches, keys):
        sizes = features.shape[1], targets.shape[1], _HIDDEN_SIZE, 2
        network = eqx.nn.MLP(*sizes, activation=jnp.tanh, dtype=jnp.float32, key=keys[0])
        parameters, static_part = eqx.partition(network, eqx.is_inexact_array)

        def loss(parameters, index, key):
            noisy_features = features[index] + _FEATURE_NOISE * jax.random.normal(
                key, (_BATCH_SIZE, features.shape[1]), features.dtype
            )
            return jnp.mean((jax.vmap(eqx.combine(parameters, static_part))(noisy_features) - targets[index]) ** 2)

        def update(carry, index):
            parameters, state, key = carry
            key, step_key = jax.random.split(key)
            updates, state = optimiser.update(jax.grad(loss)(parameters, index, step_key), state, parameters)
            return (eqx.apply_updates(parameters, updates), state, key), None

        parameters = jax.lax.scan(update, (parameters, optimiser.init(parameters), keys[1]), batches)[0][0]
        return parameters.layers

    return train
