"""A cache of results: looked up by the identity of arrays and the structure of their tree, and limited in number."""

import numpy as np
import pytest

from jeit_solvers.engines import RecentResultsCache


def test_the_same_arrays_in_the_same_tree_are_found():
    made = []

    def make(tree):
        made.append(list(tree))
        return len(made)

    keep, array = RecentResultsCache(make, size=2), np.ones(3)
    assert [keep({"a": array}), keep({"a": array})] == [1, 1]
    assert keep({"b": array}) == 2, "another tree of the same arrays"
    assert keep({"a": array.copy()}) == 3, "another array, if equal"
    assert [keep({"b": array}), keep({"a": array})] == [2, 4], "the first is forgotten"


@pytest.mark.parametrize("size", [1, 3])
def test_the_number_of_results_is_limited(size):
    keep = RecentResultsCache(lambda array: object(), size)
    arrays = [np.ones(1) for _ in range(5)]
    results = [keep(array) for array in arrays]
    again = [keep(array) is result for array, result in zip(arrays[::-1], results[::-1], strict=True)]
    assert again[:size] == [True] * size
    assert not any(again[size:])


def test_identical_arguments_are_not_examined(monkeypatch):
    keep, tree = RecentResultsCache(lambda tree: object()), {"a": np.ones(2)}
    kept = keep(tree)
    monkeypatch.setattr("jax.tree.flatten", None)
    assert keep(tree) is kept
