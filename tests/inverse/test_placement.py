"""Electrode positions estimated from a reference frame, against the true ones of a simulated tank on another mesh."""

from dataclasses import replace

import numpy as np
import pytest

from jeit import BoundaryElectrodes, Disk, ForwardModel, adjacent, ring
from jeit.data import Measurement
from jeit.data.frame_checks import rounding_of_difference
from jeit.electrodes import FaceDiscs, FacePatches, NodeElectrodes, SheetDiscs
from jeit.electrodes.face_patches import body_mesh
from jeit.forward.changes import PlacementSensitivity, shift_electrodes
from jeit.imaging import calibration
from jeit.imaging.preparation import prepare_difference
from jeit.inverse import relative_noise
from jeit.inverse.placement import ModelError, Uncertainty, _PlacementProblem, place_electrodes
from jeit.mesh import cylinder

RADIUS, SIGMA, WIDTH = 0.1, 0.02, 0.02
DISK, PROTOCOL = Disk(RADIUS), adjacent(16, current=1e-3)
DESCRIBED = BoundaryElectrodes(ring(RADIUS, 16), WIDTH, 0.005)


def turned(degrees):
    """The described positions, each rotated counter-clockwise by the given degrees."""
    described = np.asarray(DESCRIBED.position)
    angle = np.arctan2(described[:, 1], described[:, 0]) + np.deg2rad(degrees)
    return RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.fixture(scope="module")
def tank():
    """Rotations of the electrodes in degrees, and the voltages of the tank without a body on a finer mesh."""
    rng = np.random.default_rng(0)
    degrees, impedance = 1.5 * rng.normal(size=16), 0.005 * np.exp(0.7 * rng.normal(size=16))
    electrodes = BoundaryElectrodes(turned(degrees), WIDTH, impedance)
    voltages = np.asarray(ForwardModel(body_mesh(DISK, electrodes, 2000), electrodes, PROTOCOL).voltages(SIGMA))
    return degrees, voltages * (1 + 0.002 * rng.normal(size=len(voltages)))


def test_electrode_positions_are_estimated(tank):
    """Except for conformal maps of the disk onto itself, which hardly change a homogeneous disk's voltages: a common
    rotation, and displacements proportional to cos θ and sin θ."""
    degrees, voltages = tank
    model = ForwardModel(body_mesh(DISK, DESCRIBED, 800), DESCRIBED, PROTOCOL)
    placed = place_electrodes(model, voltages, deviation=np.deg2rad(2) * RADIUS)
    place = np.asarray(DESCRIBED.position) / RADIUS
    hidden = np.column_stack([np.ones(16), place])
    left = np.rad2deg(placed.shift[:, 0] / RADIUS) - degrees
    left, degrees = (one - hidden @ np.linalg.lstsq(hidden, one)[0] for one in (left, degrees))
    assert placed.shift.shape == placed.deviation.shape == (16, 1)
    assert np.std(left) < 0.2 * np.std(degrees)
    assert placed.conductivity == pytest.approx(SIGMA, rel=0.02)
    predicted = np.asarray(placed.model.voltages(placed.conductivity))
    before = np.asarray(model.voltages(SIGMA))
    assert np.linalg.norm(predicted - voltages) < 0.05 * np.linalg.norm(before - voltages)
    moved = np.asarray(placed.model.electrodes.position) - np.asarray(DESCRIBED.position)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.abs(placed.shift[:, 0]), rtol=1e-9)


def measured(voltages, name):
    mask = np.ones(voltages.shape, bool)
    return Measurement(voltages, mask, PROTOCOL, electrodes=DESCRIBED, domain=DISK, name=name)


def test_a_difference_is_prepared_with_the_estimated_positions(tank):
    _, voltages = tank
    prepared = prepare_difference(measured(1.01 * voltages, "frame"), measured(voltages, "reference"), num_points=800)
    assert prepared.calibration.shift.shape == (16, 1)
    assert float(prepared.calibration.misfit) < 0.01
    left = prepared.calibration.contact_deviation
    np.testing.assert_allclose(left, np.linalg.norm(prepared.calibration.model_error.factor[16:], axis=1))
    assert np.abs(np.asarray(prepared.model.electrodes.position) - np.asarray(DESCRIBED.position)).max() > 1e-3


def test_positions_that_explain_the_reference_are_kept(tank):
    model = ForwardModel(body_mesh(DISK, DESCRIBED, 4000), DESCRIBED, PROTOCOL)
    voltages = np.asarray(model.voltages(SIGMA))
    prepared = prepare_difference(measured(1.01 * voltages, "frame"), measured(voltages, "reference"), num_points=1500)
    assert prepared.calibration.shift is None
    np.testing.assert_array_equal(prepared.model.electrodes.position, DESCRIBED.position)


