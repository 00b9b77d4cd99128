"""Changes of voltages by touches: equal to a new solution of the model, and to first order to the Jacobian's."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies import linear_changes

from jeit.design import Bell, Hemisphere
from jeit.design.skin.touched_cells import touched_cells
from jeit.design.skin.voltage_changes import touch_changes
from jeit.electrodes import FaceDiscs, PointElectrodes, SheetDiscs
from jeit.forward import ForwardModel
from jeit.layout import grid
from jeit.mesh import layer, rectangle
from jeit.protocol import adjacent

CENTRES = grid(0.06, 0.06, 3, 3)
PLACES = np.array([[0.0, 0.0], [0.021, -0.013], [-0.03, 0.03], [0.04, 0.04], [0.001, 0.0]])
SHEET = {"thickness": 0.01}


@pytest.fixture(scope="module")
def models():
    plane = rectangle(0.1, 0.1, cell_size=0.008)
    solid = layer(rectangle(0.1, 0.1, cell_size=0.012), 0.01, 4)
    protocol = adjacent(9)
    on_bottom = np.column_stack([CENTRES, np.zeros(9)])
    nodes = np.asarray(plane.points)[
        np.linalg.norm(np.asarray(plane.points)[:, None] - CENTRES, axis=-1).argmin(axis=0)
    ]
    return {
        "sheet": ForwardModel(plane, SheetDiscs(CENTRES, 0.006, 1e-4), protocol),
        "points": ForwardModel(plane, PointElectrodes(nodes), protocol),
        "layer": ForwardModel(solid, FaceDiscs(on_bottom, 0.006, 1e-4), protocol),
        "iterative": ForwardModel(plane, SheetDiscs(CENTRES, 0.006, 1e-4), protocol, solver="cg"),
    }


def anew(model, conductivity, touched):
    """The direct way: the model solved for every touch. Removed material keeps a billionth of its conductivity."""
    before = np.asarray(model.voltages(conductivity))
    found = []
    for cells, change in zip(np.asarray(touched.cells), np.asarray(touched.change), strict=True):
        values = np.array(conductivity)
        factor = np.ones(len(values))
        np.add.at(factor, cells, change)
        factor = np.maximum(factor, 1e-9).reshape(-1, *np.ones(values.ndim - 1, int))
        found.append(np.asarray(model.voltages(factor * values)) - before)
    return np.array(found)


BALL = Hemisphere(depth=3e-3, diameter=20e-3)


@pytest.mark.parametrize(
    ("kind", "indentation", "options"),
    [
        ("sheet", Bell(), SHEET),
        pytest.param("sheet", BALL, SHEET, marks=pytest.mark.slow),
        pytest.param("points", Bell(), SHEET, marks=pytest.mark.slow),
        ("layer", BALL, {}),
        pytest.param("layer", Bell(), {}, marks=pytest.mark.slow),
        pytest.param("layer", BALL, {"edge": 1e-3}, marks=pytest.mark.slow),
        ("layer", BALL, {"contrast": 50.0}),
        pytest.param("iterative", BALL, SHEET, marks=pytest.mark.slow),
    ],
    ids=["sheet", "a ball", "points", "layer", "bell on a layer", "smooth layer", "conductor", "conjugate gradients"],
)
def test_exact_changes_equal_a_new_solution(kind, indentation, options, models):
    model = models[kind]
    conductivity = 0.5 + 0.4 * np.random.default_rng(0).random(model.mesh.num_cells)
    touched = touched_cells(model.mesh, indentation, PLACES, **options)
    expected = anew(model, conductivity, touched)
    found = touch_changes(model, conductivity, touched)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def test_touches_scale_the_tensors_of_a_stretched_sheet(models):
    model = models["sheet"]
    conductivity = np.broadcast_to([[0.5, 0.1], [0.1, 0.8]], (model.mesh.num_cells, 2, 2))
    touched = touched_cells(model.mesh, Bell(), PLACES, **SHEET)
    expected = anew(model, conductivity, touched)
    found = touch_changes(model, conductivity, touched)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def test_a_touch_that_converges_at_once_waits_for_a_slow_one(models):
    """Some change or remove few cells. The others' conductivities are seven orders of magnitude apart."""
    model, draw = models["sheet"], np.random.default_rng(0)
    touched = touched_cells(model.mesh, Bell(), PLACES, **SHEET)  # of the sizes of others, for their program
    reached = np.asarray(touched.change) != 0
    change = np.where(reached, 10 ** draw.uniform(-3, 4, reached.shape) - 1, 0.0)
    for row, number, value in ((1, 1, -0.1), (2, 5, -1.0), (3, 1, -1.0)):
        change[row] = 0
        change[row, np.flatnonzero(reached[row])[:number]] = value
    touched = eqx.tree_at(lambda one: one.change, touched, jnp.asarray(change))
    conductivity = np.full(model.mesh.num_cells, 0.5)
    expected = anew(model, conductivity, touched)
    found = touch_changes(model, conductivity, touched)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.slow
