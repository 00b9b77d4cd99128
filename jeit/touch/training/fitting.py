"""`fit_network`: train a network by Adam with early stopping on held-out rows, with checkpoints to resume from."""

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
from jeit.arguments.extras import need_extra
from jeit.touch.training.batches import ArrayRows, BatchOrder
from jeit.touch.training.model_file import Checkpoint, Course, State

# Number of batches after which a checkpoint may be written; maximum number of held-out rows evaluated at once.
_CHECKPOINT_BATCHES, _AT_ONCE = 32, 256


class TrainingObjective(NamedTuple):
    """The objective of a training; its functions are compiled.

    **Fields**

    - `loss`: function of a network, a batch of rows and a random key, which returns the loss of the batch, which is
      minimised, and the network, in which leaves that are not trained, such as running means, may have changed.
    - `held_out`: function of a network and a batch of rows, which returns the loss (b,) of each held-out row.
    - `trained`: selects the leaves (arrays) of the network that are trained: a function of a leaf that returns true or
      false, or a tree of booleans like the network, as in `equinox.filter`.

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
    """Settings of a training.

    **Fields**: `rate`: learning rate of Adam, which is multiplied by `decay` after every `decay_epochs` epochs;
    `batch`: number of rows in a batch; `epochs`: maximum number of epochs; `look_every`: number of batches between
    evaluations of the held-out rows, by default an epoch; `patience`: number of consecutive evaluations without
    improvement after which training stops; `seconds`: time between checkpoints, which may be exceeded by some dozen
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
        """Raises `ValueError` for settings that are not valid numbers."""
        for name in ("rate", "decay"):
            given = getattr(self, name)
            if not (is_number(given) and given > 0):
                raise ValueError(f"{name} must be positive; it is {describe(given)}.")
        for name in ("batch", "epochs", "patience", "decay_epochs", "look_every"):
            given = getattr(self, name)
            if not (isinstance(given, int) and given >= 1) and not (name == "look_every" and given is None):
                raise ValueError(f"{name} must be a whole number, 1 or more; it is {describe(given)}.")
        if not (is_number(self.seconds) and self.seconds >= 0):
            raise ValueError(f"seconds must be zero or more; it is {describe(self.seconds)}.")


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training.

    `network`: the trained network, with the lowest loss on held-out rows; `course`: the training history; `reason`: why
    the training ended.
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
    """Train a network by Adam with early stopping on held-out rows.

    The same `key` gives identical results on the same machine.

    **Arguments:**

    - `network`: the network, any tree of arrays and functions.
    - `objective`: its losses.
    - `training`: arrays (n, …) in any tree, such as (inputs, targets), or `Rows` of many chunks.
    - `validation`: the held-out rows, in the same form, but in memory.
    - `plan`: settings of the training, by default `TrainingPlan()`.
    - `key`: random key.
    - `checkpoint`: a file; if the training is killed at any moment, the same call resumes from it, with results
      identical to those of an uninterrupted training; the file remains after the training.
    - `progress`: called with a description of the progress after every evaluation of the held-out rows.

    Raises `ValueError` for arguments that do not fit together, a checkpoint of another training, and losses that are
    not finite from the first evaluation on; `ImportError` without the extra `learn`.

    **Example:**

    ```python
    trained = fit_network(jnp.array(0.0), objective, rows, rows, TrainingPlan(epochs=20), key=key)
    print(trained.network)
    ```
    """
    need_extra("learn", "training")
    check_key(key)
    check_kind("objective", objective, TrainingObjective, "a TrainingObjective(loss, held_out)")
    plan = TrainingPlan() if plan is None else plan
    rows = training if _are_rows(training) else ArrayRows(training)
    held = ArrayRows(validation, "validation")
    held_out_arrays = jax.tree.map(jnp.asarray, held.arrays)
    seed = [int(word) for word in np.asarray(jax.random.key_data(key) if _is_typed_key(key) else key).ravel()]
    order = BatchOrder(rows.sizes, plan.batch, seed)
    run = _CompiledTraining(network, objective, plan, order, jax.random.wrap_key_data(jnp.asarray(seed, jnp.uint32)))
    fingerprint = {
        "plan": {**dataclasses.asdict(plan), "seconds": 0},
        "key": seed,
        "network": [
            str(one) for one in jax.tree.leaves(eqx.filter_eval_shape(lambda: network)) if hasattr(one, "shape")
        ],
        "training": rows.fingerprint,
        "validation": held.fingerprint,
    }
    kept = None if checkpoint is None else Checkpoint(checkpoint, fingerprint)
    state = run.initial_state() if kept is None else kept.read(run.initial_state())
    look_every = plan.look_every or order.batches_per_epoch
    last, saved, loaded = plan.epochs * order.batches_per_epoch, time.monotonic(), (-1, None)
    while (reason := _end_reason(state, plan, last)) is None:
        upto = min(last, (state.step // look_every + 1) * look_every)
        for batches in order.chunk_batches(state.step, upto, _CHECKPOINT_BATCHES):
            if loaded[0] != batches.chunk:
                loaded = -1, None  # so that two chunks are never in memory
                loaded = batches.chunk, jax.tree.map(jnp.asarray, rows.chunk(batches.chunk))
            state = run.train_batches(state, loaded[1], batches.rows)
            if state.step < upto and kept is not None and time.monotonic() - saved >= plan.seconds:
                kept.write(state)
                saved = time.monotonic()
        state = run.evaluate(state, held_out_arrays, upto - (upto - 1) // look_every * look_every)
        if progress is not None:
            progress(_describe_progress(state, plan, order.batches_per_epoch))
        if kept is not None and (time.monotonic() - saved >= plan.seconds or _end_reason(state, plan, last)):
            kept.write(state)
            saved = time.monotonic()
    return TrainingResult(run.combine(state.best), state.course, reason)


class _CompiledTraining:
    """Compiled functions of one training, and methods that apply them to the state of the training."""

    def __init__(self, network, objective: TrainingObjective, plan: TrainingPlan, order: BatchOrder, key: Array):
        import optax

        steps = plan.decay_epochs * order.batches_per_epoch
        rate = plan.rate if plan.decay == 1 else optax.exponential_decay(plan.rate, steps, plan.decay, staircase=True)
        adam = optax.adam(rate)
        self.arrays, self.fixed = eqx.partition(network, eqx.is_array)
        combine, trained = self.combine, objective.trained

        def update(arrays, state, batch, key):
            moving, still = eqx.partition(combine(arrays), trained)

            def loss(moving):
                value, after = objective.loss(eqx.combine(moving, still), batch, key)
                return value, eqx.filter(eqx.partition(after, trained)[1], eqx.is_array)

            (value, still_after), slope = eqx.filter_value_and_grad(loss, has_aux=True)(moving)
            updates, state = adam.update(slope, state, eqx.filter(moving, eqx.is_inexact_array))
            moving = eqx.apply_updates(moving, updates)
            return eqx.combine(eqx.filter(moving, eqx.is_array), still_after), state, value

        # Each step is one call: on CPUs, XLA's convolutions take a hundred times as long within compiled loops.
        def train_batch(arrays, state, total, data, rows, number):
            batch = jax.tree.map(lambda one: one[rows], data)
            arrays, state, value = update(arrays, state, batch, jax.random.fold_in(key, number))
            return arrays, state, total + value.astype(total.dtype)

        def held_out_loss(arrays, data, rows):
            return objective.held_out(combine(arrays), jax.tree.map(lambda one: one[rows], data))

        self._train_batch, self._held_out_loss = jax.jit(train_batch), jax.jit(held_out_loss)
        self.optimiser = adam.init(eqx.filter(eqx.partition(network, trained)[0], eqx.is_inexact_array))

    def combine(self, arrays) -> Any:
        """Combine the network's fixed parts with these arrays."""
        return eqx.combine(arrays, self.fixed)

    def initial_state(self) -> State:
        """Return the state before the first batch."""
        return State(0, Course([], [], []), self.arrays, self.optimiser, self.arrays, jnp.zeros(()))

    def train_batches(self, state: State, data, rows: Int[np.ndarray, "b batch"]) -> State:
        """Train on batches of these rows; returns the new state."""
        arrays, optimiser, total = state.moving, state.optimiser, state.total
        for place, batch in enumerate(rows):
            arrays, optimiser, total = self._train_batch(arrays, optimiser, total, data, batch, state.step + place)
        return State(state.step + len(rows), state.course, arrays, optimiser, state.best, total)

    def evaluate(self, state: State, data, since: int) -> State:
        """Evaluate the held-out rows, `since` batches after the last evaluation; returns the new state.

        Raises `ValueError` if neither this loss nor any before was finite.
        """
        number = len(jax.tree.leaves(data)[0])
        size = min(number, _AT_ONCE)
        index = np.minimum(np.arange(-(-number // size) * size), number - 1).reshape(-1, size)
        each = [np.asarray(self._held_out_loss(state.moving, data, rows)) for rows in index]
        held = float(np.concatenate(each)[:number].mean())
        own = state.course
        course = Course([*own.steps, state.step], [*own.training, float(state.total) / since], [*own.validation, held])
        if not np.isfinite(held) and not np.isfinite(own.validation).any():
            raise ValueError(
                f"the loss of the rows held out is {held} after {state.step} batches; are all rows finite, and is the "
                "plan's rate too large?"
            )
        finite = [value if np.isfinite(value) else np.inf for value in course.validation]
        course = course._replace(validation=finite)
        best = state.moving if course.best == len(finite) - 1 else state.best
        return State(state.step, course, state.moving, state.optimiser, best, jnp.zeros(()))


def _end_reason(state: State, plan: TrainingPlan, last_batch: int) -> str | None:
    """Return the reason why the training has ended, or None if it has not."""
    looks = len(state.course.validation)
    if looks and looks - 1 - state.course.best >= plan.patience:
        return f"no better at {plan.patience} looks in a row"
    return f"{plan.epochs} epochs done" if state.step >= last_batch else None


def _describe_progress(state: State, plan: TrainingPlan, batches_per_epoch: int) -> str:
    own = state.course
    return (
        f"epoch {state.step / batches_per_epoch:.3g} of {plan.epochs}: {own.training[-1]:.4g}, held out "
        f"{own.validation[-1]:.4g} (best {own.validation[own.best]:.4g})"
    )


def _are_rows(value: Any) -> bool:
    """Whether an argument has the interface of `Rows`."""
    return all(hasattr(value, name) for name in ("sizes", "fingerprint", "chunk"))


def _is_typed_key(key: Array) -> bool:
    """Whether a random key is of `jax.random.key`, not of the older `jax.random.PRNGKey`."""
    return jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
