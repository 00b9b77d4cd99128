"""Work of NumPy shared between cores: results do not depend on the threads, and the BLAS settings are restored."""

import functools
import gc
import threading
import time
import warnings
import weakref

import numpy as np
import pytest
import sparse_problems
import threadpoolctl

from jeit_solvers import analyse, check_not_abandoned, cores, factorise, on_cores, results_on_cores
from jeit_solvers.cores import blas, one_thread_of_blas, parts_for_cores
from jeit_solvers.engines import on_host
from jeit_solvers.sparse import padded_fronts_jax


def threads_of_blas():
    return [one["num_threads"] for one in blas().info()]


def test_every_part_uses_one_thread_of_blas_and_nested_parts_run_serially():
    found, threads = np.zeros((6, 3)), []

    def part(row):
        def inner(column):
            found[row, column] += row + 10 * column

        on_cores(inner, range(3))
        threads.extend(threads_of_blas())

    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads_of_blas()
        on_cores(part, range(6))
        assert set(threads) == {1}
        assert 2 in before
        assert threads_of_blas() == before
    np.testing.assert_array_equal(found, np.arange(6)[:, None] + 10 * np.arange(3))


def test_any_thread_may_limit_the_blas():
    """Also one after the other, and if the first to begin is not the last to end."""
    with one_thread_of_blas():
        pass
    begun, ended, seen = threading.Event(), threading.Event(), []

    def long():
        with one_thread_of_blas():
            begun.set()
            ended.wait(10)
        seen.append(threads_of_blas())

    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads_of_blas()
        other = threading.Thread(target=long)
        other.start()
        begun.wait(10)
        assert set(threads_of_blas()) == {1}
        with one_thread_of_blas():
            ended.set()
            other.join()
            assert set(threads_of_blas()) == {1}
        assert set(seen[0]) == {1}
        assert threads_of_blas() == before
    # Limits set by others hold and are restored, even if the limit of jeit_solvers was used meanwhile.
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        with threadpoolctl.threadpool_limits(1, user_api="blas"):
            other = threading.Thread(target=lambda: on_cores(lambda _: None, range(2)))
            other.start()
            other.join()
            assert set(threads_of_blas()) == {1}
        assert threads_of_blas() == before


def test_an_error_in_a_part_is_raised_and_the_blas_threads_are_restored():
    def part(number):
        if number == 2:
            raise ValueError("the second")

    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads_of_blas()
        with pytest.raises(ValueError, match="the second"):
            on_cores(part, range(4))
        assert 2 in before
        assert threads_of_blas() == before


def test_a_free_core_helps_with_the_parts_of_a_part(monkeypatch):
    """The second part of the outer call ends at once; a thread then takes a part of the inner call of the first."""
    monkeypatch.setattr(cores, "_free_cores", functools.cache(lambda process: cores._FreeCores(2)))
    threads, is_free = set(), threading.Event()

    def inner(number):
        threads.add(threading.get_ident())
        if number == 0:
            return is_free.wait(10)  # set by the other thread only
        is_free.set()
        return None

    def outer(number):
        if number == 0:
            time.sleep(0.02)
            on_cores(inner, range(2))

    on_cores(outer, range(2))
    assert is_free.is_set()
    assert len(threads) == 2
    assert results_on_cores(lambda number: number**2, range(5)) == [0, 1, 4, 9, 16]


def test_a_thread_that_waits_lends_its_core():
    free_cores = cores._FreeCores(1)
    assert free_cores.acquire()
    assert not free_cores.acquire()
    with free_cores.lend():
        assert free_cores.acquire()
        free_cores.release()
    assert not free_cores.acquire()


def test_there_is_at_most_one_more_thread_than_cores():
    free = cores._FreeCores(2)
    for _ in range(3):  # after threads have ended, as many may begin
        assert [free.acquire(), free.acquire(), free.acquire()] == [True, True, False]
        with free.lend():
            assert free.acquire()
            with free.lend():
                assert not free.acquire()
            free.release()
        free.release()
        free.release()


def test_arrays_of_parts_are_freed_at_once():
    """Not when garbage is collected: gigabytes would remain until then."""
    array = np.ones(3)
    reference = weakref.ref(array)
    gc.disable()
    try:
        on_cores(functools.partial(lambda array, part: array.sum() + part, array), range(4))
        del array
        assert reference() is None
    finally:
        gc.enable()


def test_other_parts_end_when_one_raises_an_error(monkeypatch):
    monkeypatch.setattr(cores, "_free_cores", functools.cache(lambda process: cores._FreeCores(2)))
    failed, ended = threading.Event(), threading.Event()

    def endless():
        for _ in range(1000):
            check_not_abandoned()
            time.sleep(0.01)

    def part(number):
        if number == 0:
            on_cores(lambda _: failed.set() or time.sleep(0.05), range(1))
            raise ValueError("the first")
        failed.wait(10)
        try:
            on_cores(lambda _: endless(), range(2))
        finally:
            ended.set()

    check_not_abandoned()
    with pytest.raises(ValueError, match="the first"):
        on_cores(part, range(2))
    assert ended.wait(5)
    check_not_abandoned()


@pytest.mark.parametrize("number", [1, 2])
def test_parts_do_not_warn_of_nan(number):
    found = np.zeros(number)

    def part(number):
        found[number] = np.sqrt(-1.0 - number * np.ones(()))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        on_cores(part, range(number))
    assert np.isnan(found).all()


@pytest.mark.parametrize("number", [1, 2, 3, 7, 1000])
def test_parts_for_cores_cover_all_once(number):
    covered = np.concatenate([np.arange(number)[part] for part in parts_for_cores(number)])
    np.testing.assert_array_equal(covered, np.arange(number))


@pytest.mark.parametrize("case", [sparse_problems.box, sparse_problems.disk])
def test_a_factor_does_not_depend_on_the_distribution_of_its_fronts(case, monkeypatch):
    pattern, values, coordinates = case()
    plan, values = on_host((analyse(pattern, coordinates), values))
    alone = factorise(plan, values)
    monkeypatch.setattr(padded_fronts_jax, "_MIN_PARALLEL_ENTRIES", 0)
    monkeypatch.setattr(padded_fronts_jax, "parts_for_cores", lambda number: [slice(k, k + 1) for k in range(number)])
    shared = factorise(plan, values)
    for one, other in zip(alone.inverses + alone.lowers, shared.inverses + shared.lowers, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-14)
