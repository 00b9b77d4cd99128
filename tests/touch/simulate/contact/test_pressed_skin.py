"""Frames of pressed skins: presses carry their loads, voltages are those of the solved model, and effects in time."""

import dataclasses
import pickle

import jax
import numpy as np
import pytest

from jeit.design import Skin
from jeit.electrodes import BoundaryElectrodes, PointElectrodes
from jeit.forward import ForwardModel
from jeit.layout import named_layout, ring
from jeit.mesh import Disk, Rectangle
from jeit.protocol import adjacent
from jeit.touch.simulate.contact import (
    BarIndenter,
    DiscIndenter,
    Foundation,
    HalfSpace,
    JoinedIndenters,
    MovingPress,
    PlacedIndenter,
    Press,
    PressedSkin,
    ball_indenter,
    material,
    pressed_skin,
)
from jeit.touch.simulate.contact.cell_pressure import pressed_cells
from jeit.touch.simulate.contact.samples import Samples

KEY = jax.random.key(0)
VELOSTAT = material("velostat")
# No noise, no effects in time.
STILL = dataclasses.replace(
    VELOSTAT, hysteresis=0.0, creep=(), conductivity_trend=0.0, conductivity_walk=0.0, contact_trend=0.0,
    contact_walk=0.0, noise=0.0, gain_spread=0.0,
)  # fmt: skip
PRESSES = [
    Press(ball_indenter(0.015), 2.0, (0.01, 0.02)),
    Press(DiscIndenter(0.016), 5.0, (-0.02, 0.0)),
    Press(BarIndenter(0.03, 0.004), 3.0, (0.0, -0.02), 0.5),
    Press(
        JoinedIndenters(DiscIndenter(0.006), PlacedIndenter(DiscIndenter(0.006), (0.012, 0.0))),
        1.0,
        (0.02, -0.01),
        -1.0,
    ),
]


@pytest.fixture(scope="module")
def model():
    mesh = Disk(0.05).mesh(num_points=600)
    return ForwardModel(mesh, BoundaryElectrodes(ring(0.05, 16), 0.008, 0.2), adjacent(16))


@pytest.fixture(scope="module")
def skin(model):
    return PressedSkin(KEY, model, STILL)


def anew(skin, touched):
    """The model solved anew for every touch."""
    found = []
    for cells, change in zip(np.asarray(touched.cells), np.asarray(touched.change), strict=True):
        conductivity = np.array(skin.conductivity)
        np.add.at(conductivity, cells, conductivity[cells] * change)
        found.append(skin.model.voltages(conductivity))
    return np.array(found)


@pytest.mark.parametrize(
    "support", [Foundation(1e6, 2e-3), HalfSpace(3e6, pixels=24)], ids=["foundation", "half-space"]
)
def test_cells_carry_the_load(model, support):
    """To rounding, also where an indenter extends beyond the edge or lies between the samples."""
    samples = Samples.from_mesh(model.mesh)
    presses = [*PRESSES, Press(DiscIndenter(0.01), 1.0, (0.049, 0.0)), Press(ball_indenter(0.001), 1e-3, (0.0123, 0.0))]
    found = pressed_cells(samples, support, [(press,) for press in presses])
    carried = np.einsum("ncs,nc->n", found.pressure, samples.area[found.cells])
    np.testing.assert_allclose(carried, [press.load for press in presses], rtol=1e-12)
    assert samples.area.sum() * samples.points.shape[1] == pytest.approx(np.pi * 0.05**2, rel=5e-3)


def test_all_of_a_ball_that_touches_at_the_edge_carries_load(model):
    """Less of the skin is under it, so that it moves deeper and touches a larger area."""
    samples, layer, shape = Samples.from_mesh(model.mesh), Foundation(1e6, 2e-3), ball_indenter(0.02)
    found = pressed_cells(samples, layer, [(Press(shape, 2.0, (0.053, 0.0)),)])
    points = (samples.points - np.array([0.053, 0.0])).reshape(1, -1, 2)
    area = np.repeat(samples.area, samples.points.shape[1])[None]
    whole = layer.spread(shape, np.array([2.0]), points, area).reshape(len(samples.area), -1)
    pressure = np.zeros_like(whole)
    pressure[found.cells[0]] = found.pressure[0]
    np.testing.assert_allclose(pressure, whole, rtol=1e-9)


