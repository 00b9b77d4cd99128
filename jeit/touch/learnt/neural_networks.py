"""Two small neural networks, trained with equinox and optax, and evaluated in NumPy: `Network` is fully connected, and
`TemporalNetwork` is convolutional and classifies touches from time courses and from features of the whole touch.

Evaluating `Network` takes microseconds per frame. For `TemporalNetwork`, a few networks with different initial weights
are trained at once, and their probabilities are averaged. Evaluating them takes a fraction of a millisecond per touch.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

_BATCH_SIZE = 64
# Settings of `Network`, whose inputs are features of single frames.
_FRAME_HIDDEN_SIZE, _NUM_FRAME_EPOCHS = 64, 150
_FRAME_LEARNING_RATE, _FRAME_WEIGHT_DECAY = 3e-3, 1e-2
# Standard deviation of the noise added to features in each batch, relative to their scale.
_FRAME_FEATURE_NOISE = 0.1
# Settings of `TemporalNetwork`, whose inputs are time courses of features.
_COURSE_HIDDEN_SIZE, _DENSE_SIZE, _KERNEL_SIZE = 24, 32, 5
_NUM_NETWORKS, _NUM_COURSE_EPOCHS = 2, 45
_COURSE_LEARNING_RATE, _COURSE_WEIGHT_DECAY = 3e-3, 2e-2
# Standard deviation of the noise added to features in each batch, in the features' unit.
_COURSE_FEATURE_NOISE = 0.15
# Amount of label smoothing.
_LABEL_SMOOTHING = 0.05
# Dropout rate of the inputs of the dense layer.
_DROPOUT_RATE = 0.2


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
        activations = features / self.scale
        for layer_index, (layer_weights, layer_bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            activations = activations @ layer_weights.T + layer_bias
            activations = np.tanh(activations) if layer_index + 1 < len(self.weights) else activations
        return activations

    @classmethod
    def train(cls, features, targets) -> "Network":
        """Train a network by Adam with weight decay and a decreasing learning rate, with noise added to the features of
        each batch."""
        import jax
        import jax.numpy as jnp

        rms_feature = float(np.sqrt(np.mean(features**2))) or 1.0
        feature_scale = np.full(features.shape[1], rms_feature)
        batches = _draw_batches(len(features), _NUM_FRAME_EPOCHS)
        trained_layers = _compiled_frame_training(len(batches))(
            jnp.asarray(_pad_rows(features / feature_scale), jnp.float32),
            jnp.asarray(_pad_rows(targets), jnp.float32),
            jnp.asarray(batches),
            jax.random.split(jax.random.key(0)),
        )
        trained_layers = [
            (np.asarray(trained_layer.weight, float), np.asarray(trained_layer.bias, float))
            for trained_layer in trained_layers
        ]
        return cls(
            [layer_weights for layer_weights, _ in trained_layers],
            [layer_bias for _, layer_bias in trained_layers],
            feature_scale,
        )


@functools.cache
def _compiled_frame_training(num_steps: int) -> Callable[..., Any]:
    """Return a function that trains a network in `num_steps` steps of Adam, compiled once for each shape of its
    arguments.

    The arguments of the function are features, targets, the rows of each batch, and two random keys; the function
    returns the layers.
    """
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import optax

    adam_optimiser = optax.adamw(
        optax.cosine_decay_schedule(_FRAME_LEARNING_RATE, num_steps), weight_decay=_FRAME_WEIGHT_DECAY
    )

    @jax.jit
    def train(features, targets, batches, keys):
        layer_sizes = features.shape[1], targets.shape[1], _FRAME_HIDDEN_SIZE, 2
        network = eqx.nn.MLP(*layer_sizes, activation=jnp.tanh, dtype=jnp.float32, key=keys[0])
        network_parameters, static_fields = eqx.partition(network, eqx.is_inexact_array)

        def training_loss(network_parameters, batch_rows, key):
            noisy_features = features[batch_rows] + _FRAME_FEATURE_NOISE * jax.random.normal(
                key, (_BATCH_SIZE, features.shape[1]), features.dtype
            )
            return jnp.mean(
                (jax.vmap(eqx.combine(network_parameters, static_fields))(noisy_features) - targets[batch_rows]) ** 2
            )

        def update_step(training_state, batch_rows):
            network_parameters, optimiser_state, key = training_state
            key, step_key = jax.random.split(key)
            parameter_updates, optimiser_state = adam_optimiser.update(
                jax.grad(training_loss)(network_parameters, batch_rows, step_key), optimiser_state, network_parameters
            )
            return (eqx.apply_updates(network_parameters, parameter_updates), optimiser_state, key), None

        network_parameters = jax.lax.scan(
            update_step, (network_parameters, adam_optimiser.init(network_parameters), keys[1]), batches
        )[0][0]
        return network_parameters.layers

    return train


@dataclass(frozen=True)
class TemporalNetwork:
    """An ensemble of s convolutional networks that classify touches from time courses.

    Each row of the features (touches, features) contains `whole` features of the whole touch, then c values for each
    time step, in order of time.

    **Fields**: `first` (s, h, 5 c) and `second` (s, h, 5 h): weights of the two convolutions over five time steps with
    h outputs; `dense` (s, d, whole + 2 h) and `last` (s, classes, d): weights of the fully connected layers;
    `..._bias`: the biases of each layer; `whole`: number of features of the whole touch; `classes_`: the classes.
    """

    first: Float[np.ndarray, "s h i"]
    first_bias: Float[np.ndarray, "s h"]
    second: Float[np.ndarray, "s h j"]
    second_bias: Float[np.ndarray, "s h"]
    dense: Float[np.ndarray, "s d k"]
    dense_bias: Float[np.ndarray, "s d"]
    last: Float[np.ndarray, "s C d"]
    last_bias: Float[np.ndarray, "s C"]
    whole: int
    classes_: np.ndarray

    def predict_proba(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Compute the probabilities of the classes (touches, classes), averaged over the networks."""
        time_course = features[:, self.whole :].reshape(len(features), -1, self.first.shape[2] // _KERNEL_SIZE)
        summed_probabilities = np.zeros((len(features), len(self.classes_)))
        for network_index in range(len(self.first)):
            hidden_values = _relu(
                _concatenate_neighbouring_steps(time_course, np) @ self.first[network_index].T
                + self.first_bias[network_index]
            )
            hidden_values = _relu(
                _concatenate_neighbouring_steps(hidden_values, np) @ self.second[network_index].T
                + self.second_bias[network_index]
            )
            pooled_features = np.concatenate(
                [features[:, : self.whole], hidden_values.mean(axis=1), hidden_values.max(axis=1)], axis=1
            )
            dense_values = _relu(pooled_features @ self.dense[network_index].T + self.dense_bias[network_index])
            class_log_odds = dense_values @ self.last[network_index].T + self.last_bias[network_index]
            exponential_odds = np.exp(class_log_odds - class_log_odds.max(axis=1, keepdims=True))
            summed_probabilities += exponential_odds / exponential_odds.sum(axis=1, keepdims=True)
        return summed_probabilities / len(self.first)

    @classmethod
    def fit(
        cls, features: Float[np.ndarray, "n k"], label: np.ndarray, *, whole: int, values: int
    ) -> "TemporalNetwork":
        """Train networks by AdamW to predict the `label` of touches, with noise added to the features of each batch.

        `whole`: number of features of the whole touch; `values`: number of values at each time step.
        """
        import jax
        import jax.numpy as jnp

        classes, class_indices = np.unique(label, return_inverse=True)
        batches = _draw_batches(len(features), _NUM_COURSE_EPOCHS)
        network_parameters = _compiled_course_training(len(batches), whole, values, len(classes))(
            jnp.asarray(_pad_rows(features), jnp.float32),
            jnp.asarray(_pad_rows(class_indices)),
            jnp.asarray(batches),
            jax.random.split(jax.random.key(0), _NUM_NETWORKS),
        )
        return cls(
            *(np.asarray(network_parameter, float) for network_parameter in network_parameters),
            whole=whole,
            classes_=classes,
        )


def _relu(activations):
    return np.maximum(activations, 0.0)


def _concatenate_neighbouring_steps(time_course, array_module):
    """Concatenate the values at each time step with those at the two steps before and after; zeros beyond the ends."""
    half_width, num_steps = _KERNEL_SIZE // 2, time_course.shape[-2]
    padded_course = array_module.pad(time_course, ((0, 0), (half_width, half_width), (0, 0)))
    return array_module.concatenate(
        [padded_course[:, first_step : first_step + num_steps] for first_step in range(_KERNEL_SIZE)], axis=-1
    )


@functools.cache
def _compiled_course_training(
    num_steps: int, num_whole_features: int, num_values: int, num_classes: int
) -> Callable[..., Any]:
    """Return a function that trains networks in `num_steps` steps of AdamW, compiled once for each shape of its
    arguments.

    The arguments of the function are features, class indices, the rows of each batch, and a random key for each
    network; the function returns the weights and biases, layer by layer.
    """
    import jax
    import jax.numpy as jnp
    import optax

    adam_optimiser = optax.adamw(
        optax.cosine_decay_schedule(_COURSE_LEARNING_RATE, num_steps), weight_decay=_COURSE_WEIGHT_DECAY
    )
    weight_shapes = [
        (_COURSE_HIDDEN_SIZE, _KERNEL_SIZE * num_values),
        (_COURSE_HIDDEN_SIZE, _KERNEL_SIZE * _COURSE_HIDDEN_SIZE),
        (_DENSE_SIZE, num_whole_features + 2 * _COURSE_HIDDEN_SIZE),
        (num_classes, _DENSE_SIZE),
    ]

    def class_log_odds(weights, features, key):
        first_weights, first_bias, second_weights, second_bias, dense, dense_bias, last_weights, last_bias = weights
        time_course = features[:, num_whole_features:].reshape(len(features), -1, num_values)
        hidden_values = jax.nn.relu(_concatenate_neighbouring_steps(time_course, jnp) @ first_weights.T + first_bias)
        hidden_values = jax.nn.relu(
            _concatenate_neighbouring_steps(hidden_values, jnp) @ second_weights.T + second_bias
        )
        pooled_features = jnp.concatenate(
            [features[:, :num_whole_features], hidden_values.mean(axis=1), hidden_values.max(axis=1)], axis=1
        )
        pooled_features = (
            pooled_features * jax.random.bernoulli(key, 1 - _DROPOUT_RATE, pooled_features.shape) / (1 - _DROPOUT_RATE)
        )
        return jax.nn.relu(pooled_features @ dense.T + dense_bias) @ last_weights.T + last_bias

    def training_loss(weights, features, class_indices, key):
        noise_key, dropout_key = jax.random.split(key)
        noisy_features = features + _COURSE_FEATURE_NOISE * jax.random.normal(noise_key, features.shape, features.dtype)
        target_probabilities = (1 - _LABEL_SMOOTHING) * jax.nn.one_hot(
            class_indices, num_classes
        ) + _LABEL_SMOOTHING / num_classes
        return -jnp.mean(
            jnp.sum(
                target_probabilities * jax.nn.log_softmax(class_log_odds(weights, noisy_features, dropout_key)), axis=1
            )
        )

    def draw_weights(key):
        weights = []
        for layer_key, weight_shape in zip(jax.random.split(key, len(weight_shapes)), weight_shapes, strict=True):
            weights += [jnp.sqrt(2 / weight_shape[1]) * jax.random.normal(layer_key, weight_shape, jnp.float32)]
            weights += [jnp.zeros(weight_shape[0], jnp.float32)]
        return tuple(weights)

    @jax.jit
    def train(features, class_indices, batches, keys):
        def update_step(training_state, batch_rows):
            weights, optimiser_state, key = training_state
            key, step_key = jax.random.split(key)
            loss_gradients = jax.grad(training_loss)(weights, features[batch_rows], class_indices[batch_rows], step_key)
            weight_updates, optimiser_state = adam_optimiser.update(loss_gradients, optimiser_state, weights)
            return (optax.apply_updates(weights, weight_updates), optimiser_state, key), None

        def train_network(key):
            init_key, training_key = jax.random.split(key)
            weights = draw_weights(init_key)
            return jax.lax.scan(update_step, (weights, adam_optimiser.init(weights), training_key), batches)[0][0]

        return jax.vmap(train_network)(keys)

    return train


def _draw_batches(num_rows: int, num_epochs: int) -> Int[np.ndarray, "T b"]:
    """Return the rows of each batch (steps, rows in a batch), in a random order in each of `num_epochs` epochs."""
    num_steps = num_epochs * max(1, -(-num_rows // _BATCH_SIZE))
    rng = np.random.default_rng(0)
    row_order = np.concatenate([rng.permutation(num_rows) for _ in range(num_epochs)])
    return np.resize(row_order, (num_steps, _BATCH_SIZE))


def _pad_rows(values: np.ndarray) -> np.ndarray:
    """Pad the rows of `values` (n, …) with zeros to a multiple of the batch size, so that cross-validation folds of
    about the same size share the compiled function; no batch uses the added rows."""
    return np.pad(values, [(0, -len(values) % _BATCH_SIZE), *[(0, 0)] * (values.ndim - 1)])