@pytest.mark.slow
def test_the_background_is_fitted_to_channels_far_from_the_drives(tank):
    """Voltages next to the drives are 30 % larger than in a sheet, as where current spreads over the height of a tank.
    A fit to these, the largest, would give a background that is 9 % too low."""
    _, voltages = tank
    near = np.abs(voltages) > 2.5 * np.median(np.abs(voltages))
    deep = np.where(near, 1.3, 1.0) * voltages
    prepared = prepare_difference(measured(1.01 * deep, "frame"), measured(deep, "reference"), num_points=1500)
    calibration, noise = prepared.calibration, np.asarray(relative_noise(deep))
    assert calibration.shift is not None
    assert float(calibration.conductivity) == pytest.approx(SIGMA, rel=0.02)
    off = np.asarray(calibration.voltages) - deep
    assert float(calibration.misfit) == pytest.approx(np.linalg.norm(off) / np.linalg.norm(deep))
    # The part of the misfit that noise does not explain is counted as an error of all strengths.
    size = np.linalg.norm(deep / noise)
    misfit = min(float(calibration.misfit), np.linalg.norm(off / noise) / size)
    strength = np.sqrt(misfit**2 - (prepared.noise / np.sqrt(2) * np.sqrt(len(deep)) / size) ** 2)
    assert prepared.accuracy.strength == pytest.approx(strength)


def test_positions_that_increase_the_relative_misfit_are_rejected(tank, monkeypatch):
    """Even if they explain the small voltages."""
    _, voltages = tank
    monkeypatch.setattr(calibration, "_MAX_MISFIT_RATIO", 1e-3)
    prepared = prepare_difference(measured(1.01 * voltages, "frame"), measured(voltages, "reference"), num_points=800)
    assert prepared.calibration.shift is None
    assert prepared.calibration.model_error is not None


def test_errors_of_a_difference_include_its_uncertainty_and_rounding(tank):
    """The uncertainty of the frame counts; voltages have two digits, so that each is off by up to 5 %."""
    _, voltages = tank
    known = Uncertainty(position=0.0, drift=0.4, size=0.03, other=0.1)
    one, base = (np.array([float(f"{each:.1e}") for each in times * voltages]) for times in (1.1, 1.0))
    frame, reference = replace(measured(one, "frame"), uncertainty=known), measured(base, "reference")
    prepared = prepare_difference(frame, reference, num_points=800)
    accuracy, rounding = prepared.accuracy, rounding_of_difference(frame, reference)
    assert (accuracy.size, accuracy.model_error.drift) == (known.size, known.drift)
    assert np.abs(accuracy.model_error.factor[:16]).max() < 1e-12  # positions are exact
    assert (np.asarray(accuracy.noise) > rounding).all()
    assert np.sqrt(np.mean(((one - 1.1 * voltages) / rounding) ** 2)) == pytest.approx(np.sqrt(0.5), rel=0.15)
    difference = np.linalg.norm(one - base)
    assert prepared.quality.rounding == pytest.approx(np.linalg.norm(rounding) / difference)
    shape = np.asarray(prepared.relative_noise)
    rounded = np.sqrt(np.mean((rounding / shape) ** 2))
    assert prepared.noise == pytest.approx(np.hypot(prepared.quality.trusted_noise, rounded))
    with pytest.raises(ValueError, match=r"position is 0\.3 m, and the body is 0\.2 m wide"):
        prepare_difference(replace(frame, uncertainty=Uncertainty(position=0.3)), reference, num_points=1500)


def test_setups_without_adjustable_positions_are_refused(tank):
    _, voltages = tank
    model = ForwardModel(DISK.mesh(num_points=300), DESCRIBED, PROTOCOL)
    with pytest.raises(ValueError, match="opposite sign"):
        place_electrodes(model, -voltages, deviation=1e-3)
    for wrong in (-1e-3, 1.0, np.nan, "1 mm", None):
        with pytest.raises(ValueError, match="deviation must be a number of metres"):
            place_electrodes(model, voltages, deviation=wrong)
    for bad in ({"voltages": voltages[:100]}, {"mask": np.ones(3, bool)}, {"mask": np.zeros(len(voltages), bool)}):
        with pytest.raises(ValueError, match="mask"):
            place_electrodes(model, **{"voltages": voltages, **bad}, deviation=1e-3)
    nodes = NodeElectrodes(np.arange(16))
    with pytest.raises(ValueError, match="NodeElectrodes have no position that can be estimated"):
        place_electrodes(ForwardModel(model.mesh, nodes, PROTOCOL), voltages, deviation=1e-3)


