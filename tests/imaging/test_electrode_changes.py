"""Electrodes that move between a reference and a frame are estimated against the movement of a simulated disk, reported
and left out of the image; bodies are not taken for moved electrodes."""

import functools
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from jeit import image_difference
from jeit.data import Measurement
from jeit.electrodes import BoundaryElectrodes, body_mesh
from jeit.forward import ForwardModel
from jeit.imaging import ImagingSettings, electrode_changes, image_sequence
from jeit.imaging.preparation import prepare_difference
from jeit.imaging.stream_preparation import StreamSettings, image_stream, prepare_imager
from jeit.inverse import stream
from jeit.layout import ring
from jeit.live import ConductivityView, LiveFrame
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent
from jeit.report.image import report_image

RADIUS, NOISE = 0.1, 3e-4
SETTINGS = ImagingSettings("one-step", num_points=600, raster_shape=(64, 64))
ELECTRODES, PROTOCOL = BoundaryElectrodes(ring(RADIUS, 16), 0.01, 0.01), adjacent(16)
SHIFT = 1e-3 * np.random.default_rng(3).normal(size=16)
CENTRE, DEPTH = np.array([-0.05, 0.03]), 0.2


# Beside an electrode, and narrower: the evidence is for movement, but of one or two electrodes.
NARROW = (0.094 * np.cos(0.15), 0.094 * np.sin(0.15), 0.005, 0.1)
BODIES = {
    "none": (0, 0, 0, 1),
    "weak": (*CENTRE, 0.02, 1.2),
    "strong": (*CENTRE, 0.03, 10.0),
    "at an electrode": (0, 0.09, 0.008, 0.1),
    "narrow": NARROW,
}
"""Coordinates and radius in metres, and conductivity relative to the rest."""


@functools.cache
def frame(name: str, share: float = 0.0, seed: int = 1, only: int | None = None) -> Measurement:
    """Frame of a disk with a body, whose electrodes, or `only` one of them, have moved by a `share` of SHIFT."""
    is_moved = np.full(16, True) if only is None else np.arange(16) == only
    angles = np.arctan2(*np.asarray(ring(RADIUS, 16)).T[::-1]) + share * SHIFT * is_moved / RADIUS
    moved = BoundaryElectrodes(RADIUS * np.stack([np.cos(angles), np.sin(angles)], axis=1), 0.01, 0.01)
    truth = ForwardModel(body_mesh(Disk(RADIUS), moved, 1500), moved, PROTOCOL)
    x, y, radius, factor = BODIES[name]
    inside = np.hypot(*(np.asarray(centroids(truth.mesh)) - [x, y]).T) < radius
    return recorded([np.asarray(truth.voltages(np.where(inside, 0.02 * factor, 0.02)))], seed)


def recorded(frames, seed: int = 0, noise: float = NOISE, protocol=PROTOCOL) -> Measurement:
    voltages = np.array(frames)
    voltages = voltages * (1 + noise * np.random.default_rng(seed).normal(size=voltages.shape))
    used = np.ones(voltages.shape, bool)
    return Measurement(voltages, used, protocol, electrodes=ELECTRODES, domain=Disk(RADIUS), name="simulated")


@functools.cache
def image(name: str, share: float = 0.0, only: int | None = None):
    return image_difference(frame(name, share, only=only), frame("none", 0.0, seed=2), SETTINGS)


def test_moved_electrodes_are_estimated_and_show_no_bodies():
    result = image("none", 1.0)
    assert result.inclusions == ()
    # Voltages do not determine what a conformal map of the disk to itself does: a rotation and two more patterns.
    undetermined = np.stack([np.ones(16), *np.asarray(ring(RADIUS, 16)).T / RADIUS], axis=1)
    shift, expected = (
        values - undetermined @ np.linalg.lstsq(undetermined, values)[0]
        for values in (result.electrode_change.shift[:, 0], SHIFT)
    )
    assert np.linalg.norm(shift - expected) < 0.15 * np.linalg.norm(expected)
    assert result.electrode_change.rest < 0.05
    assert any(f"electrode {np.argmax(np.abs(SHIFT)) + 1} by about" in doubt for doubt in result.doubts)
    report = report_image(result)
    assert report["electrode_change"]["shift_unit"] == "m"
    assert np.shape(report["electrode_change"]["shift"]) == (16, 1)
    np.testing.assert_array_equal(report["electrode_change"]["contact_factor"], np.ones(16))


