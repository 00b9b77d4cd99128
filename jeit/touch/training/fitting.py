"""`fit_network`: train a neural network by Adam with early stopping on held-out rows, and checkpoints to resume
from."""

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
from jaxtyping import Array, Float, Int

from jeit.arguments import check_key, check_kind, describe, is_number
from jeit.arguments.extras import require_extra
from jeit.touch.training.batches import ArrayRows, BatchOrder
from jeit.touch.training.model_file import Checkpoint, Course, TrainingState

# Number of training batches after which a checkpoint may be written.
_BATCHES_PER_CHECKPOINT = 32
# Maximum number of held-out rows evaluated at once.
_MAX_BATCH_SIZE = 256


class TrainingObjective(NamedTuple):
    """The objective of a network's training; its functions are compiled.

    **Fields**

    - `loss`: function of a network, a batch of rows and a random key. The function returns the loss of the batch, which
      is minimised, and the network, in which leaves that are not trained, such as running means, may have changed.
    - `held_out`: function of a network and a batch of held-out rows, which returns the loss of each row, (rows,).
    - `trained`: selects the leaves (arrays) of the network that are trained: a function of a leaf that returns true or
      false, or a tree of booleans with the structure of the network, as in `equinox.filter`.

    **Example:**

    ```python
    objective = TrainingObjective(
        loss=lambda network, batch, key: (jnp.mean((network * batch[0] - batch[1]) ** 2), network),
        held_out=lambda network, batch: (network * batch[0] - batch[1]) ** 2,
    )
    ```
    """

    loss: Callable[[Any, Any, Array], tuple[Float[Array, ""], Any]]
    held_out: Callable[[Any, Any], Float[Array, " b"]]
    trained: Any = eqx.is_inexact_array


@dataclass(frozen=True)
class TrainingPlan:
    """Settings of a network's training.

    **Fields**: `rate`: learning rate of Adam, which is multiplied by `decay` after every `decay_epochs` epochs;
    `batch`: number of rows in a batch; `epochs`: maximum number of epochs; `look_every`: number of batches between
    evaluations of the held-out rows, by default an epoch; `patience`: number of consecutive evaluations without
    improvement after which training stops; `seconds`: time between checkpoints, which may be exceeded by a few dozen
    batches.

    **Example:**

    ```python
    plan = TrainingPlan(rate=1e-2, batch=16, epochs=20, patience=5)
    trained = fit_network(jnp.array(0.0), objective, rows, rows, plan, key=key)
    ```
    """

    rate: float = 1e-3
    batch: int = 128
    epochs: int = 100
    patience: int = 10
    look_every: int | None = None
    decay: float = 1.0
    decay_epochs: int = 1
    seconds: float = 10.0

    def __post_init__(self):
        """Raises `ValueError` for training settings that are not valid numbers."""
        for field_name in ("rate", "decay"):
            field_value = getattr(self, field_name)
            if not (is_number(field_value) and field_value > 0):
                raise ValueError(f"{field_name} must be positive; it is {describe(field_value)}.")
        for field_name in ("batch", "epochs", "patience", "decay_epochs", "look_every"):
            field_value = getattr(self, field_name)
            if not (isinstance(field_value, int) and field_value >= 1) and not (
                field_name == "look_every" and field_value is None
            ):
                raise ValueError(f"{field_name} must be a whole number, 1 or more; it is {describe(field_value)}.")
        if not (is_number(self.seconds) and self.seconds >= 0):
            raise ValueError(f"seconds must be zero or more; it is {describe(self.seconds)}.")


@dataclass(frozen=True)
class TrainingResult:
    """Result of a network's training.

    `network`: the trained network at the evaluation with the lowest loss of held-out rows; `course`: history of the
    losses; `reason`: why the training ended.
    """

    network: Any
    course: Course
    reason: str