@pytest.mark.parametrize("kind", ["arcs", "arcs that share an edge", "discs", "patches", "discs on a wall"])
def test_sensitivity_to_positions_and_contacts(kind):
    """Against central differences of Z, also where electrodes share facets or cells."""
    mesh = DISK.mesh(num_points=300)
    angle = np.array([0.3, 1.9, 3.6, 5.0]) if kind != "arcs that share an edge" else np.array([0.3, 0.515, 3.6, 5.0])
    place = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    impedance = np.array([2e-3, 5e-3, 1e-3, 3e-3])
    if kind in ("patches", "discs on a wall"):
        place, mesh = np.column_stack([0.05 * place, np.full(4, 0.02)]), cylinder(0.05, 0.04, cell_size=0.012)
        at = mesh.points[mesh.facets].mean(axis=1)
        place = at[np.argmin(np.linalg.norm(np.asarray(at) - place[:, None], axis=-1), axis=1)]
        electrodes = FacePatches(place, 0.015, 0.018, 1e-2 * impedance)
        if kind != "patches":
            electrodes = FaceDiscs(place, 0.01, 1e-2 * impedance)
    elif kind == "discs":
        electrodes = SheetDiscs(0.06 * place, 0.01, 1e-2 * impedance)
    else:
        electrodes = BoundaryElectrodes(RADIUS * place, WIDTH, impedance)
    model = ForwardModel(mesh, electrodes, adjacent(4))
    sensitivity = PlacementSensitivity(mesh, electrodes)
    found = sensitivity(*map(np.asarray, model.fields(SIGMA)))
    shape = sensitivity.directions.shape[:2]
    number = shape[0] * shape[1]

    def impedance_at(one, step):
        by_shift = (step * (np.arange(number) == one)).reshape(shape)
        moved = shift_electrodes(electrodes, sensitivity.directions, by_shift)
        contact = impedance_of(moved) * np.exp(step * (np.arange(4) == one - number))
        return np.asarray(model.with_electrodes(moved.with_contact_impedance(contact)).transfer_impedance(SIGMA))

    def impedance_of(given):
        return np.asarray(given.contact_impedance)

    for one in (0, number - 1, number, number + 1):
        step = 1e-5 if one < number else 1e-4
        expected = (impedance_at(one, step) - impedance_at(one, -step)) / (2 * step)
        np.testing.assert_allclose(found[one], expected, rtol=0, atol=2e-3 * np.abs(expected).max())


def test_the_error_of_a_difference_is_that_of_its_model(tank):
    """Columns of the error against differences of voltages; the last, drifts of contacts, affect one frame only."""
    model = ForwardModel(DISK.mesh(num_points=300), DESCRIBED, PROTOCOL)
    body = SIGMA * np.where(np.asarray(model.mesh.points)[np.asarray(model.mesh.cells)].mean(axis=1)[:, 0] > 0.05, 3, 1)
    rest = np.full(len(body), SIGMA)
    found = ModelError(np.eye(32)).voltages(model, body, rest)
    assert found.shape == (PROTOCOL.num_measurements, 32 + 16)

    def difference(electrodes):
        moved = model.with_electrodes(electrodes)
        return np.asarray(moved.voltages(body)), np.asarray(moved.voltages(rest))

    impedance = np.asarray(DESCRIBED.contact_impedance)
    ends = []
    for step in (1e-4, -1e-4):
        changed = impedance * np.exp(step * (np.arange(16) == 3))
        ends.append(difference(DESCRIBED.with_contact_impedance(changed)))
    there, here = ((up - down) / 2e-4 for up, down in zip(*ends, strict=True))
    scale = np.abs(there).max()
    np.testing.assert_allclose(found[:, 16 + 3], there - here, rtol=0, atol=1e-4 * scale)
    np.testing.assert_allclose(found[:, 32 + 3], 0.1 * there, rtol=0, atol=1e-4 * scale)


def test_the_noise_is_estimated_from_the_residual():
    """Voltages of the described model, at which the fit starts, with half of the expected noise."""
    model = ForwardModel(DISK.mesh(num_points=300), DESCRIBED, PROTOCOL)
    exact = np.asarray(model.voltages(1.0))
    noise = 0.5 * np.asarray(relative_noise(exact)) * np.random.default_rng(0).normal(size=len(exact))
    problem = _PlacementProblem(model, exact + noise, np.ones(len(exact), bool), 1e-6)
    here = problem.at(np.zeros(33))
    assert here is not None
    assert problem.noise_and_covariance(here, 0.5)[0] == pytest.approx(0.5, rel=0.15)