def test_one_moved_electrode_is_named_and_shows_no_bodies():
    electrode = int(np.argmax(np.abs(SHIFT)))
    result = image("none", 1.0, only=electrode)
    assert result.inclusions == ()
    assert np.flatnonzero(result.electrode_change.shift[:, 0]).tolist() == [electrode]
    np.testing.assert_allclose(result.electrode_change.shift[electrode], SHIFT[electrode], rtol=0.15)
    distance = f"{1e3 * abs(result.electrode_change.shift[electrode, 0]):.2g} mm"
    assert f"as if electrode {electrode + 1} had moved by about {distance} since" in result.electrode_change.doubt


@pytest.mark.parametrize("electrode", [int(np.argmax(np.abs(SHIFT))), 12])
def test_a_coarse_mesh_and_noise_add_no_bodies_beside_one_moved_electrode(electrode):
    """On this mesh, voltages jump as the first electrode moves. The second moves so little that noise is most of what
    remains."""
    settings = ImagingSettings("one-step", num_points=1000, raster_shape=(64, 64))
    result = image_difference(frame("none", 1.0, only=electrode), frame("none", 0.0, seed=2), settings)
    assert np.flatnonzero(result.electrode_change.shift[:, 0]).tolist() == [electrode]
    assert result.inclusions == ()


def test_a_body_beside_one_moved_electrode_stays_in_the_image():
    result = image("weak", 1.0, only=12)
    assert result.electrode_change is None
    assert min(np.linalg.norm(np.asarray(one.centroid) - CENTRE) for one in result.inclusions) < 0.1 * RADIUS


def test_contacts_that_have_changed_by_factors_show_no_bodies():
    """Contact impedances are seen where voltages are measured on driven electrodes. Steps of the linear approximation
    alone would make the change of such contacts diverge."""
    factor = np.exp(0.8 * np.random.default_rng(4).normal(size=16))
    protocol = adjacent(16, driven_electrodes=True)
    voltages = []
    for contact in (np.full(16, 0.01), 0.01 * factor):
        electrodes = BoundaryElectrodes(ring(RADIUS, 16), 0.01, contact)
        truth = ForwardModel(body_mesh(Disk(RADIUS), electrodes, 1500), electrodes, protocol)
        voltages.append(np.asarray(truth.voltages(0.02)))
    reference, changed = (recorded([one], seed, protocol=protocol) for seed, one in enumerate(voltages))
    result = image_difference(changed, reference, SETTINGS)
    assert result.inclusions == ()
    assert result.electrode_change.rest < 0.05
    assert np.corrcoef(np.log(result.electrode_change.contact_factor), np.log(factor))[0, 1] > 0.95
    assert f"(of electrode {np.argmax(np.abs(np.log(factor))) + 1}, " in result.electrode_change.doubt


def test_a_weak_body_is_found_beside_moved_electrodes():
    result = image("weak", 1.0)
    assert result.electrode_change is not None
    assert np.linalg.norm(np.asarray(result.inclusions[0].centroid) - CENTRE) < 0.1 * RADIUS
    assert result.inclusions[0].sign > 0


@pytest.mark.parametrize("name", ["weak", "at an electrode"])
def test_a_body_is_not_taken_for_moved_electrodes(name):
    result = image(name)
    assert result.electrode_change is None
    assert report_image(result)["electrode_change"] is None
    assert len(result.inclusions) == 1


def test_a_body_narrower_than_the_electrode_beside_it_is_not_taken_for_its_movement():
    result = image("narrow")
    assert result.electrode_change is None
    assert np.linalg.norm(np.asarray(result.inclusions[0].centroid) - NARROW[:2]) < 0.15 * RADIUS


def test_an_image_as_is_leaves_their_effects_in_place():
    settings = ImagingSettings("one-step", num_points=600, raster_shape=(64, 64), as_is=True)
    result = image_difference(frame("none", 1.0), frame("none", 0.0, seed=2), settings)
    assert result.electrode_change is None
    assert np.abs(result.change).max() > 3 * np.abs(image("none", 1.0).change).max()


def test_frames_of_a_series_with_moved_electrodes_are_named_although_another_frame_differs_more():
    frames = [frame("none", 0.0, seed=5), frame("none", 1.0), frame("strong"), frame("none", 0.8)]
    series = recorded([np.asarray(one.voltages)[0] for one in frames], noise=0)
    imaged = image_sequence(series, frame("none", 0.0, seed=2), SETTINGS)
    np.testing.assert_array_equal(imaged.moved, [False, True, False, True])
    assert [doubt for doubt in imaged.doubts if "moved" in doubt and "2 of 4 frames" not in doubt] == []
    assert any("2 of 4 frames" in doubt for doubt in imaged.doubts)
    peaks = np.abs(np.asarray(imaged.series.changes)).max(axis=1)
    assert (peaks[[1, 3]] < 0.1 * peaks[2]).all()