@pytest.mark.parametrize(
    ("shape", "place", "spread"),
    [
        (PlacedIndenter(DiscIndenter(0.0005), (0.02, 0.0)), (0.02, 0.0), 0.0),
        (PlacedIndenter(BarIndenter(0.04, 0.0004), (0.0, 0.003), 0.1), (0.0, 0.003), 0.04 / np.sqrt(12)),
        (DiscIndenter(1e-9), (0.0, 0.0), 0.0),
    ],
    ids=["moved in its frame", "an edge", "a point"],
)
def test_an_indenter_between_samples_presses_at_its_place(model, shape, place, spread):
    samples = Samples.from_mesh(model.mesh)
    found = pressed_cells(samples, Foundation(1e6, 2e-3), [(Press(shape, 0.01),)])
    load = np.einsum("cs,c->cs", found.pressure[0], samples.area[found.cells[0]])
    points = samples.points[found.cells[0]]
    middle = np.einsum("cs,csd->d", load, points) / load.sum()
    assert load.sum() == pytest.approx(0.01, rel=1e-12)
    assert np.linalg.norm(middle - place) < samples.radius
    along = np.sqrt(np.sum(load * (points[..., 0] - middle[0]) ** 2) / load.sum())
    assert along == pytest.approx(spread, abs=samples.radius / 2)


def test_pressure_on_cells_is_that_under_the_indenter(model):
    samples, support = Samples.from_mesh(model.mesh), VELOSTAT.support
    press = PRESSES[0]
    cells, pressure = pressed_cells(samples, support, [(press,)])
    exact = support.pressure(press.indenter, press.load).at(samples.points[cells[0]] - press.position)
    assert np.abs(pressure[0] - exact).max() < 0.05 * exact.max()
    turned = PRESSES[2]
    cells, pressure = pressed_cells(samples, support, [(turned,)])
    along = samples.points[cells[0]][pressure[0] > 0] - turned.position
    assert np.abs(along @ [-np.sin(0.5), np.cos(0.5)]).max() <= 0.002
    assert np.abs(along @ [np.cos(0.5), np.sin(0.5)]).max() == pytest.approx(0.015, rel=0.1)


@pytest.mark.parametrize("max_bytes", [0, pressed_skin._MAX_INVERSE_BYTES], ids=["large mesh", "small mesh"])
def test_frames_are_those_of_the_model_solved_anew(model, max_bytes, monkeypatch):
    """On meshes with and without an inverse between all nodes."""
    monkeypatch.setattr(pressed_skin, "_MAX_INVERSE_BYTES", max_bytes)
    skin = PressedSkin(KEY, model, STILL)
    presses = [*PRESSES, tuple(PRESSES), ()]
    found = skin.frames(KEY, presses)
    exact = anew(skin, skin.touched(presses))
    assert np.abs(found - exact).max() < 1e-8 * np.abs(exact - skin.rest()).max()
    np.testing.assert_array_equal(found[-1], skin.rest())
    assert np.abs(found[0] - skin.rest()).max() > 1e-3 * np.abs(skin.rest()).max()
    assert (skin._resting_skin is None) == (max_bytes == 0)
    copy = pickle.loads(pickle.dumps(skin))
    assert "_resting_skin" not in vars(copy)  # it is large, and made anew
    np.testing.assert_array_equal(copy.frames(KEY, presses), found)


def test_a_layer_is_pressed_too():
    layer = Skin.create(named_layout("grid-3x3", Rectangle(0.08, 0.08)), num_layers=1, cell_size=0.008)
    skin = PressedSkin(KEY, layer.model, dataclasses.replace(material("hydrogel"), noise=0.0, gain_spread=0.0))
    presses = [Press(ball_indenter(0.04), 3.0, (0.015, 0.01)), Press(DiscIndenter(0.03), 3.0, (-0.015, 0.0))]
    samples = Samples.from_mesh(layer.model.mesh)
    cells, pressure = pressed_cells(samples, skin.material.support, [(press,) for press in presses])
    np.testing.assert_allclose(np.einsum("ncs,nc->n", pressure, samples.area[cells]), 3.0, rtol=1e-12)
    touched = skin.touched(presses)
    assert (np.asarray(touched.change) <= 0).all()
    assert np.abs(anew(skin, touched) - skin.rest()).max() > 1e-4 * np.abs(skin.rest()).max()


def test_several_simultaneous_presses_are_summed(skin):
    near = [Press(DiscIndenter(0.01), 1.0, (0.0, 0.0)), Press(DiscIndenter(0.01), 2.0, (0.004, 0.0))]
    samples, support = Samples.from_mesh(skin.model.mesh), STILL.support
    both = pressed_cells(samples, support, [tuple(near)])
    total = np.zeros((skin.model.mesh.num_cells, samples.points.shape[1]))
    for press in near:
        one = pressed_cells(samples, support, [(press,)])
        np.add.at(total, one.cells[0], one.pressure[0])
    spread = np.zeros_like(total)
    np.add.at(spread, both.cells[0], both.pressure[0])
    np.testing.assert_allclose(spread, total, rtol=1e-12)