def test_nearly_removed_layers_are_exact(models):
    """A smooth edge leaves cells with any fraction of their conductivity, down to millionths."""
    model = models["layer"]
    conductivity = np.full(model.mesh.num_cells, 0.5)
    for indentation in (Bell(), Bell(depth=5e-3), BALL):
        touched = touched_cells(model.mesh, indentation, PLACES, edge=1e-3)
        expected = anew(model, conductivity, touched)
        found = touch_changes(model, conductivity, touched)
        np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.slow
def test_touches_that_do_not_converge_are_an_error(models, monkeypatch):
    monkeypatch.setattr("jeit.design.skin.voltage_changes._MAX_SOLVER_STEPS", 1)
    model = models["sheet"]
    touched = touched_cells(model.mesh, Bell(), np.array([[0.01, 0.02], [0.0, 0.0], [0.02, 0.0]]), **SHEET)
    with pytest.raises(RuntimeError, match=r"3 of 3 touches were not found in 1 steps, the first at \(10, 20\) mm"):
        touch_changes(model, 0.5, touched)


def test_conductors_that_leave_only_rounding_errors_are_an_error(models):
    model = models["sheet"]
    changes = [
        touch_changes(model, 0.5, touched_cells(model.mesh, Bell(), PLACES, contrast=c, **SHEET)) for c in (1e5, 1e6)
    ]
    np.testing.assert_allclose(*changes, atol=1e-2 * np.abs(changes[0]).max())
    hard = touched_cells(model.mesh, Bell(), PLACES, contrast=1e6, **SHEET)
    harder = eqx.tree_at(lambda one: one.change, hard, 1e3 * hard.change)
    with pytest.raises(RuntimeError, match=r"5 of 5 touches were not found in 200 steps, the first at \(0, 0\) mm"):
        touch_changes(model, 0.5, harder)


def test_exact_changes_cannot_be_traced(models):
    model = models["sheet"]
    touched = touched_cells(model.mesh, Bell(), PLACES, **SHEET)
    with pytest.raises(ValueError, match="cannot be traced"):
        jax.jit(lambda conductivity: touch_changes(model, conductivity, touched))(0.5)


def test_touches_that_change_nothing_change_no_voltage(models):
    """Beside others, which do."""
    model = models["sheet"]
    touched = touched_cells(model.mesh, Bell(), PLACES, **SHEET)
    change = np.array(touched.change)
    change[1:3] = 0
    found = np.asarray(touch_changes(model, 0.5, eqx.tree_at(lambda one: one.change, touched, jnp.asarray(change))))
    np.testing.assert_array_equal(found[1:3], 0.0)
    assert np.abs(found[[0, 3, 4]]).max(axis=1).min() > 0


def test_touches_of_another_mesh_are_refused(models):
    touched = touched_cells(models["layer"].mesh, Bell(), PLACES)
    with pytest.raises(ValueError, match="the touches are of a mesh of"):
        touch_changes(models["sheet"], 0.5, touched)


