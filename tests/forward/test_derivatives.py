"""The derivative rule: against automatic differentiation through the solve, against differences, and as an operator.

Linear maps are compared by their products with one random vector, in which any difference appears.
"""

import equinox as eqx
import jax
import numpy as np
import pytest
from kinds import MODELS, QUICK

from jeit.electrodes import BoundaryElectrodes, CombinedElectrodes, FacePatches, PointElectrodes
from jeit.forward.changes import ConductivityChange, solved_fields
from jeit.forward.transfer import electrode_fields

SEED = 7


def models(quick):
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in MODELS]


@pytest.fixture(params=models(QUICK), scope="module")
def model(request):
    return MODELS[request.param]()


@pytest.fixture(
    params=["boundary", *(pytest.param(one, marks=pytest.mark.slow) for one in ("point", "face"))], scope="module"
)
def known(request):
    """A model whose compiled programs receive the electrodes' integrals: with or without contacts, of a sheet or a
    solid."""
    return MODELS[request.param]()


def uneven(model):
    return np.exp(0.4 * np.random.default_rng(SEED).normal(size=model.mesh.num_cells))


def _relative(value, reference):
    return float(np.linalg.norm(value - np.asarray(reference)) / np.linalg.norm(reference))


@pytest.fixture(scope="module")
def directions(known):
    """Two changes of the conductivity (m,), and weights of the channels (M,)."""
    rng = np.random.default_rng(SEED + 2)
    return *rng.normal(size=(2, known.mesh.num_cells)), rng.normal(size=known.protocol.num_measurements)


@pytest.fixture(scope="module")
def derivatives(known, directions):
    """All derivatives at a conductivity by name, from one program for all conductivities, because each takes long to
    compile.

    The derivative of the voltages along a first direction, its change along a second, and that of the weighted
    channels. The last is also computed by automatic differentiation through the solve, with the fields and transfer
    impedance of this solve.
    """
    protocol, (first, second, weights) = known.protocol, directions

    def along(conductivity):
        return jax.jvp(known.voltages, (conductivity,), (first,))[1]

    def plain(conductivity):
        fields, impedance = electrode_fields(known.mesh, conductivity, known.electrodes, known.system)
        table = protocol.measurement @ impedance @ protocol.drive.T
        return table[protocol.measurement_index, protocol.drive_index], (fields, impedance)

    @jax.jit
    def found(conductivity):
        pushed, curved = jax.jvp(along, (conductivity,), (second,))
        _, pull = jax.vjp(known.voltages, conductivity)
        _, plainly, (fields, impedance) = jax.vjp(plain, conductivity, has_aux=True)
        return {
            "pushed": pushed,
            "curved": curved,
            "pulled": pull(weights)[0],
            "pulled plainly": plainly(weights)[0],
            "fields": fields,
            "impedance": impedance,
        }

    return lambda conductivity: jax.tree.map(np.asarray, found(conductivity))


def test_rule_equals_automatic_differentiation_through_the_solve(known, directions, derivatives):
    jacobian = np.asarray(known.jacobian(uneven(known)))
    assert _relative(directions[-1] @ jacobian, derivatives(uneven(known))["pulled plainly"]) < 1e-9


def test_compiled_fields_solve_the_system(known, derivatives):
    conductivity, found = uneven(known), derivatives(uneven(known))
    potentials = np.asarray(known.potentials(conductivity))
    assert potentials.shape == (known.protocol.num_drives, known.mesh.num_points)
    assert _relative(potentials, np.asarray(known.protocol.drive) @ found["fields"].T) < 1e-12
    assert _relative(known.transfer_impedance(conductivity), found["impedance"]) < 1e-12


def test_forward_and_reverse_mode_equal_the_jacobian(known, directions, derivatives):
    """So the two modes are adjoint to each other, too."""
    (first, _, weights), found = directions, derivatives(uneven(known))
    pushed, pulled, jacobian = found["pushed"], found["pulled"], np.asarray(known.jacobian(uneven(known)))
    assert _relative(pushed, jacobian @ first) < 1e-12
    assert _relative(pulled, weights @ jacobian) < 1e-12
    assert abs(weights @ pushed - first @ pulled) < 1e-12 * np.linalg.norm(weights) * np.linalg.norm(pushed)


def test_second_derivatives(known, directions, derivatives):
    conductivity, second = uneven(known), directions[1]
    ahead, behind = (derivatives(conductivity + step * second)["pushed"] for step in (1e-4, -1e-4))
    assert _relative((ahead - behind) / 2e-4, derivatives(conductivity)["curved"]) < 1e-6


def test_jacobian_is_second_order_accurate(model):
    conductivity = uneven(model)
    direction = conductivity * np.random.default_rng(SEED + 1).normal(size=model.mesh.num_cells)
    voltages, jacobian = map(np.asarray, model.voltages_and_jacobian(conductivity))
    steps = np.array([1e-2, 1e-3])
    rest = [
        np.linalg.norm(np.asarray(model.voltages(conductivity + step * direction)) - voltages - step * along)
        for step, along in zip(steps, 2 * [jacobian @ direction], strict=True)
    ]
    order = np.log(rest[0] / rest[1]) / np.log(steps[0] / steps[1])
    assert abs(order - 2) < 0.05