@pytest.mark.slow
def test_a_recording_of_a_constant_press_equals_its_frames(model):
    creeping = dataclasses.replace(STILL, creep=VELOSTAT.creep, hysteresis=VELOSTAT.hysteresis)
    skin, press = PressedSkin(KEY, model, creeping), PRESSES[1]
    seconds = np.array([2.0, 3.0, 12.0])
    found = skin.record(KEY, MovingPress(press.indenter, np.full(3, press.load), press.position), seconds)
    for frame, since in enumerate(seconds - 2.0):
        np.testing.assert_allclose(found[frame], skin.frames(KEY, [press], held=since)[0], rtol=1e-10)
    assert (np.diff(np.linalg.norm(found - skin.rest(), axis=1)) > 0).all()


def test_a_stroke_leaves_a_decaying_trace(model):
    skin = PressedSkin(KEY, model, dataclasses.replace(STILL, creep=((0.2, 1.0),)))
    seconds = np.array([0.0, 0.5, 1.0, 1.5, 1.6, 3.6, 60.0])
    place = np.array([[-0.02, 0.0], [0.0, 0.0], [0.02, 0.0], [0.02, 0.01], [0, 0], [0, 0], [0, 0]])
    stroke = MovingPress(DiscIndenter(0.01), [3.0, 3.0, 3.0, 3.0, 0.0, 0.0, 0.0], place)
    touched = skin.touched_in_time(stroke, seconds)
    found = skin.record(KEY, stroke, seconds)
    exact = anew(skin, touched)
    change = np.linalg.norm(found - skin.rest(), axis=1)
    assert np.abs(found - exact).max() < 1e-7 * change.max()
    assert 0 < change[5] < change[4] / 5 < change[3] / 5
    assert change[6] < 1e-9 * change[3]


def test_noise_gains_and_keys(model):
    noisy = PressedSkin(KEY, model, dataclasses.replace(STILL, noise=1e-3, gain_spread=0.02))
    still = PressedSkin(KEY, model, STILL)
    frames = noisy.frames(KEY, [()] * 200)
    np.testing.assert_array_equal(frames, noisy.frames(KEY, [()] * 200))
    deviation = 1e-3 * np.sqrt(np.mean(still.rest() ** 2))
    assert ((frames - frames.mean(axis=0)) / noisy.gain).std() == pytest.approx(deviation, rel=0.02)
    np.testing.assert_allclose(frames.mean(axis=0) / noisy.gain, still.rest(), atol=5 * deviation / 200**0.5)
    assert not np.array_equal(frames, noisy.frames(jax.random.key(1), [()] * 200))
    assert not np.array_equal(noisy.gain, PressedSkin(jax.random.key(1), model, noisy.material).gain)


@pytest.mark.slow
def test_drift_is_that_of_another_skin(model):
    """Conductivity exactly. Contacts, to which neighbouring voltages are hardly sensitive, to first order."""
    drifting = dataclasses.replace(STILL, conductivity_trend=1e-4, contact_trend=-1e-4)
    skin = PressedSkin(KEY, model, drifting)
    found = skin.frames(KEY, [()], elapsed=300.0)[0]
    electrodes = model.electrodes.with_contact_impedance(0.2 * np.exp(-0.03))
    other = ForwardModel(model.mesh, electrodes, model.protocol)
    exact = np.asarray(other.voltages(skin.conductivity * np.exp(0.03)))
    assert np.abs(found - exact).max() < 2e-3 * np.abs(exact - skin.rest()).max()
    recorded = skin.record(KEY, MovingPress(DiscIndenter(0.01), [0.0, 1.0]), [300.0, 301.0])[0]
    np.testing.assert_allclose(recorded, found, rtol=1e-12)
    alone = np.asarray(other.voltages(skin.conductivity)) - skin.rest()
    slope = skin._contact_derivative.sum(axis=0)
    assert np.linalg.norm(-0.03 * slope - alone) < 0.05 * np.linalg.norm(alone)


def test_drifting_contacts_affect_their_own_channels(model):
    skin = PressedSkin(KEY, model, dataclasses.replace(STILL, contact_walk=1e-2))
    found = skin.frames(KEY, [(), ()], elapsed=100.0)
    np.testing.assert_array_equal(found[0], found[1])
    assert np.linalg.norm(found[0] - skin.rest()) > 0
    points = ForwardModel(model.mesh, PointElectrodes(ring(0.05, 16)), adjacent(16))
    np.testing.assert_allclose(
        PressedSkin(KEY, points, skin.material).frames(KEY, [()], elapsed=100.0)[0],
        points.voltages(skin.conductivity),
        rtol=1e-12,
    )


def test_an_untouched_skin_drifts_over_time(model):
    skin, seconds = PressedSkin(KEY, model, material("velostat")), np.arange(20) * 5.0
    film = skin.record(KEY, [], seconds)
    assert film.shape == (20, model.protocol.num_measurements)
    gone = np.linalg.norm(film - skin.rest(), axis=1)
    assert gone[-5:].mean() > 3 * gone[0]  # drift, not noise alone
    light = skin.record(KEY, MovingPress(DiscIndenter(0.01), np.full(20, 1e-9)), seconds)
    np.testing.assert_allclose(film, light, rtol=1e-6, atol=1e-9)


