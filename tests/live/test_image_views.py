"""Views of images and contacts against `stream`, `find_contacts` and `track_contacts` on the same frames.

A sheet of sixteen electrodes on 120 nodes, in which a body of half the conductivity moves. The tests are of views, not
of the accuracy of images.
"""

import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, FaceDiscs, FacePatches, PointElectrodes
from jeit.forward import ForwardModel
from jeit.image import Raster
from jeit.image.inclusions import StrongestRegion
from jeit.inverse import Gaussian, Imager, stream
from jeit.inverse.calibration import Calibration
from jeit.inverse.nonlinear import OneStep
from jeit.layout import ring
from jeit.live import ConductivityView, LiveFrame
from jeit.live.views.conductivity import PixelGrid, channel_names, create_scene, electrode_curves
from jeit.live.views.contacts import ContactsView
from jeit.mesh import Disk, centroids, cylinder, rectangle, sphere
from jeit.protocol import adjacent, from_matrices, opposite, reference_electrode
from jeit.touch import CellFinder, ImageNoise, find_contacts, track_contacts

RADIUS, NOISE = 0.1, 2e-4
PLACES = [(0.05 * np.cos(angle), 0.05 * np.sin(angle)) for angle in np.linspace(0, 0.5, 8)]


@pytest.fixture(scope="module")
def model():
    electrodes = BoundaryElectrodes(ring(RADIUS, 16), 0.012, 1e-3)
    return ForwardModel(Disk(RADIUS).mesh(num_points=120), electrodes, adjacent(16))


@pytest.fixture(scope="module")
def calibration(model):
    return Calibration(model, np.array(1.0), model.voltages(1.0), np.array(0.0), np.zeros(0), 0, 0)


def voltages(model, places, value=0.5):
    centre = np.asarray(centroids(model.mesh))
    near = [np.linalg.norm(centre - place, axis=1) < 0.03 for place in places]
    return np.array([model.voltages(np.where(one, value, 1.0)) for one in near])


@pytest.fixture(scope="module")
def still(model):
    rest = np.asarray(model.voltages(1.0))
    return rest + NOISE * np.abs(rest) * np.random.default_rng(1).normal(size=(20, len(rest)))


@pytest.fixture(scope="module")
def frames(model):
    clean = voltages(model, PLACES)
    return clean + NOISE * np.abs(clean) * np.random.default_rng(0).normal(size=clean.shape)


def imager_of(model, reference, **options):
    return Imager.create(
        model,
        1.0,
        reference=reference,
        noise=NOISE,
        prior=Gaussian(0.02),
        hyperparameter=3.0,
        solver=OneStep(),
        **options,
    )


@pytest.fixture(scope="module")
def imager(model, still):
    return imager_of(model, still.mean(axis=0))


def live(frames, first=0):
    return [LiveFrame(first + number, number / 60, 0.0, frame) for number, frame in enumerate(frames)]


@pytest.mark.parametrize("memory", [0.0, 3.0])
def test_pixels_equal_those_of_the_stream(model, calibration, still, frames, memory):
    """Also with a memory. Of faulty frames among them the same ones are refused, for the same reasons."""
    imager = imager_of(model, still.mean(axis=0), memory=memory)
    partly = np.where(np.arange(208) < 20, np.nan, frames[2])
    given = [frames[0], still[0], frames[1, :-1], partly, np.full(208, np.nan), "half a li", 0 * frames[0], frames[2]]
    view = ConductivityView(imager, calibration)
    raster = Raster.create(model.mesh, shape=view.grid.inside.shape, extent=view.scene.extent)
    for frame, one in zip(live(given), stream(imager, given), strict=True):
        picture = view.picture(frame)
        assert (picture.status, picture.reason) == (one.status, one.reason)
        if one.conductivity is None:
            assert picture.pixels is None
            assert not picture.markers
            continue
        expected = np.asarray(raster.sample(one.conductivity - 1.0))
        np.testing.assert_array_equal(picture.pixels, expected.astype(np.float32))
        centroid, _ = StrongestRegion(model.mesh)(one.conductivity - 1.0)
        assert [(marker.x, marker.y) for marker in picture.markers] == (
            [] if one.status == "unchanged" else [tuple(centroid)]
        )


