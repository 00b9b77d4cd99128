"""Fronts of exact size: found, eliminated and solved as in dense algebra, in NumPy and in compiled programs."""

import threading
from dataclasses import replace

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import pytest
import sparse_problems
from sparse_problems import dense

from jeit_solvers import (
    ConjugateGradient,
    FrontalCholesky,
    SparseCholesky,
    SparseSymmetric,
    SparsityPattern,
    choose_solver,
    factorise_fronts,
    find_fronts,
    on_cores,
)
from jeit_solvers.sparse import choose, exact_fronts, exact_fronts_numpy
from jeit_solvers.sparse.operator import LastMatrixCache

TOLERANCE = 5e-15
SPREAD = (sparse_problems.disk, sparse_problems.box)


def of_many_fronts(monkeypatch):
    """Use leaves of a few rows, so that small problems have several levels, and threads for any amount of work."""
    monkeypatch.setattr(exact_fronts, "_LEAF_SIZE", 8)
    monkeypatch.setattr(exact_fronts_numpy, "_MIN_PARALLEL_OPERATIONS", 0)
    monkeypatch.setattr(exact_fronts_numpy, "_NUM_ROWS_ADDED_AT_ONCE", 3)
    monkeypatch.setattr(exact_fronts, "_CACHED_FRONTS", {})


def problem(case):
    pattern, values, coordinates = case()
    vectors = np.random.default_rng(0).normal(size=(pattern.size, 3))
    return pattern, np.asarray(values), coordinates, vectors


@pytest.mark.parametrize("small_fronts", [False, True])
@pytest.mark.parametrize("case", sparse_problems.PROBLEMS, ids=lambda case: case.__name__)
def test_every_problem_is_solved_to_roundoff(case, small_fronts, monkeypatch):
    pattern, values, coordinates, vectors = problem(case)
    if small_fronts:
        of_many_fronts(monkeypatch)
    found = find_fronts(pattern, coordinates)
    for given in (values, values * (1 + 0.3j * np.sin(np.arange(len(values))))):
        matrix, factor = dense(pattern, given), factorise_fronts(found, given)
        assert factor.positive_definite
        solution = factor.solve(vectors)
        residual = np.linalg.norm(matrix @ solution - vectors) / np.linalg.norm(matrix) / np.linalg.norm(solution)
        assert residual < TOLERANCE
        form = vectors.T @ solution
        np.testing.assert_allclose(factor.quadratic_form(vectors), form, rtol=0, atol=1e-11 * abs(form).max())


@pytest.mark.parametrize("case", SPREAD)
def test_fronts_form_a_tree_that_holds_every_entry_once(case, monkeypatch):
    of_many_fronts(monkeypatch)
    pattern, _, coordinates, _ = problem(case)
    found = exact_fronts._build_fronts(
        pattern.size, *map(np.asarray, (pattern.rows, pattern.columns)), coordinates, b""
    )
    assert sorted(found.order) == list(range(pattern.size))
    assert sorted(found.entry_order) == list(range(pattern.num_entries))
    assert [one.entries.stop - one.entries.start for one in found.fronts] == [
        len(one.panel_indices) for one in found.fronts
    ]
    children = [child for one in found.fronts for child in one.children]
    assert sorted(children) == list(range(len(found.fronts) - 1))
    assert all(child < number for number, one in enumerate(found.fronts) for child in one.children)
    starts = [one.start for step in found.steps for one in step]
    assert starts == sorted(starts)
    assert len(found.steps) == 4
    assert sum(one.pivots for one in found.fronts) == pattern.size
    # No row that elimination changes is missing in a border.
    lower = np.linalg.cholesky(dense(pattern, np.asarray(case()[1]))[np.ix_(found.order, found.order)])
    for one in found.fronts:
        below = lower[one.first + one.pivots :, one.first : one.first + one.pivots]
        rows = np.flatnonzero(abs(below).max(axis=1, initial=0) > 1e-14) + one.first + one.pivots
        assert set(rows) <= set(one.rows.tolist())
    assert "operations)" in repr(found)


