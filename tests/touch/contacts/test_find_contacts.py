"""Contacts found in images: places, areas and noise, and none where nothing touches."""

import sys

import jax
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import one_step
from jeit.layout import perimeter, ring
from jeit.mesh import Disk, Rectangle, centroids, disk, layer, measures
from jeit.protocol import adjacent
from jeit.touch.contacts import CellFinder, ImageNoise, RasterFinder, find_contacts
from jeit.touch.contacts.cell_finder import outline_of_cells
from jeit.touch.simulate import DiscIndenter, Press, PressedSkin, material

FINDERS = [CellFinder, RasterFinder]
MESH = disk(0.05, num_points=2500)
CENTRE = np.asarray(centroids(MESH))
QUIET = ImageNoise(np.full(MESH.num_cells, 1e-6))


def bump(x, y, width=0.007):
    return np.exp(-((CENTRE - [x, y]) ** 2).sum(axis=1) / (2 * width**2))


@pytest.mark.parametrize("finder", FINDERS)
def test_bumps_are_where_they_are(finder):
    found = find_contacts(finder(MESH), bump(0.02, 0.01) + 0.6 * bump(-0.02, -0.005), QUIET)
    assert len(found) == 2
    np.testing.assert_allclose(found[0].centroid, [0.02, 0.01], atol=5e-4)
    np.testing.assert_allclose(found[1].centroid, [-0.02, -0.005], atol=5e-4)
    assert found[1].peak / found[0].peak == pytest.approx(0.6, rel=0.02)
    for one in found:  # the outline surrounds the centroid and encloses about the region
        x, y = (one.contour - one.centroid).T
        enclosed = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
        assert enclosed == pytest.approx(one.area, rel=0.15)


def test_area_and_integral_of_a_smoothed_gaussian():
    """A Gaussian of variance w² smoothed by one of ℓ² is one of w² + ℓ², whose cut at a level has area 2π(w² + ℓ²) ln(1
    / level), and peak w² / (w² + ℓ²).
    """
    (found,) = find_contacts(CellFinder(MESH, smoothing=0.003, level=0.5), bump(0.0, 0.0), QUIET)
    wide = 0.007**2 + 0.003**2
    assert found.peak == pytest.approx(0.007**2 / wide, rel=0.03)
    assert found.area == pytest.approx(2 * np.pi * wide * np.log(2), rel=0.05)
    assert found.integral == pytest.approx(2 * np.pi * 0.007**2 * 0.5, rel=0.05)


def test_close_contacts_are_separated_and_a_shoulder_is_not():
    assert len(find_contacts(CellFinder(MESH), bump(0.011, 0) + bump(-0.011, 0), QUIET)) == 2
    assert len(find_contacts(CellFinder(MESH), bump(0.006, 0) + bump(-0.006, 0), QUIET)) == 1


@pytest.mark.parametrize("finder", FINDERS)
def test_negative_changes_are_contacts_only_on_request(finder):
    image = -bump(0.02, 0.01)
    assert find_contacts(finder(MESH), image, QUIET) == []
    (found,) = find_contacts(finder(MESH, sign=-1), image, QUIET)
    assert found.peak < 0
    assert found.integral < 0
    np.testing.assert_allclose(found.centroid, [0.02, 0.01], atol=5e-4)


@pytest.mark.parametrize("finder", FINDERS)
def test_two_presses_are_two_contacts(skin, finder):
    found = find_contacts(finder(skin.mesh), skin.two, skin.noise)
    assert len(found) == 2
    truth = np.array([[0.025, 0.0], [-0.02, 0.01]])
    off = np.linalg.norm(truth[:, None] - np.array([one.centroid for one in found]), axis=-1).min(axis=1)
    assert off.max() < 0.004


@pytest.mark.parametrize("finder", FINDERS)
def test_no_contact_in_a_thousand_empty_frames(skin, finder):
    ready = finder(skin.mesh)
    assert sum(len(find_contacts(ready, image, skin.noise)) for image in skin.empty) == 0
    eager = finder(skin.mesh, floor=1.0)  # the noise floor excludes them
    assert sum(bool(find_contacts(eager, image, skin.noise)) for image in skin.empty[:12]) > 6


