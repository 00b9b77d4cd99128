"""Exchanged wires, channels in another order, reversed signs: detected on simulated and measured tanks, and nowhere
else.
"""

from dataclasses import replace
from itertools import combinations, islice

import numpy as np
import pytest

from jeit.data import Measurement, read
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.imaging import ImagingSettings, image_difference, prepare_difference
from jeit.imaging.calibration import imaging_mesh
from jeit.imaging.wiring import Wiring, channel_orders, find_wiring, uniform_impedances
from jeit.layout import perimeter, ring
from jeit.mesh import Disk, Polygon, centroids
from jeit.protocol import adjacent, opposite, skip
from jeit.report.image import report_image

RADIUS, COUNT = 0.05, 16
DISK = Disk(RADIUS)
ELECTRODES = BoundaryElectrodes(ring(RADIUS, COUNT), 0.01, 0.05)
MODEL = ForwardModel(imaging_mesh(DISK, ELECTRODES, 400), ELECTRODES, adjacent(COUNT))
PLACES = tuple(range(COUNT))


def measured(model=MODEL, domain=DISK, places=PLACES, order="", sign=1, conductivity=0.02, name="empty") -> Measurement:
    """A frame with 1 % noise, with electrode k at the place of `places[k]` and its channels in another order."""
    electrodes = model.electrodes
    there = np.asarray(electrodes.position)[list(places)]
    turned = model.with_electrodes(
        BoundaryElectrodes(there, np.asarray(electrodes.width), np.asarray(electrodes.contact_impedance))
    )
    voltages = np.asarray(turned.voltages(conductivity))
    noisy = sign * voltages * (1 + 0.01 * np.random.default_rng(0).normal(size=voltages.shape))
    frame = np.empty_like(noisy)
    frame[channel_orders(model.protocol)[order]] = noisy
    return Measurement(
        frame, np.ones(frame.shape, bool), model.protocol, electrodes=electrodes, domain=domain, name=name
    )


def exchanged(*pairs):
    places = list(PLACES)
    for first, second in pairs:
        places[first], places[second] = places[second], places[first]
    return tuple(places)


@pytest.mark.parametrize("protocol", [adjacent(COUNT), skip(COUNT, 2), adjacent(COUNT, driven_electrodes=True)])
def test_a_sound_tank_raises_no_alarm(protocol):
    for impedance in (1e-4, 0.05, 1.0):
        electrodes = ELECTRODES.with_contact_impedance(impedance)
        model = ForwardModel(MODEL.mesh, electrodes, protocol)
        wiring = find_wiring(model, measured(model))
        assert wiring.is_described_wiring
        assert wiring.fault == ""


@pytest.mark.parametrize("pair", [(0, 1), (2, 6), (4, 12), (0, 15), (7, 9)])
def test_two_exchanged_electrodes_are_detected(pair):
    wiring = find_wiring(MODEL, measured(places=exchanged(pair)))
    assert wiring.places == exchanged(pair)
    assert f"electrodes {pair[0] + 1} and {pair[1] + 1} look exchanged" in wiring.explanation
    assert wiring.misfit < 0.02 < 0.15 < wiring.described


def test_two_exchanges_and_a_cycle_of_three_are_detected():
    assert find_wiring(MODEL, measured(places=exchanged((1, 5), (8, 11)))).places == exchanged((1, 5), (8, 11))
    turned = exchanged((3, 4), (4, 5))
    wiring = find_wiring(MODEL, measured(places=turned))
    assert wiring.places == turned
    assert "each look as if they stood where the next one should" in wiring.explanation


def test_the_explanation_counts_electrodes_from_1():
    def explanation(*places):
        return Wiring(places, misfit=0.012, described=0.34).explanation

    assert explanation(0, 2, 1, 4, 3, 5, 6, 7).startswith("electrodes 2 and 3, 4 and 5 look exchanged: ")
    assert explanation(1, 0, 3, 4, 2, 5, 6, 7) == (
        "electrodes 1 and 2 look exchanged, and electrodes 3 → 4 → 5 → 3 each look as if they stood where the next one "
        "should: so taken the misfit is 1.2 %, as described 34 %."
    )
    assert "counted from another one, electrode 1 standing where 8 should" in explanation(7, 0, 1, 2, 3, 4, 5, 6)
    assert "counted the other way round, electrode 1 standing where 3 should" in explanation(2, 1, 0, 7, 6, 5, 4, 3)
    assert "counted the other way round: " in explanation(0, 7, 6, 5, 4, 3, 2, 1)