def test_pixels_are_squares_in_the_box_of_the_body():
    """As many along the longer side as requested, and at least one along the shorter."""
    for width, height, shape in ((0.2, 0.1, (8, 16)), (0.1, 0.2, (16, 8)), (0.2, 0.004, (1, 16))):
        grid = PixelGrid(rectangle(width, height, num_points=120), 16)
        assert grid.inside.shape == shape
        np.testing.assert_allclose(grid.extent, (-width / 2, width / 2, -height / 2, height / 2), atol=1e-12)
        assert grid.inside.all()


def test_the_first_row_is_the_uppermost(model, calibration, imager):
    (frame,) = voltages(model, [(0.0, 0.06)])
    picture = ConductivityView(imager, calibration).picture(live([frame])[0])
    row, column = np.unravel_index(np.nanargmin(picture.pixels), picture.pixels.shape)
    height, width = picture.pixels.shape
    assert row / height < 0.35  # y = 60 mm of ±100, on large cells
    assert 0.4 < column / width < 0.6


def test_a_new_reference_equals_a_new_imager_with_it(model, calibration, imager, still, frames):
    other = 1.02 * still
    view = ConductivityView(imager, calibration)
    before, picture = view.image(live(frames)[7])
    centroid, peak = StrongestRegion(model.mesh)(np.asarray(before.conductivity) - 1.0)
    (marker,) = picture.markers
    assert (marker.x, marker.y, marker.label) == (*centroid, f"{round(100 * peak):+d} %")
    # The body is at (44, 24) mm, the first row is the uppermost.
    row, column = np.unravel_index(np.nanargmin(picture.pixels), picture.pixels.shape)
    assert row < 0.5 * len(picture.pixels)
    assert column > 0.6 * len(picture.pixels)
    view.set_reference(other)
    # The noise remains that of the first reference.
    deviation = np.asarray(imager.noise)
    made = Imager.create(
        *(model, 1.0),
        reference=other.mean(axis=0),
        noise=deviation,
        prior=Gaussian(0.02),
        hyperparameter=3.0,
        solver=OneStep(),
    )
    for frame, one in zip(live(1.02 * frames), stream(made, 1.02 * frames), strict=True):
        change = np.nanmax(np.abs(view.picture(frame).pixels - view.grid(one.conductivity - 1.0)))
        assert change < 1e-4 * np.abs(one.conductivity - 1.0).max()  # single precision, and voltages of 2 %


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda still: still[:, :-1], "shape"),
        (lambda still: still[:0], "give frames"),
        (
            lambda still: np.where(np.arange(208) == 7, np.nan, still),
            "no reading of 1 channel in use, the first number 7",
        ),
        (lambda still: -still, "signs right"),
        (lambda still: 1000 * still, "1e+03 times"),
    ],
)
def test_a_bad_reference_leaves_the_old_one(calibration, imager, still, frames, wrong, message):
    view = ConductivityView(imager, calibration)
    before = view.picture(live(frames)[0]).pixels
    with pytest.raises(ValueError, match="reference") as error:
        view.set_reference(wrong(still))
    assert message in str(error.value)
    np.testing.assert_array_equal(view.picture(live(frames)[0]).pixels, before)


def test_contacts_and_paths_equal_those_of_the_batch(model, calibration, imager, still, frames):
    """Markers of each frame against contacts found in images of the stream, with the noise of images of `still`; the
    number of the touch is that of the tracker over all frames."""
    view = ContactsView(ConductivityView(imager, calibration), still)
    quiet = np.array([one.conductivity for one in stream(imager, still)])
    factor = (quiet - quiet.mean(axis=0)) / np.sqrt(len(quiet) - 1)
    noise = ImageNoise(np.sqrt((factor**2).sum(axis=0)), factor)
    given = [*frames, *still[:15], *frames]  # no contact for a quarter of a second: a second touch
    pictures = [view.picture(frame) for frame in live(given)]
    finder = CellFinder(model.mesh, sign=-1)
    found = [find_contacts(finder, one.conductivity - 1.0, noise) for one in stream(imager, given)]
    for picture, contacts in zip(pictures, found, strict=True):
        assert [(one.x, one.y) for one in picture.markers] == [tuple(one.centroid) for one in contacts]
        assert [one.radius for one in picture.markers] == [one.deviation for one in contacts]
        assert [one.label for one in picture.markers] == [f"{100 * one.peak:+.0f} %" for one in contacts]
    paths = track_contacts(np.arange(len(given)) / 60, found)
    numbers = [one.track for picture in pictures for one in picture.markers]
    assert sorted(set(numbers)) == [path.number for path in paths] == [0, 1]
    assert [numbers.count(path.number) for path in paths] == [len(path.times) for path in paths]


