"""Cuts located on a model of the skin: their places, contacts in images beside them, and refused input."""

import equinox as eqx
import jax
import numpy as np
import pytest
from matplotlib.figure import Figure

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch import CellFinder, SkinHealth, find_contacts, watch
from jeit.touch.health import EventKind, EventStatus
from jeit.touch.plots import plot_health
from jeit.touch.simulate import DiscIndenter, MovingPress, PressedSkin, material
from jeit.touch.simulate.damage import Cut, DamageEvent, record_damage

CUT = Cut([(-0.005, 0.014), (0.02, 0.024)])
MATERIAL = material("velostat")
SHEET = MATERIAL.conductivity * MATERIAL.thickness
DAMAGED, PRESSED = 12.0, (10.0, 13.0)
SECONDS = np.arange(0, 26, 0.5)


def disk_model(num_points: int, refine=None) -> ForwardModel:
    mesh = Disk(0.05).mesh(num_points=num_points, refine=refine)
    return ForwardModel(mesh, BoundaryElectrodes(ring(0.05, 16), 0.008, 300.0), adjacent(16))


@pytest.fixture(scope="module")
def skin() -> PressedSkin:
    return PressedSkin(jax.random.key(0), disk_model(500, CUT.refine(2e-3)), MATERIAL)


@pytest.fixture(scope="module")
def damaged(skin) -> PressedSkin:
    return eqx.tree_at(lambda one: one.conductivity, skin, CUT.conductivity(skin.model.mesh, skin.conductivity))


def press(places, starts, load=2.0, last=1.0) -> MovingPress:
    """One press after the other, each of one second."""
    loads, position = np.zeros(len(SECONDS)), np.zeros((len(SECONDS), 2))
    for place, start in zip(places, starts, strict=True):
        there = (start <= SECONDS) & (start + last > SECONDS)
        loads[there], position[there] = load, place
    return MovingPress(DiscIndenter(0.012), loads, position)


@pytest.fixture(scope="module")
def health(skin) -> SkinHealth:
    places = 0.03 * np.array([(np.cos(a), np.sin(a)) for a in np.arange(6)])
    frames = record_damage(jax.random.key(1), skin, press(places, 2.0 + 4.5 * np.arange(6)), SECONDS, [])
    return SkinHealth.fit(frames, SECONDS, patience=9.0, model=disk_model(500), conductivity=SHEET)


@pytest.fixture(scope="module")
def after(skin, damaged, health) -> SkinHealth:
    """The cut occurs during a touch."""
    touch = press([(-0.02, -0.02)], PRESSED[:1], last=PRESSED[1] - PRESSED[0])
    frames = record_damage(jax.random.key(2), skin, touch, SECONDS, [DamageEvent(DAMAGED, damaged)])
    return watch(health, frames, SECONDS)


def test_a_cut_is_located(after):
    (event,) = after.open_events
    assert (event.kind, event.status) == (EventKind.CUT, EventStatus.LASTING)
    assert abs(event.time - DAMAGED) <= 0.5
    along, found = CUT.along(1e-3), Cut(event.path).along(1e-3)
    apart = np.linalg.norm(along[:, None] - found, axis=-1)
    assert 0.5 * (apart.min(axis=0).mean() + apart.min(axis=1).mean()) < 1.5e-3
    assert event.through
    assert abs(event.length - CUT.length) < max(0.15 * CUT.length, 2 * event.deviation)
    assert 0 < event.deviation < 0.3 * CUT.length


def test_touches_beside_the_cut_are_located(after, damaged):
    place = np.array([-0.02, -0.012])
    read = damaged.read(jax.random.key(5), pressed(damaged, place), np.array([20.0]))
    contact = find_contacts(CellFinder(after.skin.model.mesh), after.images(read)[0])[0]
    assert np.linalg.norm(contact.centroid - place) < 7e-3  # a mean cell is 4 mm wide


def pressed(skin: PressedSkin, place) -> np.ndarray:
    motion = MovingPress(DiscIndenter(0.012), np.array([2.0]), place)
    touched = skin.touched_in_time(motion, np.array([0.0]))
    change = np.bincount(np.asarray(touched.cells)[0], np.asarray(touched.change)[0], skin.model.mesh.num_cells)
    return np.asarray(skin.model.voltages(skin.conductivity * (1 + change)))[None]


def test_images_do_not_use_channels_that_are_not_read(after):
    frames = np.tile(after.reference, (3, 1))
    frames[0, :13] = np.nan
    frames[2] = np.nan
    images = after.images(frames)
    assert np.isfinite(images).all(axis=1).tolist() == [True, True, False]
    assert np.abs(images[:2]).max() < 1e-6 * SHEET


def test_a_cut_that_the_user_denies_is_removed_from_the_model(after):
    assert np.ptp(after.skin.conductivity) > 0
    denied = after.deny(after.open_events[0])
    assert np.ptp(denied.skin.conductivity) == 0


def test_a_figure_has_the_cut_and_its_length(after):
    ax = plot_health(after, title="a skin", ax=Figure().subplots())
    labels = [text.get_text() for text in ax.texts]
    event = after.open_events[0]
    assert any(f"cut, {1e3 * event.length:.0f} ± {1e3 * event.deviation:.0f} mm" in text for text in labels)
    assert any(text.endswith("0 mm") and text[0].isdigit() for text in labels)  # the scale bar
    lines = [np.column_stack(line.get_data()) for line in ax.lines]
    assert any(line.shape == (2, 2) and np.allclose(line, after.open_events[0].path) for line in lines)
    image = after.images(after.reference[None])[0]
    mended = after.repaired(np.tile(after.reference, (5, 1)))
    assert any("mended" in text.get_text() for text in plot_health(mended, image, ax=Figure().subplots()).texts)
    with pytest.raises(ValueError, match="health must be"):
        plot_health("skin")  # pyright: ignore[reportArgumentType]


def test_after_repair_the_skin_is_healthy(after, skin):
    mended = after.repaired(np.tile(skin.rest(), (5, 1)))
    assert mended.open_events == []
    np.testing.assert_array_equal(mended.skin.conductivity, np.full(mended.skin.model.mesh.num_cells, SHEET))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": "disk"}, "model"),
        ({"sign": 0, "conductivity": SHEET}, "sign"),
        ({}, "conductivity"),
        ({"conductivity": 1e-4 * SHEET}, "times what the model predicts"),
    ],
)
def test_bad_references_are_refused(options, message):
    model = disk_model(300)
    frames = np.asarray(model.voltages(SHEET)) * (1 + 1e-3 * np.random.default_rng(0).normal(size=(60, 208)))
    with pytest.raises(ValueError, match=message):
        SkinHealth.fit(frames, **({"model": model} | options))
    with pytest.raises(ValueError, match="channels"):
        SkinHealth.fit(frames[:, :90], model=model, conductivity=SHEET)


def test_images_need_a_model():
    frames = 1 + 1e-3 * np.random.default_rng(0).normal(size=(60, 20))
    with pytest.raises(ValueError, match="model"):
        SkinHealth.fit(frames).images(frames)