@pytest.mark.parametrize("solver", ["one-step", pytest.param("gauss-newton", marks=pytest.mark.slow)])
def test_a_stream_subtracts_movement_from_its_first_frame_on(solver):
    frames = [frame("none", 0.0, seed=5), frame("none", 1.0), frame("strong"), frame("none", 0.8)]
    frames.append(frame("none", 1.0, only=int(np.argmax(np.abs(SHIFT)))))  # afterwards, one electrode alone
    voltages = [np.asarray(one.voltages)[0] for one in frames]
    imager, calibration = prepare_imager(frame("none", 0.0, seed=2), StreamSettings(solver, num_points=600))
    found = []
    images = list(image_stream(imager, calibration, voltages, lambda number, change: found.append((number, change))))
    assert [number for number, _ in found] == [1, 4]
    assert "electrodes had moved" in found[0][1].doubt
    assert f"electrode {np.argmax(np.abs(SHIFT)) + 1} had moved" in found[1][1].doubt
    peaks = [np.abs(np.log(image.conductivity / calibration.conductivity)).max() for image in images]
    plain = [np.abs(np.log(image.conductivity / calibration.conductivity)).max() for image in stream(imager, voltages)]
    assert max(peaks[1], peaks[3], peaks[4]) < 0.3 * min(plain[1], plain[3], plain[4])
    assert peaks[2] > 0.9 * plain[2]
    assert [image.number for image in images] == [0, 1, 2, 3, 4]


def test_the_doubt_states_distances_in_millimetres_and_electrodes_from_1():
    shift = np.array([[1e-3, 0.0], [0.0, -2e-3], [0.0, 0.0], [2e-3, 2e-3]])
    doubt = electrode_changes.ElectrodeChange(shift, np.array([1.0, 2.0, 1.0, 0.4]), np.zeros(3), 0.12).doubt
    assert "by about 1.8 mm (root mean square; electrode 4 by about 2.8 mm), and contact" in doubt
    assert "contact impedances had changed by a factor of about 1.8 (of electrode 4, 0.4), or" in doubt
    assert "contact" not in electrode_changes.ElectrodeChange(shift, np.ones(4), np.zeros(3), 0.12).doubt
    contact = electrode_changes.ElectrodeChange(0 * shift, np.array([1.0, 2.5, 1.0, 1.0]), np.zeros(3), 0.12)
    assert "as if the contact impedance of electrode 2 had changed by a factor of about 2.5 since" in contact.doubt
    assert "the rest of the difference, 12 % of it" in doubt


