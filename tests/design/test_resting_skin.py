"""A skin at rest with touches computed in many calls, against the changes of each call alone, and a new solution."""

import numpy as np
import pytest

from jeit.design import Skin
from jeit.design.skin.touched_cells import TouchedCells
from jeit.design.skin.voltage_changes import RestingSkin, touch_changes
from jeit.layout import named_layout
from jeit.mesh import Rectangle
from jeit.touch.simulate import BarIndenter, DiscIndenter, Indent, indented_cells
from jeit.touch.simulate.contact.indents import resting_skin
from jeit_solvers.engines import as_array

# One to three contacts of few and many cells, in a group for one program and beyond its size.
TOUCHES = [
    [Indent(DiscIndenter(0.004), 3e-3, (0.01, 0.0))],
    [
        Indent(DiscIndenter(0.03), 6e-3, (-0.01, 0.01)),
        Indent(BarIndenter(0.05, 0.01), 7e-3),
        Indent(DiscIndenter(0.01), 2e-3, (0.02, 0.02)),
    ],
    *([Indent(DiscIndenter(0.004), 4e-3, (0.001 * number, -0.005))] for number in range(4)),
]


def made(num_layers: int) -> Skin:
    return Skin.create(named_layout("grid-3x3", Rectangle(0.06, 0.06)), num_layers=num_layers, cell_size=8e-3)


@pytest.fixture(scope="module", params=[0, pytest.param(4, marks=pytest.mark.slow)])
def skin(request):
    return made(request.param)


def test_changes_equal_those_of_each_call(skin):
    touched = indented_cells(skin, TOUCHES)
    right = np.asarray(touch_changes(skin.model, skin.model_conductivity, touched))
    resting = resting_skin(skin, 8e-3)
    assert resting is not None
    found = resting.changes(touched)
    assert np.abs(found - right).max() < 1e-12 * np.abs(right).max()
    assert np.allclose(resting.voltages, skin.model.voltages(skin.model_conductivity), rtol=1e-12)


@pytest.mark.slow
def test_changes_equal_those_of_another_call(skin):
    resting = resting_skin(skin, 8e-3)
    assert resting is not None
    found = resting.changes(indented_cells(skin, TOUCHES))
    again = resting.changes(indented_cells(skin, TOUCHES[1:2]))
    assert np.abs(again[0] - found[1]).max() < 1e-12 * np.abs(found).max()


def test_a_layer_selects_the_nodes_that_touches_can_reach(monkeypatch):
    """For four layers of cells in 10 mm: those of the upper one, or of all."""
    monkeypatch.setattr(RestingSkin, "create", lambda model, conductivity, touchable: touchable)
    layer = made(4)
    shallow, deep = (np.asarray(resting_skin(layer, depth)) for depth in (2e-3, 8e-3))
    np.testing.assert_array_equal(shallow, np.asarray(layer.model.mesh.points)[:, 2] > 7.4e-3)
    assert 0 < shallow.sum() < len(shallow)
    assert deep.all()


@pytest.mark.slow
def test_a_layer_stores_the_nodes_that_are_reached():
    """Those of the upper cells, where a smaller depth is touched, and 0 where nothing is."""
    layer = made(4)
    shallow, deep = (resting_skin(layer, depth) for depth in (2e-3, 8e-3))
    assert shallow is not None
    assert deep is not None
    assert shallow.inverse.band.size < 0.5 * deep.inverse.band.size
    touched = indented_cells(layer, [[Indent(DiscIndenter(0.02), 1.5e-3)], []])
    found = shallow.changes(touched)
    assert np.abs(found - deep.changes(touched)).max() < 1e-12 * np.abs(found).max()
    assert not found[1].any()
    conductivity = np.full(layer.model.mesh.num_cells, float(layer.model_conductivity))
    rest = np.asarray(layer.model.voltages(conductivity))
    np.add.at(conductivity, touched.cells[0], conductivity[0] * np.asarray(touched.change[0]))
    anew = np.asarray(layer.model.voltages(np.maximum(conductivity, 1e-9))) - rest
    assert np.abs(found[0] - anew).max() < 1e-7 * np.abs(anew).max()


def test_no_more_than_fits_in_memory():
    sheet = made(0)
    everywhere = np.ones(sheet.model.mesh.num_points, bool)
    assert RestingSkin.create(sheet.model, sheet.model_conductivity, everywhere, max_bytes=1e4) is None


def test_touches_that_do_not_converge():
    """By conductors of any contrast, as for `touch_changes`."""
    sheet = made(0)
    resting = resting_skin(sheet, 8e-3)
    assert resting is not None
    cells = np.arange(sheet.model.mesh.num_cells)[None]
    touched = TouchedCells(as_array(np.zeros((1, 2))), as_array(cells), as_array(np.full(cells.shape, 1e9)), cells.size)
    with pytest.raises(RuntimeError, match="the changes by 1 of 1 touches were not found"):
        resting.changes(touched)
