"""Complex admittivity σ + iωε: calibration and images from voltages of an independent solver (quadratic elements on
another, finer mesh, with SciPy), and images from two frequencies."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import splu

import jeit.data
from jeit.data import Measurement, read
from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.imaging import ImagingSettings, image_difference, image_frequencies
from jeit.inverse import Gaussian, Laplace, Noser, Tikhonov, calibrate, compare_rules, one_step
from jeit.layout import ring
from jeit.mesh import Disk, centroids, measures
from jeit.protocol import adjacent
from jeit.report import write_image

RADIUS = 0.1
PROTOCOL = adjacent(16, current=1e-3)
DOMAIN, ELECTRODES = Disk(RADIUS), PointElectrodes(ring(RADIUS, 16))
BACKGROUND = 1e-3 + 0.3e-3j
# Position, radius, and relative change of each part of the bodies: one more conductive, one less, one more permittive.
DISCS = ((0.05, 0.0, 0.02, 0.5e-3 + 0j), (-0.03, 0.04, 0.02, 0.3e-3j), (-0.02, -0.05, 0.02, -0.4e-3 - 0.15e-3j))


def body(mesh, discs=DISCS, background=BACKGROUND):
    """Admittivity of every cell."""
    values = np.full(mesh.num_cells, background, complex)
    for x, y, radius, change in discs:
        values[np.hypot(*(np.asarray(centroids(mesh)) - [x, y]).T) < radius] += change
    return values


def _nearest(points):
    """The vertex nearest to each electrode."""
    return np.argmin(np.linalg.norm(points[:, None] - np.asarray(ELECTRODES.position), axis=2), axis=0)


def quadratic_voltages(mesh, admittivity) -> Any:
    """Voltages (M,) in volts by P2 triangles with edge-midpoint quadrature, between mesh vertices as electrodes."""
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    pairs = cells[:, [[0, 1], [1, 2], [2, 0]]]
    edges, number = np.unique(np.sort(pairs, axis=2).reshape(-1, 2), axis=0, return_inverse=True)
    dofs = np.concatenate([cells, len(points) + number.reshape(-1, 3)], axis=1)
    jacobian = np.stack([points[cells[:, k]] - points[cells[:, 0]] for k in (1, 2)], axis=2)
    area = np.linalg.det(jacobian) / 2
    linear = np.linalg.solve(np.swapaxes(jacobian, 1, 2)[:, None], np.array([[-1, -1], [1, 0], [0, 1.0]])[..., None])
    linear = linear[..., 0]  # (m, 3, 2), gradients of the barycentric coordinates
    local = np.zeros((len(cells), 6, 6))
    for one, other in ((0, 1), (1, 2), (2, 0)):
        at = np.zeros(3)
        at[[one, other]] = 0.5
        gradient = [(4 * at[k] - 1) * linear[:, k] for k in range(3)]
        gradient += [4 * (at[i] * linear[:, j] + at[j] * linear[:, i]) for i, j in ((0, 1), (1, 2), (2, 0))]
        stacked = np.stack(gradient, axis=1)
        local += area[:, None, None] / 3 * np.einsum("mik,mjk->mij", stacked, stacked)
    size = len(points) + len(edges)
    place = np.repeat(dofs, 6, axis=1).ravel(), np.tile(dofs, 6).ravel()
    matrix = scipy.sparse.csc_array(((admittivity[:, None, None] * local).ravel(), place), shape=(size, size))
    nodes = _nearest(points)
    grounded = matrix[1:, 1:]
    load = np.zeros((size, 16), complex)
    load[nodes, np.arange(16)] = 1
    potential = np.concatenate([np.zeros((1, 16)), splu(scipy.sparse.csc_array(grounded)).solve(load[1:])])
    drive, measurement = np.asarray(PROTOCOL.channel_drive), np.asarray(PROTOCOL.channel_measurement)
    return np.einsum("ml,ln,mn->m", measurement, potential[nodes], drive)


@pytest.fixture(scope="module")
def fine():
    """A mesh with a vertex at every electrode."""
    mesh = DOMAIN.mesh(num_points=3000)
    points = np.array(mesh.points)
    points[_nearest(points)] = ELECTRODES.position
    return eqx.tree_at(lambda m: m.points, mesh, jnp.asarray(points))


@pytest.fixture(scope="module")
def frames(fine) -> Any:
    """Voltages of the empty body and of the body with discs, with 0.1 % noise in each part."""
    random, found = np.random.default_rng(3), []
    for admittivity in (body(fine, ()), body(fine)):
        voltages = quadratic_voltages(fine, admittivity)
        noise = random.normal(size=(2, voltages.size)) * 1e-3 * abs(voltages)
        found.append(voltages + noise[0] + 1j * noise[1])
    return found


def measured(voltages, name="frame"):
    """A measurement as if read from a file."""
    values = jnp.asarray(voltages)[None]
    return Measurement(values, np.ones(values.shape, bool), PROTOCOL, name=name, domain=DOMAIN, electrodes=ELECTRODES)


def test_quadratic_elements_agree_with_the_model(fine):
    model = ForwardModel(fine, ELECTRODES, PROTOCOL)
    expected = np.asarray(model.voltages(body(fine)))
    np.testing.assert_allclose(quadratic_voltages(fine, body(fine)), expected, atol=0.02 * abs(expected).max())


def test_background_of_both_parts(frames):
    model = ForwardModel(DOMAIN.mesh(num_points=900), ELECTRODES, PROTOCOL)
    found = calibrate(model, frames[0])
    assert found.status == "converged"
    assert abs(complex(found.conductivity) / BACKGROUND - 1) < 0.05


@pytest.mark.parametrize("prior", [Noser(), Laplace(), Tikhonov(), Gaussian(0.02)], ids=lambda p: type(p).__name__)
def test_image_minimises_the_objective_over_both_parts(prior):
    """Against the real problem of twice the size, with stacked real and imaginary parts."""
    model = ForwardModel(DOMAIN.mesh(num_points=150), ELECTRODES, PROTOCOL)
    voltages = np.asarray(model.voltages(BACKGROUND))
    noise: Any = 0.01 * abs(voltages)
    random = np.random.default_rng(0).normal(size=(2, voltages.size))
    difference: Any = noise * (random[0] + 1j * random[1])
    linear = one_step(model, BACKGROUND, prior=prior, noise=noise)
    weight = float(linear.hyperparameter)
    jacobian = np.asarray(model.jacobian(BACKGROUND)) / noise[:, None]
    both = np.block([[jacobian.real, -jacobian.imag], [jacobian.imag, jacobian.real]])
    data = np.concatenate([difference.real, difference.imag]) / np.tile(noise, 2)
    if isinstance(prior, Gaussian):
        covariance: Any = prior.covariance_product(model.mesh, jnp.eye(model.mesh.num_cells))
        spread = np.kron(np.eye(2), covariance) @ both.T
        expected = spread @ np.linalg.solve(both @ spread + weight**2 * np.eye(len(both)), data)
    else:
        precision = np.kron(np.eye(2), prior.precision(model.mesh, jacobian).toarray())
        expected = np.linalg.solve(both.T @ both + weight**2 * precision, both.T @ data)
    expected = expected[: len(expected) // 2] + 1j * expected[len(expected) // 2 :]
    image = np.asarray(linear.image(difference))
    np.testing.assert_allclose(image, expected, rtol=0, atol=1e-9 * abs(expected).max())
    np.testing.assert_allclose(np.asarray(linear.matrix) @ difference, image, rtol=0, atol=1e-9 * abs(expected).max())


def test_rules_take_complex_data(frames):
    model = ForwardModel(DOMAIN.mesh(num_points=300), ELECTRODES, PROTOCOL)
    noise: Any = 1e-3 * abs(frames[0])
    found = compare_rules(model, BACKGROUND, difference=frames[1] - frames[0], noise=noise, prior=Gaussian(0.02))
    assert all(np.isfinite(choice.hyperparameter) for choice in found.values())
    # 0.1 % in each part of two frames gives √2 times 0.1 %, plus model errors
    assert found["discrepancy"].criterion[0] < 5


def amounts(mesh, image, part):
    """Integral of a part of the image round every disc, relative to the true one."""
    centre, area = np.asarray(centroids(mesh)), np.asarray(measures(mesh))
    found = []
    for x, y, radius, _ in DISCS:
        near = np.hypot(*(centre - [x, y]).T) < 1.6 * radius
        found.append(area[near] @ part(np.asarray(image)[near]) / (np.pi * radius**2))
    return np.array(found)


def test_both_parts_of_an_image(frames, tmp_path):
    """Positions, signs and sizes: a change of one part does not appear in the other."""
    found = image_difference(
        measured(frames[1]), measured(frames[0]), ImagingSettings(num_points=700, raster_shape=(128, 128))
    )
    assert found.is_complex
    truth = np.array([disc[3] for disc in DISCS])
    for part, largest in ((np.real, 0.5e-3), (np.imag, 0.3e-3)):
        seen = amounts(found.mesh, found.change, part)
        assert abs(seen - part(truth)).max() < 0.35 * largest
        changed = abs(part(truth)) > 0
        np.testing.assert_array_equal(np.sign(seen[changed]), np.sign(part(truth)[changed]))
    centre = np.asarray(centroids(found.mesh))
    highest = centre[np.argmax(np.imag(found.change))]
    assert np.linalg.norm(highest - DISCS[1][:2]) < 0.1 * RADIUS
    assert np.linalg.norm(centre[np.argmax(np.real(found.change))] - DISCS[0][:2]) < 0.1 * RADIUS
    assert np.linalg.norm(centre[np.argmin(np.real(found.change))] - DISCS[2][:2]) < 0.1 * RADIUS
    write_image(found, tmp_path)
    assert (tmp_path / "image.png").stat().st_size > 10_000
    assert np.iscomplexobj(np.load(tmp_path / "image.npz")["raster"])


@pytest.mark.slow
def test_two_frequencies_of_one_body(fine):
    """One disc conducts at the second frequency only. The whole body changes by a fifth, and another disc has equal
    contrast at both frequencies, so that neither appears."""
    alike = (-0.04, 0.03, 0.02)
    first = body(fine, [(*alike, -0.5e-3), (0.05, 0.0, 0.02, 0.0)], 1e-3)
    second = body(fine, [(*alike, -0.6e-3), (0.05, 0.0, 0.02, 0.5e-3 + 0.2e-3j)], 1.2e-3)
    random = np.random.default_rng(7)
    voltages = [quadratic_voltages(fine, one) for one in (first, second)]
    voltages = [one * (1 + 5e-4 * random.normal(size=one.size)) for one in voltages]
    found = image_frequencies(measured(voltages[1], "2"), measured(voltages[0], "1"), ImagingSettings(num_points=900))
    assert abs(found.weight - 1 / 1.2) < 0.05
    change: Any = np.asarray(found.image.change)
    centre = np.asarray(centroids(found.image.mesh))
    assert np.linalg.norm(centre[np.argmax(change.real)] - [0.05, 0]) < 0.1 * RADIUS
    assert np.linalg.norm(centre[np.argmax(change.imag)] - [0.05, 0]) < 0.1 * RADIUS
    near = np.hypot(*(centre - alike[:2]).T) < alike[2]
    assert abs(change[near].real.mean()) < 0.25 * change.real.max()
    plain = image_frequencies(
        measured(voltages[1], "2"), measured(voltages[0], "1"), ImagingSettings(num_points=900), weighted=False
    )
    assert plain.weight == 1
    assert np.median(np.real(plain.image.change)) > 2 * abs(np.median(change.real))


def test_frequencies_that_do_not_match(frames):
    with pytest.raises(ValueError, match="nothing in common"):
        image_frequencies(measured(-frames[1]), measured(frames[0]))


def test_iterative_methods_refuse_complex_voltages(frames):
    with pytest.raises(ValueError, match="one-step"):
        image_difference(measured(frames[1]), measured(frames[0]), ImagingSettings(method="gauss-newton"))


@pytest.mark.slow
def test_a_measured_tank_shows_no_contrast_of_permittivity(data_folder, tmp_path):
    """The imaginary part of the small tank is a phase of the instrument, common to all voltages. Relative to the
    background, the change is real within a fifth, and rods are at the positions of the real part alone."""
    description = Path(jeit.data.__file__).with_name("tank6cm.toml").read_text("utf-8")
    (tmp_path / "complex.toml").write_text(description.replace('component = "real"', 'component = "complex"'), "utf-8")
    (file,) = (data_folder / "tank6cm" / "electrode01_metal").glob("*.csv")
    found = image_difference(read(file, description=tmp_path / "complex.toml"))
    relative = np.asarray(found.change) / complex(found.calibration.conductivity)
    assert np.sqrt(np.mean(relative.imag**2) / np.mean(relative.real**2)) < 0.2
    assert np.linalg.norm(np.asarray(found.inclusions[0].centroid) - [0, 0.018]) < 0.003
    phase = np.degrees(np.angle(complex(found.calibration.conductivity)))
    assert 24 < phase < 30
