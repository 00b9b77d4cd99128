"""One model used from eight threads at once gives the results of one thread, bit for bit."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
import pytest
from extremes import KINDS, compiled, uneven

from jeit.inverse import Imager, one_step

THREADS = 8


def assert_as_alone(shared: Callable[[int], Any], alone: Callable[[int], Any], turns: int = THREADS) -> None:
    """`shared` is unused so far, so that all its caches are filled while eight threads use it at once."""
    gate = threading.Barrier(THREADS)

    def work(thread: int) -> dict[int, Any]:
        gate.wait(60)
        numbers = [(thread + turn) % THREADS for turn in range(turns)]
        return {number: jax.tree.map(np.asarray, shared(number)) for number in numbers}

    with ThreadPoolExecutor(THREADS) as pool:
        found = list(pool.map(work, range(THREADS)))
    expected = [jax.tree.map(np.asarray, alone(number)) for number in range(THREADS)]
    for number, one in (pair for each in found for pair in each.items()):
        assert jax.tree.all(jax.tree.map(np.array_equal, one, expected[number]))


@pytest.fixture(params=["boundary", pytest.param("face", marks=pytest.mark.slow)], scope="module")
def make(request):
    return lambda: KINDS[request.param](1.0)


@pytest.fixture(scope="module")
def conductivities(make):
    return [(1 + 0.1 * number) * uneven(make()) for number in range(THREADS)]


@pytest.mark.parametrize("quantity", ["voltages", "voltages_and_jacobian", "transfer_impedance", "fields"])
def test_one_model(make, conductivities, quantity):
    shared, alone = (getattr(make(), quantity) for _ in range(2))
    assert_as_alone(lambda k: shared(conductivities[k]), lambda k: alone(conductivities[k]))


def test_a_compiled_model(make, conductivities):
    shared, alone = make(), make()
    assert_as_alone(lambda k: compiled(shared, conductivities[k]), lambda k: compiled(alone, conductivities[k]))


def test_models_made_and_imaged_in_threads(make, conductivities):
    def image(number):
        model = make()
        difference = np.asarray(model.voltages(conductivities[number]) - model.voltages(1.0))
        return one_step(model, 1.0).image(difference)

    assert_as_alone(image, image, turns=1)


def test_one_reconstruction(conductivities, make):
    model = make()
    frames = [np.asarray(model.voltages(one)) for one in conductivities]
    rest = np.asarray(model.voltages(1.0))
    shared, alone = (one_step(make(), 1.0) for _ in range(2))
    assert_as_alone(lambda k: shared.image(frames[k] - rest), lambda k: alone.image(frames[k] - rest))


@pytest.mark.slow
def test_one_imager(conductivities, make):
    frames = [np.asarray(make().voltages(one)) for one in conductivities]
    imagers = [Imager.create(make(), 1.0, noise=1e-6) for _ in range(2)]
    usable = np.ones(len(frames[0]), bool)

    def estimate(imager, number):
        return imager.estimate(frames[number], imager.weighing(usable), imager.start)

    assert_as_alone(lambda k: estimate(imagers[0], k), lambda k: estimate(imagers[1], k))