def test_a_long_session_of_contacts_keeps_little(calibration, imager, still, frames):
    view = ContactsView(ConductivityView(imager, calibration), still)
    course = [*frames, *still, *still, *frames, *frames[::-1]]  # two touches, of which one ends
    for number, frame in enumerate(course):
        view.picture(LiveFrame(number, number / 60, 0.0, frame))
    assert [(touch.number, len(touch.observations)) for touch in view._contact_tracker.open] == [(1, 1)]
    assert view._contact_tracker.closed == ()


def test_frames_of_one_moment_are_tracked(calibration, imager, still, frames):
    view = ContactsView(ConductivityView(imager, calibration), still)
    pictures = [view.picture(LiveFrame(number, 1.0, 0.0, frames[0])) for number in range(3)]
    assert [one.status for one in pictures] == 3 * ["imaged"]
    assert {one.markers[0].track for one in pictures} == {0}


def test_a_scene_contains_what_a_page_draws(model, calibration, imager):
    scene = ConductivityView(imager, calibration).scene
    assert (scene.unit, scene.diverging, len(scene.outline)) == ("S", True, 1)
    np.testing.assert_allclose(np.linalg.norm(scene.outline[0], axis=1), RADIUS)
    np.testing.assert_array_equal(scene.outline[0][0], scene.outline[0][-1])
    place = np.asarray(model.electrodes.position)
    middles = [one.mean(axis=0) for one in scene.electrodes]
    np.testing.assert_allclose(middles, place, atol=2e-3)  # vertices are not evenly spaced along 12 mm
    assert scene.names == [str(number) for number in range(1, 17)]
    assert scene.channels[:2] == ["1-2 → 3-4", "1-2 → 4-5"]
    assert len(scene.channels) == 208


def test_channels_against_a_reference_electrode_are_named():
    assert channel_names(opposite(8))[:2] == ["1-5 → 2-3", "1-5 → 3-4"]
    three = np.array([[0.0, -1.0, -1.0, 2.0], [0.0, 0.0, 1.0, -1.0]])
    assert channel_names(from_matrices(1e-3 * three, three)) == ["4… → 4…", "4… → 3-4", "3-4 → 4…", "3-4 → 3-4"]
    names = channel_names(reference_electrode(8))
    assert all(name.count("→") == 1 for name in names)
    assert len(set(names)) == len(names)


def test_a_solid_is_shown_as_a_slice():
    """The outline of the slice is the circle, within a pixel. Discs on top are circles, as seen from above."""
    mesh = cylinder(0.05, 0.04, num_points=300)
    place = np.column_stack([0.03 * ring(1.0, 4), np.full(4, 0.04)])
    electrodes = FaceDiscs(place, 0.008, 1e-3)
    grid = PixelGrid(mesh)
    scene = create_scene(mesh, electrodes, adjacent(4), grid, title="", quantity="", unit="S/m", diverging=True)
    (edge,) = scene.outline
    pixel = 0.1 / grid.inside.shape[1]
    assert np.abs(np.linalg.norm(edge, axis=1) - 0.05).max() < 0.003 + pixel  # a polygon of some nodes
    for curve, middle in zip(scene.electrodes, place, strict=True):
        np.testing.assert_allclose(np.linalg.norm(curve - middle[:2], axis=1), 0.008)
    (curve, *_) = electrode_curves(mesh, FacePatches(place, 0.008, 0.004, 1e-3))
    corners = [[-4e-3, -2e-3], [4e-3, -2e-3], [4e-3, 2e-3], [-4e-3, 2e-3], [-4e-3, -2e-3]]
    np.testing.assert_allclose(curve - place[0, :2], corners, atol=1e-12)


def test_electrodes_without_a_size_are_points(model):
    curves = electrode_curves(model.mesh, PointElectrodes([(0.0, 0.05), (0.05, 0.0)]))
    assert [one.tolist() for one in curves] == [[[0.0, 0.05]], [[0.05, 0.0]]]


def test_a_surface_in_space_has_no_flat_image():
    with pytest.raises(ValueError, match="space"):
        PixelGrid(sphere(0.05, num_points=100))