def test_small_touches_are_linear(models):
    """The remainder beyond the Jacobian falls with the square of the touch."""
    model = models["sheet"]
    left = []
    for depth in (1e-4, 2e-4):
        touched = touched_cells(model.mesh, Bell(depth=depth), PLACES, **SHEET)
        exact, linear = touch_changes(model, 0.5, touched), linear_changes(model, 0.5, touched)
        left.append(np.abs(exact - linear).max())
    assert left[1] / left[0] == pytest.approx(4, rel=0.05)
    assert left[0] < 0.02 * np.abs(linear).max()


@pytest.mark.slow
def test_linear_changes_have_derivatives_in_electrode_positions_and_batch(models):
    model = models["sheet"]
    touched = touched_cells(model.mesh, Bell(), PLACES, **SHEET)
    direction = np.random.default_rng(1).normal(size=CENTRES.shape)

    def moved(move):
        position = model.electrodes.position + move * direction
        return model.with_electrodes(eqx.tree_at(lambda e: e.position, model.electrodes, position))

    def changes(move):
        return touch_changes(moved(move), 0.5, touched, linear=True)

    step = 1e-6
    moves = np.array([0.0, step, -step, 1e-3])
    found, slopes = jax.jit(jax.vmap(lambda move: jax.jvp(changes, (move,), (1.0,))))(moves)
    for move, one in zip(moves, found, strict=True):
        np.testing.assert_allclose(one, linear_changes(moved(move), 0.5, touched), rtol=1e-9, atol=1e-15)
    difference = np.asarray(found[1] - found[2]) / (2 * step)
    np.testing.assert_allclose(slopes[0], difference, atol=1e-6 * np.abs(difference).max())


def test_touches_reduce_conduction_and_do_not_depend_on_their_order(models):
    """An insulating touch raises every self-impedance. Touches do not affect each other."""
    model = models["layer"]
    touched = touched_cells(model.mesh, BALL, PLACES)
    turned = touched_cells(model.mesh, BALL, PLACES[::-1])
    found = touch_changes(model, 1.0, touched)
    np.testing.assert_allclose(found[::-1], touch_changes(model, 1.0, turned), rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"places": [[0.3, 0.0]]}, "1 of 1 touches change no cell"),
        ({"places": [0.0, 0.0]}, r"places must be \(n, 2\)"),
        ({"places": [[0.0, 0.0], [np.nan, 0.0]]}, "places: 1 of 2 are not finite, the first is number 1"),
        ({"thickness": None}, "thickness must be given"),
        ({"thickness": 2e-3}, "press less"),
        ({"contrast": 1}, "contrast"),
        ({"contrast": -0.5}, "contrast"),
        ({"edge": -1e-3}, "edge"),
    ],
)
def test_bad_touches(change, message, models):
    arguments = {"places": PLACES, **SHEET, **change}
    with pytest.raises(ValueError, match=message):
        touched_cells(models["sheet"].mesh, Bell(), arguments.pop("places"), **arguments)


def test_bad_indentations(models):
    with pytest.raises(ValueError, match=r"^depth is 9 mm, .* 15 mm across goes in no deeper than 7\.5 mm"):
        Hemisphere(depth=9e-3, diameter=15e-3)
    with pytest.raises(ValueError, match="depth"):
        Bell(depth=-1e-3)
    with pytest.raises(ValueError, match="that of a layer is in its mesh"):
        touched_cells(models["layer"].mesh, Bell(), PLACES, thickness=0.01)
    touched = touched_cells(models["sheet"].mesh, Bell(), PLACES, **SHEET)
    with pytest.raises(ValueError, match="real conductivity"):
        touch_changes(models["sheet"], 1.0 + 0.1j, touched)
    tensors = np.tile(np.eye(2), (models["sheet"].mesh.num_cells, 1, 1))
    with pytest.raises(ValueError, match="scalar one"):
        touch_changes(models["sheet"], tensors, touched, linear=True)
