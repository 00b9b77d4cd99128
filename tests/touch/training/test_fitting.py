"""Networks trained from arrays: they learn, stop early, and resume after a kill, to the same bits."""

import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.touch.training import ArrayRows, TrainingObjective, TrainingPlan, fit_network
from jeit.touch.training.batches import BatchOrder


def loss(network, batch, key):
    inputs, targets = batch
    noisy = inputs + 0.01 * jax.random.normal(key, inputs.shape, inputs.dtype)
    return jnp.mean((jax.vmap(network)(noisy) - targets) ** 2), network


def held_out(network, batch):
    inputs, targets = batch
    return jnp.mean((jax.vmap(network)(inputs) - targets) ** 2, axis=1)


compiled_held_out = eqx.filter_jit(held_out)


def rows(number: int, seed: int = 0):
    inputs = np.random.default_rng(seed).uniform(-1, 1, (number, 2)).astype(np.float32)
    return inputs, np.stack([inputs[:, 0] * inputs[:, 1]], axis=1)


@eqx.filter_jit
def network():
    return eqx.nn.MLP(2, 1, 16, 2, jnp.tanh, dtype=jnp.float32, key=jax.random.key(0))


OBJECTIVE = TrainingObjective(loss, held_out)
PLAN = TrainingPlan(rate=1e-2, batch=32, epochs=30, seconds=0.0)
KEY = jax.random.key(3)


def bits(tree):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]


@pytest.fixture(scope="module")
def trained():
    return fit_network(network(), OBJECTIVE, rows(500), rows(100, 1), PLAN, key=KEY)


def test_training_reduces_the_loss(trained):
    """x y has a variance of 1/9. A straight line explains nothing of it."""
    assert trained.course.validation[trained.course.best] < 0.02 / 9
    assert float(compiled_held_out(trained.network, rows(100, 2)).mean()) < 0.03 / 9
    assert float(compiled_held_out(network(), rows(100, 2)).mean()) > 1 / 9


def test_the_best_network_is_kept(trained):
    found = float(compiled_held_out(trained.network, rows(100, 1)).mean())
    assert found == pytest.approx(min(trained.course.validation), rel=1e-5)


def test_a_key_determines_everything(trained):
    again = fit_network(network(), OBJECTIVE, rows(500), rows(100, 1), PLAN, key=KEY)
    other = fit_network(network(), OBJECTIVE, rows(500), rows(100, 1), PLAN, key=jax.random.key(4))
    assert bits(again.network) == bits(trained.network)
    assert bits(other.network) != bits(trained.network)


def test_it_stops_early():
    """Targets of noise: training on some makes others worse."""
    inputs, _ = rows(500)
    noise = np.random.default_rng(1).normal(size=(500, 1)).astype(np.float32)
    other = np.random.default_rng(2).normal(size=(100, 1)).astype(np.float32)
    plan = dataclasses.replace(PLAN, epochs=500, patience=5)
    found = fit_network(network(), OBJECTIVE, (inputs, noise), (inputs[:100], other), plan, key=KEY)
    assert found.reason == "no better at 5 looks in a row"
    assert len(found.course.steps) == found.course.best + 6 < 500


class Stopped(Exception):
    pass


def test_interrupted_training_resumes_to_the_same_bits(tmp_path):
    """Also within epochs, with decreasing rates."""
    plan = TrainingPlan(rate=1e-2, batch=32, epochs=3, look_every=4, seconds=0.0, decay=0.5, decay_epochs=1)
    given = network(), OBJECTIVE, rows(500), rows(100, 1), plan
    whole = fit_network(*given, key=KEY)
    reports = []

    def stop(report):
        reports.append(report)
        if len(reports) in (3, 7):
            raise Stopped

    for _ in range(20):
        try:
            found = fit_network(*given, key=KEY, checkpoint=tmp_path / "state", progress=stop)
            break
        except Stopped:
            continue
    assert len(reports) > 5
    assert found.course == whole.course
    assert bits(found.network) == bits(whole.network)
    assert bits(fit_network(*given, key=KEY, checkpoint=tmp_path / "state").network) == bits(whole.network)


@pytest.mark.slow
def test_killed_at_any_moment(tmp_path, trained):
    """By kill -9, after its first progress reports. The resumed training ends as one that was never killed."""
    script = tmp_path / "train.py"
    script.write_text(
        "import sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from test_fitting import KEY, OBJECTIVE, PLAN, fit_network, network, rows\n"
        "def show(report):\n    print(report, flush=True)\n"
        "fit_network(network(), OBJECTIVE, rows(500), rows(100, 1), PLAN, key=KEY,\n"
        "            checkpoint=sys.argv[1], progress=show)\n",
        "utf-8",
    )
    command = [sys.executable, str(script), str(tmp_path / "killed")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ))
    assert process.stdout is not None
    for _ in range(4):
        process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    report = []
    given = network(), OBJECTIVE, rows(500), rows(100, 1), PLAN
    found = fit_network(*given, key=KEY, checkpoint=tmp_path / "killed", progress=report.append)
    assert 0 < len(report) < len(trained.course.steps)
    assert bits(found.network) == bits(trained.network)


def test_a_checkpoint_of_another_training_is_refused(tmp_path):
    given = network(), OBJECTIVE, rows(500), rows(100, 1)
    plan = dataclasses.replace(PLAN, epochs=2)
    fit_network(*given, plan, key=KEY, checkpoint=tmp_path / "state")
    with pytest.raises(ValueError, match="of another training \\(plan was"):
        fit_network(*given, dataclasses.replace(plan, epochs=3), key=KEY, checkpoint=tmp_path / "state")
    with pytest.raises(ValueError, match="training was"):
        fit_network(*given[:2], rows(501), given[3], plan, key=KEY, checkpoint=tmp_path / "state")
    with pytest.raises(ValueError, match="key was"):
        fit_network(*given, plan, key=jax.random.key(0), checkpoint=tmp_path / "state")