def test_changes_of_some_cells_do_not_need_the_whole_jacobian(model):
    rng = np.random.default_rng(SEED)
    cells = np.flatnonzero(rng.random(model.mesh.num_cells) < 0.2)
    changes = [
        ConductivityChange(None, rng.normal(size=(model.mesh.num_cells, 2))),
        ConductivityChange(cells, rng.normal(size=(len(cells), 3))),
    ]
    conductivity = uneven(model)
    solved = solved_fields(model, conductivity)
    voltages, jacobian = map(np.asarray, model.voltages_and_jacobian(conductivity))
    np.testing.assert_allclose(solved.voltages, voltages, rtol=1e-9, atol=1e-12 * np.abs(voltages).max())
    some = [slice(None) if one.cells is None else one.cells for one in changes]
    expected = np.concatenate([jacobian[:, k] @ one.slope for k, one in zip(some, changes, strict=True)], 1)
    assert _relative(solved.derivatives(changes), expected) < 1e-10


def test_reciprocity(model):
    conductivity = uneven(model)
    pairs, ratio = model.protocol.reciprocal_pairs()
    if len(pairs) == 0:
        impedance = np.asarray(model.transfer_impedance(conductivity))
        assert np.abs(impedance - impedance.T).max() < 1e-12 * np.abs(impedance).max()
        return
    voltages = np.asarray(model.voltages(conductivity))
    error = voltages[pairs[:, 1]] - ratio * voltages[pairs[:, 0]]
    assert np.linalg.norm(error) < 1e-12 * np.linalg.norm(voltages)


FIELDS = ("position", "width", "radius", "height", "contact_impedance")


@pytest.mark.parametrize("model", models(["boundary", "inside"]), indirect=True, scope="module")
def test_gradients_of_electrodes_and_nodes_against_central_differences(model):
    """For every array of the electrodes, and for the mesh's nodes.

    One program for all of them takes a batch, and each member is compared with its separate result.
    """
    conductivity, electrodes, places = uneven(model), model.electrodes, {}
    if not isinstance(electrodes, CombinedElectrodes):
        places = {one: ("electrodes", one) for one in FIELDS if hasattr(electrodes, one)}
    # Electrodes that slide on a moving boundary are tested with their own positions.
    if not isinstance(electrodes, FacePatches | BoundaryElectrodes | PointElectrodes):
        places["points"] = ("mesh", "points")
    values = {one: np.asarray(getattr(getattr(model, part), field)) for one, (part, field) in places.items()}
    still = {one: np.zeros_like(value) for one, value in values.items()}

    def changed(values):
        return eqx.tree_at(
            lambda one: [getattr(getattr(one, part), field) for part, field in places.values()],
            model,
            [values[one] for one in places],  # a compiled function receives them in another order
        )

    @jax.jit
    @jax.vmap
    def along(values, direction):
        return jax.jvp(lambda values: changed(values).voltages(conductivity), (values,), (direction,))

    steps = 1e-3 * np.array([0.0, 1.0, -1.0, 2.0, -2.0])
    for field, value in values.items():
        scale = 1e-3 if field in ("position", "points") else 0.02 * value
        direction = scale * np.random.default_rng(SEED + 3).normal(size=value.shape)
        batch = [{**values, field: value + step * direction} for step in steps]
        stacked, way = (
            {one: np.stack([each[one] for each in some]) for one in values}
            for some in (batch, [{**still, field: direction}] * len(steps))
        )
        found, derivative = map(np.asarray, along(stacked, way))
        for one, values_of_one in zip(found, batch, strict=True):
            assert _relative(one, changed(values_of_one).voltages(conductivity)) < 1e-12, field
        # Fourth-order central differences, whose error is below that of the rule.
        _, ahead, behind, far_ahead, far_behind = found
        difference = (8 * (ahead - behind) - (far_ahead - far_behind)) / 12e-3
        assert _relative(difference, derivative[0]) < 1e-5, field


def test_voltages_scale_with_current_and_resistance(model):
    """A constant phase also divides every voltage, if there is no contact impedance."""
    conductivity, doubled = uneven(model), model
    if not model.electrodes.is_point:
        impedance = np.asarray(model.electrodes.contact_impedance)
        doubled = model.with_electrodes(model.electrodes.with_contact_impedance(impedance / 2))
    voltages = np.asarray(model.voltages(conductivity))
    assert _relative(doubled.voltages(2 * conductivity), voltages / 2) < 1e-12
    if model.electrodes.is_point:
        assert _relative(model.voltages(conductivity * (1 + 0.3j)), voltages / (1 + 0.3j)) < 1e-12
