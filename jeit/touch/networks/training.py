"""Train the two designs of image networks, on simulated touches."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.touch.networks.examples import Examples, Touches
from jeit.touch.networks.sensed import Sensed
from jeit.touch.networks.three_stages import DepthAutoencoder, ThreeStages, VoltageAutoencoder
from jeit.touch.networks.unrolled import Unrolled
from jeit.touch.training import MappedRows, Objective, Plan, Rows, Trained, fit

# Of the unrolled network: weights of the maps of its first steps, and of the misfit relative to the last map; the
# model's own error, relative to the changes; the greatest deviations of logarithms of contact impedances that drift;
# and the greatest multiple of the noise that it is trained with.
_EARLY, _MISFIT, _MODEL_ERROR, _DRIFT, _LOUDER = 0.3, 0.05, 0.1, 0.1, 6.0
# Scale of the squares of depths, so that losses are about one before training.
_SCALE = 0.002


class Learnt(NamedTuple):
    """A network that images, and the courses of its trainings by name."""

    network: ThreeStages | Unrolled
    courses: dict[str, Trained]


class Runs(NamedTuple):
    """Settings of consecutive trainings: their `plan`, `key`, the `folder` of their checkpoints, and `progress`, which
    is called with a description of the progress."""

    plan: Plan
    key: Array
    folder: Path | None = None
    progress: Callable[[str], None] | None = None

    def run(self, name: str, network, objective: Objective, training, validation) -> Trained:
        """Run one training, with a key of its own by its name."""
        key = jax.random.fold_in(self.key, int.from_bytes(name.encode()[:4], "little"))
        kept = None if self.folder is None else self.folder / f"{name}.training"
        report = self.progress
        said = None if report is None else (lambda text: report(f"{name}, {text}"))
        return fit(network, objective, training, validation, self.plan, key=key, checkpoint=kept, progress=said)


def train_three_stages(training: Touches, validation: Examples, noise: float, runs: Runs) -> Learnt:
    """Train the paper's design: an autoencoder of the changes, one of the maps, and a projection between them.

    Both autoencoders are fixed while the projection is trained. `noise`: standard deviation of relative changes.
    """
    shape = validation.depth.shape[1:]
    start = ThreeStages(validation.change.shape[1], shape, key=runs.key)
    mean, deviation = mean_and_deviation(training.rows("change"))
    noisy = np.hypot(deviation, noise)
    start = eqx.tree_at(
        lambda one: (one.mean, one.deviation),
        start,
        (jnp.asarray(mean, jnp.float32), jnp.asarray(noisy, jnp.float32)),
    )
    own = jnp.asarray(noise / noisy, jnp.float32)
    changes = MappedRows(training.rows("change"), start.standard, f"standardised under noise of {noise}")
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
            VoltageAutoencoder(validation.change.shape[1], key=voltages),
            Objective(denoised, lambda network, batch: jnp.mean((network(batch) - batch) ** 2, axis=1)),
            changes,
            start.standard(jnp.asarray(validation.change, jnp.float32)),
        ),
        "maps": runs.run(
            "maps",
            DepthAutoencoder(shape, key=depth),
            Objective(redrawn, lambda network, batch: jnp.mean((network(batch) - batch) ** 2, axis=(1, 2)) / _SCALE),
            training.rows("depth"),
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

    rows = training.rows("change", "depth"), _noisy(validation, noise)
    found["projection"] = runs.run("projection", start, Objective(projected, _map_errors, trained), *rows)
    return Learnt(found["projection"].network, found)


def train_unrolled(
    start: Unrolled, sensed: Sensed, training: Touches, validation: Examples, noise: float, runs: Runs
) -> Learnt:
    """Train the network `start`, which is of a skin already, on the error of its maps and of their voltages.

    The voltages are those of the skin's forward model for the maps, with `noise` and drifting contacts.
    """
    contacts = jnp.asarray(sensed.contacts, jnp.float32)

    def loss(network, batch, key):
        change, wanted = batch
        keys = jax.random.split(key, 4)
        # Squares of uniform shares: most are near the usual values.
        much, loud = (jax.random.uniform(one, (len(change), 1), change.dtype) ** 2 for one in keys[2:])
        drift = _DRIFT * much * jax.random.normal(keys[1], (len(change), len(contacts)), change.dtype)
        own = noise * _LOUDER**loud
        noisy = change + own * jax.random.normal(keys[0], change.shape, change.dtype) + drift @ contacts
        *early, last = network.each(noisy)
        value = jnp.mean((last - wanted) ** 2)
        for one in early:
            value = value + _EARLY * jnp.mean((one - wanted) ** 2)
        off = own[:, 0] ** 2 + _MODEL_ERROR**2 * jnp.mean(change**2, axis=1)
        missed = jnp.mean((network.predicted_changes(last) - change) ** 2, axis=1) / off
        # The logarithm of the misfit: otherwise touches on electrodes, which the model explains least, would dominate.
        return value / _SCALE + _MISFIT * jnp.mean(jnp.log1p(missed)), network

    rows = training.rows("change", "depth"), _noisy(validation, noise)
    found = runs.run("unrolled", start, Objective(loss, _map_errors, start.trained), *rows)
    return Learnt(found.network, {"unrolled": found})


def shuffled(examples: Examples, seed: int = 0) -> Examples:
    """The same changes and maps, in random pairs: only the distribution of maps can be learnt from them."""
    order = np.random.default_rng(seed).permutation(len(examples.change))
    return examples._replace(depth=examples.depth[order])


def _map_errors(network, batch):
    change, wanted = batch
    return jnp.mean((network(change) - wanted) ** 2, axis=(1, 2)) / _SCALE


def mean_and_deviation(rows: Rows) -> tuple[Float[np.ndarray, " M"], Float[np.ndarray, " M"]]:
    """Mean and deviation of each column of rows that are arrays (n, M), over all their chunks."""
    number, mean, squares = 0, np.zeros(()), np.zeros(())
    for chunk, size in enumerate(rows.sizes):
        own = np.asarray(rows.chunk(chunk), float)
        middle = own.mean(axis=0)
        # Squares about the mean of both parts together (Chan, Golub and LeVeque 1983).
        off, number = middle - mean, number + size
        squares = squares + ((own - middle) ** 2).sum(axis=0) + off**2 * (number - size) * size / number
        mean = mean + off * size / number
    return mean, np.sqrt(squares / number)


def _noisy(examples: Examples, noise: float) -> tuple[Float[np.ndarray, "n M"], Float[np.ndarray, "n r c"]]:
    """Changes with noise, and maps; the noise is fixed, so that held-out data are the same in every evaluation."""
    random = np.random.default_rng(0).normal(size=examples.change.shape)
    return np.asarray(examples.change + noise * random, np.float32), examples.depth
