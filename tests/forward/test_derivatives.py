"""The derivative rule: against plain autodiff through the solve, against differences, and as an operator."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kinds import MODELS, QUICK

from jeit.electrodes import BoundaryElectrodes, CombinedElectrodes, FacePatches, PointElectrodes
from jeit.forward.changes import Change, solved_fields
from jeit.forward.transfer import electrode_fields

SEED = 7


@pytest.fixture(
    params=[name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in MODELS], scope="module"
)
def model(request):
    return MODELS[request.param]()


@pytest.fixture(scope="module")
def conductivity(model):
    return jnp.exp(0.4 * jax.random.normal(jax.random.key(SEED), (model.mesh.num_cells,)))


def _plain_voltages(model, conductivity):
    """The same voltages by plain autodiff through the linear solve, without the rule."""
    impedance = electrode_fields(model.mesh, conductivity, model.electrodes, model.system)[1]
    protocol = model.protocol
    table = protocol.measurement @ impedance @ protocol.drive.T
    return table[protocol.measurement_index, protocol.drive_index]


def _relative(value, reference):
    return float(jnp.linalg.norm(value - reference) / jnp.linalg.norm(reference))


def test_rule_equals_autodiff_through_the_solve(model, conductivity):
    plain = jax.jit(jax.jacrev(lambda s: _plain_voltages(model, s)))(conductivity)
    assert _relative(model.jacobian(conductivity), plain) < 1e-9


def test_forward_and_reverse_mode_equal_the_jacobian(model, conductivity):
    jacobian = model.jacobian(conductivity)
    assert _relative(jax.jit(jax.jacfwd(model.voltages))(conductivity), jacobian) < 1e-12
    assert _relative(jax.jit(jax.jacrev(model.voltages))(conductivity), jacobian) < 1e-12


def test_jacobian_is_second_order_accurate(model, conductivity):
    direction = conductivity * jax.random.normal(jax.random.key(SEED + 1), conductivity.shape)
    voltages, jacobian = model.voltages_and_jacobian(conductivity)
    steps = np.array([1e-2, 1e-3])
    rest = [
        float(jnp.linalg.norm(model.voltages(conductivity + step * direction) - voltages - step * jacobian @ direction))
        for step in steps
    ]
    order = np.log(rest[0] / rest[1]) / np.log(steps[0] / steps[1])
    assert abs(order - 2) < 0.05


def test_changes_of_some_cells_need_no_whole_jacobian(model, conductivity):
    rng = np.random.default_rng(SEED)
    cells = np.flatnonzero(rng.random(model.mesh.num_cells) < 0.2)
    changes = [
        Change(None, rng.normal(size=(model.mesh.num_cells, 2))),
        Change(cells, rng.normal(size=(len(cells), 3))),
    ]
    solved = solved_fields(model, np.asarray(conductivity))
    voltages, jacobian = model.voltages_and_jacobian(conductivity)
    np.testing.assert_allclose(solved.voltages, voltages, rtol=1e-9, atol=1e-12 * np.abs(voltages).max())
    some = [slice(None) if one.cells is None else one.cells for one in changes]
    expected = np.concatenate([np.asarray(jacobian)[:, k] @ one.slope for k, one in zip(some, changes, strict=True)], 1)
    assert _relative(solved.derivatives(changes), expected) < 1e-10


def test_products_with_the_jacobian_are_adjoint(model, conductivity):
    key_v, key_w = jax.random.split(jax.random.key(SEED + 2))
    tangent = jax.random.normal(key_v, conductivity.shape)
    voltages, pushed = jax.jvp(model.voltages, (conductivity,), (tangent,))
    cotangent = jax.random.normal(key_w, voltages.shape)
    (pulled,) = jax.vjp(model.voltages, conductivity)[1](cotangent)
    assert abs(cotangent @ pushed - tangent @ pulled) < 1e-12 * jnp.linalg.norm(cotangent) * jnp.linalg.norm(pushed)


def test_reciprocity(model, conductivity):
    pairs, ratio = model.protocol.reciprocal_pairs()
    if len(pairs) == 0:
        impedance = model.transfer_impedance(conductivity)
        assert jnp.abs(impedance - impedance.T).max() < 1e-12 * jnp.abs(impedance).max()
        return
    voltages = model.voltages(conductivity)
    error = voltages[pairs[:, 1]] - ratio * voltages[pairs[:, 0]]
    assert jnp.linalg.norm(error) < 1e-12 * jnp.linalg.norm(voltages)


def test_fields_are_the_solution(model, conductivity):
    """K u, tested with every node's basis function, is the current that enters there (zero off the electrodes)."""
    fields, impedance = jax.jit(electrode_fields)(model.mesh, conductivity, model.electrodes, model.system)
    potentials = model.potentials(conductivity)
    assert potentials.shape == (model.protocol.num_drives, model.mesh.num_points)
    assert _relative(potentials, model.protocol.drive @ fields.T) < 1e-12
    assert _relative(model.transfer_impedance(conductivity), impedance) < 1e-12


FIELDS = ("position", "width", "radius", "height", "contact_impedance")


@pytest.fixture(scope="module")
def along(model, conductivity):
    """Voltages, and their derivative, where values of the electrodes' fields change in a direction; dictionaries both.

    One program for all fields: each takes seconds to compile.
    """

    def voltages(values):
        fields = list(values)
        changed = eqx.tree_at(lambda m: [getattr(m.electrodes, one) for one in fields], model, list(values.values()))
        return changed.voltages(conductivity)

    return jax.jit(lambda values, direction: jax.jvp(voltages, (values,), (direction,)))


