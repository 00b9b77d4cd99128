"""Models, reconstructions, imagers and skins give the same bits after pickling (by Dask, too) or copying."""

import copy
import pickle
import subprocess
import sys

import cloudpickle
import jax
import numpy as np
import pytest
from extremes import KINDS, compiled, uneven

from jeit.design import Skin
from jeit.forward import ForwardModel
from jeit.inverse import Imager, one_step
from jeit.layout import named_layout
from jeit.mesh import Rectangle

WAYS = {
    "pickle": lambda one: pickle.loads(pickle.dumps(one)),
    "cloudpickle": lambda one: cloudpickle.loads(cloudpickle.dumps(one)),
    "deep copy": copy.deepcopy,
    "copy": copy.copy,
}


def assert_same_bits(original, use):
    """Before first use, with empty caches, and afterwards."""
    fresh = {way: change(original) for way, change in WAYS.items()}
    expected = jax.tree.map(np.asarray, use(original))
    for found in (*map(use, fresh.values()), *(use(change(original)) for change in WAYS.values())):
        assert jax.tree.all(jax.tree.map(np.array_equal, jax.tree.map(np.asarray, found), expected))


@pytest.mark.parametrize("kind", KINDS)
def test_models(kind):
    model = KINDS[kind](1.0)
    conductivity = uneven(model)
    assert_same_bits(model, lambda one: one.voltages_and_jacobian(conductivity))
    if kind == "boundary":
        assert_same_bits(model, lambda one: compiled(one, conductivity))


def assert_equal(original):
    """Compare all fields without using the object."""
    for change in WAYS.values():
        again = change(original)
        assert jax.tree.structure(again) == jax.tree.structure(original), "and compiled code takes it for the same"
        assert jax.tree.all(jax.tree.map(np.array_equal, again, original))


def test_a_model_with_conjugate_gradients():
    model = KINDS["boundary"](1.0)
    assert_equal(ForwardModel(model.mesh, model.electrodes, model.protocol, solver="cg"))


def test_reconstructions():
    model = KINDS["boundary"](1.0)
    frame, rest = (np.asarray(model.voltages(one)) for one in (uneven(model), 1.0))
    assert_same_bits(one_step(model, 1.0), lambda one: one.image(frame - rest))


@pytest.fixture(scope="module")
def imager():
    return Imager.create(KINDS["boundary"](1.0), 1.0, noise=1e-6)


def test_imagers(imager):
    assert_equal(imager)


@pytest.mark.slow
def test_imagers_in_use(imager):
    frame = np.asarray(KINDS["boundary"](1.0).voltages(uneven(KINDS["boundary"](1.0))))
    usable = np.ones(len(frame), bool)
    assert_same_bits(imager, lambda one: one.estimate(frame, one.weighing(usable), one.start))


def test_skins():
    skin = Skin.create(named_layout("grid-4x4", Rectangle(0.1, 0.1)), num_layers=0, cell_size=8e-3)
    places = np.array([[0.0, 0.0], [0.01, 0.02]])
    assert_same_bits(skin, lambda one: (one.touched_cells(places), one.model.voltages_and_jacobian(1.0)))


ANOTHER = """
import pickle, sys, numpy as np, jeit
model, conductivity = pickle.load(sys.stdin.buffer)
again = pickle.loads(pickle.dumps(model))
assert hash(model.system.pattern.layout) == hash(again.system.pattern.layout)
sys.stdout.buffer.write(np.asarray(model.voltages(conductivity)).tobytes())
"""


def test_another_process_computes_the_same():
    """As in Dask's workers, with another hash seed and without any state of this process."""
    model = KINDS["boundary"](1.0)
    given = pickle.dumps((model, uneven(model)))
    done = subprocess.run([sys.executable, "-c", ANOTHER], input=given, capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout == np.asarray(model.voltages(uneven(model))).tobytes()