@pytest.mark.parametrize("order", list(channel_orders(adjacent(COUNT)))[1:])
def test_another_order_of_channels_is_detected(order):
    """By reciprocity measurement by measurement and drive by drive have the same voltages: the first order is named."""
    wiring = find_wiring(MODEL, measured(order=order))
    first = list(channel_orders(MODEL.protocol))[1]
    assert (wiring.order, wiring.reversed_signs, wiring.places) == (first, False, PLACES)
    assert f"the channels look ordered {first}" in wiring.explanation


def test_a_fixed_order_described_as_rotating_is_recognised_as_the_protocols_fixed_order():
    fixed = ForwardModel(MODEL.mesh, ELECTRODES, adjacent(COUNT, order="fixed")).voltages(1.0)
    name = next(name for name in channel_orders(MODEL.protocol) if "fixed" in name)
    np.testing.assert_allclose(np.asarray(fixed)[channel_orders(MODEL.protocol)[name]], MODEL.voltages(1.0))


def test_the_opposite_sign_is_detected_also_beside_an_exchange():
    wiring = find_wiring(MODEL, measured(sign=-1, places=exchanged((2, 6))))
    assert (wiring.reversed_signs, wiring.places) == (True, exchanged((2, 6)))
    assert "opposite sign" in wiring.explanation


@pytest.mark.slow
def test_a_sign_that_explains_a_frame_alone_is_reported_alone_and_without_unavailable_remedies():
    """One of many permutations may explain slightly more."""
    angle = 2 * np.pi * np.arange(64) / 64
    oval = Polygon(np.stack([0.102 * np.cos(angle), 0.1 * np.sin(angle)], axis=1))
    electrodes = BoundaryElectrodes(perimeter(oval, COUNT), 0.01, 0.05)
    model = ForwardModel(imaging_mesh(oval, electrodes, 400), electrodes, adjacent(COUNT))
    turned = tuple((k + 1) % COUNT for k in range(COUNT))
    empty = measured(model, oval, turned, sign=-1)
    assert find_wiring(model, empty).places == PLACES
    with pytest.raises(
        ValueError, match=r"opposite sign \(\[data\] polarity = .reversed.\): .* Mend the wires or the description\.$"
    ):
        prepare_difference(measured(model, oval, turned, sign=-1, conductivity=0.03), empty)


@pytest.mark.slow
def test_a_shifted_first_electrode_is_detected_where_the_body_shows_it():
    domain = Polygon(np.array([[0, 0], [0.1, 0], [0.08, 0.06], [0, 0.05]]))
    electrodes = BoundaryElectrodes(perimeter(domain, COUNT, start=0.013), 0.008, 0.05)
    model = ForwardModel(imaging_mesh(domain, electrodes, 400), electrodes, adjacent(COUNT))
    shifted, mirrored = (tuple((3 + way * k) % COUNT for k in range(COUNT)) for way in (1, -1))
    for places in (shifted, mirrored):
        wiring = find_wiring(model, measured(model, domain, places))
        assert wiring.places == places
        way = "from another one" if places == shifted else "the other way round"
        assert f"look counted {way}, electrode 1 standing where 4 should" in wiring.explanation
    round_again = tuple(-k % COUNT for k in range(COUNT))
    explanation = find_wiring(model, measured(model, domain, round_again)).explanation
    assert "look counted the other way round" in explanation
    assert "electrode 1" not in explanation
    # A round, uniform tank looks the same from all electrodes.
    assert find_wiring(MODEL, measured(places=shifted)).is_described_wiring


def test_a_frame_that_nothing_explains_is_refused_too():
    frame = measured()
    voltages = np.random.default_rng(1).permutation(np.asarray(frame.voltages)[0])
    wiring = find_wiring(
        MODEL, Measurement(voltages, np.ones(208, bool), frame.protocol, electrodes=ELECTRODES, domain=DISK)
    )
    assert wiring.is_described_wiring
    assert "no order of channels, sign, or exchange" in wiring.fault


