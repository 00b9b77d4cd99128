"""Sets of presses: their random draws, their store, and their state after kill -9."""

import os
import signal
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from studies import contents, in_another_process

from jeit.design.study.lock import lock_store
from jeit.design.study.store import Store
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch.simulate.contact import (
    BarIndenter,
    DiscIndenter,
    PressDraws,
    PressedSkin,
    PressSet,
    ball_indenter,
    material,
    open_presses,
    press_sets,
    simulate_presses,
)

xarray = pytest.importorskip("xarray")
pytest.importorskip("zarr")
KEY = jax.random.key(0)

# The same in another process, which is killed while it writes its second chunk, after the voltages.
KILLED = """
import os, signal, sys
sys.path.insert(0, sys.argv[1])
from test_press_sets import small_set
from jeit.design.study.store import Store
from jeit.touch.simulate.contact import open_presses, press_sets, simulate_presses

presses = small_set()
data = open_presses(presses, sys.argv[3])  # no need to simulate again what is known

def known(presses, number):
    return {name: data[name].values[list(presses.chunks[number])] for name in presses.contents().arrays}

press_sets.solve_presses = known
write, calls = Store.write_array, []

def dying(self, name, rows, values):
    calls.append(name)
    write(self, name, rows, values)
    if len(calls) == 6:
        os.kill(os.getpid(), signal.SIGKILL)

Store.write_array = dying
simulate_presses(presses, sys.argv[2])
"""

# Presses touch every cell, so that one program serves all chunks.
EVERYWHERE = DiscIndenter(0.3)


def small_set(**options) -> PressSet:
    model = ForwardModel(Disk(0.05).mesh(num_points=150), BoundaryElectrodes(ring(0.05, 8), 0.008, 0.2), adjacent(8))
    draws = PressDraws([EVERYWHERE, DiscIndenter(0.2)], Disk(0.05), (0.5, 5.0), margin=0.01, at_once=2)
    return PressSet(PressedSkin(KEY, model, material("velostat")), draws, 16, chunk=8, **options)


@pytest.fixture(scope="module")
def presses():
    return small_set()


@pytest.fixture(scope="module")
def whole(presses, tmp_path_factory):
    path = tmp_path_factory.mktemp("presses") / "whole.zarr"
    simulate_presses(presses, path)
    return path


@pytest.fixture
def solved(monkeypatch):
    """Numbers of the chunks that are solved from now on."""
    numbers, solve = [], press_sets.solve_presses
    monkeypatch.setattr(
        press_sets, "solve_presses", lambda presses, number: numbers.append(number) or solve(presses, number)
    )
    return numbers


def test_draws_have_the_specified_distribution():
    draws = PressDraws([ball_indenter(0.02), BarIndenter(0.03, 0.01)], Disk(0.05), (0.1, 10.0), margin=0.01, at_once=3)
    touches = draws.draw(KEY, 3000)
    assert np.bincount([len(touch) for touch in touches]) == pytest.approx([0, 1000, 1000, 1000], abs=90)
    presses = [press for touch in touches for press in touch]
    radius = np.linalg.norm([press.position for press in presses], axis=1)
    assert radius.max() <= 0.04
    assert np.mean(radius**2) == pytest.approx(0.04**2 / 2, rel=0.03)
    load = np.log([press.load for press in presses])
    assert load.min() >= np.log(0.1)
    assert load.max() <= np.log(10)
    assert load.mean() == pytest.approx(0, abs=0.06)
    assert np.mean([press.indenter is draws.indenters[0] for press in presses]) == pytest.approx(0.5, abs=0.03)
    few, again = draws.draw(KEY, 50), draws.draw(KEY, 50)
    assert all(one[0].load == other[0].load for one, other in zip(few, again, strict=True))


def test_xarray_opens_the_set_and_its_frames_are_those_of_the_skin(presses, whole):
    data = open_presses(presses, whole)
    assert dict(data.sizes) == {"touch": 16, "channel": 40, "press": 2, "axis": 2}
    assert data.finished.values.all()
    assert np.isfinite(data.voltages.values).all()
    assert data.voltages.units == "V"
    count = np.isfinite(data.force.values).sum(axis=1)
    assert set(count) == {1, 2}
    made = presses.solve(1)
    np.testing.assert_array_equal(data.voltages.values[8:16], made["voltages"])
    np.testing.assert_array_equal(data.position.values[8:16], made["position"])
    # Apart from the press the frames are those at rest, with noise 80 dB below.
    rest = presses.skin.rest()
    assert np.abs(data.voltages.values / rest - 1).max() < 0.5