def test_the_evidence_is_that_of_a_dense_covariance():
    """9 channels, of which reciprocity leaves 6 combinations; 4 changes of electrodes, and a factor common to all."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(9, 9)))[0]
    eigenvalues = np.array([5.0, 3.0, 1.0, 0.3, 0.1, 0.02, 0.0, 0.0, 0.0])
    weight, channels = rng.uniform(1.0, 2.0, 9), np.delete(np.arange(12), [2, 5, 11])
    difference, reference, patterns = rng.normal(size=12), rng.uniform(1.0, 3.0, 12), rng.normal(size=(12, 4))
    spectrum = SimpleNamespace(eigenvalues=eigenvalues, basis=basis)
    linearisation = SimpleNamespace(spectrum=spectrum, root_weight=weight, channels=channels)
    problem = electrode_changes._WhitenedProblem(linearisation, difference, patterns, reference)
    data, level, columns = ((weight * values.T[..., channels]).T for values in (difference, reference, patterns))
    size, reciprocal = np.sqrt(np.mean(data**2)), basis[:, :6] @ basis[:, :6].T
    level, columns = reciprocal @ level, reciprocal @ columns
    level *= electrode_changes._MAX_COMMON_VOLTAGE_FACTOR * size * np.sqrt(9) / np.linalg.norm(level)
    for logarithms in ([-0.5, -2.0, -2.5], [-0.5, -2.0, -2.5, -1.0], [0.2, -1.0, -3.5, 0.4]):
        conductivity, noise, error = np.exp(2 * np.array(logarithms[:3])) * size**2
        covariance = conductivity * (basis * eigenvalues) @ basis.T * 9 / eigenvalues.sum() + noise * np.eye(9)
        covariance += error * reciprocal + np.outer(level, level)
        departure = (
            logarithms[:3] - electrode_changes._INITIAL_LOG_DEVIATIONS[:3]
        ) / electrode_changes._LOG_DEVIATIONS_PRIOR_WIDTH
        prior = departure @ departure
        if len(logarithms) == 4:
            covariance += np.exp(2 * logarithms[3]) * columns @ columns.T
            prior += (2 * max(logarithms[3], 0)) ** 2
        expected = 0.5 * (data @ np.linalg.solve(covariance, data) + np.linalg.slogdet(covariance)[1] + prior)
        np.testing.assert_allclose(problem._negative_log_posterior(np.array(logarithms)), expected, rtol=1e-9)


def test_a_series_prefers_the_movement_of_many_electrodes_to_that_of_one():
    electrode = int(np.argmax(np.abs(SHIFT)))
    frames = [frame("none", 1.5, only=electrode), frame("none", 0.8)]
    series = recorded([np.asarray(one.voltages)[0] for one in frames], noise=0)
    assert image_sequence(series, frame("none", 0.0, seed=2), SETTINGS).moved[1]


def test_a_stream_searches_fewer_and_fewer_suspicious_frames(monkeypatch):
    imager, calibration = prepare_imager(frame("none", 0.0, seed=2), StreamSettings("one-step", num_points=600))
    searched = []

    def search(self, difference):
        searched.append(difference)
        time.sleep(0.02)

    monkeypatch.setattr(electrode_changes.ElectrodeChanges, "estimator", search)
    moved = np.asarray(frame("none", 1.0).voltages)[0]
    images = list(image_stream(imager, calibration, [moved] * 9, lambda number, change: None))
    assert len(images) == 9
    assert len(searched) == 4  # of the suspicious frames 1, 2, 4 and 8
    assert min(images[number].latency for number in (0, 1, 3, 7)) >= 0.02  # which contains the search


def test_a_live_picture_leaves_out_what_moved_electrodes_explain():
    """Until a new reference is measured; an event states the movement once."""
    settings = StreamSettings("one-step", num_points=600)
    view, view_as_is = (
        ConductivityView.prepare(frame("none", 0.0, seed=2), replace(settings, as_is=as_is)) for as_is in (False, True)
    )
    moved = LiveFrame(0, 0.0, 0.0, np.asarray(frame("none", 1.0).voltages)[0])
    picture, picture_as_is = view.picture(moved), view_as_is.picture(moved)
    assert np.nanmax(np.abs(picture.pixels)) < 0.3 * np.nanmax(np.abs(picture_as_is.pixels))
    (event,) = picture.events
    assert event.startswith("Measure a new reference: the voltages have changed as if electrodes had moved since")
    assert picture_as_is.events == view.picture(moved).events == ()
    np.testing.assert_array_equal(view.image(moved)[1].pixels, picture_as_is.pixels)
    view.set_reference(moved.values[None])
    assert view.picture(moved).status == "unchanged"
    moved_back = view.picture(replace(moved, values=np.asarray(frame("none", 0.0, seed=2).voltages)[0]))
    assert len(moved_back.events) == 1  # movement since the new reference is a new event
    assert view.picture(replace(moved, values="no numbers")).pixels is None


def test_a_strong_body_is_outlined_although_electrodes_have_moved():
    """The rest of the voltages, which the outline cannot explain, is explained by the movement."""
    result = image_difference(frame("strong", 1.0), frame("none", 0.0, seed=2), ImagingSettings(num_points=600))
    (body,) = result.inclusions
    assert np.linalg.norm(np.array(body.centroid) - CENTRE) < 3e-3
    assert result.shapes is not None


@pytest.mark.slow
def test_one_body_is_preferred_to_several_that_explain_as_much():
    """Without six of the electrodes, bodies that are all fitted at once explain the voltages of a narrow one, too."""
    measured, reference = (
        replace(one, mask=~np.any([PROTOCOL.channels_touching(electrode) for electrode in range(6)], axis=0)[None])
        for one in (frame("narrow"), frame("none", 0.0, seed=2))
    )
    result = image_difference(measured, reference, ImagingSettings(num_points=600))
    assert result.shapes is not None
    (body,) = result.inclusions
    assert np.linalg.norm(np.array(body.centroid) - NARROW[:2]) < NARROW[2]


def test_an_implausible_displacement_of_one_electrode_is_not_taken_for_it():
    prepared = prepare_difference(frame("none", 1.0), frame("none", 0.0, seed=2), num_points=600, as_is=True)
    changes = prepared.electrode_changes
    pattern = changes._derivatives[:, 5]
    assert np.flatnonzero(changes._single_electrode_estimator(2.5 * pattern).any(axis=1)).tolist() == [5]
    assert changes._single_electrode_estimator(3.5 * pattern) is None
