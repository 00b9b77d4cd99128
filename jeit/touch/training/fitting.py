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
        for name in ("rate", "decay"):
            value = getattr(self, name)
            if not (is_number(value) and value > 0):
                raise ValueError(f"{name} must be positive; it is {describe(value)}.")
        for name in ("batch", "epochs", "patience", "decay_epochs", "look_every"):
            value = getattr(self, name)
            if not (isinstance(value, int) and value >= 1) and not (name == "look_every" and value is None):
                raise ValueError(f"{name} must be a whole number, 1 or more; it is {describe(value)}.")
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
    rows = training if _is_row_source(training) else ArrayRows(training)
    validation_rows = ArrayRows(validation, "validation")
    held_out_arrays = jax.tree.map(jnp.asarray, validation_rows.arrays)
    seed = [int(integer) for integer in np.asarray(jax.random.key_data(key) if _is_typed_key(key) else key).ravel()]
    batch_order = BatchOrder(rows.sizes, plan.batch, seed)
    run = _CompiledTraining(
        network, objective, plan, batch_order, jax.random.wrap_key_data(jnp.asarray(seed, jnp.uint32))
    )
    fingerprint = {
        "plan": {**dataclasses.asdict(plan), "seconds": 0},
        "key": seed,
        "network": [
            str(leaf) for leaf in jax.tree.leaves(eqx.filter_eval_shape(lambda: network)) if hasattr(leaf, "shape")
        ],
        "training": rows.fingerprint,
        "validation": validation_rows.fingerprint,
    }
    checkpoint_file = None if checkpoint is None else Checkpoint(checkpoint, fingerprint)
    state = run.initial_state() if checkpoint_file is None else checkpoint_file.read(run.initial_state())
    evaluation_interval = plan.look_every or batch_order.batches_per_epoch
    num_batches_in_total, time_of_last_checkpoint, loaded_chunk = (
        plan.epochs * batch_order.batches_per_epoch,
        time.monotonic(),
        (-1, None),
    )
    while (reason := _end_reason(state, plan, num_batches_in_total)) is None:
        next_evaluation = min(num_batches_in_total, (state.step // evaluation_interval + 1) * evaluation_interval)
        for batches in batch_order.chunk_batches(state.step, next_evaluation, _BATCHES_PER_CHECKPOINT):
            if loaded_chunk[0] != batches.chunk:
                loaded_chunk = -1, None  # drops the chunk, so that two chunks are never in memory
                loaded_chunk = batches.chunk, jax.tree.map(jnp.asarray, rows.chunk(batches.chunk))
            state = run.train_batches(state, loaded_chunk[1], batches.rows)
            if (
                state.step < next_evaluation
                and checkpoint_file is not None
                and time.monotonic() - time_of_last_checkpoint >= plan.seconds
            ):
                checkpoint_file.write(state)
                time_of_last_checkpoint = time.monotonic()
        state = run.evaluate(
            state, held_out_arrays, next_evaluation - (next_evaluation - 1) // evaluation_interval * evaluation_interval
        )
        if progress is not None:
            progress(_describe_progress(state, plan, batch_order.batches_per_epoch))
        if checkpoint_file is not None and (
            time.monotonic() - time_of_last_checkpoint >= plan.seconds or _end_reason(state, plan, num_batches_in_total)
        ):
            checkpoint_file.write(state)
            time_of_last_checkpoint = time.monotonic()
    return TrainingResult(run.combine(state.best), state.course, reason)


class _CompiledTraining:
    """Compiled functions of a network's training, and methods that apply these functions to the state of the
    training."""

    def __init__(self, network, objective: TrainingObjective, plan: TrainingPlan, batch_order: BatchOrder, key: Array):
        import optax

        steps = plan.decay_epochs * batch_order.batches_per_epoch
        rate = plan.rate if plan.decay == 1 else optax.exponential_decay(plan.rate, steps, plan.decay, staircase=True)
        adam_optimiser = optax.adam(rate)
        self.arrays, self.fixed = eqx.partition(network, eqx.is_array)
        combine, trained = self.combine, objective.trained

        def update(arrays, state, batch, key):
            trained_part, untrained_part = eqx.partition(combine(arrays), trained)

            def loss(trained_part):
                loss_value, updated_network = objective.loss(eqx.combine(trained_part, untrained_part), batch, key)
                return loss_value, eqx.filter(eqx.partition(updated_network, trained)[1], eqx.is_array)

            (loss_value, updated_fixed_part), gradients = eqx.filter_value_and_grad(loss, has_aux=True)(trained_part)
            updates, state = adam_optimiser.update(gradients, state, eqx.filter(trained_part, eqx.is_inexact_array))
            trained_part = eqx.apply_updates(trained_part, updates)
            return eqx.combine(eqx.filter(trained_part, eqx.is_array), updated_fixed_part), state, loss_value

        # Each batch is one call: on CPUs, XLA's convolutions take a hundred times as long within compiled loops.
        def train_batch(arrays, state, total_loss, data, rows, batch_index):
            batch = jax.tree.map(lambda array: array[rows], data)
            arrays, state, loss_value = update(arrays, state, batch, jax.random.fold_in(key, batch_index))
            return arrays, state, total_loss + loss_value.astype(total_loss.dtype)

        def held_out_loss(arrays, data, rows):
            return objective.held_out(combine(arrays), jax.tree.map(lambda array: array[rows], data))

        self._train_batch, self._held_out_loss = jax.jit(train_batch), jax.jit(held_out_loss)
        self.optimiser = jax.jit(adam_optimiser.init)(
            eqx.filter(eqx.partition(network, trained)[0], eqx.is_inexact_array)
        )

    def combine(self, arrays) -> Any:
        """Combine the given arrays with the fixed parts of the network."""
        return eqx.combine(arrays, self.fixed)

    def initial_state(self) -> TrainingState:
        """Return the state of the training before the first batch."""
        return TrainingState(0, Course([], [], []), self.arrays, self.optimiser, self.arrays, jnp.zeros(()))

    def train_batches(self, state: TrainingState, data, rows: Int[np.ndarray, "b batch"]) -> TrainingState:
        """Train the network on batches of `data` with the indices `rows` (batches, batch size); returns the new
        state."""
        arrays, optimiser, total_loss = state.arrays, state.optimiser, state.total
        for offset, batch in enumerate(rows):
            arrays, optimiser, total_loss = self._train_batch(
                arrays, optimiser, total_loss, data, batch, state.step + offset
            )
        return TrainingState(state.step + len(rows), state.course, arrays, optimiser, state.best, total_loss)

    def evaluate(self, state: TrainingState, data, num_batches: int) -> TrainingState:
        """Evaluate the loss of the held-out rows, `num_batches` batches after the last evaluation; returns the new
        state.

        Raises `ValueError` if neither this loss nor any earlier loss of held-out rows is finite.
        """
        num_rows = len(jax.tree.leaves(data)[0])
        batch_size = min(num_rows, _MAX_BATCH_SIZE)
        row_indices = np.minimum(np.arange(-(-num_rows // batch_size) * batch_size), num_rows - 1).reshape(
            -1, batch_size
        )
        losses = [np.asarray(self._held_out_loss(state.arrays, data, rows)) for rows in row_indices]
        held_out_loss = float(np.concatenate(losses)[:num_rows].mean())
        previous_course = state.course
        course = Course(
            [*previous_course.steps, state.step],
            [*previous_course.training, float(state.total) / num_batches],
            [*previous_course.validation, held_out_loss],
        )
        if not np.isfinite(held_out_loss) and not np.isfinite(previous_course.validation).any():
            raise ValueError(
                f"the loss of the rows held out is {held_out_loss} after {state.step} batches; are all rows finite, "
                "and is the plan's rate too large?"
            )
        finite_losses = [value if np.isfinite(value) else np.inf for value in course.validation]
        course = course._replace(validation=finite_losses)
        arrays_with_lowest_loss = state.arrays if course.best == len(finite_losses) - 1 else state.best
        return TrainingState(state.step, course, state.arrays, state.optimiser, arrays_with_lowest_loss, jnp.zeros(()))


def _end_reason(state: TrainingState, plan: TrainingPlan, last_batch: int) -> str | None:
    """Return the reason why the training has ended, or None if the training has not ended."""
    num_evaluations = len(state.course.validation)
    if num_evaluations and num_evaluations - 1 - state.course.best >= plan.patience:
        return f"no better at {plan.patience} looks in a row"
    return f"{plan.epochs} epochs done" if state.step >= last_batch else None


def _describe_progress(state: TrainingState, plan: TrainingPlan, batches_per_epoch: int) -> str:
    course = state.course
    return (
        f"epoch {state.step / batches_per_epoch:.3g} of {plan.epochs}: {course.training[-1]:.4g}, held out "
        f"{course.validation[-1]:.4g} (best {course.validation[course.best]:.4g})"
    )


def _is_row_source(value: Any) -> bool:
    """Whether an argument has the interface of `Rows`, training data in chunks."""
    return all(hasattr(value, name) for name in ("sizes", "fingerprint", "chunk"))


def _is_typed_key(key: Array) -> bool:
    """Whether a random key was created by `jax.random.key`, not by the older `jax.random.PRNGKey`."""
    return jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
