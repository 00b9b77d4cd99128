"""A small fully connected network, trained with equinox and optax, asked in NumPy, where a frame takes microseconds."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_WIDTH, _BATCH, _EPOCHS, _RATE, _DECAY = 64, 64, 150, 3e-3, 1e-2
# Of features' scale, added anew in every batch.
_NOISE = 0.1


@dataclass(frozen=True)
class Network:
    """Layers of weights (out, in) and biases (out,), hyperbolic tangents between them; `scale` (k,) of features."""

    weights: list[Float[np.ndarray, "o i"]]
    biases: list[Float[np.ndarray, " o"]]
    scale: Float[np.ndarray, " k"]

    def predict(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Targets (n, d)."""
        values = features / self.scale
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = values @ weight.T + bias
            values = np.tanh(values) if number + 1 < len(self.weights) else values
        return values

    @classmethod
    def train(cls, features, targets) -> "Network":
        """By Adam with decaying weights and steps, from batches with noise on their features."""
        import equinox as eqx
        import jax
        import jax.numpy as jnp
        import optax

        size = float(np.sqrt(np.mean(features**2))) or 1.0
        scale = np.full(features.shape[1], size)
        steps = _EPOCHS * max(1, -(-len(features) // _BATCH))
        rng = np.random.default_rng(0)
        order = np.concatenate([rng.permutation(len(features)) for _ in range(_EPOCHS)])
        keys = jax.random.split(jax.random.key(0))
        network = eqx.nn.MLP(
            features.shape[1], targets.shape[1], _WIDTH, 2, activation=jnp.tanh, dtype=jnp.float32, key=keys[0]
        )
        network = _trained(
            network,
            jnp.asarray(features / scale, jnp.float32),
            jnp.asarray(targets, jnp.float32),
            jnp.asarray(np.resize(order, (steps, _BATCH))),
            keys[1],
            optax.adamw(optax.cosine_decay_schedule(_RATE, steps), weight_decay=_DECAY),
        )
        layers = [(np.asarray(one.weight, float), np.asarray(one.bias, float)) for one in network.layers]
        return cls([weight for weight, _ in layers], [bias for _, bias in layers], scale)


def _trained(network, features, targets, batches, key, optimiser):
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    moving, still = eqx.partition(network, eqx.is_inexact_array)

    def loss(moving, index, key):
        given = features[index] + _NOISE * jax.random.normal(key, (len(index), features.shape[1]), features.dtype)
        return jnp.mean((jax.vmap(eqx.combine(moving, still))(given) - targets[index]) ** 2)

    def step(carry, index):
        moving, state, key = carry
        key, own = jax.random.split(key)
        updates, state = optimiser.update(jax.grad(loss)(moving, index, own), state, moving)
        return (eqx.apply_updates(moving, updates), state, key), None

    @jax.jit
    def run(moving, state, key, batches):
        return jax.lax.scan(step, (moving, state, key), batches)[0][0]

    return eqx.combine(run(moving, optimiser.init(moving), key, batches), still)
