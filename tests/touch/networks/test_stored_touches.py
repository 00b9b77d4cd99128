"""Touches read from a store in groups of chunks, and training on them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_networks import bits

from jeit.touch.networks import ImageNetwork
from jeit.touch.networks.learn import TrainingRuns, mean_and_deviation, shuffle_pairs, train_three_stages
from jeit.touch.networks.linear_channels import touch_draws
from jeit.touch.networks.simulated_touches import StoredTouches, TouchExamples
from jeit.touch.simulate import IndentSet, simulate_presses
from jeit.touch.training import MappedRows, TrainingPlan, TrainingResult
from jeit.touch.training.model_file import Course

PLAN = TrainingPlan(rate=2e-3, batch=20, epochs=3, seconds=0.0)


@pytest.fixture(scope="module")
def stored(small_skin, tmp_path_factory):
    indents = IndentSet(small_skin, touch_draws(small_skin), 110, shape=(16, 16), chunk=20)
    path = tmp_path_factory.mktemp("stored") / "touches.zarr"
    return indents, path, simulate_presses(indents, path)


@pytest.fixture(scope="module")
def other(small_skin):
    """Touches that are not in the training data."""
    solved = IndentSet(small_skin, touch_draws(small_skin), 40, seed=2, shape=(16, 16), chunk=40).solve(0)
    return TouchExamples(solved["change"], solved["depth"])


def test_the_number_of_chunks_in_memory(stored):
    """Six chunks of the store, the last of them half full, distributed as evenly as possible."""
    indents, path, found = stored
    assert StoredTouches(indents, path).rows("change").sizes == (110,)
    assert StoredTouches(indents, path, max_chunk_size=1).rows("change").sizes == (20, 20, 20, 20, 20, 10)
    rows = StoredTouches(indents, path, max_chunk_size=50).rows("change", "depth")
    assert rows.sizes == (40, 40, 30)
    chunks = [rows.chunk(number) for number in range(3)]
    for place, name in enumerate(("change", "depth")):
        whole = np.concatenate([one[place] for one in chunks])
        assert whole.dtype == np.float32
        assert np.array_equal(whole, found[name].to_numpy().astype(np.float32))


def test_fingerprints(stored, small_skin, tmp_path):
    """They depend on the touches, on how they are split, and on which arrays are read, but not on the place of the
    store.
    """
    indents, path, _ = stored
    own = StoredTouches(indents, path, max_chunk_size=50)
    again = IndentSet(small_skin, touch_draws(small_skin), 110, shape=(16, 16), chunk=20)
    simulate_presses(again, tmp_path / "again.zarr")
    assert StoredTouches(again, tmp_path / "again.zarr", 50).rows("depth").fingerprint == own.rows("depth").fingerprint
    other = IndentSet(small_skin, touch_draws(small_skin), 110, seed=1, shape=(16, 16), chunk=20)
    simulate_presses(other, tmp_path / "other.zarr")
    different = [
        own.rows("depth"),
        own.rows("change"),
        own.rows("depth", "change"),
        StoredTouches(indents, path).rows("depth"),
        StoredTouches(other, tmp_path / "other.zarr", 50).rows("depth"),
        MappedRows(own.rows("depth"), abs, "no less than zero"),
    ]
    assert len({rows.fingerprint for rows in different}) == len(different)


def test_incomplete_touches(stored, small_skin, tmp_path):
    def stop(now):
        if now.chunks == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_presses(stored[0], tmp_path / "some.zarr", progress=stop)
    with pytest.raises(ValueError, match=r"path: 2 of 6 chunks .* are simulated"):
        StoredTouches(stored[0], tmp_path / "some.zarr")


def test_mean_and_deviation(stored):
    indents, path, found = stored
    change = found["change"].to_numpy().astype(np.float32).astype(float)
    mean, deviation = mean_and_deviation(StoredTouches(indents, path, max_chunk_size=50).rows("change"))
    assert np.allclose(mean, change.mean(axis=0), rtol=1e-12, atol=1e-15)
    assert np.allclose(deviation, change.std(axis=0), rtol=1e-12)


def test_chunks_are_read_as_arrays_are_given(stored):
    """For one chunk: the same bits in the same order, so that training has the same rows."""
    indents, path, found = stored
    arrays, touches = TouchExamples(found["change"].to_numpy(), found["depth"].to_numpy()), StoredTouches(indents, path)
    for names in (("change",), ("change", "depth")):
        given, read = arrays.rows(*names), touches.rows(*names)
        assert given.sizes == read.sizes
        assert bits(given.chunk(0)) == bits(read.chunk(0))


class Stopped(Exception):
    pass


class Until(TrainingRuns):
    """Training up to the stage whose name begins with `unwanted`."""

    unwanted = ""

    def run(self, name, network, objective, training, validation):
        if name == self.unwanted:
            raise Stopped
        return super().run(name, network, objective, training, validation)


class Looked(TrainingRuns):
    """Training that does nothing but record the objectives for some rows, as numbers for the first stage, else as
    shapes.
    """

    losses: dict[str, Any]

    def run(self, name, network, objective, training, validation):
        batch = jax.tree.map(lambda one: jnp.asarray(one[:20]), training.chunk(2))
        given = batch, jax.tree.map(jnp.asarray, validation)

        def asked(batch, held):
            return objective.loss(network, batch, self.key)[0], objective.held_out(network, held)

        found = jax.jit(asked)(*given) if name == "voltages" else jax.eval_shape(asked, *given)
        self.losses[name] = *found, objective.trained
        return TrainingResult(network, Course([1], [1.0], [1.0]), "done")


@pytest.mark.slow
def test_the_objectives_of_the_three_stages(stored, other, small_skin, monkeypatch):
    """Untrained, the first stage reconstructs nothing. The last starts from the first's results, which are frozen."""
    random = np.random.default_rng(0)
    monkeypatch.setattr(
        "jeit.touch.networks.three_stage_network._draw_weights",
        lambda key, shape, inputs: jnp.asarray(random.normal(size=shape) * np.sqrt(2 / inputs), jnp.float32),
    )
    indents, path, _ = stored
    runs = Looked(PLAN, jax.random.key(0))
    runs.losses = {}
    found = train_three_stages(StoredTouches(indents, path, max_chunk_size=50), other, 1e-3, runs)
    assert list(runs.losses) == list(found.courses) == ["voltages", "maps", "projection"]
    assert all(loss.shape == () and held.shape == (40,) for loss, held, _ in runs.losses.values())
    # Standardised changes have a mean square of about one, and so has the error of an untrained network.
    assert 0.5 < runs.losses["voltages"][0] < 5
    assert runs.losses["voltages"][1].min() > 0
    trained = runs.losses["projection"][2]
    assert any(jax.tree.leaves(trained.projection))
    assert not any(jax.tree.leaves((trained.mean, trained.deviation, trained.encoder, trained.decoder)))
    assert eqx.tree_equal(found.network.decoder, found.courses["maps"].network.decoder)
    assert eqx.tree_equal(found.network.encoder, found.courses["voltages"].network.encoder)
    assert ImageNetwork.from_skin(found.network, small_skin, 1e-3, (16, 16)).design == "three-stages"


