"""How the two designs are trained, on touches simulated."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.touch.networks.sensed import Sensed
from jeit.touch.networks.three_stages import DepthAutoencoder, ThreeStages, VoltageAutoencoder
from jeit.touch.networks.unrolled import Unrolled
from jeit.touch.training import Objective, Plan, Trained, fit

# Of the unrolled network: how much the maps of its first steps count, and the misfit beside the last map; the model's
# own error, relative to the changes; deviations of logarithms of contact impedances that drift, at most; and how many
# times the noise it is to stand, at most.
_EARLY, _MISFIT, _MODEL_ERROR, _DRIFT, _LOUDER = 0.3, 0.05, 0.1, 0.1, 6.0
# Squares of depths, so that losses are about one before training.
_SCALE = 0.002


class Examples(NamedTuple):
    """Touches: relative changes (n, M) without noise, and depth maps (n, rows, columns) over the thickness."""

    change: Float[np.ndarray, "n M"]
    depth: Float[np.ndarray, "n r c"]


class Learnt(NamedTuple):
    """A network that images, and the courses of its trainings by name."""

    network: ThreeStages | Unrolled
    courses: dict[str, Trained]


class Runs(NamedTuple):
    """Trainings, one after the other: their `plan`, `key`, the `folder` of their checkpoints, and who is told."""

    plan: Plan
    key: Array
    folder: Path | None = None
    progress: Callable[[str], None] | None = None

    def run(self, name: str, network, objective: Objective, training, validation) -> Trained:
        """One, its key its own by its name."""
        key = jax.random.fold_in(self.key, int.from_bytes(name.encode()[:4], "little"))
        kept = None if self.folder is None else self.folder / f"{name}.training"
        tell = self.progress
        said = None if tell is None else (lambda text: tell(f"{name}, {text}"))
        return fit(network, objective, training, validation, self.plan, key=key, checkpoint=kept, progress=said)


def train_three_stages(training: Examples, validation: Examples, noise: float, runs: Runs) -> Learnt:
    """The paper's: an autoencoder of the changes, one of the maps, and what leads from the one to the other while both
    stay. `noise`: deviation of relative changes."""
    shape = training.depth.shape[1:]
    start = ThreeStages(training.change.shape[1], shape, key=runs.key)
    noisy = np.hypot(training.change.std(axis=0), noise)
    start = eqx.tree_at(
        lambda one: (one.mean, one.deviation),
        start,
        (jnp.asarray(training.change.mean(axis=0), jnp.float32), jnp.asarray(noisy, jnp.float32)),
    )
    own = jnp.asarray(noise / noisy, jnp.float32)
    changes = [np.asarray(start.standard(jnp.asarray(one.change, jnp.float32))) for one in (training, validation)]
    voltages, depth = (jax.random.fold_in(runs.key, one) for one in (1, 2))

    def denoised(network, batch, key):
        first, second = jax.random.split(key)
        noisy = batch + own * jax.random.normal(first, batch.shape, batch.dtype)
        return jnp.mean((network(noisy, second) - batch) ** 2), network

    def redrawn(network, batch, key):
        return jnp.mean((network(batch, key) - batch) ** 2) / _SCALE, network

    found = {
        "voltages": runs.run(
            "voltages",
            VoltageAutoencoder(changes[0].shape[1], key=voltages),
            Objective(denoised, lambda network, batch: jnp.mean((network(batch) - batch) ** 2, axis=1)),
            *changes,
        ),
        "maps": runs.run(
            "maps",
            DepthAutoencoder(shape, key=depth),
            Objective(redrawn, lambda network, batch: jnp.mean((network(batch) - batch) ** 2, axis=(1, 2)) / _SCALE),
            training.depth,
            validation.depth,
        ),
    }
    ends = (found["voltages"].network.encoder, found["maps"].network.decoder)
    start = eqx.tree_at(lambda one: (one.encoder, one.decoder), start, ends)
    trained = eqx.tree_at(
        lambda one: one.projection,
        jax.tree.map(lambda _: False, start),
        jax.tree.map(eqx.is_inexact_array, start.projection),
    )

    def projected(network, batch, key):
        change, wanted = batch
        noisy = change + noise * jax.random.normal(key, change.shape, change.dtype)
        return jnp.mean((network(noisy) - wanted) ** 2) / _SCALE, network

    rows = [(np.asarray(one.change, np.float32), one.depth) for one in (training, _noisy(validation, noise))]
    found["projection"] = runs.run("projection", start, Objective(projected, _map_errors, trained), *rows)
    return Learnt(found["projection"].network, found)


def train_unrolled(
    start: Unrolled, sensed: Sensed, training: Examples, validation: Examples, noise: float, runs: Runs
) -> Learnt:
    """The network `start`, of a skin already: its maps are to be right, and so are the voltages that the skin's model
    gives them, under `noise` and contacts that drift."""
    contacts = jnp.asarray(sensed.contacts, jnp.float32)

    def loss(network, batch, key):
        change, wanted = batch
        keys = jax.random.split(key, 4)
        # Most are near what is usual: squares of uniform shares.
        much, loud = (jax.random.uniform(one, (len(change), 1), change.dtype) ** 2 for one in keys[2:])
        drift = _DRIFT * much * jax.random.normal(keys[1], (len(change), len(contacts)), change.dtype)
        own = noise * _LOUDER**loud
        noisy = change + own * jax.random.normal(keys[0], change.shape, change.dtype) + drift @ contacts
        *early, last = network.each(noisy)
        value = jnp.mean((last - wanted) ** 2)
        for one in early:
            value = value + _EARLY * jnp.mean((one - wanted) ** 2)
        off = own[:, 0] ** 2 + _MODEL_ERROR**2 * jnp.mean(change**2, axis=1)
        missed = jnp.mean((network.felt(last) - change) ** 2, axis=1) / off
        # Its logarithm: touches on electrodes, which the model explains least, would count for more than all others.
        return value / _SCALE + _MISFIT * jnp.mean(jnp.log1p(missed)), network

    rows = [(np.asarray(one.change, np.float32), one.depth) for one in (training, _noisy(validation, noise))]
    found = runs.run("unrolled", start, Objective(loss, _map_errors, start.trained), *rows)
    return Learnt(found.network, {"unrolled": found})


def shuffled(examples: Examples, seed: int = 0) -> Examples:
    """The same changes and maps, each with another's: nothing can be learnt of them but what maps are like."""
    order = np.random.default_rng(seed).permutation(len(examples.change))
    return examples._replace(depth=examples.depth[order])


def _map_errors(network, batch):
    change, wanted = batch
    return jnp.mean((network(change) - wanted) ** 2, axis=(1, 2)) / _SCALE


def _noisy(examples: Examples, noise: float) -> Examples:
    """With noise that stays: what is held out is the same at every look."""
    random = np.random.default_rng(0).normal(size=examples.change.shape)
    return examples._replace(change=examples.change + noise * random)
