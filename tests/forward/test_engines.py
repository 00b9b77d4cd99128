"""Results of NumPy and of compiled programs agree to rounding.

For conductivities of every shape and type, with Jacobians from automatic differentiation, alone and in batches.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kinds import MODELS

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.forward import model as forward_model
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit_solvers import ConjugateGradient, Multigrid
from jeit_solvers.engines import empty_for_jax, on_device

QUANTITIES = ("voltages", "transfer_impedance", "potentials", "fields", "voltages_and_jacobian")


# Programs of known electrodes receive their integrals: with or without contacts, of a sheet or a solid; all else is
# alike. For other kinds, test_derivatives compares the compiled integrals with NumPy's.
@pytest.fixture(
    params=["boundary", *(pytest.param(one, marks=pytest.mark.slow) for one in ("point", "face"))], scope="module"
)
def model(request):
    return MODELS[request.param]()


def uneven(size):
    return np.exp(0.5 * np.random.default_rng(3).normal(size=size))


def assert_same(found, expected, tolerance=1e-12):
    """Compare arrays to this fraction of the largest value of each."""
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert isinstance(one, jax.Array)
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=0, atol=tolerance * np.abs(other).max())


def test_numpy_and_compiled_code_agree(model):
    """One at a time and in a batch, with one program for all quantities."""
    batch = uneven(model.mesh.num_cells) * np.array([[0.5], [1.0], [2.0]])

    def everything(conductivity):
        return [getattr(model, quantity)(conductivity) for quantity in QUANTITIES]

    in_batches = not model.electrodes.is_point
    together = jax.jit(jax.vmap(everything))(batch) if in_batches else jax.jit(everything)(batch[0])
    for k, one in enumerate(batch if in_batches else batch[:1]):
        expected = jax.tree.map(lambda part, k=k: np.asarray(part)[k], together) if in_batches else together
        assert_same(everything(one), expected)


def test_one_number_per_node(model):
    nodal = uneven(model.mesh.num_points)
    found = model.voltages_and_jacobian(nodal)
    of_cells = np.asarray(model.voltages(nodal[np.asarray(model.mesh.cells)].mean(axis=1)))
    assert_same(found[0], of_cells, 1e-13)


@pytest.mark.slow
def test_one_number_per_node_in_compiled_code(model):
    nodal = uneven(model.mesh.num_points)
    found = model.voltages_and_jacobian(nodal)
    both = jax.jit(lambda at: (model.voltages_and_jacobian(at), jax.jacrev(model.voltages)(at)))
    together, plain = both(nodal)
    assert_same(found, together)
    assert_same(found[1], plain)


def test_complex_numbers(model):
    admittivity = uneven(model.mesh.num_cells) * np.exp(0.4j * np.linspace(0, 1, model.mesh.num_cells))
    both = jax.jit(lambda at: (model.voltages_and_jacobian(at), jax.jacfwd(model.voltages, holomorphic=True)(at)))
    found, (together, plain) = model.voltages_and_jacobian(admittivity), both(admittivity)
    assert_same(found, together)
    assert_same(found[1], plain)


def test_tensors(model):
    axes, cells = model.mesh.dimension, model.mesh.num_cells
    equal = uneven(cells)
    assert_same(model.voltages(equal[:, None, None] * np.eye(axes)), np.asarray(model.voltages(equal)), 1e-13)
    skewed, direction = 0.2 * np.random.default_rng(4).normal(size=(2, cells, axes, axes))
    tensors, direction = np.eye(axes) + skewed @ np.swapaxes(skewed, 1, 2), direction @ np.swapaxes(direction, 1, 2)
    voltages, derivative = jax.jit(lambda at: jax.jvp(model.voltages, (at,), (direction,)))(tensors)
    assert_same(model.voltages(tensors), voltages)
    ahead, behind = (np.asarray(model.voltages(tensors + step * direction)) for step in (1e-4, -1e-4))
    np.testing.assert_allclose((ahead - behind) / 2e-4, derivative, rtol=0, atol=1e-7 * np.abs(derivative).max())
    with pytest.raises(ValueError, match="for tensors use"):
        model.jacobian(tensors)


@pytest.fixture(scope="module")
def parts():
    return Disk(0.1).mesh(num_points=60), BoundaryElectrodes(ring(0.1, 8), 0.02, 1e-3), adjacent(8)


def test_known_values_are_not_compiled(parts, caplog):
    with jax.log_compiles(), caplog.at_level("WARNING"):
        model = ForwardModel(*parts)
        model.voltages_and_jacobian(1.0)
        model.with_electrodes(parts[1].with_contact_impedance(2e-3)).voltages(np.full(model.mesh.num_cells, 2.0))
    assert "Compiling" not in caplog.text
    with jax.log_compiles(), caplog.at_level("WARNING"):
        jax.jit(lambda number: number + 1)(1.0)
    assert "Compiling" in caplog.text, "what is compiled is in the log"


def test_a_requested_solver_is_used(parts):
    rough = ForwardModel(*parts, solver=ConjugateGradient(tolerance=1e-6)).voltages(1.0)
    exact = ForwardModel(*parts).voltages(1.0)
    assert 1e-9 < np.abs(rough - exact).max() / np.abs(exact).max() < 1e-3


def test_a_large_jacobian_is_computed_on_all_cores(parts, monkeypatch):
    model = ForwardModel(*parts)
    expected = np.asarray(model.jacobian(1.0))
    monkeypatch.setattr(forward_model, "_MAX_BLOCK_ENTRIES", 200)
    monkeypatch.setattr(forward_model, "_MIN_PARALLEL_BLOCKS", 2)
    assert_same(model.jacobian(1.0), expected)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the device has a memory of its own")
def test_jax_uses_the_memory_of_the_result():
    made = empty_for_jax((300, 500), np.dtype(float))
    made[:] = 1
    assert on_device(made).unsafe_buffer_pointer() == made.ctypes.data


@pytest.fixture(scope="module")
def by_multigrid(parts):
    """A model with good and bad contacts, solved directly in compiled programs, and by multigrid."""
    pytest.importorskip("pyamg", reason="PyAMG, of the extra `large`, is not installed")
    mesh, electrodes, protocol = parts
    electrodes = electrodes.with_contact_impedance(np.geomspace(1e-6, 1.0, 8))
    return [ForwardModel(mesh, electrodes, protocol, solver=solver) for solver in ("cholesky", Multigrid(1e-12))]


def test_multigrid_gives_the_same_voltages_and_jacobian(parts, by_multigrid):
    _, found = by_multigrid
    assert found.at_once
    exact, conductivity = ForwardModel(parts[0], found.electrodes, parts[2]), uneven(parts[0].num_cells)
    for given in (conductivity, conductivity * (1 + 0.2j)):
        assert_same(found.voltages_and_jacobian(given), exact.voltages_and_jacobian(given), 1e-9)


@pytest.mark.slow
def test_multigrid_gives_the_same_derivatives_of_everything(parts, by_multigrid):
    def slopes(model):
        def misfit(conductivity, electrodes):
            return jnp.sum(model.with_electrodes(electrodes).voltages(conductivity) ** 2)

        return jax.jit(jax.value_and_grad(misfit, (0, 1)))(uneven(parts[0].num_cells), model.electrodes)

    exact, found = (jax.tree.leaves(slopes(model)) for model in by_multigrid)
    for one, other in zip(found, exact, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-8 * np.abs(other).max())


def test_other_electrodes_do_not_reuse_cached_results(parts):
    """Contact integrals and the last models are cached; changed ones are computed again."""
    model = ForwardModel(*parts)
    first = model.voltages(1.0)
    other = model.with_electrodes(BoundaryElectrodes(ring(0.1, 8, start_angle=0.1), 0.02, 2e-3))
    assert np.abs(other.voltages(1.0) - first).max() > 1e-3 * np.abs(first).max()
    np.testing.assert_array_equal(model.voltages(1.0), first)
    wider = eqx.tree_at(lambda m: m.mesh.points, model, 1.1 * model.mesh.points)
    again = ForwardModel(wider.mesh, BoundaryElectrodes(1.1 * ring(0.1, 8), 0.022, 1.1e-3), adjacent(8))
    np.testing.assert_allclose(again.voltages(1.0), first, rtol=1e-9)  # a sheet has no scale of its own


def test_integrals_first_computed_in_a_program_are_reused_outside_it(parts):
    """Integrals of known electrodes are computed once, in NumPy, and do not belong to a program."""
    model = ForwardModel(*parts, solver="cholesky")
    conductivity = np.linspace(1.0, 2.0, model.mesh.num_cells)
    assert jax.eval_shape(lambda values: model.voltages(values), conductivity).shape == (40,)
    expected = ForwardModel(*parts).voltages(conductivity)
    assert_same(model.voltages(conductivity), expected)


class InJaxAlone(BoundaryElectrodes):
    """User-defined electrodes that are written in JAX alone."""

    def contact(self, mesh):
        return super().contact(jax.tree.map(jnp.asarray, mesh))


def test_electrodes_written_in_jax_alone(parts):
    mesh, electrodes, protocol = parts
    own = InJaxAlone(electrodes.position, electrodes.width, electrodes.contact_impedance)
    expected = ForwardModel(*parts).voltages(1.5)
    np.testing.assert_allclose(ForwardModel(mesh, own, protocol).voltages(1.5), expected, rtol=1e-12)


def test_arrays_of_users_are_copied(parts):
    """An acquisition loop may overwrite its buffer, and JAX would share aligned memory."""
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
def test_conductivities_of_any_numeric_type(parts, kind):
    model = ForwardModel(*parts)
    values = np.arange(1, model.mesh.num_cells + 1).astype(kind)
    expected = model.voltages(values.astype(float))
    np.testing.assert_array_equal(model.voltages(values), expected)
    np.testing.assert_array_equal(model.voltages([float(one) for one in values]), expected)
    with pytest.raises(ValueError, match="real or complex numbers"):
        model.voltages(values.astype(object))


@pytest.mark.slow
def test_a_model_is_made_inside_jit_of_a_known_mesh(parts):
    mesh, electrodes, protocol = parts

    @jax.jit
    def impedance(position):
        return ForwardModel(mesh, BoundaryElectrodes(position, 0.02, 1e-3), protocol).transfer_impedance(1.0)

    expected = ForwardModel(*parts).transfer_impedance(1.0)
    np.testing.assert_allclose(
        impedance(electrodes.position), expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max()
    )


def test_a_model_is_made_while_jit_traces(parts):
    mesh, electrodes, protocol = parts
    found = jax.eval_shape(
        lambda position: ForwardModel(mesh, BoundaryElectrodes(position, 0.02, 1e-3), protocol).transfer_impedance(1.0),
        electrodes.position,
    )
    assert found.shape == (8, 8)