@pytest.fixture(scope="module")
def three_stages(stored, other, tmp_path_factory):
    """Trains the paper's network on three chunks, up to one of its stages, in one folder. Also returns the chunks that
    were read.
    """
    indents, path, _ = stored
    folder, loaded = tmp_path_factory.mktemp("trained"), []
    touches = StoredTouches(indents, path, max_chunk_size=50)
    read = touches.read
    touches.read = lambda name, number: loaded.append((name, number)) or read(name, number)

    def train(unwanted=""):
        loaded.clear()
        runs = Until(PLAN, jax.random.key(0), folder)
        runs.unwanted = unwanted
        return train_three_stages(touches, other, 1e-3, runs), loaded

    return train, folder


@pytest.fixture(scope="module")
def voltages(three_stages):
    train, folder = three_stages
    with pytest.raises(Stopped):
        train("maps")
    return {one.name for one in folder.iterdir()}


@pytest.fixture(scope="module")
def maps(three_stages, voltages):
    train, folder = three_stages
    with pytest.raises(Stopped):
        train("projection")
    return {one.name for one in folder.iterdir()} - voltages


@pytest.fixture(scope="module")
def paper(three_stages, maps):
    train, _ = three_stages
    found, loaded = train()
    return found, list(loaded)


@pytest.mark.slow
def test_the_state_of_a_training_has_its_name(voltages):
    assert voltages == {"voltages.training"}


@pytest.mark.slow
def test_a_later_training_has_its_own_state(maps):
    assert maps == {"maps.training"}


@pytest.mark.slow
def test_three_trainings_of_the_paper_s_network(paper, small_skin):
    """On a set larger than memory, whose three chunks are read one by one. The last stage starts from the results of
    the first.
    """
    found, loaded = paper
    assert set(found.courses) == {"voltages", "maps", "projection"}
    # The saved results of the first two are not trained again. Their mean is that of all chunks.
    assert {name for name, _ in loaded} == {"change", "depth"}
    assert {number for name, number in loaded if name == "depth"} == {0, 1, 2}
    assert len([number for name, number in loaded if name == "depth"]) <= 3 * PLAN.epochs
    an_epoch = 2 + 2 + 1
    assert all(one.course.steps == [an_epoch * (1 + k) for k in range(PLAN.epochs)] for one in found.courses.values())
    assert all(one.course.validation[-1] < 0.9 * one.course.validation[0] for one in found.courses.values())
    assert eqx.tree_equal(found.network.decoder, found.courses["maps"].network.decoder)
    assert eqx.tree_equal(found.network.encoder, found.courses["voltages"].network.encoder)
    assert ImageNetwork.from_skin(found.network, small_skin, 1e-3, (16, 16)).design == "three-stages"


@pytest.mark.slow
def test_the_paper_s_network_learns_from_voltages(stored, other):
    """Trained on the maps of other touches it learns nothing."""
    found = stored[2]
    right = TouchExamples(found["change"].to_numpy(), found["depth"].to_numpy())
    runs = TrainingRuns(TrainingPlan(rate=3e-3, batch=20, epochs=12, patience=12), jax.random.key(1))
    own, lost = (
        train_three_stages(taught, other, 1e-3, runs).courses["projection"].course
        for taught in (right, shuffle_pairs(right))
    )
    assert min(own.validation) < min(lost.validation)


def test_shuffled_maps_belong_to_other_touches(other):
    lost = shuffle_pairs(other)
    assert np.array_equal(lost.change, other.change)
    assert not np.array_equal(lost.depth, other.depth)
    assert np.array_equal(np.sort(lost.depth.sum(axis=(1, 2))), np.sort(other.depth.sum(axis=(1, 2))))


@pytest.mark.slow
def test_training_interrupted_between_chunks_continues_to_the_same_bits(paper, stored, other, tmp_path):
    messages = []

    def stop(message):
        messages.append(message)
        if len(messages) == 2 * PLAN.epochs + 1:
            raise Stopped

    def train():
        touches = StoredTouches(stored[0], stored[1], max_chunk_size=50)
        return train_three_stages(touches, other, 1e-3, TrainingRuns(PLAN, jax.random.key(0), tmp_path, stop))

    with pytest.raises(Stopped):
        train()
    assert bits(train().network) == bits(paper[0].network)
