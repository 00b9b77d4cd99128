"""Two engines, one formula: what NumPy answers at once is what the compiled program answers, to rounding."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kinds import MODELS, QUICK

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit_solvers import ConjugateGradient

QUANTITIES = ("voltages", "transfer_impedance", "potentials", "fields", "voltages_and_jacobian")


@pytest.fixture(
    params=[name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in MODELS], scope="module"
)
def model(request):
    return MODELS[request.param]()


def conductivities(model):
    """Per cell, per node, complex, and tensors."""
    random = np.random.default_rng(3)
    cells, nodes, axes = model.mesh.num_cells, model.mesh.num_points, model.mesh.dimension
    skewed = 0.2 * random.normal(size=(cells, axes, axes))
    return {
        "cells": np.exp(0.5 * random.normal(size=cells)),
        "nodes": np.exp(0.5 * random.normal(size=nodes)),
        "complex": np.exp(0.3 * random.normal(size=cells)) * (1 + 0.4j),
        "tensors": np.eye(axes) + skewed @ np.swapaxes(skewed, 1, 2),
    }


@eqx.filter_jit
def compiled(model, quantity, conductivity):
    return getattr(model, quantity)(conductivity)


@pytest.mark.parametrize("kind", ["cells", "nodes", "complex", "tensors"])
def test_numpy_and_compiled_code_agree(model, kind):
    conductivity = conductivities(model)[kind]
    quantities = QUANTITIES[:-1] if kind == "tensors" else QUANTITIES
    for quantity in quantities if kind == "cells" else quantities[-1:]:
        at_once = getattr(model, quantity)(conductivity)
        expected = jax.tree.leaves(compiled(model, quantity, conductivity))
        for one, other in zip(jax.tree.leaves(at_once), expected, strict=True):
            assert isinstance(one, jax.Array)
            assert one.dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * np.abs(other).max())


@pytest.fixture(scope="module")
def parts():
    return Disk(0.1).mesh(num_points=200), BoundaryElectrodes(ring(0.1, 8), 0.02, 1e-3), adjacent(8)


def test_what_has_values_is_not_compiled(parts, caplog):
    with jax.log_compiles(), caplog.at_level("WARNING"):
        model = ForwardModel(*parts)
        model.voltages_and_jacobian(1.0)
        model.with_electrodes(parts[1].with_contact_impedance(2e-3)).voltages(np.full(model.mesh.num_cells, 2.0))
    assert "Compiling" not in caplog.text
    with jax.log_compiles(), caplog.at_level("WARNING"):
        jax.jit(lambda s: model.voltages(s))(1.0)
    assert "Compiling" in caplog.text


def test_a_solver_that_is_asked_for_is_used(parts):
    rough = ForwardModel(*parts, solver=ConjugateGradient(tolerance=1e-6)).voltages(1.0)
    exact = ForwardModel(*parts).voltages(1.0)
    assert 1e-9 < np.abs(rough - exact).max() / np.abs(exact).max() < 1e-3


def test_other_electrodes_are_not_taken_for_the_same(parts):
    """Contact integrals and the last models are kept; what has changed is worked out anew."""
    model = ForwardModel(*parts)
    first = model.voltages(1.0)
    other = model.with_electrodes(BoundaryElectrodes(ring(0.1, 8, start_angle=0.1), 0.02, 2e-3))
    assert np.abs(other.voltages(1.0) - first).max() > 1e-3 * np.abs(first).max()
    np.testing.assert_array_equal(model.voltages(1.0), first)
    wider = eqx.tree_at(lambda m: m.mesh.points, model, 1.1 * model.mesh.points)
    again = ForwardModel(wider.mesh, BoundaryElectrodes(1.1 * ring(0.1, 8), 0.022, 1.1e-3), adjacent(8))
    np.testing.assert_allclose(again.voltages(1.0), first, rtol=1e-9)  # a sheet has no scale of its own


def test_integrals_that_a_program_asked_for_first_serve_outside_it(parts):
    """Of electrodes with values they are worked out once, in NumPy, and belong to no program."""
    model = ForwardModel(*parts, solver="cholesky")
    conductivity = jnp.linspace(1.0, 2.0, model.mesh.num_cells)
    inside = jax.jit(lambda values: model.voltages_and_jacobian(values))(conductivity)
    traced = compiled(model, "voltages_and_jacobian", conductivity)
    for results in (model.voltages_and_jacobian(conductivity), traced):
        for one, other in zip(results, inside, strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-13 * np.abs(other).max())


def test_derivatives_go_through_the_compiled_engine(parts):
    model = ForwardModel(*parts)
    conductivity = jnp.linspace(1.0, 2.0, model.mesh.num_cells)
    _, jacobian = model.voltages_and_jacobian(conductivity)
    reverse = jax.jacrev(model.voltages)(conductivity)
    np.testing.assert_allclose(jacobian, reverse, rtol=0, atol=1e-11 * np.abs(reverse).max())


class InJaxAlone(BoundaryElectrodes):
    """Electrodes of a user who knows nothing of engines."""

    def contact(self, mesh):
        return super().contact(jax.tree.map(jnp.asarray, mesh))


def test_electrodes_written_in_jax_alone_serve(parts):
    mesh, electrodes, protocol = parts
    own = InJaxAlone(electrodes.position, electrodes.width, electrodes.contact_impedance)
    expected = ForwardModel(*parts).voltages(1.5)
    np.testing.assert_allclose(ForwardModel(mesh, own, protocol).voltages(1.5), expected, rtol=1e-12)


def test_arrays_of_users_are_copied(parts):
    """An acquisition loop may write into its buffer again, and JAX would share aligned memory."""
    mesh, electrodes, protocol = parts
    raw = np.empty(128, np.uint8)
    start = -raw.ctypes.data % 64
    impedance = raw[start : start + 64].view(float)
    impedance[:] = 0.1
    model = ForwardModel(mesh, electrodes.with_contact_impedance(impedance), protocol)
    before = np.array(model.transfer_impedance(1.0))
    impedance[:] = 5.0
    np.testing.assert_array_equal(model.electrodes.contact_impedance, 0.1)
    np.testing.assert_array_equal(model.transfer_impedance(1.0), before)


@pytest.mark.parametrize("kind", [">f8", np.longdouble, int])
def test_numbers_of_any_kind_are_conductivities(parts, kind):
    model = ForwardModel(*parts)
    values = np.arange(1, model.mesh.num_cells + 1).astype(kind)
    expected = model.voltages(values.astype(float))
    np.testing.assert_array_equal(model.voltages(values), expected)
    np.testing.assert_array_equal(model.voltages([float(one) for one in values]), expected)
    with pytest.raises(ValueError, match="real or complex numbers"):
        model.voltages(values.astype(object))


def test_a_model_may_be_made_inside_jit_of_a_known_mesh(parts):
    mesh, electrodes, protocol = parts

    @jax.jit
    def impedance(position):
        return ForwardModel(mesh, BoundaryElectrodes(position, 0.02, 1e-3), protocol).transfer_impedance(1.0)

    expected = ForwardModel(*parts).transfer_impedance(1.0)
    np.testing.assert_allclose(
        impedance(electrodes.position), expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max()
    )
