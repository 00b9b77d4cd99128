"""Layout optimisation: improved layouts within all constraints, from several starting points, and reproducible."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.path import Path

from jeit.design import (
    Bell,
    DesignSpace,
    Objective,
    Skin,
    TouchPrior,
    layout_scores,
    optimise_layout,
    sensitivity_map,
    touch_grid,
    touches_away_from_the_edge,
)
from jeit.design.optimisation.design_space import Constraints, minimise_from_starts
from jeit.design.optimisation.optimise import _largest_violation, _make_feasible, _parameters_of_starts, _random_starts
from jeit.design.optimisation.variables import LayoutParameters, Variables, balanced_score
from jeit.design.skin.sheet_touches import sheet_touches
from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.layout import Layout, named_layout, perimeter
from jeit.mesh import Disk, Polygon, Rectangle, rectangle
from jeit.protocol import two_terminal

SKIN = Rectangle(0.1, 0.1)
SPACING, NUMBER = 0.02, 8
MESH = rectangle(0.1, 0.1, num_points=62)
PLACES = touch_grid(SKIN, 5, 5).places
# A poor layout: all electrodes along one side and a half.
START = Layout(
    np.array([[x, y] for y in (-0.04, -0.015) for x in (-0.036, -0.012, 0.012, 0.036)]), 8e-3, outline=SKIN, name="low"
)
MODEL = ForwardModel(MESH, START.sheet_discs(1e-4), two_terminal(NUMBER))
TOUCHES = sheet_touches(MESH, Bell(deviation=12e-3), PLACES, thickness=0.01)
KEEP_OUT = Disk(0.015, (0.02, 0.02))
LIMITS = {"minimum_spacing": SPACING, "keep_out": (KEEP_OUT,)}
SETTING = {"prior": TouchPrior.create(PLACES, correlation=0.02), "noise": 1e-4}


def optimise(layout=START, *, model=MODEL, steps=100, starts=1, key=None, callback=None, **space):
    skin = Skin(layout, model, thickness=0.01, conductivity=0.2)
    found = DesignSpace(**space)
    return optimise_layout(
        skin, Objective(TOUCHES, **SETTING), found, steps=steps, starts=starts, key=key, callback=callback
    )


def optimise_from_three(steps=14, **options):
    return optimise(starts=3, key=jax.random.key(1), steps=steps, **LIMITS, **options)


@pytest.fixture(scope="module")
def found():
    return optimise_from_three()


def distances(centres):
    return np.linalg.norm(centres[:, None] - centres, axis=-1)[np.triu_indices(len(centres), 1)]


def test_random_starts_are_moved_until_they_satisfy_the_constraints():
    skin, space = Skin(START, MODEL, thickness=0.01, conductivity=0.2), DesignSpace(**LIMITS)
    constraints = space.constraints(skin)
    variables = space.variables(skin, constraints, TOUCHES.depth)
    drawn = np.stack([variables.start, *_random_starts(variables, constraints, 2, jax.random.key(1))])
    assert (shortfall(constraints, variables, drawn)[1:] > 1e-3).all()
    assert (shortfall(constraints, variables, _make_feasible(variables, constraints, jnp.asarray(drawn))) == 0).all()


def shortfall(constraints, variables, all_variables):
    parameters = _parameters_of_starts(variables, jnp.asarray(all_variables))
    layouts = zip(parameters.centres, parameters.radii, strict=True)
    return np.maximum([_largest_violation(constraints, *layout) for layout in layouts], 0)


def test_the_minimised_costs_have_their_gradients(monkeypatch):
    """For all starting points, in one direction, central differences of score and penalty."""
    asked = []

    def stay(cost, variables, steps, record, **options):
        if options:  # up to where the constraints are satisfied
            return minimise_from_starts(cost, variables, steps, record, **options)
        asked.append((cost, np.asarray(variables)))
        return variables, "step limit"

    monkeypatch.setattr("jeit.design.optimisation.optimise.minimise_from_starts", stay)
    optimise_from_three()
    cost, variables = asked[0]
    direction = np.random.default_rng(0).normal(size=variables.shape)
    slope = np.sum(np.asarray(cost(variables)[2]) * direction, axis=1)
    step = 1e-6
    above, below = (np.asarray(cost(variables + sign * step * direction)[0]) for sign in (1, -1))
    np.testing.assert_allclose(slope, (above - below) / (2 * step), rtol=1e-4)


def test_the_optimised_layout_is_much_better(found):
    assert found.value > found.start_value + 2
    before = layout_scores(MODEL, 2e-3, TOUCHES, **SETTING)
    np.testing.assert_allclose(found.start_value, balanced_score(before), rtol=1e-9)
    np.testing.assert_allclose(found.value, balanced_score(found.scores), rtol=1e-9)
    assert float(found.scores.soft_worst) > 2 * float(before.soft_worst)
    assert float(found.scores.mean_variance) < 0.7 * float(before.mean_variance)
    assert found.status in ("converged", "step limit")
    assert "satisfied by 3" in found.reason


def test_all_starting_points_end_within_all_constraints(found):
    np.testing.assert_array_equal(found.shortfall, 0)
    for centres in found.centres:
        assert distances(centres).min() >= SPACING
        assert np.abs(centres).max() <= 0.05 - 4e-3
        assert np.linalg.norm(centres - KEEP_OUT.centre, axis=1).min() >= KEEP_OUT.radius + 4e-3
    assert found.layout.labels == START.labels
    assert found.layout.outline == SKIN


def test_history_and_snapshots_contain_the_iterations(found):
    steps = found.history.shape[1]
    assert found.snapshots.shape == (3, steps, NUMBER, 2)
    np.testing.assert_allclose(found.snapshots[0, 0], START.centres, atol=1e-12)
    assert found.values.max() == found.value
    assert 1 < steps <= 15


def test_same_arguments_same_layout(found):
    """Bit by bit on a CPU. A GPU sums in another order each time."""
    tolerance = 0.0 if jax.default_backend() == "cpu" else 1e-6
    reported = []
    again = optimise_from_three(callback=lambda step, scores: reported.append((step, scores)))
    np.testing.assert_allclose(again.centres, found.centres, rtol=tolerance, atol=tolerance * 0.05)
    np.testing.assert_allclose(np.stack([scores for _, scores in reported], axis=1), found.history, rtol=tolerance)
    assert [step for step, _ in reported] == list(range(len(reported)))


def test_the_search_is_over_symmetric_layouts_with_sizes_within_limits():
    """For any variables the quarters of the skin are equal, and the variables of a symmetric layout reproduce it."""
    ring = Layout(perimeter(Rectangle(0.08, 0.08), NUMBER, start=0.005), 8e-3, outline=SKIN)
    skin = Skin(ring, MODEL, thickness=0.01, conductivity=0.2)
    space = DesignSpace(symmetry="rotate-4", sizes=(6e-3, 12e-3))
    variables = space.variables(skin, space.constraints(skin), TOUCHES.depth)
    parameters_of = eqx.filter_jit(variables.parameters)
    start = parameters_of(jnp.asarray(variables.start))
    np.testing.assert_allclose(nearest(start.centres, ring.centres), 0, atol=1e-9)
    np.testing.assert_allclose(start.radii, 4e-3, rtol=1e-9)
    for values in np.random.default_rng(0).uniform(size=(3, len(variables.start))):
        centres, radii, *_ = (np.asarray(part) for part in parameters_of(jnp.asarray(values)))
        assert np.abs(centres).max() <= 0.05
        match = np.linalg.norm(centres[:, None] - centres @ np.array([[0, 1], [-1, 0]]), axis=-1)
        np.testing.assert_allclose(match.min(axis=1), 0, atol=1e-9)
        np.testing.assert_allclose(radii[match.argmin(axis=0)], radii, rtol=1e-9)
        assert 3e-3 <= radii.min() < radii.max() <= 6e-3


def nearest(places, others):
    """Distance from each place to the nearest of the others."""
    return np.linalg.norm(np.asarray(places)[:, None] - np.asarray(others), axis=-1).min(axis=1)


@pytest.mark.slow
def test_symmetry_and_sizes():
    # A shift along the edge keeps electrodes off the axes, about which the quarters are symmetric.
    track = Rectangle(0.08, 0.08)
    ring = Layout(perimeter(track, NUMBER, start=0.005), 8e-3, outline=SKIN)
    found = optimise(ring, symmetry="rotate-4", sizes=(6e-3, 12e-3), steps=8, minimum_spacing=0.015)
    centres, diameters = np.asarray(found.layout.centres), np.asarray(found.layout.diameters)
    assert found.value > found.start_value + 0.1
    turned = centres @ np.array([[0, 1], [-1, 0]])
    match = np.linalg.norm(centres[:, None] - turned, axis=-1)
    np.testing.assert_allclose(match.min(axis=1), 0, atol=1e-9)
    np.testing.assert_allclose(diameters[match.argmin(axis=0)], diameters, rtol=1e-9)
    assert 6e-3 <= diameters.min() < diameters.max() <= 12e-3
    assert distances(centres).min() >= 0.015


@pytest.mark.slow
def test_contact_impedance_and_thickness_are_variables():
    """They stay within their ranges and improve the score, and the reported scores are those of such a skin, built
    anew.
    """
    found = optimise(contact_impedance=(2e-5, 5e-4), thickness=(6e-3, 2e-2), steps=5)
    assert found.best == 0
    impedance, thickness = np.asarray(found.layout.contact_impedance), float(found.thickness[0])
    assert impedance.shape == (NUMBER,)
    assert 2e-5 <= impedance.min() < impedance.max() <= 5e-4
    assert 6e-3 <= thickness < 0.01  # the thinner, the larger the fraction of the current's path that a touch takes
    model = MODEL.with_electrodes(found.layout.sheet_discs())
    touches = sheet_touches(MESH, Bell(deviation=12e-3), PLACES, thickness=thickness)
    scores = layout_scores(model, 2e-3 * thickness / 0.01, touches, **SETTING)
    np.testing.assert_allclose(found.value, balanced_score(scores), rtol=1e-6)
    np.testing.assert_allclose(found.scores.sensitivity, scores.sensitivity, rtol=1e-6)
    fixed = optimise(steps=5)
    assert found.value > fixed.value + 0.3
    np.testing.assert_array_equal(fixed.thickness, 0.01)
    assert fixed.layout.contact_impedance is None


def test_shortfall_is_the_missing_distance():
    angle = np.arange(6)
    corners = 0.05 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    hexagon = Polygon(corners, [[[0, 0], [0, 0.01], [0.01, 0]]])
    points = 0.06 * np.random.default_rng(0).uniform(-1, 1, (200, 2))
    shortfall = eqx.filter_jit(Constraints(hexagon, 0.0).violations)
    lacking = shortfall(jnp.asarray(points), jnp.full(200, 1e-9))[-200:]
    loops = [np.asarray(loop) for loop in (hexagon.vertices, *hexagon.holes)]
    inside = Path(loops[0]).contains_points(points) & ~Path(loops[1]).contains_points(points)
    np.testing.assert_array_equal(lacking < 0, inside)
    edge = np.concatenate(
        [loop + t * (np.roll(loop, -1, axis=0) - loop) for loop in loops for t in np.linspace(0, 1, 2001)]
    )
    nearest = np.min(np.linalg.norm(points[:, None] - edge, axis=-1), axis=1)
    np.testing.assert_allclose(np.abs(lacking), nearest, atol=5e-6)


L_SHAPE = Polygon(((0.0, 0.0), (0.1, 0.0), (0.1, 0.04), (0.04, 0.04), (0.04, 0.1), (0.0, 0.1)))


@pytest.mark.slow
@pytest.mark.parametrize("outline", [L_SHAPE, Disk(0.05)], ids=["L", "disk"])
def test_skins_that_do_not_fill_their_bounding_box(outline):
    """A step may move an electrode off the skin, where it has no score."""
    mesh = outline.mesh(num_points=250)
    middle = np.mean(outline.extent[:2]), np.mean(outline.extent[2:])
    inside = touches_away_from_the_edge(outline, 4e-3, 9, 9).places
    rim = inside[np.argsort(-np.linalg.norm(inside - middle, axis=1), kind="stable")]
    layout = Layout(rim[: 2 * NUMBER : 2], 6e-3, outline=outline)
    places = touch_grid(outline, 7, 7).places
    model = ForwardModel(mesh, layout.sheet_discs(1e-4), two_terminal(NUMBER))
    skin = Skin(layout, model, thickness=0.01, conductivity=0.2)
    objective = Objective.create(skin, places, correlation=0.02, noise=1e-4)
    found = optimise_layout(skin, objective, steps=10, starts=2, key=jax.random.key(0))
    assert found.status != "stalled"
    assert found.history.shape[1] > 5
    assert found.value > found.start_value + 0.5
    assert found.shortfall.max() == 0


def test_points_off_a_skin_are_projected_to_its_edge():
    points = np.array([[0.02, 0.05], [0.07, 0.05], [0.05, 0.09], [0.045, 0.05], [-0.01, -0.02]])
    expected = np.array([[0.02, 0.05], [0.07, 0.04], [0.04, 0.09], [0.04, 0.05], [0.0, 0.0]])
    np.testing.assert_allclose(L_SHAPE.nearest(points), expected, atol=1e-15)
    expected = np.array([[0.02, 0.01], [0.03, 0.04], [0.0, -0.05]])
    np.testing.assert_allclose(Disk(0.05).nearest(expected * [[1], [1.7], [1.1]]), expected, atol=1e-15)


@pytest.mark.slow
def test_the_optimised_skin_is_better_than_the_papers_and_a_regular_grid():
    """Starting from the boundary layout, on a coarse sheet. Evaluated on a finer one, at other places, with exact
    touches.
    """
    skin, protocol, conductance = Rectangle(0.2, 0.2), two_terminal(32), 2e-3
    start = named_layout("park-boundary")

    def setting(nodes, columns):
        mesh, grid = rectangle(0.2, 0.2, num_points=nodes), touch_grid(skin, columns, columns)
        touches = sheet_touches(mesh, Bell(), grid.places, thickness=0.01)
        prior = TouchPrior.create(grid.places, correlation=0.015)
        return ForwardModel(mesh, start.sheet_discs(1e-4), protocol), grid, touches, {"prior": prior, "noise": 1e-4}

    model, _, touches, options = setting(700, 14)
    sheet = Skin(start, model, thickness=0.01, conductivity=conductance / 0.01)
    found = optimise_layout(sheet, Objective(touches, **options), DesignSpace(minimum_spacing=8e-3), steps=20)
    model, grid, touches, options = setting(2500, 24)
    worst, variance = {}, {}
    for layout in (found.layout, start, named_layout("park-inner"), named_layout("grid-8x4")):
        moved = model.with_electrodes(layout.sheet_discs(1e-4))
        worst[layout.name] = sensitivity_map(moved, conductance, grid, thickness=0.01).minimum
        variance[layout.name] = layout_scores(moved, conductance, touches, **options).mean_variance
    best_worst, least_variance = worst.pop(found.layout.name), variance.pop(found.layout.name)
    assert best_worst > 1.4 * worst["park-boundary"]
    assert best_worst > 5 * max(worst["park-inner"], worst["grid-8x4"])
    assert least_variance < 0.5 * min(variance.values())


def test_error_messages():
    with pytest.raises(ValueError, match="do not fit the outline"):
        optimise(minimum_spacing=0.06)
    with pytest.raises(ValueError, match="key, which random starts need, must be one random key"):
        optimise(starts=2)
    with pytest.raises(ValueError, match="8 of 8 electrodes are in the first of 2 parts"):
        optimise(Layout(START.centres - 5e-4, 8e-3, outline=Rectangle(0.1, 0.3)), symmetry="mirror-y")
    with pytest.raises(ValueError, match=r"^symmetry must be one of .*, or None; it is "):
        optimise(symmetry="glide")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="a quarter turn maps only a square"):
        optimise(Layout(START.centres, 8e-3, outline=Rectangle(0.1, 0.3)), symmetry="rotate-4")
    with pytest.raises(ValueError, match="keep_out: it leaves no room"):
        optimise(starts=2, key=jax.random.key(0), keep_out=(Rectangle(0.2, 0.2),))
    with pytest.raises(ValueError, match="outline: it reaches 50 mm beyond the model's mesh"):
        optimise(outline=Rectangle(0.2, 0.2))
    with pytest.raises(ValueError, match="keep_out must be a list of domains"):
        optimise(keep_out=Disk(0.01))
    with pytest.raises(ValueError, match=r"more than the skin is wide, .* were millimetres given for metres"):
        optimise(thickness=(5, 20))
    with pytest.raises(ValueError, match="sizes: the outline is smaller than an electrode"):
        optimise(sizes=(8, 20))
    with pytest.raises(ValueError, match="outline: the layout does not know"):
        optimise(Layout(START.centres, 8e-3))
    with pytest.raises(ValueError, match="the model 8; their number cannot change"):
        optimise(Layout(START.centres[:6], 8e-3, outline=SKIN))
    five = LayoutParameters(START.centres[:5], START.diameters[:5] / 2, jnp.ones(5), jnp.ones(()))
    with pytest.raises(ValueError, match="add or remove 1, or choose another symmetry"):
        Variables.create(SKIN, five, symmetry="mirror-x")
    with pytest.raises(ValueError, match="contact_impedance must be two values"):
        optimise(contact_impedance=(1e-3, 1e-4))
    with pytest.raises(ValueError, match=r"the touches are 2\.5 mm deep"):
        optimise(thickness=(2e-3, 2e-2))
    with pytest.raises(ValueError, match="sizes must be two values"):
        optimise(sizes=(8e-3, 4e-3))
    with pytest.raises(ValueError, match="steps must be"):
        optimise(steps=0)
    points = ForwardModel(MESH, PointElectrodes(START.centres), two_terminal(NUMBER))
    with pytest.raises(ValueError, match="model has PointElectrodes"):
        optimise(model=points)
    thicker = Skin(START, MODEL, thickness=0.02, conductivity=0.2)
    with pytest.raises(ValueError, match="touches are of a sheet 10 mm thick, and the skin is 20 mm thick"):
        optimise_layout(thicker, Objective(TOUCHES, **SETTING))
    with pytest.raises(ValueError, match="skin is a layer; layouts are optimised on a sheet"):
        optimise_layout(Skin.create(START, cell_size=0.012), Objective(TOUCHES, **SETTING))


def test_starting_points_that_end_outside_the_constraints_are_reported(monkeypatch):
    """As where minimising the penalty makes all layouts too dense: the given layout is kept."""

    def descent(variables, constraints, values):
        return jnp.broadcast_to(variables.start, values.shape)

    monkeypatch.setattr("jeit.design.optimisation.optimise._make_feasible", descent)
    crowded = Layout(0.4 * START.centres, 8e-3, outline=SKIN, name="low")  # for the compiled program of the others
    found = optimise_from_three(layout=crowded, steps=1)
    assert (found.status, found.best) == ("infeasible", None)
    assert (found.shortfall > 1e-3).all()
    assert found.reason.startswith("no start satisfies the constraints: minimum_spacing= lacks 10.4 mm")
    assert found.layout is crowded
    assert found.value == found.start_value


@pytest.mark.slow
def test_infeasible_constraints_are_reported():
    found = optimise(keep_out=(Rectangle(0.096, 0.096),), steps=1)
    assert found.status == "infeasible"
    assert found.shortfall[0] > 1e-3
    assert "minimum_spacing= lacks" in found.reason  # all are confined to a corner
    assert found.layout is START
