"""Results that are kept: known again by the very arrays and the kind of tree they came of, and only so many."""

import numpy as np

from jeit_solvers.engines import Recent


def test_the_same_arrays_in_the_same_tree_are_known_again():
    made = []

    def make(tree):
        made.append(list(tree))
        return len(made)

    keep, array = Recent(make, size=2), np.ones(3)
    assert [keep({"a": array}), keep({"a": array})] == [1, 1]
    assert keep({"b": array}) == 2, "another tree of the same arrays"
    assert keep({"a": array.copy()}) == 3, "another array, if equal"
    assert [keep({"b": array}), keep({"a": array})] == [2, 4], "the first is forgotten"
