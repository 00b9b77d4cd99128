"""Touches read from a store, some of its chunks at a time, and trained on."""

import jax
import numpy as np
import pytest
from small_networks import bits

from jeit.simulate import IndentSet, simulate_presses
from jeit.touch.networks.examples import Examples, StoredTouches
from jeit.touch.networks.sensed import Sensed
from jeit.touch.networks.three_stages import ThreeStages
from jeit.touch.networks.touches import touch_draws
from jeit.touch.networks.training import Runs, mean_and_deviation, train_three_stages, train_unrolled
from jeit.touch.networks.unrolled import Unrolled
from jeit.touch.training import MappedRows, Plan

PLAN = Plan(rate=2e-3, batch=20, epochs=2, seconds=0.0)


@pytest.fixture(scope="module")
def stored(small_skin, tmp_path_factory):
    indents = IndentSet(small_skin, touch_draws(small_skin), 110, shape=(16, 16), chunk=20)
    path = tmp_path_factory.mktemp("stored") / "touches.zarr"
    return indents, path, simulate_presses(indents, path)


def test_as_many_chunks_as_are_in_memory_at_once(stored):
    """Six chunks of the store, the last of them half full, as even as may be."""
    indents, path, found = stored
    assert StoredTouches(indents, path).rows("change").sizes == (110,)
    assert StoredTouches(indents, path, at_once=1).rows("change").sizes == (20, 20, 20, 20, 20, 10)
    rows = StoredTouches(indents, path, at_once=50).rows("change", "depth")
    assert rows.sizes == (40, 40, 30)
    chunks = [rows.chunk(number) for number in range(3)]
    for place, name in enumerate(("change", "depth")):
        whole = np.concatenate([one[place] for one in chunks])
        assert whole.dtype == np.float32
        assert np.array_equal(whole, found[name].to_numpy().astype(np.float32))


def test_fingerprints(stored, small_skin, tmp_path):
    """Of the touches, how they are parted, and which arrays are read; the same wherever the store lies."""
    indents, path, _ = stored
    own = StoredTouches(indents, path, at_once=50)
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


def test_touches_that_are_not_all_there(stored, small_skin, tmp_path):
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
    mean, deviation = mean_and_deviation(StoredTouches(indents, path, at_once=50).rows("change"))
    assert np.allclose(mean, change.mean(axis=0), rtol=1e-12, atol=1e-15)
    assert np.allclose(deviation, change.std(axis=0), rtol=1e-12)


class Stopped(Exception):
    pass


@pytest.mark.parametrize("design", ["three-stages", "unrolled"])
def test_a_set_larger_than_memory(design, stored, small_skin, tmp_path):
    """Both designs are trained on three chunks, and go on amid them to the same bits."""
    indents, path, found = stored
    held = Examples(found["change"].to_numpy()[:30], found["depth"].to_numpy()[:30])
    channels = held.change.shape[1]
    loaded = []

    def train(folder, progress=None):
        touches = StoredTouches(indents, path, at_once=50)
        read = touches.read
        touches.read = lambda name, number: loaded.append((name, number)) or read(name, number)
        runs = Runs(PLAN, jax.random.key(0), folder, progress)
        if design == "three-stages":
            return train_three_stages(touches, held, 1e-3, runs)
        start = Unrolled(channels, (16, 16), key=jax.random.key(1))
        sensed = Sensed(np.zeros((channels, 256)), np.zeros((16, channels)), (16, 16))
        return train_unrolled(start, sensed, touches, held, 1e-3, runs)

    whole = train(None)
    assert {number for _, number in loaded} == {0, 1, 2}
    trainings = 3 if design == "three-stages" else 1
    assert all(len(one.course.steps) == 2 and one.course.steps[-1] == 10 for one in whole.courses.values())
    assert len(whole.courses) == trainings
    told = []

    def stop(said):
        told.append(said)
        if len(told) == 2 * trainings - 1:
            raise Stopped

    with pytest.raises(Stopped):
        train(tmp_path, stop)
    again = train(tmp_path, stop)
    assert bits(again.network) == bits(whole.network)


def test_chunks_are_learnt_from_as_arrays_are(stored):
    """Of one chunk: the same bits, whether it is read from a store or given."""
    indents, path, found = stored
    held = Examples(found["change"].to_numpy()[:30], found["depth"].to_numpy()[:30])
    arrays = Examples(found["change"].to_numpy(), found["depth"].to_numpy())
    runs = Runs(PLAN, jax.random.key(0))
    one, other = (train_three_stages(rows, held, 1e-3, runs) for rows in (arrays, StoredTouches(indents, path)))
    assert bits(one.network) == bits(other.network)
    assert isinstance(one.network, ThreeStages)
