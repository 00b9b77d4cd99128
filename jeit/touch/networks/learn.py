"""Learn a network that images touches: simulate touches, train the network, and evaluate the network."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_kind, check_name, describe
from jeit.arguments.extras import require_extra
from jeit.design import Skin, touches_away_from_the_edge
from jeit.design.study.store import DifferentContentsError
from jeit.layout import Layout
from jeit.touch.networks.image_network import NETWORK_DESIGNS, NETWORK_FILE, ImageNetwork, write_network
from jeit.touch.networks.linear_channels import (
    LinearChannels,
    depth_centroids,
    detection_noise,
    error_statistics,
    touch_draws,
)
from jeit.touch.networks.simulated_touches import SimulatedTouches, StoredTouches, TouchExamples
from jeit.touch.networks.three_stage_network import DepthAutoencoder, ThreeStages, VoltageAutoencoder
from jeit.touch.networks.unrolled_network import Unrolled
from jeit.touch.simulate import Indent, IndentSet, ball_indenter, relative_changes, simulate_presses
from jeit.touch.simulate.contact.indent_sets import image_places
from jeit.touch.training import (
    MappedRows,
    Rows,
    TrainingObjective,
    TrainingPlan,
    TrainingResult,
    fit_network,
)

# Training of the unrolled network. Weights of the maps of the other steps and of the voltage misfit in the loss,
# relative to the weight of the last step's map. Model error, relative to the voltage changes; maximum standard
# deviation of the drift of log contact impedances; maximum noise, as a multiple of the given noise.
_EARLIER_MAP_LOSS_WEIGHT, _VOLTAGE_MISFIT_LOSS_WEIGHT, _RELATIVE_MODEL_ERROR, _MAX_CONTACT_DRIFT, _MAX_NOISE_FACTOR = (
    0.3,
    0.05,
    0.1,
    0.1,
    6.0,
)
# Squared depths are divided by this scale, so that losses are about one before training.
_LOSS_SCALE = 0.002


class TrainedNetwork(NamedTuple):
    """A trained neural network and the results of its trainings.

    **Fields**: `network`: the network; `courses`: results of its trainings, with the histories of losses, by name.
    """

    network: ThreeStages | Unrolled
    courses: dict[str, TrainingResult]


class TrainingRuns(NamedTuple):
    """Settings of consecutive trainings of a network's parts.

    **Fields**: `plan`: settings of every training; `key`: random key; `folder`: folder of the checkpoints, or None;
    `progress`: function that is called with a description of the progress, or None.
    """

    plan: TrainingPlan
    key: Array
    folder: Path | None = None
    progress: Callable[[str], None] | None = None

    def run(self, name: str, network, objective: TrainingObjective, training, validation) -> TrainingResult:
        """Run one training, with a random key that depends on the training's name."""
        key = jax.random.fold_in(self.key, int.from_bytes(name.encode()[:4], "little"))
        checkpoint = None if self.folder is None else self.folder / f"{name}.training"
        report = self.progress
        report_step = None if report is None else (lambda message: report(f"{name}, {message}"))
        return fit_network(
            network, objective, training, validation, self.plan, key=key, checkpoint=checkpoint, progress=report_step
        )


