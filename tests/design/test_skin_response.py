"""The response of a skin with one layout: insulating and conductive touches, with all arguments checked before any is
simulated.
"""

import jax
import numpy as np
import pytest

from jeit.design import (
    DesignSpace,
    Objective,
    Skin,
    TouchPrior,
    compare_layouts,
    defaults,
    find_taxels,
    improve_layout,
    optimise_layout,
    sensitivity_map,
    skin_response,
    touch_grid,
    touches_away_from_the_edge,
)
from jeit.design.comparison import comparison_figures
from jeit.design.measurements import random_selections
from jeit.design.skin.names import skin_protocol
from jeit.layout import Layout, grid
from jeit.mesh import Polygon, Rectangle

OUTLINE = Rectangle(0.06, 0.05)
LAYOUT = Layout(grid(0.04, 0.03, 3, 2), 8e-3, outline=OUTLINE, name="six")
GRID = touches_away_from_the_edge(OUTLINE, 5e-3, 6, 6)
OPTIONS = {"num_layers": 5, "cell_size": 6e-3}


def respond(*, num_pairs=6, num_taxels=8, contrast=0.0, **options):
    skin = Skin.create(LAYOUT, protocol=skin_protocol(LAYOUT, num_pairs=num_pairs), **{**OPTIONS, **options})
    touched = skin.touched_cells(GRID.places, contrast=contrast)
    return skin, skin_response(skin, GRID, key=jax.random.key(0), touched=touched, num_taxels=num_taxels)


def objective(skin):
    return Objective.create(skin, GRID.places)


@pytest.mark.parametrize("contrast", [0.0, 5.0])
def test_touches_insulate_or_conduct(contrast):
    skin, response = respond(contrast=contrast)
    alone = sensitivity_map(skin.model, 1.0, GRID, contrast=contrast)
    np.testing.assert_allclose(response.sensitivity.values, alone.values, rtol=1e-10)  # the solves' rounding


def test_a_comparison_with_itself_has_no_blind_spot():
    _, response = respond()
    one, other = comparison_figures(response, response)
    assert one == other
    assert one["blind_spot_fraction"] == 0
    theta = np.asarray(response.sensitivity.values)
    # Two points are distinguished at the diameter of a taxel, on average.
    diameter_mm = 10 * np.sqrt(4 * one["taxel_area_cm2"]["mean"] / np.pi)
    assert 0.8 * diameter_mm < one["two_point_mm"] < 1.01 * diameter_mm
    assert one["sensitivity_uniformity"] == pytest.approx(theta.mean() / np.sqrt((theta**2).mean()))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"contrast": 1.0}, "contrast must be a factor"),
        ({"cell_size": 1e-5}, r"cell_size is 0\.01 mm, which makes about 2\.2e\+08 nodes; give 0\.15 mm or more"),
        (
            {"cell_size": 0.05},
            r"cell_size is 50 mm; give no more than 12 mm, as electrodes of 'six' are 8 mm across\.$",
        ),
        ({"thickness": 2e-3}, "thickness is 2 mm; give more than the 2.5 mm"),
        ({"thickness": 0.055}, "thickness is 55 mm; give more than the 2.5 mm"),
        ({"thickness": 10}, r"thickness is 10000 mm, more than the skin is wide, .* were millimetres given for metres"),
        ({"thickness": "10"}, "thickness must be a positive length in metres; it is '10'"),
        ({"cell_size": 4.5}, "cell_size is 4500 mm; give no more than .* were millimetres given for metres"),
        ({"cell_size": np.nan}, "cell_size must be a positive length in metres; it is nan"),
        ({"cell_size": -4.5e-3}, r"cell_size must be a positive length in metres; it is -0\.0045"),
        ({"conductivity": -1.0}, "conductivity"),
        ({"num_pairs": 16}, "num_pairs is 16; 'six' has 6 electrodes, and they make 15 pairs"),
        ({"num_taxels": 200}, "num_taxels is 200"),
    ],
)
def test_touches_that_cannot_be_detected_are_refused_before_they_are_simulated(options, message, monkeypatch):
    monkeypatch.setattr(Skin, "voltage_changes", None)
    with pytest.raises(ValueError, match=message):
        respond(**options)


def test_a_skin_is_a_sheet_or_a_layer_with_one_set_of_defaults():
    sheet, layer = (Skin.create(LAYOUT, num_layers=number, cell_size=6e-3) for number in (0, 4))
    assert [skin.model.mesh.dimension for skin in (sheet, layer)] == [2, 3]
    for skin in (sheet, layer):
        np.testing.assert_array_equal(skin.model.electrodes.contact_impedance, defaults.CONTACT_IMPEDANCE)
        assert skin.model.protocol.num_measurements == 15  # all pairs, since there are fewer than 94
        assert (skin.thickness, float(skin.conductivity)) == (defaults.THICKNESS, defaults.CONDUCTIVITY)
    assert float(sheet.model_conductivity) == pytest.approx(0.01)
    assert float(layer.model_conductivity) == 1.0


