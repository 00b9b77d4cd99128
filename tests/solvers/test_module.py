"""`Module`: its bound methods equal those of Equinox, and are cached."""

import copy
import pickle
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

from jeit_solvers.module import Module


class Line(eqx.Module):
    """A method bound by Equinox."""

    slope: np.ndarray
    offset: np.ndarray

    def at(self, x):
        """Value at x."""
        return self.slope * x + self.offset


class QuickLine(Module):
    """The same method, bound quickly."""

    slope: np.ndarray
    offset: np.ndarray
    then: Callable = eqx.field(static=True, default=abs)

    at = Line.at

    def twice(self, x):
        return self.then(self.at(self.at(x)))


ONE, OTHER = QuickLine(np.array(2.0), np.array(1.0)), QuickLine(np.array(-3.0), np.array(0.5))


def test_methods_belong_to_their_own_object():
    first, second, again = ONE.at, OTHER.at, ONE.at
    assert (first(1.0), second(1.0), again(2.0), OTHER.twice(1.0)) == (3.0, -2.5, 5.0, 8.0)
    assert first.__self__ is again.__self__ is ONE
    assert second.__self__ is OTHER


def test_bound_methods_equal_those_of_equinox():
    """The same type, name, docstring and leaves, so that they pass through transformations of JAX."""
    quick, slow = ONE.at, Line(ONE.slope, ONE.offset).at
    assert type(quick) is type(slow)
    assert (quick.__name__, quick.__doc__, quick.__module__) == (slow.__name__, slow.__doc__, slow.__module__)
    assert [float(leaf) for leaf in jax.tree.leaves(quick)] == [2.0, 1.0]
    assert eqx.filter_jit(quick)(3.0) == 7.0
    assert jax.jit(lambda method: method(3.0))(quick) == 7.0
    changed = eqx.tree_at(lambda method: method.__self__.slope, quick, np.array(4.0))
    assert (changed(1.0), ONE.at(1.0)) == (5.0, 3.0)
    for other in (copy.deepcopy(quick), pickle.loads(pickle.dumps(quick))):
        assert other(3.0) == 7.0
        assert other.__self__ is not ONE


def test_fields_that_are_functions_stay_unbound():
    assert ONE.then is abs
    assert ONE.__class__ is QuickLine


def test_binding_does_not_check_the_object_again(monkeypatch):
    """Equinox examines every leaf of the object whenever it binds a method."""
    slow, looked = Line(ONE.slope, ONE.offset), []
    assert ONE.at(0.0) == 1.0
    leaves = jax.tree_util.tree_leaves
    monkeypatch.setattr(jax.tree_util, "tree_leaves", lambda *given: looked.append(given) or leaves(*given))
    assert (slow.at(0.0), len(looked) > 0) == (1.0, True)
    looked.clear()
    assert (ONE.at(0.0), looked) == (1.0, [])
