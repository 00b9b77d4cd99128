"""A strong ball in a tank of plates: fitted beside a smooth field, its conductivity told with its range."""

from types import SimpleNamespace

import numpy as np
import pytest

from jeit import image_difference
from jeit.data import Measurement
from jeit.electrodes import FacePatches
from jeit.electrodes.body_mesh import body_mesh
from jeit.forward import ForwardModel
from jeit.imaging import ImagingSettings, automatic, method
from jeit.mesh import Disk, Rectangle, Solid, centroids
from jeit.protocol import opposite, skip

BOX, BATH, TIMES = Solid(Rectangle(0.1, 0.14), 0.1), 0.2, 4.0
BALL, RADIUS = np.array([0.012, -0.025, 0.055]), 0.022
SIDES = [(a, s * 0.07, z) for s in (-1, 1) for z in (0.03, 0.07) for a in (-0.025, 0.025)]
SIDES += [(s * 0.05, b, z) for s in (-1, 1) for z in (0.03, 0.07) for b in (-0.035, 0.035)]


def measured(model, conductivity, seed, domain=BOX):
    voltages = np.asarray(model.voltages(conductivity))
    voltages = voltages * (1 + 1e-4 * np.random.default_rng(seed).normal(size=voltages.shape))
    known = {"electrodes": model.electrodes, "domain": domain, "name": str(seed)}
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
    assert result.settings.method == "shapes"
    in_ball = np.linalg.norm(np.asarray(centroids(result.mesh)) - BALL, axis=1) < 0.5 * RADIUS
    assert np.asarray(result.change)[in_ball].mean() > 0.8 * result.inclusions[0].peak  # the image is of the body
    (deviation,) = result.shapes.contrast_deviations
    background = float(result.calibration.conductivity)
    np.testing.assert_allclose([low, high], background * np.expm1(body.contrast + np.array([-1, 1]) * deviation))


def prepared(dimension, strongest, noise):
    told = None if noise is None else SimpleNamespace(relative=noise)
    return SimpleNamespace(
        quality=SimpleNamespace(difference_noise=told),
        calibration=SimpleNamespace(conductivity=BATH),
        mesh=SimpleNamespace(dimension=dimension),
    ), np.array([0.0, -strongest * BATH])


@pytest.mark.parametrize(
    ("dimension", "strongest", "noise", "looks"),
    [(3, 0.1, 0.1, True), (3, 0.1, None, True), (3, 0.1, 0.5, False), (3, 0.02, 0.1, False), (2, 0.1, 0.1, False)],
)
def test_bodies_are_looked_for_in_solids_where_data_can_tell_of_them(monkeypatch, dimension, strongest, noise, looks):
    asked = []

    def image(*_):
        asked.append(True)
        raise ValueError("no image")

    monkeypatch.setitem(automatic.METHODS, "gauss-newton", SimpleNamespace(image=image, hyperparameter=5.0))
    data, change = prepared(dimension, strongest, noise)
    assert automatic._bodies_in_solid(data, "gaussian", change) is None
    assert bool(asked) == looks


@pytest.mark.slow
def test_bodies_of_a_sound_linear_image_are_told_in_a_cylinder():
    """A ball a fifth as conductive, that one step shows at a tenth of its contrast, by currents between two rings."""
    angle = 2 * np.pi * np.arange(12) / 12
    around = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle)], axis=1)
    places = np.concatenate([np.column_stack([around, np.full(12, z)]) for z in (0.025, 0.055)])
    tank, patches = Solid(Disk(0.05), 0.08), FacePatches(places, 0.012, 0.015, 1e-3)
    model = ForwardModel(body_mesh(tank, patches, 6000), patches, skip(24, 7, current=1e-3))
    middle, radius = np.array([-0.018, 0.008, 0.044]), 0.012
    held = np.linalg.norm(np.asarray(centroids(model.mesh)) - middle, axis=1) < radius
    frame = measured(model, BATH * np.where(held, 0.2, 1.0), 1, tank)
    result = image_difference(frame, measured(model, BATH, 2, tank), ImagingSettings(num_points=2500))
    assert "which a linear image of a solid blurs" in result.why
    body = result.shapes.bodies[0]
    assert np.linalg.norm(body.centroid - middle) < 0.004
    assert body.sign == -1