@pytest.mark.parametrize(
    ("finder", "times", "draws", "within"), [(CellFinder, 50, 50, 0.2), (RasterFinder, 10, 20, 0.5)]
)
def test_deviation_is_the_scatter_of_the_centroid(skin, finder, times, draws, within):
    """Against draws of noise many times that of the readings. The standard error is 7 % for 50 draws, 11 % for 20, and
    a contour moves by whole cells.
    """
    random = np.random.default_rng(0)
    volts = times * random.choice([-1, 1], 208) * skin.before.std(axis=0)
    noise = ImageNoise.of_channels(skin.reconstruction, np.abs(volts))
    images = np.asarray(skin.reconstruction.image(skin.change + volts * random.normal(size=(draws, 208))))
    ready = finder(skin.mesh, floor=0.5)
    (exact,) = find_contacts(finder(skin.mesh), skin.one, skin.noise)
    places = []
    for image in images:
        found = find_contacts(ready, image, noise)
        nearest = min(found, key=lambda one: np.linalg.norm(one.centroid - exact.centroid))
        places.append(nearest.centroid)
    observed = np.sqrt(np.var(places, axis=0).sum())
    predicted = find_contacts(ready, skin.one, noise)[0].deviation
    assert predicted == pytest.approx(observed, rel=within)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [Rectangle(0.2, 0.05), Rectangle(0.1, 0.1)])
def test_deviation_on_a_raster_includes_cells_that_join_and_leave(shape):
    """The slope at the edge alone gave 0.04 mm of 0.22, and 0.08 of 0.2."""
    electrodes = BoundaryElectrodes(perimeter(shape, 16), 0.008, 300.0)
    fine, coarse = (ForwardModel(shape.mesh(num_points=n), electrodes, adjacent(16)) for n in (1500, 900))
    skin = PressedSkin(jax.random.key(0), fine, material("velostat"))
    empty = skin.frames(jax.random.key(1), [()] * 100)
    linear = one_step(coarse, float(skin.conductivity[0]), noise=empty.std(axis=0))
    deviation = empty.std(axis=0)
    noise, finder = ImageNoise.of_channels(linear, deviation), RasterFinder(coarse.mesh)
    points = np.asarray(coarse.mesh.points)
    low, wide = points.min(axis=0), np.ptp(points, axis=0)
    random, predicted, observed = np.random.default_rng(0), [], []
    for share in ((0.63, 0.63), (0.28, 0.6), (0.45, 0.4), (0.7, 0.35), (0.37, 0.52), (0.55, 0.7)):
        (frame,) = skin.frames(jax.random.key(2), [Press(DiscIndenter(0.01), 2.0, low + np.array(share) * wide)])
        frames = frame - empty.mean(axis=0) + deviation * random.normal(size=(12, len(deviation)))
        found = [find_contacts(finder, image, noise)[0] for image in np.asarray(linear.image(frames))]
        observed.append(np.var([one.centroid for one in found], axis=0).sum())
        predicted.append(np.mean([one.deviation**2 for one in found]))
    assert 0.7 < np.sqrt(np.sum(predicted) / np.sum(observed)) < 1.5


def test_outline_of_cells_is_their_outer_boundary_alone():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    loop = outline_of_cells(points, np.array([[0, 1, 2], [0, 2, 3]]))
    assert sorted(loop.tolist()) == sorted(points.tolist())
    around = np.flatnonzero((np.linalg.norm(CENTRE, axis=1) < 0.03) & (np.linalg.norm(CENTRE, axis=1) > 0.01))
    outer = outline_of_cells(np.asarray(MESH.points), np.asarray(MESH.cells)[around])
    assert np.linalg.norm(outer, axis=1).min() > 0.027  # not that of the hole


def test_noise_of_frames_is_that_of_channels(skin):
    predicted = ImageNoise.of_channels(skin.reconstruction, skin.before.std(axis=0))
    np.testing.assert_allclose(skin.noise.deviation, predicted.deviation, rtol=0.3)  # 100 frames give 7 %
    matrix = np.asarray(skin.reconstruction.matrix)
    covariance = (matrix * skin.before.std(axis=0) ** 2) @ matrix.T
    np.testing.assert_allclose(predicted.factor.T @ predicted.factor, covariance, atol=1e-9 * np.abs(covariance).max())


