"""Smallest detectable bodies, against the voltages of small bodies on a finer mesh, and scaling laws."""

import jax
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, FacePatches
from jeit.forward import ForwardModel
from jeit.inverse import detectable_diameters, detectable_strength
from jeit.inverse.uncertainty import _MAX_EXAMINED_CELLS, _diameters
from jeit.layout import ring
from jeit.mesh import Disk, Solid, centroids, measures
from jeit.protocol import adjacent

NOISE, BACKGROUND = 1e-6, 0.3
LIMIT = 8.0  # standard deviations; the models have at most 64 channels
DISK = np.pi * 0.1**2


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
    without_noise = detectable_strength(model, BACKGROUND, np.where(mask, NOISE, np.nan), mask)
    np.testing.assert_allclose(without_noise, masked)
    assert (masked > detectable_strength(model, BACKGROUND, NOISE)).all()
    assert strength_at(model, place, noise=3 * NOISE) == pytest.approx(3 * strength_at(model, place))


def test_diameters_are_those_of_insulating_bodies(disk):
    mesh = disk[0].mesh
    area, centres = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    everywhere = np.full(mesh.num_cells, np.pi * 0.01**2)
    assert _diameters(everywhere, area, DISK, 2) == pytest.approx((0.02, 0.02))
    half = np.where(centres[:, 0] < -0.01, 1.0, 4.0) * everywhere
    assert _diameters(half, area, DISK, 2) == pytest.approx((0.04, 0.04))
    hidden = np.arange(len(area)) % 25 == 0  # 4 % of the cells
    assert 0 < area[hidden].sum() < 0.05 * area.sum()
    assert _diameters(np.where(hidden, np.inf, everywhere), area, DISK, 2) == pytest.approx((0.02, 0.02))
    assert _diameters(1e3 * everywhere, area, DISK, 2) == (np.inf, np.inf)
    # An insulating ball has half its volume as strength.
    assert _diameters(np.full(5, 0.5 * np.pi * 0.02**3 / 6), np.ones(5), DISK, 3) == pytest.approx((0.02, 0.02))


def test_a_large_mesh_is_sampled(disk):
    model = disk[1]
    assert model.mesh.num_cells > 2 * _MAX_EXAMINED_CELLS
    every = _diameters(detectable_strength(model, BACKGROUND, NOISE), np.asarray(measures(model.mesh)), DISK, 2)
    assert detectable_diameters(model, BACKGROUND, NOISE) == pytest.approx(every, rel=0.03)


def test_a_small_body_in_a_solid():
    mesh = Solid(Disk(0.1), 0.1).mesh(num_points=400)
    model = ForwardModel(mesh, FacePatches(ring(0.1, 8, height=0.05), 0.04, 0.05, 1e-3), adjacent(8))
    strength = detectable_strength(model, BACKGROUND, NOISE, cells=np.array([7, 500]))[1]
    change = 1e-3 * BACKGROUND * (np.arange(mesh.num_cells) == 500)
    voltages = np.asarray(model.voltages(BACKGROUND + change)) - np.asarray(model.voltages(BACKGROUND))
    cell_strength = float(measures(mesh)[500]) * 1e-3 / 3
    assert np.linalg.norm(voltages) / NOISE * strength / cell_strength == pytest.approx(LIMIT, rel=2e-3)


def test_of_many_channels_the_root_mean_square_is_that_of_the_noise():
    electrodes = BoundaryElectrodes(ring(0.1, 16), 0.01, 1e-3)
    model = ForwardModel(Disk(0.1).mesh(num_points=400), electrodes, adjacent(16))
    cell = np.array([20])
    voltages = model.jacobian(BACKGROUND)[:, cell[0]] / np.asarray(measures(model.mesh))[cell] * 2 * BACKGROUND
    strength = detectable_strength(model, BACKGROUND, NOISE, cells=cell)
    assert np.sqrt(np.mean((strength * voltages / NOISE) ** 2)) == pytest.approx(1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"background": -1.0}, "background must be positive"),
        ({"background": 1 + 1j}, "background must be one real"),
        ({"noise": 0.0}, "noise must be positive"),
        ({"noise": np.where(np.arange(40) == 3, np.nan, 1e-6)}, r"in volts; channel 3 .* has nan"),
        ({"noise": np.ones(3)}, "noise: give one real number of volts"),
        ({"noise": 1e-6 + 1e-6j}, "noise: give one real number of volts"),
        ({"noise": "1e-6"}, "noise: give one real number of volts"),
        ({"noise": True}, "noise: give one real number of volts"),
        ({"mask": np.zeros(40, bool)}, "mask must be"),
        ({"mask": np.full(40, np.nan)}, r"mask must be \(40,\) booleans .* got"),
        ({"cells": [10**6]}, "cells must be indices from 0"),
        ({"cells": [0.5]}, "cells must be booleans"),
        ({"cells": []}, "cells: none is chosen"),
        ({"cells": 0}, "cells must be booleans"),
        ({"cells": [[0, 1]]}, "cells must be booleans"),
        ({"model": 3}, "model must be a ForwardModel"),
    ],
)
def test_bad_input(arguments, message, disk):
    with pytest.raises(ValueError, match=message):
        detectable_strength(**{"model": disk[0], "background": BACKGROUND, "noise": NOISE} | arguments)


def test_anything_but_a_model_is_refused():
    with pytest.raises(ValueError, match="model must be a ForwardModel"):
        detectable_diameters(None, 1.0, NOISE)  # pyright: ignore[reportArgumentType]


def test_traced_noise_is_refused(disk):
    with pytest.raises(ValueError, match=r"background or noise is traced.*call it outside"):
        jax.jit(lambda noise: detectable_strength(disk[0], BACKGROUND, noise))(NOISE)
