"""A strong ball in a tank of plates: fitted beside a smooth field, its conductivity told with its range."""

import numpy as np
import pytest

from jeit import image_difference
from jeit.data import Measurement
from jeit.electrodes import FacePatches
from jeit.electrodes.body_mesh import body_mesh
from jeit.forward import ForwardModel
from jeit.imaging import ImagingSettings, method
from jeit.mesh import Rectangle, Solid, centroids
from jeit.protocol import opposite

BOX, BATH, TIMES = Solid(Rectangle(0.1, 0.14), 0.1), 0.2, 4.0
BALL, RADIUS = np.array([0.012, -0.025, 0.055]), 0.022
SIDES = [(a, s * 0.07, z) for s in (-1, 1) for z in (0.03, 0.07) for a in (-0.025, 0.025)]
SIDES += [(s * 0.05, b, z) for s in (-1, 1) for z in (0.03, 0.07) for b in (-0.035, 0.035)]


def measured(model, conductivity, seed):
    voltages = np.asarray(model.voltages(conductivity))
    voltages = voltages * (1 + 1e-4 * np.random.default_rng(seed).normal(size=voltages.shape))
    known = {"electrodes": model.electrodes, "domain": BOX, "name": str(seed)}
    return Measurement(voltages, np.ones(voltages.shape, bool), model.protocol, **known)


@pytest.mark.slow
def test_a_ball_is_fitted_beside_a_smooth_field(monkeypatch):
    plates = FacePatches(np.array(SIDES), 0.03, 0.03, 1e-3)
    model = ForwardModel(body_mesh(BOX, plates, 6000), plates, opposite(16, current=1e-3))
    held = np.linalg.norm(np.asarray(centroids(model.mesh)) - BALL, axis=1) < RADIUS
    frame, reference = measured(model, BATH * np.where(held, TIMES, 1.0), 1), measured(model, BATH, 2)
    asked, fitted = {}, method.reconstruct_shapes
    monkeypatch.setattr(method, "reconstruct_shapes", lambda *a, **k: asked.update(k) or fitted(*a, **k))
    result = image_difference(frame, reference, ImagingSettings(num_points=2500))
    assert asked["smooth"] is not None
    assert asked["least_rise"] == 1
    assert result.shapes is not None
    (body,), ((low, high),) = result.shapes.bodies, result.peak_ranges
    assert np.linalg.norm(body.centroid - BALL) < 0.004
    assert low < result.inclusions[0].peak < high
    (deviation,) = result.shapes.contrast_deviations
    background = float(result.calibration.conductivity)
    np.testing.assert_allclose([low, high], background * np.expm1(body.contrast + np.array([-1, 1]) * deviation))