def train_three_stages(
    training: SimulatedTouches, validation: TouchExamples, noise: float, runs: TrainingRuns
) -> TrainedNetwork:
    """Train the design of Park et al. 2022: autoencoders of voltage changes and of depth maps, and a projection between
    their codes.

    Both autoencoders are fixed while the projection is trained. `noise`: standard deviation of the noise of relative
    voltage changes.
    """
    map_shape = validation.depth.shape[1:]
    initial_network = ThreeStages(validation.change.shape[1], map_shape, key=runs.key)
    mean_change, change_deviation = mean_and_deviation(training.rows("change"))
    noisy_deviation = np.hypot(change_deviation, noise)
    initial_network = eqx.tree_at(
        lambda network: (network.mean, network.deviation),
        initial_network,
        (jnp.asarray(mean_change, jnp.float32), jnp.asarray(noisy_deviation, jnp.float32)),
    )
    noise_scale = jnp.asarray(noise / noisy_deviation, jnp.float32)
    scaled_changes = MappedRows(
        training.rows("change"), initial_network.standardise, f"standardised under noise of {noise}"
    )
    voltage_key, depth_key = (jax.random.fold_in(runs.key, key_number) for key_number in (1, 2))

    def denoising_loss(network, batch, key):
        noise_key, dropout_key = jax.random.split(key)
        noisy_batch = batch + noise_scale * jax.random.normal(noise_key, batch.shape, batch.dtype)
        return jnp.mean((network(noisy_batch, dropout_key) - batch) ** 2), network

    def map_loss(network, batch, key):
        return jnp.mean((network(batch, key) - batch) ** 2) / _LOSS_SCALE, network

    training_results = {
        "voltages": runs.run(
            "voltages",
            VoltageAutoencoder(validation.change.shape[1], key=voltage_key),
            TrainingObjective(denoising_loss, lambda network, batch: jnp.mean((network(batch) - batch) ** 2, axis=1)),
            scaled_changes,
            initial_network.standardise(jnp.asarray(validation.change, jnp.float32)),
        ),
        "maps": runs.run(
            "maps",
            DepthAutoencoder(map_shape, key=depth_key),
            TrainingObjective(
                map_loss, lambda network, batch: jnp.mean((network(batch) - batch) ** 2, axis=(1, 2)) / _LOSS_SCALE
            ),
            training.rows("depth"),
            validation.depth,
        ),
    }
    trained_parts = (training_results["voltages"].network.encoder, training_results["maps"].network.decoder)
    initial_network = eqx.tree_at(lambda network: (network.encoder, network.decoder), initial_network, trained_parts)
    is_trained_weight = eqx.tree_at(
        lambda network: network.projection,
        jax.tree.map(lambda _: False, initial_network),
        jax.tree.map(eqx.is_inexact_array, initial_network.projection),
    )

    def projection_loss(network, batch, key):
        change, true_maps = batch
        noisy_change = change + noise * jax.random.normal(key, change.shape, change.dtype)
        return jnp.mean((network(noisy_change) - true_maps) ** 2) / _LOSS_SCALE, network

    datasets = training.rows("change", "depth"), _add_noise(validation, noise)
    training_results["projection"] = runs.run(
        "projection", initial_network, TrainingObjective(projection_loss, _map_errors, is_trained_weight), *datasets
    )
    return TrainedNetwork(training_results["projection"].network, training_results)


def train_unrolled(
    untrained: Unrolled,
    channels: LinearChannels,
    training: SimulatedTouches,
    validation: TouchExamples,
    noise: float,
    runs: TrainingRuns,
) -> TrainedNetwork:
    """Train an unrolled network, already adapted to a skin, to minimise errors of its depth maps and of their voltages.

    The voltages of maps are computed by the skin's forward model. In training, relative noise of one to six times
    `noise` and the effect of drifting contact impedances are added to the voltage changes.
    """
    contact_changes = jnp.asarray(channels.contacts, jnp.float32)

    def loss(network, batch, key):
        change, true_maps = batch
        random_keys = jax.random.split(key, 4)
        # Drift and log noise are linear in the square of a uniform random number, so that most amounts are low.
        drift_size, noise_size = (
            jax.random.uniform(size_key, (len(change), 1), change.dtype) ** 2 for size_key in random_keys[2:]
        )
        contact_drift = (
            _MAX_CONTACT_DRIFT
            * drift_size
            * jax.random.normal(random_keys[1], (len(change), len(contact_changes)), change.dtype)
        )
        noise_levels = noise * _MAX_NOISE_FACTOR**noise_size
        noisy_change = (
            change
            + noise_levels * jax.random.normal(random_keys[0], change.shape, change.dtype)
            + contact_drift @ contact_changes
        )
        *maps_of_earlier_steps, last_map = network.maps_after_steps(noisy_change)
        loss_value = jnp.mean((last_map - true_maps) ** 2)
        for map_of_earlier_step in maps_of_earlier_steps:
            loss_value = loss_value + _EARLIER_MAP_LOSS_WEIGHT * jnp.mean((map_of_earlier_step - true_maps) ** 2)
        expected_misfit = noise_levels[:, 0] ** 2 + _RELATIVE_MODEL_ERROR**2 * jnp.mean(change**2, axis=1)
        relative_misfit = jnp.mean((network.predicted_changes(last_map) - change) ** 2, axis=1) / expected_misfit
        # The logarithm of the misfit is used, since touches on electrodes, which the model explains least, would
        # otherwise dominate.
        return loss_value / _LOSS_SCALE + _VOLTAGE_MISFIT_LOSS_WEIGHT * jnp.mean(jnp.log1p(relative_misfit)), network

    datasets = training.rows("change", "depth"), _add_noise(validation, noise)
    result = runs.run("unrolled", untrained, TrainingObjective(loss, _map_errors, untrained.trained), *datasets)
    return TrainedNetwork(result.network, {"unrolled": result})