def test_a_finished_set_is_not_simulated_again(presses, whole, solved):
    before, reports = contents(whole), []
    simulate_presses(presses, whole, progress=reports.append)
    assert solved == []
    assert contents(whole) == before
    assert [now[:4] for now in reports] == [(16, 16, 2, 2)]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_one_process_at_a_time_simulates_a_set(presses, whole):
    with (
        lock_store(whole, "press set"),
        pytest.raises(ValueError, match=r"whole\.zarr is being written by this process .* resume the press set"),
    ):
        simulate_presses(presses, whole)
    (whole / "voltages" / "c" / "0.abc.partial").write_bytes(b"half")
    before = contents(whole)
    simulate_presses(presses, whole)
    assert set(before) - set(contents(whole)) == {"voltages/c/0.abc.partial"}


def test_stopped_within_a_chunk_and_resumed_the_store_is_the_same(presses, whole, tmp_path, solved, monkeypatch):
    """During the second chunk, after its voltages."""
    path, write, calls = tmp_path / "stopped.zarr", Store.write_array, []

    def stop(self, name, rows, values):
        calls.append(name)
        write(self, name, rows, values)
        if len(calls) == 6:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write_array", stop)
        with pytest.raises(KeyboardInterrupt):
            simulate_presses(presses, path)
    data = open_presses(presses, path)
    assert data.finished.values.sum() == 8
    assert np.isfinite(data.voltages.values[8:16]).all()  # written, but not marked as complete
    solved.clear()
    simulate_presses(presses, path)
    assert solved == [1]
    assert contents(path) == contents(whole)


@pytest.mark.slow
def test_killed_within_a_chunk_and_resumed_the_store_is_the_same(presses, whole, tmp_path, solved):
    path = tmp_path / "killed.zarr"
    ended = in_another_process(KILLED, Path(__file__).parent, path, whole, PYTHONPATH=os.pathsep.join(sys.path))
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    data = open_presses(presses, path)
    assert data.finished.values.sum() == 8
    assert np.isfinite(data.voltages.values[8:16]).all()  # written, but not marked as complete
    simulate_presses(presses, path)
    assert solved == [1]
    assert contents(path) == contents(whole)


@pytest.mark.slow
def test_workers_simulate_the_same(presses, whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        found = simulate_presses(presses, tmp_path / "far.zarr", client=client)
    exact = open_presses(presses, whole)
    np.testing.assert_array_equal(found.force.values, exact.force.values)
    np.testing.assert_allclose(found.voltages.values, exact.voltages.values, rtol=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda path: PressDraws([], Disk(0.05), (0.1, 1.0)), "indenters: give one"),
        (lambda path: PressDraws([0.1], Disk(0.05), (0.1, 1.0)), r"indenters\[0\] must be"),
        (lambda path: PressDraws([ball_indenter(0.01)], 0.05, (0.1, 1.0)), "outline must be"),
        (lambda path: PressDraws([ball_indenter(0.01)], Disk(0.05), (1.0, 0.1)), "load must be the least"),
        (lambda path: PressDraws([ball_indenter(0.01)], Disk(0.05), (0.1, 1.0), margin=0.06), "margin is 60 mm"),
        (lambda path: PressDraws([ball_indenter(0.01)], Disk(0.05), (0.1, 1.0), at_once=0), "at_once must be"),
        (lambda path: PressDraws(ball_indenter(0.01), Disk(0.05), (0.1, 1.0)), "indenters must be a list"),
        (lambda path: PressDraws([ball_indenter(0.01)], Disk(0.05), 1.0), "load must be the least"),
        (lambda path: PressDraws([ball_indenter(0.01)], Disk(0.05), ("a", "b")), "load must be the least"),
        (lambda path: PressDraws([ball_indenter(0.01)], Disk(0.05), (0.1, 1.0), margin=-0.01), "margin must be metres"),
        (lambda path: small_set().draws.draw(jax.random.key(0), 2.5), "number must be a whole number of touches"),
        (lambda path: PressSet(None, None, 1), "skin must be"),
        (
            lambda path: PressSet(small_set().skin, PressDraws([ball_indenter(0.01)], Disk(0.05), (0.1, 1e4)), 1),
            "into a layer",
        ),
        (lambda path: PressSet(small_set().skin, None, 1), "draws must be"),
        (lambda path: PressSet(small_set().skin, small_set().draws, 0), "number must be"),
        (lambda path: small_set(seed=1.5), "seed must be a whole number"),
        (lambda path: PressSet(small_set().skin, small_set().draws, 1, held=-1.0), "held must be seconds"),
        (lambda path: PressSet(small_set().skin, small_set().draws, 1, elapsed="1"), "elapsed must be seconds"),
        (lambda path: simulate_presses(small_set(), None), "path must be"),
        (lambda path: simulate_presses(small_set(seed=1), path), "holds the results of another press set"),
    ],
)
def test_impossible_sets_are_refused(whole, call, message):
    with pytest.raises(ValueError, match=message):
        call(whole)