def fit_network(
    network: Any,
    objective: TrainingObjective,
    training: Any,
    validation: Any,
    plan: TrainingPlan | None = None,
    *,
    key: Array,
    checkpoint: str | Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> TrainingResult:
    """Train a neural network by Adam with early stopping on held-out rows.

    The same random `key` gives identical results on the same machine.

    **Arguments:**

    - `network`: the untrained network, any tree of arrays and functions.
    - `objective`: functions that compute the network's losses.
    - `training`: training data: arrays (rows, …) in any tree, such as (inputs, targets), or `Rows` of many chunks.
    - `validation`: the held-out rows, in the same form as the training data, but in memory.
    - `plan`: settings of the training, by default `TrainingPlan()`.
    - `key`: random key.
    - `checkpoint`: path of a file; if the training is killed at any moment, the same call resumes from this file, with
      results identical to those of an uninterrupted training; the file remains after the training.
    - `progress`: function that is called with a description of the progress after every evaluation of the held-out
      rows.

    Raises `ValueError` for arguments that are inconsistent, a checkpoint of a different training, and losses of
    held-out rows that are not finite from the first evaluation on; `ImportError` without the extra `learn`.

    **Example:**

    ```python
    trained = fit_network(jnp.array(0.0), objective, rows, rows, TrainingPlan(epochs=20), key=key)
    print(trained.network)
    ```
    """
    require_extra("learn", "training")
    check_key(key)
    check_kind("objective", objective, TrainingObjective, "a TrainingObjective(loss, held_out)")
    plan = TrainingPlan() if plan is None else plan
    training_rows = training if _is_row_source(training) else ArrayRows(training)
    validation_rows = ArrayRows(validation, "validation")
    held_out_arrays = jax.tree.map(jnp.asarray, validation_rows.arrays)
    key_integers = [
        int(key_integer) for key_integer in np.asarray(jax.random.key_data(key) if _is_typed_key(key) else key).ravel()
    ]
    batch_order = BatchOrder(training_rows.sizes, plan.batch, key_integers)
    compiled_training = _CompiledTraining(
        network, objective, plan, batch_order, jax.random.wrap_key_data(jnp.asarray(key_integers, jnp.uint32))
    )
    fingerprint = {
        "plan": {**dataclasses.asdict(plan), "seconds": 0},
        "key": key_integers,
        "network": [
            str(network_leaf)
            for network_leaf in jax.tree.leaves(eqx.filter_eval_shape(lambda: network))
            if hasattr(network_leaf, "shape")
        ],
        "training": training_rows.fingerprint,
        "validation": validation_rows.fingerprint,
    }
    checkpoint_file = None if checkpoint is None else Checkpoint(checkpoint, fingerprint)
    training_state = (
        compiled_training.initial_state()
        if checkpoint_file is None
        else checkpoint_file.read(compiled_training.initial_state())
    )
    evaluation_interval = plan.look_every or batch_order.batches_per_epoch
    num_batches_in_total, time_of_last_checkpoint, loaded_chunk = (
        plan.epochs * batch_order.batches_per_epoch,
        time.monotonic(),
        (-1, None),
    )
    while (end_reason := _end_reason(training_state, plan, num_batches_in_total)) is None:
        next_evaluation = min(
            num_batches_in_total, (training_state.step // evaluation_interval + 1) * evaluation_interval
        )
        for chunk_batches in batch_order.chunk_batches(training_state.step, next_evaluation, _BATCHES_PER_CHECKPOINT):
            if loaded_chunk[0] != chunk_batches.chunk:
                loaded_chunk = -1, None  # drops the chunk, so that two chunks are never in memory
                loaded_chunk = chunk_batches.chunk, jax.tree.map(jnp.asarray, training_rows.chunk(chunk_batches.chunk))
            training_state = compiled_training.train_batches(training_state, loaded_chunk[1], chunk_batches.rows)
            if (
                training_state.step < next_evaluation
                and checkpoint_file is not None
                and time.monotonic() - time_of_last_checkpoint >= plan.seconds
            ):
                checkpoint_file.write(training_state)
                time_of_last_checkpoint = time.monotonic()
        training_state = compiled_training.evaluate(
            training_state,
            held_out_arrays,
            next_evaluation - (next_evaluation - 1) // evaluation_interval * evaluation_interval,
        )
        if progress is not None:
            progress(_describe_progress(training_state, plan, batch_order.batches_per_epoch))
        if checkpoint_file is not None and (
            time.monotonic() - time_of_last_checkpoint >= plan.seconds
            or _end_reason(training_state, plan, num_batches_in_total)
        ):
            checkpoint_file.write(training_state)
            time_of_last_checkpoint = time.monotonic()
    return TrainingResult(compiled_training.combine(training_state.best), training_state.course, end_reason)


class _CompiledTraining:
    """Compiled functions of a network's training, and methods that apply these functions to the state of the
    training."""

    def __init__(self, network, objective: TrainingObjective, plan: TrainingPlan, batch_order: BatchOrder, key: Array):
        import optax

        decay_steps = plan.decay_epochs * batch_order.batches_per_epoch
        learning_rate = (
            plan.rate
            if plan.decay == 1
            else optax.exponential_decay(plan.rate, decay_steps, plan.decay, staircase=True)
        )
        adam_optimiser = optax.adam(learning_rate)
        self.network_arrays, self.fixed_parts = eqx.partition(network, eqx.is_array)
        combine_parts, trained_filter = self.combine, objective.trained

        def update_network(network_arrays, optimiser_state, batch_rows, key):
            trained_part, untrained_part = eqx.partition(combine_parts(network_arrays), trained_filter)

            def training_loss(trained_part):
                loss_value, updated_network = objective.loss(eqx.combine(trained_part, untrained_part), batch_rows, key)
                return loss_value, eqx.filter(eqx.partition(updated_network, trained_filter)[1], eqx.is_array)

            (loss_value, updated_fixed_part), loss_gradients = eqx.filter_value_and_grad(training_loss, has_aux=True)(
                trained_part
            )
            parameter_updates, optimiser_state = adam_optimiser.update(
                loss_gradients, optimiser_state, eqx.filter(trained_part, eqx.is_inexact_array)
            )
            trained_part = eqx.apply_updates(trained_part, parameter_updates)
            return eqx.combine(eqx.filter(trained_part, eqx.is_array), updated_fixed_part), optimiser_state, loss_value

        # Each batch is one call: on CPUs, XLA's convolutions take a hundred times as long within compiled loops.
        def train_batch(network_arrays, optimiser_state, total_loss, chunk_arrays, row_indices, batch_index):
            batch_rows = jax.tree.map(lambda array: array[row_indices], chunk_arrays)
            network_arrays, optimiser_state, loss_value = update_network(
                network_arrays, optimiser_state, batch_rows, jax.random.fold_in(key, batch_index)
            )
            return network_arrays, optimiser_state, total_loss + loss_value.astype(total_loss.dtype)

        def held_out_loss(network_arrays, chunk_arrays, row_indices):
            return objective.held_out(
                combine_parts(network_arrays), jax.tree.map(lambda array: array[row_indices], chunk_arrays)
            )

        self._train_batch, self._held_out_loss = jax.jit(train_batch), jax.jit(held_out_loss)
        self.optimiser_state = jax.jit(adam_optimiser.init)(
            eqx.filter(eqx.partition(network, trained_filter)[0], eqx.is_inexact_array)
        )

    def combine(self, network_arrays) -> Any:
        """Combine the given arrays with the fixed parts of the network."""
        return eqx.combine(network_arrays, self.fixed_parts)

    def initial_state(self) -> TrainingState:
        """Return the state of the training before the first batch."""
        return TrainingState(
            0, Course([], [], []), self.network_arrays, self.optimiser_state, self.network_arrays, jnp.zeros(())
        )

    def train_batches(
        self, training_state: TrainingState, chunk_arrays, batches_of_rows: Int[np.ndarray, "b batch"]
    ) -> TrainingState:
        """Train the network on batches of `chunk_arrays` with the indices `batches_of_rows` (batches, batch size);
        returns the new state."""
        network_arrays, optimiser_state, total_loss = (
            training_state.arrays,
            training_state.optimiser,
            training_state.total,
        )
        for batch_offset, batch_rows in enumerate(batches_of_rows):
            network_arrays, optimiser_state, total_loss = self._train_batch(
                network_arrays,
                optimiser_state,
                total_loss,
                chunk_arrays,
                batch_rows,
                training_state.step + batch_offset,
            )
        return TrainingState(
            training_state.step + len(batches_of_rows),
            training_state.course,
            network_arrays,
            optimiser_state,
            training_state.best,
            total_loss,
        )

    def evaluate(self, training_state: TrainingState, held_out_arrays, num_batches: int) -> TrainingState:
        """Evaluate the loss of the held-out rows, `num_batches` batches after the last evaluation; returns the new
        state.

        Raises `ValueError` if neither this loss nor any earlier loss of held-out rows is finite.
        """
        num_rows = len(jax.tree.leaves(held_out_arrays)[0])
        batch_size = min(num_rows, _MAX_BATCH_SIZE)
        row_indices = np.minimum(np.arange(-(-num_rows // batch_size) * batch_size), num_rows - 1).reshape(
            -1, batch_size
        )
        row_losses = [
            np.asarray(self._held_out_loss(training_state.arrays, held_out_arrays, batch_rows))
            for batch_rows in row_indices
        ]
        held_out_loss = float(np.concatenate(row_losses)[:num_rows].mean())
        previous_course = training_state.course
        training_course = Course(
            [*previous_course.steps, training_state.step],
            [*previous_course.training, float(training_state.total) / num_batches],
            [*previous_course.validation, held_out_loss],
        )
        if not np.isfinite(held_out_loss) and not np.isfinite(previous_course.validation).any():
            raise ValueError(
                f"the loss of the rows held out is {held_out_loss} after {training_state.step} batches; are all "
                "rows finite, and is the plan's rate too large?"
            )
        finite_losses = [loss_value if np.isfinite(loss_value) else np.inf for loss_value in training_course.validation]
        training_course = training_course._replace(validation=finite_losses)
        arrays_with_lowest_loss = (
            training_state.arrays if training_course.best == len(finite_losses) - 1 else training_state.best
        )
        return TrainingState(
            training_state.step,
            training_course,
            training_state.arrays,
            training_state.optimiser,
            arrays_with_lowest_loss,
            jnp.zeros(()),
        )


def _end_reason(training_state: TrainingState, plan: TrainingPlan, num_batches_in_total: int) -> str | None:
    """Return the reason why the training has ended, or None if the training has not ended."""
    num_evaluations = len(training_state.course.validation)
    if num_evaluations and num_evaluations - 1 - training_state.course.best >= plan.patience:
        return f"no better at {plan.patience} looks in a row"
    return f"{plan.epochs} epochs done" if training_state.step >= num_batches_in_total else None


def _describe_progress(training_state: TrainingState, plan: TrainingPlan, batches_per_epoch: int) -> str:
    training_course = training_state.course
    return (
        f"epoch {training_state.step / batches_per_epoch:.3g} of {plan.epochs}: {training_course.training[-1]:.4g}, "
        f"held out {training_course.validation[-1]:.4g} (best {training_course.validation[training_course.best]:.4g})"
    )


def _is_row_source(training_data: Any) -> bool:
    """Whether an argument has the interface of `Rows`, training data in chunks."""
    return all(hasattr(training_data, attribute_name) for attribute_name in ("sizes", "fingerprint", "chunk"))


def _is_typed_key(key: Array) -> bool:
    """Whether a random key was created by `jax.random.key`, not by the older `jax.random.PRNGKey`."""
    return jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
