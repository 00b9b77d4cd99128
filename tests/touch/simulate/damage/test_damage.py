"""Cuts, faults of electrodes and repair: their effect on voltages, and refused input."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk, Rectangle
from jeit.protocol import adjacent, two_terminal
from jeit.touch.simulate import DiscIndenter, MovingPress, PressedSkin, material
from jeit.touch.simulate.damage import FAULTS, Cut, DamageEvent, ElectrodeFault, draw_cut, mend_cut, record_damage

WIDTH, HEIGHT = 0.06, 0.03


def strip(cut: Cut, num_points: int = 1500) -> ForwardModel:
    """A strip with an electrode over each of its ends."""
    mesh = Rectangle(WIDTH, HEIGHT, (0, 0)).mesh(num_points=num_points, refine=cut.refine(5e-4))
    ends = BoundaryElectrodes(np.array([[-WIDTH / 2, 0], [WIDTH / 2, 0]]), 0.999 * HEIGHT, 1e-6)
    return ForwardModel(mesh, ends, two_terminal(2, np.array([[0, 1]]), current=1.0))


def disk_model(cut: Cut, num_points: int = 900) -> ForwardModel:
    mesh = Disk(0.05).mesh(num_points=num_points, refine=cut.refine(1e-3))
    return ForwardModel(mesh, BoundaryElectrodes(ring(0.05, 16), 0.008, 1e-3), adjacent(16, current=1e-3))


@pytest.fixture(scope="module")
def slit() -> ForwardModel:
    return disk_model(Cut([(-0.01, 0.0), (0.01, 0.0)]), 400)


def test_a_complete_cut_blocks_the_current():
    cut = Cut([(0.003, -HEIGHT), (0.003, HEIGHT)])
    model = strip(cut)
    before, after = (
        float(model.voltages(values)[0])
        for values in (np.ones(model.mesh.num_cells), cut.conductivity(model.mesh, 1.0))
    )
    assert before == pytest.approx(WIDTH / HEIGHT, rel=0.02)
    # Almost nothing conducts, over a band of one or two cells' width.
    assert after > 1e6 * 2.5e-4 / HEIGHT


def test_the_resistance_of_a_half_slit_is_that_of_the_formula():
    """A strip seen from the side is a sheet cut to half its depth: longer by (4h/π) ln csc(π/4)."""
    cut = Cut([(0.002, -HEIGHT), (0.002, 0.0)])
    model = strip(cut, 4000)
    before, after = (
        float(model.voltages(values)[0])
        for values in (np.ones(model.mesh.num_cells), cut.conductivity(model.mesh, 1.0))
    )
    assert (after - before) * HEIGHT == pytest.approx(
        4 * HEIGHT / np.pi * np.log(np.sqrt(2)), rel=0.12
    )  # one cell longer


def test_half_the_depth_has_less_effect_than_all_and_more_than_none():
    cut = draw_cut(jax.random.key(3), Disk(0.05), length=(0.03, 0.03), bent=1.0)
    model = disk_model(cut)
    change = []
    rest = np.asarray(model.voltages(1e-2))
    for depth in (0.2, 0.5, 0.8, 1.0):
        values = Cut(cut.path, depth).conductivity(model.mesh, 1e-2, thickness=1e-3)
        change.append(np.linalg.norm(np.asarray(model.voltages(values)) - rest))
    assert np.all(np.diff(change) > 0)
    assert cut.length == pytest.approx(0.03)
    assert len(cut.path) == 3


def test_cuts_are_inside_and_have_the_given_length():
    outline = Rectangle(0.2, 0.2, (0, 0))
    for number in range(40):
        cut = draw_cut(jax.random.key(number), outline, margin=0.004)
        assert 0.02 <= cut.length <= 0.06
        assert np.abs(cut.along(1e-3)).max() < 0.096
    with pytest.raises(ValueError, match=r"no cut of 5\d\.\d mm"):
        draw_cut(jax.random.key(0), Disk(0.01), length=(0.05, 0.06))


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_affects_the_channels_of_its_electrode(slit, kind):
    model = slit.with_protocol(two_terminal(16, current=1e-3))
    change = ElectrodeFault(5, kind).changes(jax.random.key(0), model, 1e-2, np.arange(30) / 10)
    rest = np.asarray(model.voltages(1e-2))
    own = model.protocol.channels_touching(5)
    assert np.abs(change[:, own] / rest[own]).mean(axis=0).min() > 0.2
    assert np.abs(change[:, ~own] / rest[~own]).max() < 0.12  # it no longer shunts the sheet
    if kind == "loose":
        assert (change[:, own].std(axis=0) > 0.1 * np.abs(rest[own])).all()


def test_a_torn_wire_may_read_the_end_of_the_range(slit):
    rest = np.asarray(slit.voltages(1e-2))
    read = rest + ElectrodeFault(2, "torn", rail=4.0).changes(jax.random.key(0), slit, 1e-2, np.arange(3.0))
    own = slit.protocol.channels_touching(2)
    np.testing.assert_allclose(read[:, own], 4.0)
    np.testing.assert_allclose(read[:, ~own], np.tile(rest[~own], (3, 1)))


@pytest.mark.slow
def test_a_recording_continues_through_damage_and_repair():
    cut = Cut([(-0.012, 0.01), (0.012, 0.016)])
    model, film = disk_model(cut, 400), dataclasses.replace(material("velostat"), noise=0.0)
    skin = PressedSkin(jax.random.key(0), model, film)
    damaged = eqx.tree_at(lambda one: one.conductivity, skin, cut.conductivity(model.mesh, skin.conductivity))
    values, glued = mend_cut(model.mesh, skin.conductivity, cut, film, 1.05)
    whole = eqx.tree_at(lambda one: (one.conductivity, one.material), skin, (values, glued))
    seconds = np.arange(12) / 2
    press = MovingPress(DiscIndenter(0.012), np.where((seconds > 1) & (seconds < 5), 2.0, 0.0), (0.0, -0.02))
    changes = [DamageEvent(2.0, damaged), DamageEvent(4.0, whole)]
    found = record_damage(jax.random.key(1), skin, press, seconds, changes)
    plain = record_damage(jax.random.key(1), skin, press, seconds, [])
    exact = skin.record(jax.random.key(1), press, seconds)
    np.testing.assert_allclose(plain, exact, rtol=1e-6, atol=1e-9 * np.abs(exact).max())
    np.testing.assert_array_equal(found[seconds < 2], plain[seconds < 2])
    size = np.linalg.norm(found - plain, axis=1) / np.linalg.norm(plain, axis=1)
    assert size[(seconds >= 2) & (seconds < 4)].min() > 0.02
    assert 0 < size[seconds >= 4].max() < 0.01
    assert glued.hysteresis > film.hysteresis


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda: Cut([(0, 0)]), "path"),
        (lambda: Cut([(0, 0), (0, 0)]), "path"),
        (lambda: Cut([(0, 0), (np.nan, 1)]), "path"),
        (lambda: Cut([(0, 0), (1, 1)], depth=0), "depth"),
        (lambda: Cut([(0, 0), (1, 1)], residual=1), "residual"),
        (lambda: Cut([(3, 3), (4, 4)]).cells(Disk(0.05).mesh(num_points=200)), "no cell"),
        (lambda: Cut([(0, 0), (0.01, 0)], 0.5).conductivity(Disk(0.05).mesh(num_points=200), 1.0), "thickness"),
        (lambda: ElectrodeFault(-1), "electrode"),
        (lambda: ElectrodeFault(1, "lost"), "kind"),  # pyright: ignore[reportArgumentType]
        (lambda: DamageEvent(-1.0), "time"),
    ],
)
def test_bad_input_is_refused(ask, message):
    with pytest.raises(ValueError, match=message):
        ask()