def test_known_fronts_are_reused_and_others_are_not():
    pattern, _, coordinates, _ = problem(sparse_problems.disk)
    found = find_fronts(pattern, coordinates)
    assert find_fronts(pattern, coordinates) is found
    assert replace(found, order=found.order[::-1]) == found
    assert hash(replace(found)) == hash(found)
    assert find_fronts(pattern) != found
    with pytest.raises(ValueError, match=r"`coordinates` must have shape \(n, d\) with n = 90"):
        find_fronts(pattern, coordinates[1:])


@pytest.mark.parametrize("entry", [-1.0, np.nan])
def test_a_matrix_that_is_not_positive_definite_gives_nan(entry, monkeypatch):
    of_many_fronts(monkeypatch)
    pattern, values, coordinates, vectors = problem(sparse_problems.disk)
    values = np.array(values)
    values[17] = entry
    found = find_fronts(pattern, coordinates)
    assert len(found.fronts) > 7
    for given in (values, values.astype(complex)):
        factor = factorise_fronts(found, given)
        assert not factor.positive_definite
        assert np.isnan(factor.solve(vectors)).any()
        assert np.isnan(factor.quadratic_form(vectors)).any()
    solver = FrontalCholesky(find_fronts(pattern, coordinates))
    solution = lineax.linear_solve(SparseSymmetric(jnp.asarray(values), pattern), vectors[:, 0], solver, throw=False)
    assert np.isnan(solution.value).any()


class Compiled:
    """The disk solved in compiled programs, which call NumPy."""

    pattern, values, coordinates, vectors = problem(sparse_problems.disk)
    with pytest.MonkeyPatch.context() as patch:
        of_many_fronts(patch)
        solver = FrontalCholesky(find_fronts(pattern, coordinates))

    @classmethod
    def energy(cls, values, vector):
        operator = SparseSymmetric(values, cls.pattern)
        return vector @ lineax.linear_solve(operator, vector, cls.solver).value


def test_compiled_programs_and_their_derivatives():
    vector, values = jnp.asarray(Compiled.vectors[:, 0]), jnp.asarray(Compiled.values)
    solution = np.linalg.solve(dense(Compiled.pattern, values), vector)
    energy, slope = jax.jit(jax.value_and_grad(Compiled.energy))(values, vector)
    np.testing.assert_allclose(energy, vector @ solution, rtol=1e-12)
    rows, columns = np.asarray(Compiled.pattern.rows), np.asarray(Compiled.pattern.columns)
    expected = -solution[rows] * solution[columns] * np.where(rows == columns, 1, 2)
    np.testing.assert_allclose(slope, expected, rtol=1e-9, atol=1e-12 * abs(expected).max())
    several = values * (1 + np.arange(3)[:, None])
    batch = jax.jit(jax.vmap(Compiled.energy, in_axes=(0, None)))(several, vector)
    np.testing.assert_allclose(batch, energy / (1 + np.arange(3)), rtol=1e-12)
    single = jax.jit(Compiled.energy)(values.astype("float32"), vector.astype("float32"))
    assert single.dtype == "float32"
    np.testing.assert_allclose(single, energy, rtol=1e-5)


def test_eight_threads_solve_separate_matrices():
    """Compiled programs that wait for NumPy while others run and factorise other matrices."""
    solved = jax.jit(Compiled.energy)
    vector, found = jnp.asarray(Compiled.vectors[:, 0]), np.full(8, np.nan)

    def work(number):
        for _ in range(3):
            found[number] = solved(Compiled.values * (1 + number), vector)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(8)]
    for one in threads:
        one.start()
    for one in threads:
        one.join(60)
    assert not any(one.is_alive() for one in threads)
    energy = vector @ np.linalg.solve(dense(Compiled.pattern, Compiled.values), vector)
    np.testing.assert_allclose(found * (1 + np.arange(8)), energy, rtol=1e-12)