def shuffle_pairs(examples: TouchExamples, seed: int = 0) -> TouchExamples:
    """Pair voltage changes and depth maps at random: only the distribution of maps can be learnt from such pairs."""
    random_order = np.random.default_rng(seed).permutation(len(examples.change))
    return examples._replace(depth=examples.depth[random_order])


def _map_errors(network, batch):
    change, true_maps = batch
    return jnp.mean((network(change) - true_maps) ** 2, axis=(1, 2)) / _LOSS_SCALE


def mean_and_deviation(rows: Rows) -> tuple[Float[np.ndarray, " M"], Float[np.ndarray, " M"]]:
    """Compute the mean and the standard deviation of each column of the `rows` over all their chunks."""
    num_rows, running_mean, squared_deviations = 0, np.zeros(()), np.zeros(())
    for chunk_index, chunk_size in enumerate(rows.sizes):
        chunk_values = np.asarray(rows.chunk(chunk_index), float)
        chunk_mean = chunk_values.mean(axis=0)
        # Sum of squares about the mean of earlier chunks and this chunk together (Chan, Golub and LeVeque 1983).
        mean_difference, num_rows = chunk_mean - running_mean, num_rows + chunk_size
        squared_deviations = (
            squared_deviations
            + ((chunk_values - chunk_mean) ** 2).sum(axis=0)
            + mean_difference**2 * (num_rows - chunk_size) * chunk_size / num_rows
        )
        running_mean = running_mean + mean_difference * chunk_size / num_rows
    return running_mean, np.sqrt(squared_deviations / num_rows)


def _add_noise(examples: TouchExamples, noise: float) -> tuple[Float[np.ndarray, "n M"], Float[np.ndarray, "n r c"]]:
    """Return voltage changes with noise, and depth maps; the noise is fixed, so that held-out data never differ."""
    standard_noise = np.random.default_rng(0).normal(size=examples.change.shape)
    return np.asarray(examples.change + noise * standard_noise, np.float32), examples.depth


DEPTH_MAP_SHAPE = (48, 48)
# Number of simulated touches of a chunk; seed offsets of the training, held-out and test sets. No choice depends on the
# test set.
_CHUNK_SIZE, _SEED_OFFSETS = 250, (0, 1, 2)
# Diameter of the ball with which a network is evaluated, metres.
_BALL_DIAMETER = 0.015
# Depth to which the ball is pressed, divided by the skin's thickness.
_BALL_DEPTH = 0.75
# Number of places along a side at which the ball is pressed.
_BALL_PLACES_PER_SIDE = 15


@dataclass(frozen=True)
class NetworkPreset:
    """Numbers of simulated touches and training plans for learning an image network.

    **Fields**: `number`: number of training touches; `held_out`: number of held-out touches, and of test touches;
    `plan`: settings of every training; `three_stages`: settings for the design "three-stages" if they differ from
    `plan`, else None.

    **Example:**

    ```python
    preset = NetworkPreset(20, 10, TrainingPlan(batch=10, epochs=1))
    learnt_images = learn_images(sheet, "network", preset=preset)
    ```
    """

    number: int
    held_out: int
    plan: TrainingPlan
    three_stages: TrainingPlan | None = None

    def plan_of(self, design: str) -> TrainingPlan:
        """Return the training settings for a network design."""
        return self.three_stages if design == "three-stages" and self.three_stages is not None else self.plan