def test_unknown_noise_is_estimated_from_the_image(skin):
    random = np.random.default_rng(0)
    own = ImageNoise.of_image(0.01 * random.normal(size=MESH.num_cells) + bump(0.0, 0.0, 0.003))
    assert own.deviation[0] == pytest.approx(0.01, rel=0.1)  # a narrow contact, of 2 % of the cells
    assert own.factor is None
    assert own.distance(np.ones((MESH.num_cells, 2))) == pytest.approx(np.sqrt(2) * own.deviation.sum())
    found = find_contacts(CellFinder(skin.mesh), skin.one)
    assert len(found) == 1
    assert np.linalg.norm(found[0].centroid - [0.01, 0.005]) < 0.003


@pytest.mark.slow
def test_large_artefacts_are_not_reported_as_noise():
    """Two touches on eight electrodes leave artefacts everywhere. The median distance from the median concealed both
    touches.
    """
    electrodes = BoundaryElectrodes(ring(0.05, 8), 0.008, 300.0)
    fine, coarse = (ForwardModel(Disk(0.05).mesh(num_points=n), electrodes, adjacent(8)) for n in (1500, 600))
    skin = PressedSkin(jax.random.key(0), fine, material("velostat"))
    empty = skin.frames(jax.random.key(1), [()] * 400)
    reference = empty[:100].mean(axis=0)
    linear = one_step(coarse, float(skin.conductivity[0]), noise=empty[:100].std(axis=0))
    finder = CellFinder(coarse.mesh)
    drawn = np.random.default_rng(0).uniform(-0.026, 0.026, (40, 2, 2))
    pairs = [two for two in drawn if np.linalg.norm(two[0] - two[1]) > 0.03]
    presses = [tuple(Press(DiscIndenter(0.01), 5.0, place) for place in two) for two in pairs]
    images = np.asarray(linear.image(skin.frames(jax.random.key(2), presses) - reference))
    assert sum(len(find_contacts(finder, image)) == 2 for image in images) >= 8  # of 17, where 5 were left before
    untouched = np.asarray(linear.image(empty[100:] - reference))
    assert sum(bool(find_contacts(finder, image)) for image in untouched) <= 9  # of 300


def test_smoothing_is_a_mean(skin):
    finder = CellFinder(skin.mesh)
    np.testing.assert_allclose(finder.smoothing @ np.ones(skin.mesh.num_cells), 1.0)
    assert CellFinder(skin.mesh, smoothing=0.0).smoothing.nnz == skin.mesh.num_cells
    assert np.asarray(measures(skin.mesh)).sum() == pytest.approx(finder.areas.sum())


@pytest.mark.parametrize("finder", FINDERS)
@pytest.mark.parametrize(
    ("image", "wrong"),
    [
        (np.zeros(17), "another"),
        (np.full(MESH.num_cells, np.nan), "NaN"),
        (np.zeros(MESH.num_cells, complex), "real"),
    ],
)
def test_bad_images(finder, image, wrong):
    with pytest.raises(ValueError, match=wrong):
        find_contacts(finder(MESH), image, QUIET)


def test_stages_lead_from_image_to_contacts(skin):
    finder = RasterFinder(skin.mesh)
    stages = finder.stages(skin.two, skin.noise)
    inside = np.isfinite(stages.region)
    assert inside.mean() == pytest.approx(np.pi / 4, rel=0.01)
    assert stages.grey.max() == 255
    assert not stages.grey[~inside].any()
    assert not stages.threshold[~inside].any()
    assert (stages.opened <= stages.threshold).all()
    found = find_contacts(finder, skin.two, skin.noise)
    assert [one.peak for one in stages.contacts] == [one.peak for one in found]
    assert sum(one.area for one in found) == pytest.approx(finder.raster.pixel_area * stages.opened.sum(), rel=0.01)


