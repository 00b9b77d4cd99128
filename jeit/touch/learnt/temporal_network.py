"""A small convolutional network that classifies touches from their course over time and features of the whole touch.

A few networks with different initial weights are trained at once with equinox and optax, and their probabilities are
averaged. They are evaluated in NumPy, which takes a fraction of a millisecond per touch.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

_HIDDEN, _DENSE, _WIDE = 24, 32, 5
_MEMBERS, _BATCH, _EPOCHS, _RATE, _DECAY = 2, 64, 45, 3e-3, 2e-2
# Standard deviation of the noise added to features in each batch, relative to their scale; amount of label smoothing;
# dropout rate of the values that enter the dense layer.
_NOISE, _SMOOTHED, _DROPPED = 0.15, 0.05, 0.2


@dataclass(frozen=True)
class TemporalNetwork:
    """An ensemble of s networks that classify touches from their course over time.

    Each row of the features (n, k) contains `whole` features of the whole touch, then c values for each of T time
    steps, step by step.

    **Fields**: `first` (s, h, 5 c) and `second` (s, h, 5 h): weights of the convolutions; `dense` (s, d, whole + 2 h)
    and `last` (s, C, d): weights of the fully connected layers; `..._bias`: the biases of each layer; `whole`: number
    of features of the whole touch; `classes_` (C,): the classes.
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
        """Compute the probabilities (n, C) of the classes, averaged over the networks."""
        course = features[:, self.whole :].reshape(len(features), -1, self.first.shape[2] // _WIDE)
        said = np.zeros((len(features), len(self.classes_)))
        for one in range(len(self.first)):
            hidden = _relu(_neighbouring_steps(course, np) @ self.first[one].T + self.first_bias[one])
            hidden = _relu(_neighbouring_steps(hidden, np) @ self.second[one].T + self.second_bias[one])
            pooled = np.concatenate([features[:, : self.whole], hidden.mean(axis=1), hidden.max(axis=1)], axis=1)
            dense = _relu(pooled @ self.dense[one].T + self.dense_bias[one])
            odds = dense @ self.last[one].T + self.last_bias[one]
            powers = np.exp(odds - odds.max(axis=1, keepdims=True))
            said += powers / powers.sum(axis=1, keepdims=True)
        return said / len(self.first)

    @classmethod
    def fit(
        cls, features: Float[np.ndarray, "n k"], label: np.ndarray, *, whole: int, values: int
    ) -> "TemporalNetwork":
        """Train networks on the classes `label` (n,) by AdamW, with noise added to the features of each batch.

        `whole`: number of features of the whole touch; `values`: number of values at each time step, c.
        """
        import jax
        import jax.numpy as jnp

        classes, number = np.unique(label, return_inverse=True)
        steps = _EPOCHS * max(1, -(-len(features) // _BATCH))
        rng = np.random.default_rng(0)
        order = np.concatenate([rng.permutation(len(features)) for _ in range(_EPOCHS)])
        # The number of rows is padded to a multiple of the batch size, so that folds of about the same size share the
        # compiled function; no batch uses the added rows.
        more = -len(features) % _BATCH
        trained = _compiled_training(steps, whole, values, len(classes))(
            jnp.asarray(np.pad(features, ((0, more), (0, 0))), jnp.float32),
            jnp.asarray(np.pad(number, (0, more))),
            jnp.asarray(np.resize(order, (steps, _BATCH))),
            jax.random.split(jax.random.key(0), _MEMBERS),
        )
        return cls(*(np.asarray(one, float) for one in trained), whole=whole, classes_=classes)


def _relu(values):
    return np.maximum(values, 0.0)


def _neighbouring_steps(course, engine):
    """Concatenate each time step with the two before and the two after it (n, T, 5 c); zeros beyond the ends."""
    half, length = _WIDE // 2, course.shape[-2]
    padded = engine.pad(course, ((0, 0), (half, half), (0, 0)))
    return engine.concatenate([padded[:, one : one + length] for one in range(_WIDE)], axis=-1)


@functools.cache
def _compiled_training(num_steps: int, whole: int, values: int, classes: int) -> Callable[..., Any]:
    """Return a function that trains networks in `num_steps` steps, compiled once for each shape.

    The function returns weights and biases, layer by layer, from features, indices of the classes, the rows of each
    batch, and a key for each network.
    """
    import jax
    import jax.numpy as jnp
    import optax

    optimiser = optax.adamw(optax.cosine_decay_schedule(_RATE, num_steps), weight_decay=_DECAY)
    sizes = [(_HIDDEN, _WIDE * values), (_HIDDEN, _WIDE * _HIDDEN), (_DENSE, whole + 2 * _HIDDEN), (classes, _DENSE)]

    def log_odds(weights, features, key):
        first, first_bias, second, second_bias, dense, dense_bias, last, last_bias = weights
        course = features[:, whole:].reshape(len(features), -1, values)
        hidden = jax.nn.relu(_neighbouring_steps(course, jnp) @ first.T + first_bias)
        hidden = jax.nn.relu(_neighbouring_steps(hidden, jnp) @ second.T + second_bias)
        pooled = jnp.concatenate([features[:, :whole], hidden.mean(axis=1), hidden.max(axis=1)], axis=1)
        pooled = pooled * jax.random.bernoulli(key, 1 - _DROPPED, pooled.shape) / (1 - _DROPPED)
        return jax.nn.relu(pooled @ dense.T + dense_bias) @ last.T + last_bias

    def loss(weights, features, number, key):
        for_noise, for_dropping = jax.random.split(key)
        noisy = features + _NOISE * jax.random.normal(for_noise, features.shape, features.dtype)
        wanted = (1 - _SMOOTHED) * jax.nn.one_hot(number, classes) + _SMOOTHED / classes
        return -jnp.mean(jnp.sum(wanted * jax.nn.log_softmax(log_odds(weights, noisy, for_dropping)), axis=1))

    def draw_weights(key):
        weights = []
        for own, size in zip(jax.random.split(key, len(sizes)), sizes, strict=True):
            weights += [jnp.sqrt(2 / size[1]) * jax.random.normal(own, size, jnp.float32)]
            weights += [jnp.zeros(size[0], jnp.float32)]
        return tuple(weights)

    @jax.jit
    def train(features, number, batches, keys):
        def update(carry, index):
            weights, state, key = carry
            key, own = jax.random.split(key)
            slope = jax.grad(loss)(weights, features[index], number[index], own)
            updates, state = optimiser.update(slope, state, weights)
            return (optax.apply_updates(weights, updates), state, key), None

        def train_one(key):
            for_start, for_steps = jax.random.split(key)
            weights = draw_weights(for_start)
            return jax.lax.scan(update, (weights, optimiser.init(weights), for_steps), batches)[0][0]

        return jax.vmap(train_one)(keys)

    return train
