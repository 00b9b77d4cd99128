"""A strong ball in a tank with plate electrodes, fitted beside a smooth field, with its conductivity and interval."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jeit import image_difference
from jeit.data import Measurement
from jeit.electrodes import FacePatches
from jeit.electrodes.face_patches import body_mesh
from jeit.forward import ForwardModel
from jeit.image import Raster
from jeit.image.segmentation import CONDUCTIVE
from jeit.imaging import (
    ImagedDifference,
    ImagingSettings,
    automatic,
    difference,
    imaging_mesh,
    method,
    prepare_difference,
)
from jeit.inverse import Laplace
from jeit.inverse.shapes import Ellipsoid, Quantities, ShapeReconstruction
from jeit.inverse.shapes.quantities import include_deviation
from jeit.mesh import Disk, Rectangle, Solid, centroids
from jeit.protocol import opposite, skip
from jeit.report import image as image_report

BOX, BATH, TIMES = Solid(Rectangle(0.1, 0.14), 0.1), 0.2, 4.0
BALL, RADIUS = np.array([0.012, -0.025, 0.055]), 0.022
SIDES = [(a, s * 0.07, z) for s in (-1, 1) for z in (0.03, 0.07) for a in (-0.025, 0.025)]
SIDES += [(s * 0.05, b, z) for s in (-1, 1) for z in (0.03, 0.07) for b in (-0.035, 0.035)]


def measured(model, conductivity, seed, domain=BOX):
    voltages = np.asarray(model.voltages(conductivity))
    voltages = voltages * (1 + 1e-4 * np.random.default_rng(seed).normal(size=voltages.shape))
    known = {"electrodes": model.electrodes, "domain": domain, "name": str(seed)}
    return Measurement(voltages, np.ones(voltages.shape, bool), model.protocol, **known)


def test_labels_of_a_solid_are_those_at_half_height():
    mesh = BOX.mesh(num_points=300)
    raster = Raster.create(mesh, shape=(40, 30), height=0.05)

    def ball(z):
        return Ellipsoid(1, np.array([0.0, 0.0, z]), 0.03 * np.eye(3), 1e-4, np.zeros(3), 1.0, False, False, 10.0)

    middle = difference._label_body_pixels(mesh, [ball(0.05)], raster)
    left, right, low, high = raster.extent
    pixel = (right - left) * (high - low) / middle.size
    assert middle.max() == CONDUCTIVE
    assert (middle > 0).sum() * pixel == pytest.approx(np.pi * 0.03**2, rel=0.1)
    assert not difference._label_body_pixels(mesh, [ball(0.01)], raster).any()


@pytest.mark.slow
def test_a_ball_is_fitted_beside_a_smooth_field(monkeypatch):
    plates = FacePatches(np.array(SIDES), 0.03, 0.03, 1e-3)
    model = ForwardModel(body_mesh(BOX, plates, 6000), plates, opposite(16, current=1e-3))
    held = np.linalg.norm(np.asarray(centroids(model.mesh)) - BALL, axis=1) < RADIUS
    frame, reference = measured(model, BATH * np.where(held, TIMES, 1.0), 1), measured(model, BATH, 2)
    asked, fitted = {}, method.reconstruct_shapes
    monkeypatch.setattr(method, "reconstruct_shapes", lambda *a, **k: asked.update(k) or fitted(*a, **k))
    result = image_difference(frame, reference, ImagingSettings(num_points=1600))
    assert asked["smooth"] is not None
    assert asked["least_rise"] == 1
    assert result.shapes is not None
    (body,), ((low, high),) = result.shapes.bodies, result.peak_ranges
    assert np.linalg.norm(body.centroid - BALL) < 0.004
    assert low < result.inclusions[0].peak < high
    assert result.settings.method == "shapes"
    finer = result.shapes.finer
    assert finer is not None
    assert result.mesh is finer.model.mesh is not result.calibration.model.mesh
    assert result.electrodes is finer.model.electrodes
    assert np.shape(result.change) == (result.mesh.num_cells,)
    in_ball = np.linalg.norm(np.asarray(centroids(result.mesh)) - BALL, axis=1) < 0.5 * RADIUS
    assert np.asarray(result.change)[in_ball].mean() > 0.8 * result.inclusions[0].peak  # the image is of the body
    background = float(result.calibration.conductivity)
    deviation = np.diff(np.log1p(np.array([low, high]) / background)) / 2
    assert deviation > 0.1  # the mesh's error, with more from noise
    known, (one,) = body.quantities, result.inclusions
    np.testing.assert_allclose([low, high], background * np.array(known.change_interval))
    assert (one.area, one.area_interval) == (body.volume, known.measure_interval)
    assert one.centroid_radius == known.centroid_radius
    assert np.linalg.norm(body.centroid - BALL) < 3 * one.centroid_radius < 0.01
    ratio = 1 + known.change
    assert known.strength == pytest.approx(body.volume * (ratio - 1) / (ratio + 2), rel=0.05)


def test_strengths_in_a_solid_count_its_cells():
    """A reference that the model explains exactly leaves the discretisation error."""
    tank = Solid(Disk(0.1), 0.08)
    angle = 2 * np.pi * np.arange(8) / 8
    places = np.column_stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), np.full(8, 0.04)])
    electrodes = FacePatches(places, 0.03, 0.04, 0.01)
    model = ForwardModel(imaging_mesh(tank, electrodes, 700), electrodes, skip(8, 1))
    empty, other = (measured(model, one, 0, tank) for one in (BATH, 1.1 * BATH))
    accuracy = prepare_difference(other, empty, num_points=700).accuracy
    assert accuracy.strength == pytest.approx(0.03, abs=5e-3)


def prepared(dimension, strongest, noise):
    difference_noise = None if noise is None else SimpleNamespace(relative=noise)
    return SimpleNamespace(
        quality=SimpleNamespace(difference_noise=difference_noise),
        calibration=SimpleNamespace(conductivity=BATH),
        mesh=SimpleNamespace(dimension=dimension),
        accuracy=None,
        noise=noise,
    ), np.array([0.0, -strongest * BATH])


@pytest.mark.parametrize(
    ("dimension", "strongest", "noise", "looks"),
    [(3, 0.1, 0.1, True), (3, 0.1, None, True), (3, 0.1, 0.5, False), (3, 0.02, 0.1, False), (2, 0.1, 0.1, False)],
)
def test_bodies_are_searched_in_solids_where_data_can_determine_them(monkeypatch, dimension, strongest, noise, looks):
    asked = []

    def image(*_):
        asked.append(True)
        raise ValueError("no image")

    monkeypatch.setitem(automatic.METHODS, "gauss-newton", SimpleNamespace(image=image, hyperparameter=5.0))
    data, change = prepared(dimension, strongest, noise)
    assert automatic._fit_bodies_in_solid(data, method.MethodOptions("gaussian"), change) is None
    assert bool(asked) == looks


@pytest.mark.parametrize("fault", ["", "it is strong"])
@pytest.mark.parametrize("prior", ["gaussian", "noser", Laplace()])
def test_a_requested_prior_is_that_of_the_image(monkeypatch, prior, fault):
    data, change = prepared(3, 0.1, 0.1)
    data.difference = change
    monkeypatch.setattr(automatic, "linear_image_fault", lambda *_: fault)
    monkeypatch.setattr(automatic, "Reconstruction", SimpleNamespace)
    fitted = SimpleNamespace(bodies=(1,), misfit=0.5, conductivity=change, finer=None)
    monkeypatch.setattr(automatic, "shapes_in", lambda *_: fitted)
    for name in ("one-step", "gauss-newton"):
        made = SimpleNamespace(image=lambda *_: (SimpleNamespace(misfit=1.0), change), hyperparameter=5.0)
        monkeypatch.setitem(automatic.METHODS, name, made)
    chosen = automatic.image_automatically(data, method.MethodOptions(prior))
    assert chosen.method == ("shapes" if prior == "gaussian" else "gauss-newton" if fault else "one-step")


@pytest.mark.parametrize("strongest", [0.1, 1.0])
@pytest.mark.parametrize(("dimension", "edges"), [(2, "outlines"), (3, "surfaces")])
def test_the_fit_is_named_for_the_kind_of_body(monkeypatch, dimension, edges, strongest):
    """An outline in a sheet, a surface in a solid, beside a sound linear image and without one."""
    data, change = prepared(dimension, strongest, 0.1)
    data.difference, data.calibration.conductivity = change, BATH
    data.mask = np.ones(2, bool)
    monkeypatch.setattr(automatic, "linear_image_fault", lambda *_: "it is strong" if strongest == 1 else "")
    monkeypatch.setattr(automatic, "Reconstruction", SimpleNamespace)
    fitted = SimpleNamespace(bodies=(1,), misfit=0.5, conductivity=change, finer=None)
    monkeypatch.setattr(automatic, "shapes_in", lambda *_: fitted)
    for name in ("one-step", "gauss-newton"):
        made = SimpleNamespace(image=lambda *_: (SimpleNamespace(misfit=1.0), change), hyperparameter=5.0)
        monkeypatch.setitem(automatic.METHODS, name, made)
    chosen = automatic.image_automatically(data, method.MethodOptions("gaussian"))
    if dimension == 3 or strongest == 1:
        assert f"{edges} " in chosen.reason
    else:
        assert chosen.method == "one-step"


@pytest.mark.parametrize("dimension", [2, 3])
def test_settings_of_bodies_reach_their_search(monkeypatch, dimension):
    data, _ = prepared(dimension, 0.1, 0.1)
    data.model, data.difference = SimpleNamespace(voltages=lambda background: np.zeros(2)), np.zeros(2)
    data.sharp_noise = data.mask = None
    data.modelled_share, data.accuracy = 0.5, None
    data.with_noise_from = lambda misfit: data
    monkeypatch.setattr(method, "find_inclusions", lambda *_, **__: [])
    monkeypatch.setattr(method, "reconstruct_shapes", lambda *_, **searched: searched)
    smooth: Any = SimpleNamespace(conductivity=np.ones(2), misfit=1.0)
    searched: Any = method.shapes_in(data, smooth, method.MethodOptions("gaussian", kinds="columns", progress=print))
    assert searched["progress"] is print
    assert (searched["prior"] is None) if dimension == 2 else (searched["prior"].kinds == "columns")


@pytest.mark.parametrize("given", [{"method": "one-step"}, {"prior": "noser"}, {"hyperparameter": 3.0}])
def test_kinds_of_bodies_are_settings_where_bodies_are_searched(given):
    assert ImagingSettings(method="shapes", bodies="columns").bodies == "columns"
    with pytest.raises(ValueError, match="bodies: only methods 'auto' and 'shapes' with the default prior"):
        ImagingSettings(bodies="ellipsoids", **given)
    with pytest.raises(ValueError, match=r"bodies must be one of either, ellipsoids, columns; .* mean 'columns'"):
        ImagingSettings(bodies="column")


@pytest.mark.slow
def test_bodies_of_a_sound_linear_image_are_distinguished_in_a_cylinder():
    """A ball with a fifth of the conductivity, which one step shows at a tenth of its contrast, from currents between
    two rings.
    """
    angle = 2 * np.pi * np.arange(12) / 12
    around = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle)], axis=1)
    places = np.concatenate([np.column_stack([around, np.full(12, z)]) for z in (0.025, 0.055)])
    tank, patches = Solid(Disk(0.05), 0.08), FacePatches(places, 0.012, 0.015, 1e-3)
    model = ForwardModel(body_mesh(tank, patches, 6000), patches, skip(24, 7, current=1e-3))
    middle, radius = np.array([-0.018, 0.008, 0.044]), 0.012
    held = np.linalg.norm(np.asarray(centroids(model.mesh)) - middle, axis=1) < radius
    frame = measured(model, BATH * np.where(held, 0.2, 1.0), 1, tank)
    result = image_difference(frame, measured(model, BATH, 2, tank), ImagingSettings(num_points=1600))
    assert "which a linear image of a solid blurs" in result.why
    body = result.shapes.bodies[0]
    assert np.linalg.norm(body.centroid - middle) < 0.004
    assert body.sign == -1


def test_where_electrodes_do_not_distinguish_the_kind_of_a_body_it_is_doubted_and_intervals_cover_both():
    def body(column, contrast):
        return Ellipsoid(1, BALL, 0.02 * np.eye(3), 3e-5, BALL, contrast, column, column, 2.0)

    zero: Any = np.zeros(1)
    shapes = ShapeReconstruction(
        bodies=(body(True, np.log(3)), body(False, np.log(4))),
        conductivity=zero,
        voltages=zero,
        misfit=np.zeros(()),  # pyright: ignore
        drift=0.0,
        doubtful=(),
        contrast_deviations=(0.1, 0.2),
        alternatives=(body(False, np.log(6)), None),
        alternative_deviations=(0.5, np.nan),
    )
    model = SimpleNamespace(mesh=SimpleNamespace(dimension=3))
    calibration = SimpleNamespace(conductivity=BATH, misfit=0.0, model=model)
    frame = SimpleNamespace(
        mask=np.ones((1, 2), bool), voltages=np.ones((1, 2)), notes=(), electrodes=None, domain=None
    )
    whole = SimpleNamespace(measurement=frame, reference=frame)
    quality = SimpleNamespace(doubt="")
    image: Any = SimpleNamespace(
        shapes=shapes,
        reconstruction=shapes,
        calibration=calibration,
        quality=quality,
        electrode_change=None,
        **vars(whole),
    )
    own = Quantities(2.0, (1.7, 2.3), 3e-5, (2e-5, None), 1.5e-5, (1.4e-5, 1.6e-5), 1e-3)
    elsewhere = replace(body(False, np.log(6)), centroid=BALL + np.array([0.0, 0.0, 0.005]))
    known = include_deviation(own, body(True, np.log(3)), elsewhere, 0.5)
    assert known.centroid_radius == pytest.approx(0.005)
    assert include_deviation(own, body(True, np.log(3)), body(False, np.log(6)), 0.5).centroid_radius == 1e-3
    np.testing.assert_allclose(known.change_interval, (1.7, 6 * np.exp(0.5) - 1))
    assert known.measure_interval == (2e-5, None)
    np.testing.assert_allclose(known.strength_interval, (1.4e-5, 3e-5 * 5 / 8))
    assert include_deviation(own, body(True, np.log(3)), None, np.nan) == own
    (doubt,) = ImagedDifference.doubts.fget(image)  # pyright: ignore
    assert "x 12 mm, y -25 mm may as well be no column but an ellipsoid, of 6 times the background and 30 cm³" in doubt
    bodies = image_report._shapes_report(image)["bodies"]  # pyright: ignore
    assert bodies[0]["form"] == "column"
    assert bodies[0]["or"]["form"] == "ellipsoid"
    np.testing.assert_allclose(bodies[0]["or"]["conductivity_over_background"], 6)
    assert bodies[0]["or"]["deviation_of_logarithm"] == 0.5
    assert "or" not in bodies[1]
    assert bodies[0]["conductivity_is"] == "estimated from the data, as of one material with all others of its sign"
    assert bodies[1]["conductivity_is"] == "estimated from the data"


def test_a_column_of_another_volume_keeps_its_height_and_a_ball_grows_in_all_directions():
    known = Quantities(2.0, (1.5, 2.5), 8e-5, (7e-5, 9e-5), 4e-5, (3e-5, 5e-5))
    axes = np.array([[0.0, 0.0, 0.05], [0.03, 0.0, 0.0], [0.0, 0.01, 0.0]])
    for column, scale in ((True, [1.0, 2.0, 2.0]), (False, [4 ** (1 / 3)] * 3)):
        found = Ellipsoid(1, BALL, axes, 2e-5, BALL, 1.0, column, False, 2.0).with_quantities(known)
        np.testing.assert_allclose(found.axes, axes * np.array(scale)[:, None])
        assert (found.volume, found.contrast) == (8e-5, pytest.approx(np.log(3)))
        assert found.bounded_axes == 3 - column


def test_the_last_axis_of_a_drawn_column_is_vertical():
    axes = np.array([[0.0, 0.0, 0.05], [0.03, 0.0, 0.0], [0.0, 0.01, 0.0]])
    form = difference._solid_form(Ellipsoid(1, BALL, axes, 3e-5, BALL, 1.0, True, False, 2.0))  # pyright: ignore
    assert form is not None
    assert form.column
    np.testing.assert_allclose(np.ptp(form.surface().points, axis=0), [0.06, 0.02, 0.1])
    np.testing.assert_allclose(form.axes[-1], [0, 0, 0.05])