def test_an_image_is_refused_with_the_explanation_and_computed_unchanged_on_request():
    places = exchanged((2, 6))
    near = np.linalg.norm(np.asarray(centroids(MODEL.mesh)) - [0.02, 0.01], axis=1) < 0.012
    object_ = measured(places=places, conductivity=np.where(near, 0.04, 0.02), name="object")
    with pytest.raises(ValueError, match=r"'empty' does not fit .* electrodes 3 and 7 look exchanged.*as_is=True"):
        prepare_difference(object_, measured(places=places), num_points=400)
    plain = ImagingSettings(method="one-step", hyperparameter=10.0, as_is=True, num_points=400, raster_shape=(64, 64))
    result = image_difference(object_, measured(places=places), plain)
    assert "electrodes 3 and 7 look exchanged" in report_image(result)["wiring"]["fault"]
    sound = measured(conductivity=np.where(near, 0.04, 0.02)), measured()
    assert report_image(image_difference(*sound, replace(plain, as_is=False)))["wiring"]["fault"] is None


def test_a_frame_without_signal_is_left_to_other_checks():
    nothing = Measurement(np.zeros(208), np.ones(208, bool), MODEL.protocol, electrodes=ELECTRODES, domain=DISK)
    assert find_wiring(MODEL, nothing).fault == ""
    with pytest.raises(ValueError, match="inf times those of the reference"):
        prepare_difference(measured(), nothing, num_points=300)


def measured_tanks(data_folder):
    yield read(data_folder / "kit4" / "datamat_1_0.mat")
    for file in sorted((data_folder / "tank6cm").glob("*/*.csv")):
        yield read(file).split_reference()[1]


def model_of(frame: Measurement) -> ForwardModel:
    mesh = imaging_mesh(frame.domain, frame.electrodes, 600)
    return ForwardModel(mesh, frame.electrodes, frame.protocol)


def test_a_measured_tank_raises_no_alarm(data_folder):
    frame = read(data_folder / "kit4" / "datamat_1_0.mat")
    assert find_wiring(model_of(frame), frame).fault == ""


@pytest.mark.slow
def test_measured_tanks_raise_no_alarm(data_folder):
    for frame in measured_tanks(data_folder):
        assert find_wiring(model_of(frame), frame).fault == ""
    frame = read(data_folder / "ktc2023" / "ref.mat")
    assert find_wiring(model_of(frame), frame).fault == ""


@pytest.mark.slow
def test_all_exchanges_of_two_electrodes_are_detected_on_measured_tanks(data_folder):
    """Each pair on one of two tanks, and every distance along the ring on both. Exchanged electrodes have exchanged
    impedances, which `test_two_exchanged_electrodes_are_detected` computes with the electrodes moved instead.
    """
    frames = list(islice(measured_tanks(data_folder), 2))
    models = [model_of(frame) for frame in frames]
    impedances = [uniform_impedances(model) for model in models]
    for pair in combinations(range(COUNT), 2):
        frame, model = frames[pair[0] % 2], models[pair[0] % 2]
        places = list(exchanged(pair))
        electrodes = BoundaryElectrodes(
            np.asarray(frame.electrodes.position)[places],
            np.asarray(frame.electrodes.width),
            np.asarray(frame.electrodes.contact_impedance),
        )
        moved = [impedance[np.ix_(places, places)] for impedance in impedances[pair[0] % 2]]
        wiring = find_wiring(model.with_electrodes(electrodes), frame, moved)
        assert wiring.places == tuple(places), pair
        assert (wiring.order, wiring.reversed_signs) == ("", False), pair


@pytest.mark.parametrize("signed", [False, True])
def test_the_order_of_magnitudes_is_detected(signed):
    """Magnitudes, or the same with the signs that the described order gives them on reading."""
    model = MODEL.with_protocol(opposite(COUNT))
    order = 'from electrode 1 on in every drive (order = "fixed")'
    frame = measured(model, order=order)
    signs = np.sign(np.asarray(model.voltages(1.0))) if signed else 1
    wiring = find_wiring(model, replace(frame, voltages=signs * np.abs(np.asarray(frame.voltages))))
    assert wiring.order == order
    assert wiring.magnitudes == (not signed)
    assert wiring.misfit < 0.05
    assert ("to be magnitudes, without signs" in wiring.explanation) == (not signed)
    alone = find_wiring(model, replace(frame, voltages=np.abs(np.asarray(measured(model).voltages))))
    assert alone.order == ""
    assert alone.magnitudes