PRESETS = {
    "quick": NetworkPreset(1000, 250, TrainingPlan(rate=2e-3, batch=32, epochs=10, patience=6, decay=0.8)),
    "full": NetworkPreset(
        24_000,
        2000,
        TrainingPlan(rate=2e-3, batch=64, epochs=20, patience=8, decay=0.87),
        TrainingPlan(rate=1e-3, batch=128, epochs=30, patience=5, decay=0.92),
    ),
}


@dataclass(frozen=True)
class ImageStanding:
    """Accuracy of an image network on the touches of a test set.

    **Fields**: `explained`: fraction of the squared depth that the estimated maps explain, at most 1; `place`: mean,
    standard deviation (sd) and root mean square (rms) of the error of a ball's centroid over a grid of places, metres;
    `deepest`: median ratio of the ball's estimated depth to its true depth; `right`, `estimated` (touches, rows,
    columns): true and estimated maps of some touches, divided by the thickness of the skin.
    """

    explained: float
    place: dict[str, float]
    deepest: float
    right: Float[np.ndarray, "k rows columns"]
    estimated: Float[np.ndarray, "k rows columns"]


@dataclass(frozen=True)
class LearntImages:
    """A trained image network and its accuracy.

    **Fields**: `network`: the network; `courses`: results of its trainings, with the histories of losses, by name;
    `standing`: accuracy of the network; `seconds`: duration of each part of the work, seconds.
    """

    network: ImageNetwork
    courses: dict[str, TrainingResult]
    standing: ImageStanding
    seconds: dict[str, float]