def test_the_same_mesh_with_other_electrodes():
    skin = Skin.create(LAYOUT, num_layers=0, cell_size=6e-3)
    moved = skin.with_layout(Layout(LAYOUT.centres + 2e-3, 8e-3, outline=OUTLINE, contact_impedance=5e-4))
    assert moved.model.mesh.points is skin.model.mesh.points
    np.testing.assert_array_equal(moved.model.electrodes.contact_impedance, 5e-4)
    with pytest.raises(ValueError, match="cell_size is 6 mm; give no more than 3 mm"):
        skin.with_layout(Layout(LAYOUT.centres, 2e-3, outline=OUTLINE))


def test_a_drawing_of_a_rectangle_is_meshed_as_a_rectangle():
    drawn = Layout(LAYOUT.centres, 8e-3, outline=Polygon(OUTLINE.vertices))
    assert isinstance(Skin.create(drawn, num_layers=0, cell_size=6e-3).outline, Rectangle)


@pytest.mark.parametrize(
    ("call", "complaint"),
    [
        (lambda skin: Skin.create("grid-2x2"), "layout must be a Layout"),
        (lambda skin: skin_response(skin.layout, GRID, key=None), "skin must be a Skin"),
        (lambda skin: skin_response(skin, GRID.places, key=None), "grid must be a TouchGrid"),
        (lambda skin: compare_layouts(skin.layout, skin), "first must be a Skin"),
        (lambda skin: optimise_layout(skin.layout, None), "skin must be a Skin"),
        (lambda skin: optimise_layout(skin, "minimum"), "objective must be an Objective, .*; it is 'minimum'"),
        (lambda skin: optimise_layout(skin, objective(skin), "disk"), "space must be a DesignSpace, .*; it is 'disk'"),
        (lambda skin: optimise_layout(skin, objective(skin), starts=2), "key, which random starts need, .* it is None"),
        (lambda skin: optimise_layout(skin, objective(skin), key=3), r"jax\.random\.key\(3\); it is 3"),
        (lambda skin: DesignSpace(outline="disk"), "outline must be an outline, such as .*; it is 'disk'"),
        (lambda skin: DesignSpace(keep_out=3), "keep_out must be a list of domains, .*; it is 3"),
        (lambda skin: DesignSpace(minimum_spacing="8 mm"), "minimum_spacing must be .* it is '8 mm'"),
        (lambda skin: Objective.create(skin, GRID), "places must be .*places; it is a TouchGrid"),
        (lambda skin: Objective.create(GRID, skin), "skin must be a Skin, .*; it is a TouchGrid"),
        (lambda skin: Objective.create(skin, GRID.places, GRID), "indentation must be .*; it is a TouchGrid"),
        (lambda skin: Objective(GRID, None), "touches must be SheetTouches, .*; it is a TouchGrid"),
        (lambda skin: Objective(skin.sheet_touches(GRID.places), GRID), "prior must be a TouchPrior"),
        (lambda skin: TouchPrior.create(GRID, correlation=0.05), "places must be .*; it is a TouchGrid"),
        (lambda skin: skin.voltage_changes(GRID), "touched must be TouchedCells, .*; it is a TouchGrid"),
        (lambda skin: sensitivity_map(skin, 1.0, GRID), "model must be a ForwardModel.*; it is a Skin"),
        (lambda skin: sensitivity_map(skin.model, 1.0, GRID.places), "grid must be a TouchGrid, .*; it is an array"),
        (lambda skin: touch_grid(skin), "outline must be an outline, .*; it is a Skin"),
        (lambda skin: skin_protocol("park-inner"), "layout must be a Layout, .*; it is 'park-inner'"),
        (lambda skin: improve_layout("park-inner"), "layout must be a Layout, .*; it is 'park-inner'"),
        (lambda skin: skin_response(skin, GRID, key=7), r"key must be one random key, .*key\(7\); it is 7"),
        (lambda skin: find_taxels(np.ones((3, 2)), np.ones((3, 2)), 1.0, key=None), "key must be .* it is None"),
        (lambda skin: random_selections(0, 9, 3, 2), "key must be one random key"),
        (lambda skin: Objective(None, None, score="minimum"), "score must be a function"),
    ],
)
def test_bad_arguments_are_refused(call, complaint):
    with pytest.raises(ValueError, match=complaint):
        call(Skin.create(LAYOUT, num_layers=0, cell_size=8e-3))
