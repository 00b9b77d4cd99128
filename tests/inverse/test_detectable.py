"""Smallest detectable bodies, against the voltages of small bodies on a finer mesh, and scaling laws."""

import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, FacePatches
from jeit.forward import ForwardModel
from jeit.inverse import detectable_diameters, detectable_strength
from jeit.layout import ring
from jeit.mesh import Disk, Solid, centroids, measures
from jeit.protocol import adjacent

NOISE, BACKGROUND = 1e-6, 0.3
LIMIT = 8.0  # standard deviations


@pytest.fixture(scope="module")
def disk():
    def model(num_points):
        electrodes = BoundaryElectrodes(ring(0.1, 8), 0.02, 1e-3)
        return ForwardModel(Disk(0.1).mesh(num_points=num_points), electrodes, adjacent(8))

    return model(400), model(6000)


def strength_at(model, place, noise=NOISE):
    strength = detectable_strength(model, BACKGROUND, noise)
    return strength[np.argmin(np.linalg.norm(np.asarray(centroids(model.mesh)) - place, axis=1))]


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.05, 0.02)])
@pytest.mark.parametrize("change", [-0.8, 2.0])
def test_the_voltages_of_a_body_of_that_strength_are_eight_standard_deviations(place, change, disk):
    coarse, fine = disk
    inside = np.linalg.norm(np.asarray(centroids(fine.mesh)) - place, axis=1) < 0.012
    conductivity = np.where(inside, BACKGROUND * (1 + change), BACKGROUND)
    voltages = np.asarray(fine.voltages(conductivity)) - np.asarray(fine.voltages(BACKGROUND))
    strength = np.asarray(measures(fine.mesh))[inside].sum() * abs(change) / (2 + change)
    deviations = np.linalg.norm(voltages) / NOISE * strength_at(coarse, place) / strength
    assert deviations == pytest.approx(LIMIT, rel=0.07)


def test_channels_without_use_do_not_count_and_noise_scales(disk):
    model, place = disk[0], (0.05, 0.02)
    mask = np.arange(model.protocol.num_measurements) % 2 == 0
    masked = detectable_strength(model, BACKGROUND, NOISE, mask)
    noisy = detectable_strength(model, BACKGROUND, np.where(mask, NOISE, 1e6))
    np.testing.assert_allclose(masked, noisy, rtol=1e-9)
    assert (masked > detectable_strength(model, BACKGROUND, NOISE)).all()
    assert strength_at(model, place, noise=3 * NOISE) == pytest.approx(3 * strength_at(model, place))


def test_diameters_are_those_of_insulating_bodies(disk):
    mesh = disk[0].mesh
    area = np.asarray(measures(mesh))
    everywhere = np.full(mesh.num_cells, np.pi * 0.01**2)
    assert detectable_diameters(mesh, everywhere) == pytest.approx((0.02, 0.02))
    centres = np.asarray(centroids(mesh))
    half = detectable_diameters(mesh, np.where(centres[:, 0] < -0.01, 1.0, 4.0) * np.pi * 0.01**2)
    assert half == pytest.approx((0.04, 0.04))
    rim = np.linalg.norm(centres, axis=1) > np.sqrt(0.97) * 0.1
    assert area[rim].sum() < 0.05 * area.sum()
    median, almost_everywhere = detectable_diameters(mesh, np.where(rim, np.inf, np.pi * 0.01**2))
    assert (median, almost_everywhere) == pytest.approx((0.02, 0.02))
    assert detectable_diameters(mesh, 1e3 * everywhere) == (np.inf, np.inf)


def test_an_insulating_ball_has_half_its_volume_as_strength():
    mesh = Solid(Disk(0.1), 0.1).mesh(num_points=400)
    ball = np.full(mesh.num_cells, 0.5 * np.pi * 0.02**3 / 6)
    assert detectable_diameters(mesh, ball) == pytest.approx((0.02, 0.02))
    model = ForwardModel(mesh, FacePatches(ring(0.1, 8, height=0.05), 0.04, 0.05, 1e-3), adjacent(8))
    strength = detectable_strength(model, BACKGROUND, NOISE)
    change = 1e-3 * BACKGROUND * (np.arange(mesh.num_cells) == 500)
    voltages = np.asarray(model.voltages(BACKGROUND + change)) - np.asarray(model.voltages(BACKGROUND))
    cell_strength = float(measures(mesh)[500]) * 1e-3 / 3
    assert np.linalg.norm(voltages) / NOISE * strength[500] / cell_strength == pytest.approx(LIMIT, rel=2e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"background": -1.0}, "background must be positive"),
        ({"background": 1 + 1j}, "background must be one real"),
        ({"noise": 0.0}, "noise must be positive"),
        ({"noise": np.ones(3)}, "noise has shape"),
        ({"mask": np.zeros(40, bool)}, "mask must be"),
    ],
)
def test_bad_input(arguments, message, disk):
    with pytest.raises(ValueError, match=message):
        detectable_strength(disk[0], **{"background": BACKGROUND, "noise": NOISE} | arguments)