def learn_images(
    skin: Skin,
    folder: str | Path,
    *,
    preset: str | NetworkPreset = "full",
    design: str = "unrolled",
    touches: int | None = None,
    seed: int = 0,
    client: Any = None,
    progress: Callable[[str], None] | None = None,
) -> LearntImages:
    """Simulate touches of a skin, train an image network on the touches, and write the network to a folder.

    The network's file is `network.jeit`. After an interruption, the same call resumes: touches are stored in chunks in
    the folder `work`, and trainings in checkpoints.

    **Arguments:**

    - `skin`: the skin, which must be flat.
    - `folder`: the folder of the results, which is created if needed.
    - `preset`: size of the training: "quick", under two minutes, "full", or a `NetworkPreset`.
    - `design`: "unrolled", a network with the skin's forward model, or "three-stages", that of Park et al. 2022.
    - `touches`: number of simulated training touches, by default that of the preset, limited only by the disk.
    - `seed`: random seed.
    - `client`: client of a dask cluster that simulates the touches, or None.
    - `progress`: function that is called with a description of the progress.

    Raises `ValueError` for curved skins, unknown names, an invalid number of touches, and a folder with results for
    another skin; `ImportError` without the extras `learn` and `cluster`.

    **Example:**

    ```python
    preset = NetworkPreset(20, 10, TrainingPlan(batch=10, epochs=1))
    learnt_images = learn_images(sheet, "network", preset=preset)
    ```
    """
    require_extra("learn", "a network that images touches")
    require_extra("cluster", "a store of simulated touches")
    check_kind("skin", skin, Skin, "a Skin, as of read_described_skin('skin.toml')")
    if not isinstance(skin.layout, Layout):
        raise ValueError(
            f"skin: networks image flat skins, and {describe(skin.layout.name)} is of a curved one; give its surface "
            "as a rectangle, skin.width_mm and skin.height_mm in place of the table [surface]."
        )
    check_name("design", design, NETWORK_DESIGNS)
    if not isinstance(preset, NetworkPreset):
        check_name("preset", preset, PRESETS)
        preset = PRESETS[preset]
    if touches is not None:
        if not (isinstance(touches, int) and touches >= 1):
            raise ValueError(f"touches must be a whole number, 1 or more; it is {describe(touches)}.")
        preset = dataclasses.replace(preset, number=touches)
    report_progress = (lambda _: None) if progress is None else progress
    working_folder = Path(folder) / "work"
    working_folder.mkdir(parents=True, exist_ok=True)
    stage_seconds, start_time = {}, time.monotonic()
    report_progress("noise")
    noise = detection_noise(skin)
    simulated_sets = {}
    for set_name, num_touches, seed_offset in zip(
        ("learnt", "held-out", "standing"),
        (preset.number, preset.held_out, preset.held_out),
        _SEED_OFFSETS,
        strict=True,
    ):
        indents = IndentSet(
            skin, touch_draws(skin), num_touches, seed=3 * seed + seed_offset, shape=DEPTH_MAP_SHAPE, chunk=_CHUNK_SIZE
        )
        store_path = working_folder / f"{set_name}.zarr"
        try:
            simulate_presses(
                indents,
                store_path,
                client=client,
                progress=lambda state, set_name=set_name: report_progress(
                    f"touches {set_name}: {state.points} of {state.all_points}"
                ),
            )
        except DifferentContentsError:
            raise ValueError(
                f"folder '{folder}' was begun for another skin, seed or number of touches; give another folder, or "
                f"delete '{working_folder}' to learn anew."
            ) from None
        simulated_sets[set_name] = StoredTouches(indents, store_path)
    held_out_examples, test_examples = (simulated_sets[set_name].in_memory() for set_name in ("held-out", "standing"))
    stage_seconds["touches"] = time.monotonic() - start_time
    key = jax.random.key(seed)
    training_runs = TrainingRuns(preset.plan_of(design), key, working_folder, progress)
    if design == "unrolled":
        linear_channels = LinearChannels.from_skin(skin, DEPTH_MAP_SHAPE)
        initial_network = Unrolled(held_out_examples.change.shape[1], DEPTH_MAP_SHAPE, key=jax.random.fold_in(key, 3))
        pixel_positions = image_places(skin, DEPTH_MAP_SHAPE[1], DEPTH_MAP_SHAPE[0])
        initial_network = initial_network.adapted_to_skin(linear_channels, pixel_positions, skin.layout.centres, noise)
        trained_network = train_unrolled(
            initial_network, linear_channels, simulated_sets["learnt"], held_out_examples, noise, training_runs
        )
    else:
        trained_network = train_three_stages(simulated_sets["learnt"], held_out_examples, noise, training_runs)
    stage_seconds["training"] = time.monotonic() - start_time - stage_seconds["touches"]
    network = ImageNetwork.from_skin(trained_network.network, skin, noise, DEPTH_MAP_SHAPE)
    report_progress("standing")
    standing = evaluate_network(network, skin, test_examples)
    stage_seconds["all"] = time.monotonic() - start_time
    write_network(network, Path(folder) / NETWORK_FILE)
    return LearntImages(network, trained_network.courses, standing, stage_seconds)


def evaluate_network(network: ImageNetwork, skin: Skin, examples: TouchExamples, seed: int = 0) -> ImageStanding:
    """Evaluate an image network on simulated touches, with the noise of its training."""
    generator = np.random.default_rng(seed)

    def estimate_maps(change):
        return network.share(change + network.noise * generator.normal(size=change.shape))

    estimated_maps = estimate_maps(examples.change)
    explained_fraction = 1 - float(np.mean((estimated_maps - examples.depth) ** 2) / np.mean(examples.depth**2))
    ball_grid = touches_away_from_the_edge(
        skin.outline, _BALL_DIAMETER / 2, _BALL_PLACES_PER_SIDE, _BALL_PLACES_PER_SIDE
    )
    ball, ball_depth = ball_indenter(_BALL_DIAMETER), min(_BALL_DEPTH * float(skin.thickness), _BALL_DIAMETER / 2)
    ball_maps = estimate_maps(relative_changes(skin, [[Indent(ball, ball_depth, place)] for place in ball_grid.places]))
    rows, columns = network.shape
    place_errors = error_statistics(depth_centroids(ball_maps, image_places(skin, columns, rows)), ball_grid.places)
    max_relative_depth = float(np.median(ball_maps.max(axis=(1, 2)))) * float(skin.thickness) / ball_depth
    return ImageStanding(explained_fraction, place_errors, max_relative_depth, examples.depth[:6], estimated_maps[:6])