class Chunks:
    """The same rows in three chunks."""

    def __init__(self, arrays, sizes):
        self.arrays, self.sizes = arrays, sizes
        self.fingerprint = ArrayRows(arrays).fingerprint
        self.loaded = []

    def chunk(self, number):
        self.loaded.append(number)
        first = sum(self.sizes[:number])
        return tuple(one[first : first + self.sizes[number]] for one in self.arrays)


@pytest.mark.slow
def test_chunks():
    """A set larger than memory is learnt as well, chunk by chunk."""
    chunks = Chunks(rows(500), (200, 200, 100))
    found = fit_network(network(), OBJECTIVE, chunks, rows(100, 1), PLAN, key=KEY)
    assert found.course.validation[found.course.best] < 0.02 / 9
    assert len(chunks.loaded) <= 3 * PLAN.epochs


@pytest.mark.slow
def test_training_interrupted_between_chunks_resumes(tmp_path):
    """Within an epoch."""
    chunks = Chunks(rows(500), (200, 200, 100))
    found = fit_network(network(), OBJECTIVE, chunks, rows(100, 1), PLAN, key=KEY)
    given = network(), OBJECTIVE, Chunks(rows(500), (200, 200, 100)), rows(100, 1), PLAN
    given[2].chunk = lambda number, whole=given[2].chunk: whole(number) if len(given[2].loaded) < 7 else stop()

    def stop():
        raise Stopped

    with pytest.raises(Stopped):
        fit_network(*given, key=KEY, checkpoint=tmp_path / "state")
    again = fit_network(network(), OBJECTIVE, chunks, rows(100, 1), PLAN, key=KEY, checkpoint=tmp_path / "state")
    assert bits(again.network) == bits(found.network)


def test_every_epoch_uses_each_row_at_most_once():
    order = BatchOrder((70, 50), 16, [1, 2])
    legs = list(order.chunk_batches(0, 2 * order.batches_per_epoch, 3))
    for epoch in range(2):
        own = [leg for leg in legs if leg.first // order.batches_per_epoch == epoch]
        assert sum(len(leg.rows) for leg in own) == order.batches_per_epoch == 7
        for chunk, size in enumerate((70, 50)):
            taken = np.concatenate([leg.rows.ravel() for leg in own if leg.chunk == chunk])
            assert len(set(taken.tolist())) == len(taken) == size // 16 * 16
    again = list(order.chunk_batches(5, 2 * order.batches_per_epoch, 3))
    assert np.array_equal(np.concatenate([leg.rows for leg in again]), np.concatenate([leg.rows for leg in legs])[5:])


class Counting(eqx.Module):
    """A line, an offset that is not trained, and the number, sum and sum of squares of a random number per batch."""

    slope: jax.Array
    offset: jax.Array
    seen: jax.Array


def test_leaves_that_are_not_trained():
    """They change only by what the loss assigns to them. Every batch has a random key of its own."""

    def line(own, batch, key):
        inputs, targets = batch
        value = jnp.mean((own.slope * inputs[:, :1] + own.offset - targets) ** 2)
        drawn = jax.random.uniform(key)
        return value, eqx.tree_at(lambda one: one.seen, own, own.seen + jnp.stack([jnp.ones(()), drawn, drawn**2]))

    def each(own, batch):
        return (own.slope * batch[0][:, 0] + own.offset - batch[1][:, 0]) ** 2

    inputs = np.linspace(-1, 1, 128)[:, None]
    start = Counting(*(jnp.asarray(value) for value in (0.0, 0.5, np.zeros(3))))
    wanted = Counting(True, False, False)  # pyright: ignore[reportArgumentType]
    plan = TrainingPlan(rate=0.05, batch=32, epochs=100, patience=100)
    given = inputs, 2 * inputs + 0.5
    found = fit_network(start, TrainingObjective(line, each, wanted), given, given, plan, key=KEY)
    assert float(found.network.slope) == pytest.approx(2, abs=1e-2)
    assert float(found.network.offset) == 0.5
    number, total, total_of_squares = np.asarray(found.network.seen)
    assert number == found.course.steps[found.course.best]
    assert total / number == pytest.approx(0.5, abs=0.1)
    assert total_of_squares / number - (total / number) ** 2 == pytest.approx(1 / 12, rel=0.2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"training": (np.zeros((3, 2)), np.zeros((4, 1)))}, "training must be arrays of one and the same number"),
        ({"validation": ()}, "validation must be arrays"),
        ({"key": 3}, "key must be one random key"),
        ({"objective": loss}, "objective must be a TrainingObjective"),
    ],
)
def test_bad_arguments(change, message):
    given = {"objective": OBJECTIVE, "training": rows(10), "validation": rows(10), "key": KEY, **change}
    with pytest.raises(ValueError, match=message):
        fit_network(network(), given.pop("objective"), given.pop("training"), given.pop("validation"), **given)


@pytest.mark.parametrize("change", [{"rate": 0.0}, {"batch": 0}, {"epochs": 1.5}, {"look_every": 0}, {"seconds": -1}])
def test_bad_plans(change):
    with pytest.raises(ValueError, match=f"{next(iter(change))} must be"):
        TrainingPlan(**change)


def test_losses_that_are_not_finite():
    inputs, targets = rows(500)
    plan = dataclasses.replace(PLAN, epochs=1)
    with pytest.raises(ValueError, match="are all rows finite"):
        fit_network(network(), OBJECTIVE, (inputs, np.full_like(targets, np.nan)), rows(100, 1), plan, key=KEY)
