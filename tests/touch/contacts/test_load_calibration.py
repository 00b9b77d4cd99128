"""Loads from peaks: the curve is recovered, error bars are calibrated, and loads beyond the calibration are refused."""

import dataclasses

import jax
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch.contacts import CellFinder, Contact, LoadCalibration, find_contacts
from jeit.touch.simulate import DiscIndenter, Press, PressedSkin, material

RADIUS = 0.05


def contact(load, distance, noise=0.0, sign=1):
    rho = distance / RADIUS
    peak = sign * 2e-6 * np.exp(0.8 * rho**2 + 0.5 * rho**4) * load / (load + 8.0) * np.exp(noise)
    return Contact(np.array([0.0, distance]), 1e-4, float(peak), 1e-10, np.zeros((3, 2)), 0.0)


def drawn(random, number, scatter, sign=1):
    loads, places = random.uniform(0.5, 20, number), random.uniform(0, 0.04, number)
    noise = scatter * random.normal(size=number)
    return [contact(*one, sign) for one in zip(loads, places, noise, strict=True)], loads


def test_an_exact_curve_is_recovered():
    calibration = LoadCalibration.fit(*drawn(np.random.default_rng(0), 60, 1e-6), radius=RADIUS)
    np.testing.assert_allclose(calibration.parameters, [np.log(2e-6), 0.8, 0.5, np.log(8.0)], atol=0.02)
    for load, place in ((1.0, 0.0), (5.0, 0.03), (15.0, 0.035)):
        assert calibration.load(contact(load, place)).force == pytest.approx(load, rel=0.01)


@pytest.mark.parametrize("sign", [1, -1])
def test_error_bars_are_calibrated(sign):
    random, off = np.random.default_rng(1), []
    for _ in range(20):  # each calibration has one error for all the loads that it estimates
        calibration = LoadCalibration.fit(*drawn(random, 40, 0.05, sign), radius=RADIUS)
        for load, place in zip(random.uniform(1, 8, 40), random.uniform(0, 0.035, 40), strict=True):
            estimated = calibration.load(contact(load, place, 0.05 * random.normal(), sign))
            off.append((estimated.force - load) / estimated.deviation)
    assert np.std(off) == pytest.approx(1.0, abs=0.2)
    assert np.mean(np.abs(off) < 2) > 0.9


def test_loads_rise_with_peaks():
    calibration = LoadCalibration.fit(*drawn(np.random.default_rng(2), 40, 0.05), radius=RADIUS)
    forces = [calibration.load(contact(load, 0.02)).force for load in np.linspace(0.5, 15, 30)]
    assert (np.diff(forces) > 0).all()


def test_loads_beyond_the_calibration_are_refused():
    calibration = LoadCalibration.fit(*drawn(np.random.default_rng(3), 40, 0.01), radius=RADIUS)
    with pytest.raises(ValueError, match="greater loads"):
        calibration.load(contact(60.0, 0.02))
    reached = 1e3 * max(one.centroid[1] for one in drawn(np.random.default_rng(3), 40, 0.01)[0])
    message = rf"is 47\.0 mm from the middle, and calibrated contacts reach {reached:.1f} mm; .* farther out"
    with pytest.raises(ValueError, match=message):
        calibration.load(contact(5.0, 0.047))


@pytest.mark.slow
def test_a_skin_is_calibrated_over_its_radius(skin):
    """Loads at places and of sizes outside the calibration, to 15 %, near the edge and at the centre."""
    electrodes = BoundaryElectrodes(ring(RADIUS, 16), 0.008, 300.0)
    model = ForwardModel(Disk(RADIUS).mesh(num_points=2500), electrodes, adjacent(16))
    pressed = PressedSkin(jax.random.key(0), model, dataclasses.replace(material("velostat"), gain_spread=0.0))
    finder = CellFinder(skin.mesh)

    def peaks(key, radii, loads):
        turned = np.arange(len(radii)) * 2.4
        presses = [
            Press(DiscIndenter(0.01), load, (r * np.cos(a), r * np.sin(a)))
            for r, load, a in zip(radii, loads, turned, strict=True)
        ]
        images = np.asarray(skin.reconstruction.image(pressed.frames(jax.random.key(key), presses) - pressed.rest()))
        return [find_contacts(finder, image, skin.noise)[0] for image in images]

    radii, loads = np.tile([0.0, 0.012, 0.024, 0.035], 6), np.repeat([0.5, 1.0, 2.0, 5.0, 10.0, 20.0], 4)
    calibration = LoadCalibration.fit(peaks(1, radii, loads), loads, radius=RADIUS)
    _, second, fourth, _ = calibration.parameters
    assert second * 0.6**2 + fourth * 0.6**4 > 0.3  # a third stronger and more, at 30 mm
    others = np.array([0.7, 1.5, 3.0, 8.0, 4.0, 1.2])
    found = [calibration.load(one) for one in peaks(2, [0.005, 0.018, 0.03, 0.0, 0.033, 0.028], others)]
    np.testing.assert_allclose([one.force for one in found], others, rtol=0.15)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_peak_of_the_other_sign_is_not_a_load(sign):
    contacts, loads = drawn(np.random.default_rng(0), 20, 0.01, sign)
    calibration = LoadCalibration.fit(contacts, loads, radius=RADIUS)
    assert calibration.load(contact(2.0, 0.0, sign=sign)).force == pytest.approx(2.0, rel=0.1)
    with pytest.raises(ValueError, match=r"is not (positive|negative), as those"):
        calibration.load(contact(2.0, 0.0, sign=-sign))


def test_bad_input():
    contacts, loads = drawn(np.random.default_rng(4), 20, 0.05)
    with pytest.raises(ValueError, match="8 or more"):
        LoadCalibration.fit(contacts[:5], loads[:5], radius=RADIUS)
    with pytest.raises(ValueError, match="not all the same"):
        LoadCalibration.fit(contacts, np.ones(20), radius=RADIUS)
    with pytest.raises(ValueError, match="one sign"):
        LoadCalibration.fit([contact(1.0, 0.0, sign=-1), *contacts[1:]], loads, radius=RADIUS)
    for options in ({"radius": 0.0}, {"radius": 50.0}, {"radius": RADIUS, "centre": (50.0, 0.0)}):
        with pytest.raises(ValueError, match="radius"):
            LoadCalibration.fit(contacts, loads, **options)
    reached = 1e3 * max(one.centroid[1] for one in contacts)
    message = f"radius is 50000 mm, and contacts lie up to {reached:.3g} mm from the centre, and are 10 mm wide; "
    with pytest.raises(ValueError, match=message):
        LoadCalibration.fit(contacts, loads, radius=50.0)
    for centre in ((0.0,), "ab", (0.0, np.nan), None):
        with pytest.raises(ValueError, match=r"centre must be \(x, y\)"):
            LoadCalibration.fit(contacts, loads, radius=RADIUS, centre=centre)
    with pytest.raises(ValueError, match="contacts must be a list"):
        LoadCalibration.fit(loads, contacts, radius=RADIUS)
    with pytest.raises(ValueError, match="loads must be newtons"):
        LoadCalibration.fit(contacts, ["a"] * 20, radius=RADIUS)
