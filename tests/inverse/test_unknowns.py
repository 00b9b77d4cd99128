"""Joint estimation of electrode positions, contact impedances, background and scale with the conductivity."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, PointElectrodes, SheetDiscs
from jeit.forward import ForwardModel
from jeit.inverse import Gaussian, Parametrisation, TotalVariation, posterior, reconstruct
from jeit.inverse.nonlinear import (
    Background,
    ContactImpedance,
    ElectrodePosition,
    GaussNewton,
    LevenbergMarquardt,
    Scale,
)
from jeit.inverse.nonlinear.problem import independent_data
from jeit.inverse.nonlinear.reconstruct import pose_least_squares
from jeit.layout import grid, ring
from jeit.mesh import Disk, Rectangle, centroids
from jeit.protocol import adjacent

RADIUS, NUMBER = 0.05, 16
ANGLE = 2 * np.pi * np.arange(NUMBER) / NUMBER
CENTRE = np.array([0.015, 0.01])


def model_of(num_points, shift=0.0, contact=1e-3, driven=False):
    """A disk of 100 mm diameter, with a `shift` of the electrodes along its edge in metres."""
    angle = ANGLE + np.asarray(shift) / RADIUS
    position = RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    electrodes = BoundaryElectrodes(position, 0.006, contact)
    protocol = adjacent(NUMBER, driven_electrodes=driven)
    return ForwardModel(Disk(RADIUS).mesh(num_points=num_points), electrodes, protocol)


def inclusion(mesh):
    return np.linalg.norm(np.asarray(centroids(mesh)) - CENTRE, axis=1) < 0.012


def noisy(voltages, relative=1e-3):
    noise = relative * jnp.abs(voltages)
    return voltages + noise * jax.random.normal(jax.random.key(0), voltages.shape), noise


@pytest.fixture(scope="module")
def model():
    return model_of(900)


@pytest.mark.slow
def test_estimated_positions_improve_an_image(model):
    """Every electrode is displaced by 2 mm. A disk's voltages do not determine three motions: its conformal maps onto
    itself.

    (1, cos and sin of the angle; Boyle, Adler and Lionheart, IEEE Trans. Med. Imaging 31 (2012) 2185-2193.)
    """
    shift = 2e-3 * np.sign(np.cos(2 * ANGLE + 0.2))
    truth = model_of(4000, shift)
    voltages, noise = noisy(truth.voltages(jnp.where(inclusion(truth.mesh), 3.0, 1.0)))
    options = {"prior": TotalVariation(), "noise": noise, "hyperparameter": 100.0}
    wrong = reconstruct(model, voltages, 1.0, **options)
    moving = Parametrisation(unknowns=[ElectrodePosition(model, 2e-3)])
    right = reconstruct(model, voltages, 1.0, parametrisation=moving, **options)
    assert right.status == "converged"
    error = np.asarray(right.unknowns["ElectrodePosition"]) - shift
    motions = np.stack([np.ones(NUMBER), np.cos(ANGLE), np.sin(ANGLE)], axis=1)
    left = error - motions @ np.linalg.lstsq(motions, error)[0]
    assert np.abs(left).max() < 0.3e-3
    place = inclusion(model.mesh)
    alike = [np.corrcoef(place, np.log(one.conductivity))[0, 1] for one in (wrong, right)]
    assert alike[0] < 0.8
    assert alike[1] > 0.92
    moved = np.asarray(right.model.electrodes.position - model.electrodes.position)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.abs(right.unknowns["ElectrodePosition"]), rtol=1e-9)


def test_the_default_solver_damps_its_steps_if_there_are_unknowns(monkeypatch):
    """Gauss-Newton steps lead too far where electrodes move."""
    model = model_of(80)
    chosen = []

    def minimise(solver, inversion, start, box):
        chosen.append(solver)
        raise InterruptedError

    for kind in (GaussNewton, LevenbergMarquardt):
        monkeypatch.setattr(kind, "minimise", minimise)
    for unknowns in ([], [ElectrodePosition(model, 1e-3)], [Scale()]):
        parametrisation = Parametrisation(unknowns=unknowns)
        with pytest.raises(InterruptedError):
            reconstruct(model, np.ones(208), 1.0, noise=1e-3, hyperparameter=1.0, parametrisation=parametrisation)
    assert chosen == [GaussNewton(), LevenbergMarquardt(max_steps=100), LevenbergMarquardt(max_steps=100)]


@pytest.mark.slow
def test_contact_impedances(model):
    factor = np.exp(0.4 * np.cos(3 * ANGLE))
    truth = model_of(2500, contact=1e-3 * factor, driven=True)
    voltages, noise = noisy(truth.voltages(jnp.where(inclusion(truth.mesh), 0.5, 1.0)))
    model = model_of(900, driven=True)
    result = reconstruct(
        model, voltages, 1.0, prior=Gaussian(0.015), noise=4 * noise, hyperparameter=3.0,
        parametrisation=Parametrisation(unknowns=[ContactImpedance(model)]),
    )  # fmt: skip
    assert result.status == "converged"
    found = np.asarray(result.unknowns["ContactImpedance"]) / 1e-3
    np.testing.assert_allclose(result.model.electrodes.contact_impedance, 1e-3 * found, rtol=1e-12)
    assert np.corrcoef(found, factor)[0, 1] > 0.98
    # A common factor is the error of a coarse mesh at the electrodes' ends.
    ratio = found / factor
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.12
    deviation = posterior(result).unknowns()["ContactImpedance"]
    assert (np.asarray(deviation) < 0.2 * 1e-3 * found).all()


@pytest.mark.slow
def test_background_and_scale():
    """Each by itself: only the contact impedance distinguishes a scale from a background, which the image partly
    explains."""
    known = model_of(900, driven=True)
    voltages, noise = noisy(known.voltages(1.3), 1e-4)
    options = {"prior": Gaussian(0.02), "noise": noise, "hyperparameter": 10.0}
    also = [Parametrisation(unknowns=[one]) for one in (Background(1.0), Scale(1.0))]
    background = reconstruct(known, voltages, 1.0, parametrisation=also[0], **options)
    assert float(background.unknowns["Background"][0]) == pytest.approx(np.log(1.3), abs=0.02)
    np.testing.assert_allclose(background.conductivity, 1.3, rtol=5e-3)
    doubled = reconstruct(known, 2 * voltages, 1.3, parametrisation=also[1], **options)
    assert float(doubled.unknowns["Scale"][0]) == pytest.approx(2, rel=0.02)
    np.testing.assert_allclose(doubled.conductivity, 1.3, rtol=5e-3)
    np.testing.assert_allclose(doubled.model.protocol.drive, 2 * known.protocol.drive, rtol=0.02)


@pytest.mark.slow
def test_derivative_with_all_unknowns():
    """Products with the Jacobian against automatic differentiation, and second-order Taylor remainders."""
    model = model_of(150, driven=True)
    voltages, noise = noisy(model.voltages(1.1))
    unknowns = [ContactImpedance(model), ElectrodePosition(model, 1e-4), Background(), Scale()]
    small, data = independent_data(model, voltages, np.ones(len(voltages), bool), noise, at_once=False)
    background, unknown = np.ones(model.mesh.num_cells), Parametrisation(unknowns=unknowns)
    # Solvers are compiled for seconds.
    inversion, _ = pose_least_squares(small, data, background, Gaussian(0.02), 1.0, unknown)
    point = 0.01 * jax.random.normal(jax.random.key(1), (inversion.num_coefficients,))
    direction = jax.random.normal(jax.random.key(2), point.shape)
    residual, jacobian = eqx.filter_jit(inversion.linearise)(point)
    residual_at = eqx.filter_jit(inversion.residual)
    _, tangent = jax.jvp(residual_at, (point,), (direction,))
    np.testing.assert_allclose(jacobian @ direction, tangent, rtol=1e-8, atol=1e-8 * np.abs(tangent).max())
    steps = 1e-2 * 0.5 ** np.arange(4)
    errors = [np.linalg.norm(residual_at(point + h * direction) - residual - h * tangent) for h in steps]
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2, abs=0.1)


@pytest.mark.slow
def test_logarithmic_unknowns_are_reported_in_their_own_units():
    """Contact impedances in ohm·m and a factor; deviations in the same units: those of the logarithms times the
    values."""
    number = 5  # and few nodes: unknowns are compiled for seconds

    def tiny(contact):
        electrodes = BoundaryElectrodes(ring(RADIUS, number), 0.006, contact)
        return ForwardModel(Disk(RADIUS).mesh(num_points=25), electrodes, adjacent(number, driven_electrodes=True))

    model, voltages = tiny(2e-3), np.asarray(tiny(3e-3).voltages(1.0))
    noise = 1e-3 * np.abs(voltages)
    result = reconstruct(
        model, voltages, 1.0, prior=Gaussian(0.02), noise=noise, hyperparameter=10.0,
        parametrisation=Parametrisation(unknowns=[ContactImpedance(model, 0.4), Scale(0.05)]),
    )  # fmt: skip
    impedance, factor = (np.asarray(result.unknowns[name]) for name in ("ContactImpedance", "Scale"))
    np.testing.assert_allclose(impedance, 3e-3, rtol=0.1)
    np.testing.assert_allclose(impedance, result.model.electrodes.contact_impedance, rtol=1e-12)
    np.testing.assert_allclose(result.model.protocol.drive, factor * model.protocol.drive, rtol=1e-12)
    found = posterior(result)
    share = np.sqrt(1 - ((found.root @ found.jacobian) ** 2).sum(axis=0))[result.inversion.basis.num_coefficients :]
    np.testing.assert_allclose(found.unknowns()["ContactImpedance"], 0.4 * share[:number] * impedance, rtol=1e-9)
    np.testing.assert_allclose(found.unknowns()["Scale"], 0.05 * share[number:] * factor, rtol=1e-9)


def test_discs_in_a_sheet_move_in_both_directions():
    electrodes = SheetDiscs(grid(0.08, 0.08, 3, 3), 0.004, 1e-3)
    sheet = ForwardModel(Rectangle(0.12, 0.12).mesh(num_points=700), electrodes, adjacent(9))
    unknown = ElectrodePosition(sheet, 1e-3)
    assert unknown.size == 18
    moved, _ = unknown.apply(sheet, jnp.zeros(1), jnp.arange(18.0) * 1e-5)
    change = np.asarray(moved.electrodes.position - electrodes.position)
    np.testing.assert_allclose(change[:, 0], np.arange(9) * 1e-5, atol=1e-15)
    np.testing.assert_allclose(change[:, 1], np.arange(9, 18) * 1e-5, atol=1e-15)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda model: ElectrodePosition(model, 0.0), "positive"),
        (lambda model: ElectrodePosition(model, np.ones(3)), "16"),
        (lambda model: Background(-1.0), "positive"),
        (lambda model: Scale(np.nan), "positive"),
        (lambda model: ContactImpedance(point_model(model)), "point electrodes"),
        (lambda model: ElectrodePosition(point_model(model), 1e-3), "BoundaryElectrodes"),
    ],
)
def test_bad_input(make, message, model):
    with pytest.raises(ValueError, match=message):
        make(model)


def point_model(model):
    return ForwardModel(model.mesh, PointElectrodes(ring(RADIUS, NUMBER)), model.protocol)
