"""Bodies at a given depth: their depth maps, the changes they cause, and sets that continue after a killed run."""

import jax
import numpy as np
import pytest

from jeit.design import Skin
from jeit.layout import named_layout
from jeit.mesh import Rectangle, measures
from jeit.touch.simulate import (
    BarIndenter,
    DiscIndenter,
    Indent,
    IndentDraws,
    IndentSet,
    ball_indenter,
    depth_maps,
    indented_cells,
    open_presses,
    relative_changes,
    simulate_presses,
)
from jeit.touch.simulate.contact.indent_sets import image_places
from jeit.touch.simulate.contact.indents import resting_skin


def made(num_layers: int, cell_size: float = 5e-3) -> Skin:
    return Skin.create(named_layout("grid-3x3", Rectangle(0.06, 0.06)), num_layers=num_layers, cell_size=cell_size)


@pytest.fixture(scope="module")
def sheet():
    return made(0, 8e-3)


def test_a_ball_leaves_a_cap(sheet):
    """Of volume π d² (R − d / 3)."""
    places = image_places(sheet, 240, 240)
    (depth,) = depth_maps([[Indent(ball_indenter(0.02), 4e-3, (0.003, -0.004))]], places)
    volume = depth.sum() * (0.06 / 240) ** 2
    assert volume == pytest.approx(np.pi * 4e-3**2 * (0.01 - 4e-3 / 3), rel=1e-3)
    assert np.linalg.norm(places.reshape(-1, 2)[depth.argmax()] - (0.003, -0.004)) < 0.3e-3


def test_rotated_and_several_bodies(sheet):
    places = image_places(sheet, 120, 120)
    bar = BarIndenter(0.03, 0.006)
    along, across = (depth_maps([[Indent(bar, 2e-3, angle=one)]], places)[0] for one in (0.0, np.pi / 2))
    assert np.allclose(along, across.T)
    both = depth_maps([[Indent(bar, 2e-3), Indent(bar, 3e-3, angle=np.pi / 2)]], places)[0]
    assert np.allclose(both, np.maximum(along, 1.5 * across))


@pytest.mark.parametrize("num_layers", [0, 4])
def test_indented_volume_does_not_conduct(num_layers):
    """The fraction of the skin's volume that cells lose is that of the indented body."""
    skin = made(num_layers)
    depth = 4e-3
    cells = indented_cells(skin, [[Indent(DiscIndenter(0.03), depth)]])
    lost = -np.sum(np.asarray(cells.change) * np.asarray(measures(skin.model.mesh))[np.asarray(cells.cells)])
    whole = float(skin.outline.area) * (float(skin.thickness) if num_layers else 1.0)
    wanted = np.pi * 0.015**2 * depth / (0.06**2 * float(skin.thickness))
    assert lost / whole == pytest.approx(wanted, rel=0.12 if num_layers else 0.03)


def test_changes_are_those_of_the_model(sheet):
    """Against the model solved anew, and zero where nothing touches."""
    touch = [Indent(ball_indenter(0.02), 5e-3, (0.004, 0.002)), Indent(DiscIndenter(0.01), 2e-3, (-0.015, 0.0))]
    cells = indented_cells(sheet, [touch])
    conductivity = np.full(sheet.model.mesh.num_cells, float(sheet.model_conductivity))
    conductivity[np.asarray(cells.cells[0])] *= 1 + np.asarray(cells.change[0])
    rest, pressed = (np.asarray(sheet.model.voltages(one)) for one in (sheet.model_conductivity, conductivity))
    found, nothing = relative_changes(sheet, [touch, []])
    assert np.allclose(found, pressed / rest - 1, rtol=1e-6, atol=1e-9)
    assert np.abs(nothing).max() == 0


@pytest.fixture
def draws(sheet):
    return IndentDraws([ball_indenter(0.015), DiscIndenter(0.01)], sheet.outline, (1e-3, 6e-3), margin=5e-3, at_once=2)


def test_draws(draws):
    touches = draws.draw(jax.random.key(0), 400)
    depths = np.array([one.depth for touch in touches for one in touch])
    assert depths.min() >= 1e-3
    assert depths.max() <= 6e-3
    assert np.median(depths) == pytest.approx(np.sqrt(6) * 1e-3, rel=0.1)
    assert {len(touch) for touch in touches} == {1, 2}


@pytest.mark.slow
def test_a_set_is_resumed(sheet, tmp_path):
    """Stopped after its first chunk, it ends with the same arrays."""
    draws = IndentDraws([DiscIndenter(0.01)], sheet.outline, (1e-3, 6e-3), margin=5e-3, at_once=2)
    indents = IndentSet(sheet, draws, 8, seed=3, shape=(12, 12), chunk=4)
    whole = simulate_presses(indents, tmp_path / "whole.zarr")

    def stop(now):
        if now.chunks == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_presses(indents, tmp_path / "killed.zarr", progress=stop)
    assert open_presses(indents, tmp_path / "killed.zarr").finished.sum() == 4
    reports = []
    again = simulate_presses(indents, tmp_path / "killed.zarr", progress=reports.append)
    assert reports[0].chunks == 1
    for name in ("change", "depth"):
        assert np.array_equal(again[name].to_numpy(), whole[name].to_numpy())
    depth = whole["depth"].to_numpy()
    assert depth.shape == (8, 12, 12)
    assert 0 <= depth.min() <= depth.max() <= 0.6
    assert np.abs(whole["change"].to_numpy()).max(axis=1).min() > 0
    drawn = draws.draw(jax.random.fold_in(jax.random.key(3), 1), 4)
    assert np.allclose(
        whole["change"].to_numpy()[4:8], relative_changes(sheet, drawn, resting_skin(sheet, 6e-3)), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda skin, draws: Indent("ball", 1e-3), "indenter must be an indenter"),
        (lambda skin, draws: Indent(DiscIndenter(0.01), 0.0), "depth must be a positive length"),
        (lambda skin, draws: IndentDraws([DiscIndenter(0.01)], skin.outline, (1.0, 8.0)), "were millimetres given"),
        (
            lambda skin, draws: indented_cells(skin, [[Indent(DiscIndenter(0.01), 0.02)]]),
            "depth is 20 mm, and the skin 10 mm thick",
        ),
        (lambda skin, draws: indented_cells("skin", []), "skin must be a Skin"),
        (lambda skin, draws: IndentSet(skin, draws, 0), "number must be a whole number"),
        (lambda skin, draws: IndentSet(skin, draws, 1, seed=-1), "seed must be a whole number"),
        (lambda skin, draws: IndentSet(skin, "draws", 1), "draws must be IndentDraws"),
        (
            lambda skin, draws: IndentSet(skin, IndentDraws([DiscIndenter(0.01)], skin.outline, (1e-3, 0.02)), 1),
            "draws go 20 mm deep, and the skin is 10 mm thick",
        ),
        (lambda skin, draws: simulate_presses("set", "here"), "presses must be a PressSet"),
    ],
)
def test_bad_arguments(sheet, draws, make, message):
    with pytest.raises(ValueError, match=message):
        make(sheet, draws)