def test_stages_where_touched_skin_conducts_less():
    image = -bump(0.02, 0.01)
    stages = RasterFinder(MESH, sign=-1).stages(image, QUIET)
    (found,) = find_contacts(RasterFinder(MESH, sign=-1), image, QUIET)
    (shown,) = stages.contacts
    assert shown.peak == found.peak == np.nanmin(stages.region) < 0
    with pytest.raises(ValueError, match="image has shape"):
        RasterFinder(MESH).stages(image[:-1], QUIET)


@pytest.mark.parametrize(
    ("deviation", "factor", "wrong"),
    [
        (1e-6, None, "deviation must be an array"),
        (np.full(3, np.nan), None, "not finite"),
        (-np.ones(3), None, "negative"),
        (np.ones((3, 2)), None, r"shape \(3, 2\)"),
        (np.ones(3), np.ones((5, 2)), r"give \(r, 3\)"),
    ],
)
def test_bad_noise(deviation, factor, wrong):
    with pytest.raises(ValueError, match=wrong):
        ImageNoise(deviation, factor)


def test_a_zero_image_has_no_contact():
    assert find_contacts(CellFinder(MESH), np.zeros(MESH.num_cells)) == []
    assert find_contacts(RasterFinder(MESH), np.zeros(MESH.num_cells)) == []


def test_noise_of_another_mesh(skin):
    with pytest.raises(ValueError, match="both on the same mesh"):
        find_contacts(CellFinder(MESH), bump(0, 0), skin.noise)
    with pytest.raises(ValueError, match="noise must be ImageNoise"):
        find_contacts(CellFinder(MESH), bump(0, 0), 1e-3)
    with pytest.raises(ValueError, match="finder must be"):
        find_contacts(MESH, bump(0, 0), QUIET)


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        ({"sign": 0}, "sign"),
        ({"floor": -1}, "floor"),
        ({"level": 1.0}, "level"),
        ({"smoothing": 3.0}, "smoothing"),
        ({"sign": np.ones(2)}, "sign"),
    ],
)
def test_bad_cell_finders(options, wrong):
    with pytest.raises(ValueError, match=wrong):
        CellFinder(MESH, **options)


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        ({"block": 100}, "block"),
        ({"opening": 0}, "opening"),
        ({"pixels": 3}, "pixels"),
        ({"pixels": 100_000}, "pixels"),
        ({"constant": 300}, "constant"),
    ],
)
def test_bad_raster_finders(options, wrong):
    with pytest.raises(ValueError, match=wrong):
        RasterFinder(MESH, **options)


def test_a_solid_is_refused():
    with pytest.raises(ValueError, match="three dimensions"):
        CellFinder(layer(disk(0.05, num_points=60), 0.01, num_layers=1))


def test_frames_that_do_not_determine_noise(skin):
    with pytest.raises(ValueError, match="10 frames or more"):
        ImageNoise.of_frames(skin.reconstruction, skin.before[:3])
    with pytest.raises(ValueError, match="all the same"):
        ImageNoise.of_frames(skin.reconstruction, np.tile(skin.before[0], (20, 1)))
    with pytest.raises(ValueError, match="images are all the same"):
        ImageNoise.of_images(np.ones((12, 3)))
    with pytest.raises(ValueError, match="10 images or more"):
        ImageNoise.of_images(np.eye(3))
    with pytest.raises(ValueError, match="frames must be voltages"):
        ImageNoise.of_frames(skin.reconstruction, skin.before.astype(str))
    with pytest.raises(ValueError, match="frames must be voltages"):
        ImageNoise.of_frames(skin.reconstruction, skin.before + 0j)
    with pytest.raises(ValueError, match="deviation must be one number"):
        ImageNoise.of_channels(skin.reconstruction, "1e-6")
    with pytest.raises(ValueError, match="deviation"):
        ImageNoise.of_channels(skin.reconstruction, np.zeros(7))
    with pytest.raises(ValueError, match="not zero for all"):
        ImageNoise.of_channels(skin.reconstruction, 0.0)
    with pytest.raises(ValueError, match="finite"):
        ImageNoise.of_image(np.array([1.0, np.nan]))


def test_without_opencv_the_message_names_the_package_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImportError, match=r"jeit\[vision\]"):
        RasterFinder(MESH)