def test_a_half_space_is_not_pressed_at_its_edge(model):
    """Its contact area would be cut off at the edge, and the rest scaled up to carry all of the load."""
    skin = PressedSkin(KEY, model, dataclasses.replace(STILL, support=HalfSpace(3e5, pixels=24)))
    with pytest.raises(
        ValueError, match=r"half-space, (19|20) % of its pressure would lie on the skin, less than 20 %"
    ):
        skin.touched([Press(ball_indenter(0.02), 2.0, (0.052, 0.0))])
    skin.touched(
        [
            Press(ball_indenter(0.02), 2.0, (0.0495, 0.0)),
            Press(ball_indenter(0.001), 1e-3, (0.03, 0.0)),
            Press(DiscIndenter(1e-9), 1.0),
        ]
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda skin: skin.frames(0, PRESSES), "key must be"),
        (lambda skin: skin.frames(KEY, PRESSES[0]), "presses must be a list"),
        (lambda skin: skin.frames(KEY, []), "presses: give one"),
        (lambda skin: skin.frames(KEY, [DiscIndenter(0.01)]), r"presses\[0\] must be a Press"),
        (lambda skin: skin.frames(KEY, PRESSES, held=-1.0), "held must be seconds"),
        (lambda skin: skin.frames(KEY, PRESSES, elapsed=np.nan), "elapsed must be seconds"),
        (lambda skin: skin.frames(KEY, [Press(DiscIndenter(0.01), 1.0, (20.0, 0.0))]), "lie off the skin"),
        (
            lambda skin: skin.frames(KEY, [Press(DiscIndenter(0.01), 1.0, (0.0552, 0.0))]),
            r"\(55.2, 0\) mm touches no skin",
        ),
        (lambda skin: skin.frames(KEY, [Press(DiscIndenter(1e-4), 100.0)]), "into a layer 2 mm thick"),
        (lambda skin: skin.frames(KEY, [Press(DiscIndenter(0.004), 100.0)]), "into a layer 2 mm thick"),
        (lambda skin: skin.record(KEY, MovingPress(DiscIndenter(0.01), [1.0, 1.0]), [1.0, 0.0]), "nor fall"),
        (lambda skin: skin.record(KEY, MovingPress(DiscIndenter(0.01), [1.0, 1.0]), [1.0]), "has 2 frames"),
        (
            lambda skin: skin.record(KEY, MovingPress(DiscIndenter(0.01), [0.0, 0.0]), [0.0, 1.0]),
            "no press has any load",
        ),
        (lambda skin: skin.record(KEY, PRESSES[0], [0.0]), "motions"),
        (lambda skin: MovingPress(DiscIndenter(0.01), [1.0, -1.0]), "loads, in newtons"),
        (
            lambda skin: skin.record(KEY, MovingPress(DiscIndenter(0.01), [1.0, 1.0]), ["a", "b"]),
            "seconds must be times",
        ),
        (lambda skin: skin.record(KEY, [], [0.0, np.nan]), "seconds must be times"),
        (lambda skin: skin.record(KEY, [], [[0.0, 1.0]]), "seconds must be times"),
        (lambda skin: skin.record(KEY, [], []), "seconds must be times"),
        (lambda skin: skin.record(KEY, [], [-1.0, 1.0]), "seconds must not be negative"),
        (lambda skin: skin.touched_in_time(MovingPress(DiscIndenter(0.01), [1.0, 1.0]), [1.0, 0.0]), "nor fall"),
        (lambda skin: MovingPress(DiscIndenter(0.01), [1.0, 1.0], 0.01), r"position must be \(x, y\)"),
        (lambda skin: MovingPress(DiscIndenter(0.01), [1.0, 1.0], np.zeros((2, 1))), r"it has shape \(2, 1\)"),
        (lambda skin: MovingPress(DiscIndenter(0.01), ["1", "2"]), "load must be newtons"),
        (lambda skin: MovingPress(DiscIndenter(0.01), [1.0, 1.0], np.zeros((3, 2))), "for T frames"),
        (lambda skin: Press(DiscIndenter(0.01), -1.0), "load must be positive"),
        (lambda skin: PressedSkin(KEY, skin, STILL), "model must be"),
        (lambda skin: PressedSkin(KEY, skin.model, "velostat"), "material must be"),
        (lambda skin: PressedSkin(KEY, skin.model, STILL, conductivity=-1.0), "must be positive"),
    ],
)
def test_impossible_presses_are_refused(skin, call, message):
    with pytest.raises(ValueError, match=message):
        call(skin)