@pytest.mark.parametrize("field", FIELDS)
def test_electrode_gradients_against_central_differences(model, along, field):
    electrodes = model.electrodes
    if not hasattr(electrodes, field) or isinstance(electrodes, CombinedElectrodes):
        return
    values = {one: getattr(electrodes, one) for one in FIELDS if hasattr(electrodes, one)}
    value, still = values[field], jax.tree.map(np.zeros_like, values)
    scale = jnp.asarray(1e-3 if field == "position" else 0.02 * value)
    direction = scale * jax.random.normal(jax.random.key(SEED + 3), value.shape)

    def voltages(value):
        return along({**values, field: value}, still)[0]

    _, derivative = along(values, {**still, field: direction})
    step = 1e-3
    # Fourth-order central difference: the rule, not the difference, is what is judged.
    near = voltages(value + step * direction) - voltages(value - step * direction)
    far = voltages(value + 2 * step * direction) - voltages(value - 2 * step * direction)
    assert _relative((8 * near - far) / (12 * step), derivative) < 1e-5


def test_second_derivatives(model, conductivity):
    first, second = jax.random.normal(jax.random.key(SEED + 4), (2, *conductivity.shape))

    def slope(step, direction):
        return jax.jvp(model.voltages, (conductivity + step * first,), (direction,))[1]

    _, curvature = jax.jvp(lambda s: slope(s, second), (0.0,), (1.0,))
    difference = (slope(1e-4, second) - slope(-1e-4, second)) / 2e-4
    assert _relative(difference, curvature) < 1e-6


def test_derivative_with_respect_to_mesh_points(model, conductivity):
    if isinstance(model.electrodes, FacePatches | BoundaryElectrodes | PointElectrodes):
        return  # electrodes that slide on a moving boundary are covered by their own positions
    points = model.mesh.points

    def voltages(points):
        return eqx.tree_at(lambda m: m.mesh.points, model, points).voltages(conductivity)

    direction = 1e-3 * jax.random.normal(jax.random.key(SEED + 5), points.shape)
    _, derivative = jax.jvp(voltages, (points,), (direction,))
    step = 1e-3
    difference = (voltages(points + step * direction) - voltages(points - step * direction)) / (2 * step)
    assert _relative(difference, derivative) < 1e-5


@pytest.mark.parametrize("name", ["boundary", "point"])
class TestShapesAndTypes:
    @pytest.fixture
    def model(self, name):
        return MODELS[name]()

    @pytest.fixture
    def conductivity(self, model):
        return jnp.exp(0.4 * jax.random.normal(jax.random.key(SEED), (model.mesh.num_cells,)))

    def test_batch_equals_loop(self, model, conductivity):
        batch = conductivity * jnp.array([[0.5], [1.0], [2.0]])
        voltages, jacobian = jax.vmap(model.voltages_and_jacobian)(batch)
        for k in range(3):
            alone = model.voltages_and_jacobian(batch[k])
            assert _relative(voltages[k], alone[0]) < 1e-12
            assert _relative(jacobian[k], alone[1]) < 1e-12

    def test_batch_over_electrode_positions(self, model, conductivity):
        shifts = jnp.array([0.0, 1e-3])[:, None, None] + model.electrodes.position

        def voltages(position):
            return eqx.tree_at(lambda m: m.electrodes.position, model, position).voltages(conductivity)

        batch = jax.vmap(voltages)(shifts)
        for k in range(2):
            assert _relative(batch[k], voltages(shifts[k])) < 1e-12

    @pytest.mark.slow
    def test_jit_equals_eager(self, model, conductivity):
        with jax.disable_jit():
            eager = model.voltages(conductivity)
        assert _relative(model.voltages(conductivity), eager) < 1e-12

    def test_complex_conductivity(self, model, conductivity):
        admittivity = conductivity * (1 + 0.3j)
        # A constant phase divides every voltage by it where there is no contact impedance to share it with.
        scaled = model
        if hasattr(model.electrodes, "contact_impedance"):
            fixed = model.voltages_and_jacobian(admittivity)[1]
            plain = jax.jacfwd(model.voltages, holomorphic=True)(admittivity)
            assert _relative(fixed, plain) < 1e-12
            return
        assert _relative(scaled.voltages(admittivity), scaled.voltages(conductivity) / (1 + 0.3j)) < 1e-12

    def test_conductivity_per_node(self, model, conductivity):
        nodal = jnp.exp(0.3 * jax.random.normal(jax.random.key(9), (model.mesh.num_points,)))
        voltages, jacobian = model.voltages_and_jacobian(nodal)
        assert _relative(voltages, model.voltages(nodal[model.mesh.cells].mean(axis=1))) < 1e-13
        assert _relative(jacobian, jax.jacrev(model.voltages)(nodal)) < 1e-12

    def test_conductivity_tensors(self, model, conductivity):
        tensors = conductivity[:, None, None] * jnp.eye(2)
        assert _relative(model.voltages(tensors), model.voltages(conductivity)) < 1e-13
        turned = jnp.broadcast_to(jnp.array([[2.0, 0.5], [0.5, 1.0]]), tensors.shape)
        direction = 0.1 * tensors
        _, derivative = jax.jvp(model.voltages, (turned,), (direction,))
        step = 1e-4
        difference = (model.voltages(turned + step * direction) - model.voltages(turned - step * direction)) / (
            2 * step
        )
        assert _relative(difference, derivative) < 1e-7
        with pytest.raises(ValueError, match="for tensors use"):
            model.jacobian(tensors)

    def test_voltages_scale_with_current_and_resistance(self, model, conductivity):
        if hasattr(model.electrodes, "contact_impedance"):
            doubled = eqx.tree_at(
                lambda m: m.electrodes.contact_impedance, model, model.electrodes.contact_impedance / 2
            )
        else:
            doubled = model
        assert _relative(doubled.voltages(2 * conductivity), model.voltages(conductivity) / 2) < 1e-12