def test_more_programs_than_cores_may_call_numpy_at_once(monkeypatch):
    """Calls come from threads of XLA when programs run other operations besides, with arrays of over 100 kB, which JAX
    copies in such threads, inside and outside of parts on cores."""
    of_many_fronts(monkeypatch)
    monkeypatch.setattr(exact_fronts, "_LEAF_SIZE", 128)
    size = 8000
    rows = np.concatenate([np.arange(size), np.arange(1, size)])
    columns = np.concatenate([np.arange(size), np.arange(size - 1)])
    pattern = SparsityPattern.from_entries(rows, columns, size)
    values = pattern.assemble(np.where(rows == columns, 2.1, -1.0))
    chain, vectors = find_fronts(pattern, np.arange(size)[:, None]), np.random.default_rng(0).normal(size=(size, 20))
    twice = jax.jit(
        lambda given, b: (
            exact_fronts_numpy.solve_with_cached_factor(chain, given, b).sum(),
            exact_fronts_numpy.solve_with_cached_factor(chain, 2 * given, jnp.sin(b)).sum(),
        )
    )
    found = np.full((12, 2), np.nan)

    def part(number):
        found[number] = [float(one) for one in twice(values * (1 + number), vectors)]

    threads = [threading.Thread(target=part, args=(number,), daemon=True) for number in range(8)]
    threads.append(threading.Thread(target=on_cores, args=(part, range(8, 12)), daemon=True))
    for one in threads:
        one.start()
    for one in threads:
        one.join(60)
    assert not any(one.is_alive() for one in threads)
    np.testing.assert_allclose(found * (1 + np.arange(12))[:, None], np.tile(found[0], (12, 1)), rtol=1e-9)


def test_right_hand_sides_of_every_kind():
    factor = factorise_fronts(Compiled.solver.fronts, Compiled.values)
    matrix, vectors = dense(Compiled.pattern, Compiled.values), Compiled.vectors
    for given in (
        vectors * (1 + 2j),
        vectors[:, :0],
        np.asfortranarray(vectors),
        vectors[:, ::-1],
        vectors.astype(int),
    ):
        np.testing.assert_allclose(matrix @ factor.solve(given), given, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"shape \(n, k\) with n = 90; got \(90,\)"):
        factor.solve(vectors[:, 0])
    with pytest.raises(ValueError, match=r"values must have shape"):
        factorise_fronts(Compiled.solver.fronts, Compiled.values[1:])


def test_the_last_factor_is_reused_unless_it_is_large(monkeypatch):
    made = []
    monkeypatch.setattr(exact_fronts_numpy, "_LAST_FACTOR", LastMatrixCache())
    plain = factorise_fronts
    monkeypatch.setattr(exact_fronts_numpy, "factorise_fronts", lambda *given: made.append(1) or plain(*given))
    given = find_fronts(Compiled.pattern, Compiled.coordinates), Compiled.values, Compiled.vectors
    for _ in range(2):
        exact_fronts_numpy.solve_with_cached_factor(*given)
    assert len(made) == 1
    exact_fronts_numpy.solve_with_cached_factor(given[0], 2 * Compiled.values, Compiled.vectors)
    assert len(made) == 2
    monkeypatch.setattr(exact_fronts_numpy, "_MAX_CACHED_ENTRIES", 0)
    for _ in range(2):
        exact_fronts_numpy.solve_with_cached_factor(*given)
    assert len(made) == 4


def test_fronts_of_another_pattern_are_refused():
    other, values, _, _ = problem(sparse_problems.chain)
    with pytest.raises(ValueError, match=r"the fronts are for a pattern of 90 rows"):
        Compiled.solver.init(SparseSymmetric(jnp.asarray(values), other), {})


def test_the_choice_depends_on_size_memory_and_device(monkeypatch):
    pattern, values, coordinates, vectors = problem(sparse_problems.box)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    small = choose_solver(pattern, coordinates)
    assert isinstance(small, SparseCholesky)
    assert small.reason.startswith("direct: a factorisation takes")
    monkeypatch.setattr(choose, "_MAX_COMPILED_OPERATIONS_CPU", 0)
    large = choose_solver(pattern, coordinates)
    assert isinstance(large, FrontalCholesky)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert isinstance(choose_solver(pattern, coordinates), SparseCholesky)
    monkeypatch.undo()
    monkeypatch.setattr(choose, "multigrid_is_installed", lambda: False)
    too_large = choose_solver(pattern, coordinates, memory_limit=1e3)
    assert isinstance(too_large, ConjugateGradient)
    assert "MB are allowed" in too_large.reason
    expected = np.linalg.solve(dense(pattern, values), vectors[:, 0])
    for solver in (large, too_large):
        found = lineax.linear_solve(SparseSymmetric(jnp.asarray(values), pattern), vectors[:, 0], solver).value
        np.testing.assert_allclose(found, expected, rtol=1e-7)
