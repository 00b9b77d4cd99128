"""GREIT: the matrix against its definition, its noise figure, and its images of small targets compared with NOSER."""

import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, PointElectrodes
from jeit.forward import ForwardModel
from jeit.image import Raster, figures_of_merit
from jeit.inverse import greit, one_step
from jeit.inverse.linear.greit import _desired_images, _place_targets
from jeit.layout import perimeter, ring
from jeit.mesh import Rectangle, Refine, box, centroids, disk, measures
from jeit.protocol import adjacent, two_terminal

RADIUS = 0.1
PROTOCOL = adjacent(16, current=1e-3)
RECTANGLE = Rectangle(0.3, 0.2)


def on_a_disk(num_points, num_electrodes=16, width=0.012):
    electrodes = BoundaryElectrodes(ring(RADIUS, num_electrodes), width, 1e-3)
    mesh = disk(RADIUS, num_points=num_points, refine=Refine(electrodes.position, factor=2.0))
    return ForwardModel(mesh, electrodes, adjacent(num_electrodes, current=1e-3))


def on_a_rectangle(num_points):
    electrodes = BoundaryElectrodes(perimeter(RECTANGLE, 16, start=0.03), 0.02, 1e-3)
    return ForwardModel(RECTANGLE.mesh(num_points=num_points), electrodes, PROTOCOL)


@pytest.fixture(scope="module")
def model():
    return on_a_disk(600)


@pytest.fixture(scope="module")
def reconstruction(model):
    return greit(model, 1.0)


def judge(truth, position, methods):
    """Figures of merit of each method for targets of 8 mm radius, simulated on another mesh as small changes."""
    inside = np.linalg.norm(np.asarray(centroids(truth.mesh)) - position[:, None], axis=-1) < 0.008
    difference = inside @ np.asarray(truth.jacobian(1.0)).T
    area = inside @ np.asarray(measures(truth.mesh))
    found = []
    for method in methods:
        raster = Raster.create(method.mesh, shape=(96, 96))
        found.append(figures_of_merit(raster.sample(method.image(difference)), raster.extent, position, area=area))
    return found


@pytest.fixture(scope="module")
def figures(model, reconstruction):
    """Figures of merit of GREIT and NOSER at the same noise figure, up to 0.8 radii, between an electrode and a gap."""
    angle = np.pi / 32
    position = np.linspace(0, 0.8 * RADIUS, 17)[:, None] * [np.cos(angle), np.sin(angle)]
    noser = one_step(model, 1.0, hyperparameter=2.75e-3)
    assert noise_figure_by_draws(model, noser) == pytest.approx(0.5, rel=0.05)
    return judge(on_a_disk(1500), position, [reconstruction, noser])


def central_response(model):
    """Response to a target of 0.05 radii in the middle, per siemens, from the Jacobian."""
    covered = np.linalg.norm(np.asarray(centroids(model.mesh)), axis=1) < 0.1 * RADIUS
    return np.asarray(model.jacobian(1.0)) @ covered


def noise_figure_by_draws(model, reconstruction, noise=None):
    """The noise figure by its definition with simulated noise: mean signal over standard deviation, of data over
    image."""
    noise = np.ones(208) if noise is None else np.asarray(noise)
    response, matrix = central_response(model), np.asarray(reconstruction.matrix)
    drawn = np.random.default_rng(1).normal(size=(len(response), 2000))
    weight = np.asarray(measures(model.mesh) / measures(model.mesh).sum())
    image, image_noise = matrix @ response, matrix @ (noise * drawn.T).T
    of_image = (weight @ np.abs(image)) / np.sqrt(weight @ image_noise.var(axis=1))
    return np.mean(np.abs(response / noise)) / drawn.std() / of_image


def test_matrix_fits_desired_images_to_responses(model):
    """R (YYᵀ + λ²W⁻¹) = XYᵀ with unequal noise and a mask, by an explicit sum over targets."""
    mask = np.ones(208, bool)
    mask[[3, 50]] = False
    noise = np.random.default_rng(0).uniform(0.5, 2, 208)
    found = np.asarray(
        greit(model, 1.0, noise=jnp.asarray(noise), mask=jnp.asarray(mask), hyperparameter=1e-6, num_targets=200).matrix
    )
    position, covered = _place_targets(model.mesh, np.zeros(2), 0.05 * body_radius(model.mesh), 200)
    area = covered.T @ np.asarray(measures(model.mesh))
    desired = _desired_images(model.mesh, position, area, 0.25 * body_radius(model.mesh)).toarray()
    jacobian = np.asarray(model.jacobian(1.0))[mask]
    system, right = 1e-6**2 * np.diag(noise[mask] ** 2), 0
    for k in range(len(position)):
        response = jacobian @ covered[:, [k]].toarray()[:, 0]
        system = system + np.outer(response, response) / len(position)
        right = right + np.outer(desired[:, k], response) / len(position)
    assert np.linalg.norm(found[:, mask] @ system - right) < 1e-9 * np.linalg.norm(right)
    assert np.abs(found[:, ~mask]).max() == 0


def body_radius(mesh):
    return np.sqrt(float(measures(mesh).sum()) / np.pi)


def test_targets_are_distributed_evenly_within_the_outline():
    mesh = on_a_rectangle(400).mesh
    position, covered = _place_targets(mesh, np.zeros(2), 0.007, 500)
    # A strip half a spacing wide at the edge has no centres of targets inside.
    assert 420 < len(position) < 520
    assert (np.abs(position) < np.array([0.15, 0.1]) - 0.005).all()
    distance = np.linalg.norm(position[:, None] - position, axis=-1) + np.eye(len(position))
    np.testing.assert_allclose(distance.min(axis=1), np.sqrt(2 / np.sqrt(3) * 0.06 / 500), rtol=1e-9)
    measure, centre = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    area = covered.T @ measure
    np.testing.assert_allclose(area.mean(), np.pi * 0.007**2, rtol=0.01)
    # A cell counts by its centre, whichever part of it is covered.
    gravity = (covered.T @ (measure[:, None] * centre)) / area[:, None]
    assert np.linalg.norm(gravity - position, axis=1).max() < np.sqrt(measure.max())
    np.testing.assert_allclose(np.linalg.norm((gravity - position).mean(axis=0)), 0, atol=1e-3)


def test_desired_images_are_discs_with_the_target_change():
    mesh = disk(RADIUS, num_points=3000)
    measure, centre = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    position, area = np.array([[0.0, 0.0], [0.03, -0.02], [0.095, 0.0]]), np.array([1e-4, 2e-4, 1e-4])
    desired = _desired_images(mesh, position, area, 0.03).toarray()
    np.testing.assert_allclose(desired.T @ measure, area, rtol=1e-12)
    for k in range(2):
        distance = np.linalg.norm(centre - position[k], axis=1)
        # A smooth edge, symmetric about the radius, enlarges the disc a little: 2 ∫ r h(r) dr.
        height = area[k] / (np.pi * 0.03**2)
        assert desired[distance < 0.02, k].min() == desired[:, k].max() == pytest.approx(height, rel=0.03)
        assert desired[distance > 0.0376, k].max() == 0
        np.testing.assert_allclose(desired[np.abs(distance - 0.03) < 5e-4, k].mean(), height / 2, rtol=0.1)


def test_requested_noise_figure_is_reached(model, reconstruction):
    assert reconstruction.rule == "noise-figure"
    # The noise figure was set with another target; a smaller one in the middle has a response of the same shape.
    assert noise_figure_by_draws(model, reconstruction) == pytest.approx(0.5, rel=0.03)
    noise = jnp.asarray(np.random.default_rng(2).uniform(0.5, 2, 208))
    other = greit(model, 1.0, noise_figure=0.8, noise=noise)
    assert noise_figure_by_draws(model, other, noise) == pytest.approx(0.8, rel=0.03)


def test_hyperparameter_is_relative_to_the_noise(model, reconstruction):
    given = greit(model, 1.0, hyperparameter=float(reconstruction.hyperparameter) / 7, noise=7.0)
    assert given.rule == "given"
    largest = np.abs(np.asarray(reconstruction.matrix)).max()
    np.testing.assert_allclose(given.matrix, reconstruction.matrix, atol=1e-9 * largest)


def test_compatible_with_other_linear_reconstructions(model, reconstruction):
    assert reconstruction.weights.shape == (104, model.mesh.num_cells)  # reciprocity halves 208 channels
    change = jnp.stack([central_response(model), -central_response(model)])
    image = np.asarray(reconstruction.image(change))
    assert image.shape == (2, model.mesh.num_cells)
    nearest = np.linalg.norm(np.asarray(centroids(model.mesh)), axis=1)
    assert nearest[image[0].argmax()] < 0.015
    np.testing.assert_allclose(image[1], -image[0], atol=1e-12 * image.max())


def test_amplitude_is_more_uniform_than_with_noser(figures):
    """At equal noise figures, from the middle to 0.8 radii."""
    spread = [float(np.std(merit.amplitude_response) / np.mean(merit.amplitude_response)) for merit in figures]
    assert spread[0] < 0.05
    assert spread[0] < 0.65 * spread[1]
    assert figures[0].amplitude_response.min() > 0.92
    assert figures[0].amplitude_response.max() < 1.14


def test_ringing_and_displacement_are_small(figures):
    found, noser = figures
    assert found.ringing.max() < 0.17
    assert found.ringing.max() < 0.5 * noser.ringing.max()
    assert np.abs(found.position_error).max() < 0.042 * RADIUS
    assert np.abs(found.position_error).mean() < 0.6 * np.abs(noser.position_error).mean()
    assert found.shape_deformation.max() < 0.1
    # The price is an image that is slightly larger than NOSER's.
    assert found.resolution.max() < 0.44
    assert found.resolution.min() > 0.25


@pytest.mark.slow
def test_a_rectangle():
    position = np.array([[0.0, 0.0], [0.06, 0.0], [0.1, 0.02], [0.0, 0.06], [-0.08, -0.05], [-0.11, 0.06]])
    (found,) = judge(on_a_rectangle(1200), position, [greit(on_a_rectangle(600), 1.0)])
    assert found.amplitude_response.min() > 0.87
    assert found.amplitude_response.max() < 1.18
    assert np.abs(found.position_error).max() < 0.005
    assert found.ringing.max() < 0.2
    assert found.resolution.max() < 0.41


def test_default_radius_suits_other_numbers_of_electrodes():
    few = on_a_disk(300, num_electrodes=8, width=0.02)
    assert greit(few, 1.0).rule == "noise-figure"
    with pytest.raises(ValueError, match="no hyperparameter gives"):
        greit(few, 1.0, radius=0.2)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"radius": 0.0}, "fractions of the body's radius"),
        ({"radius": 1.5}, "fractions of the body's radius"),
        ({"target_radius": 0.3}, "targets no larger than their images"),
        ({"num_targets": 0}, "num_targets"),
        ({"num_targets": 10.5}, "num_targets"),
        ({"hyperparameter": -1.0}, "hyperparameter must be positive"),
        ({"hyperparameter": "gcv"}, "takes a number or 'noise-figure'"),
        ({"noise_figure": np.nan}, "noise_figure must be positive"),
        ({"noise": 0.0}, "noise must be positive"),
        ({"noise": np.ones(7)}, "noise: give one real number"),
        ({"mask": np.ones(7, bool)}, "mask must be"),
        ({"mask": np.zeros(208, bool)}, "mask must be"),
        ({"conductivity": 1 + 1j}, "complex"),
        ({"conductivity": "nodes"}, "one value per cell"),
        ({"target_radius": 1e-4}, "fractions of the body's radius"),
        ({"radius": 0.015, "target_radius": 0.01, "num_targets": 50}, "1.5 mm radius is lost between the cells"),
    ],
)
def test_bad_input(model, changed, message):
    arguments = {"conductivity": 1.0, **changed}
    if isinstance(arguments["conductivity"], str):
        arguments["conductivity"] = np.ones(model.mesh.num_points)
    with pytest.raises(ValueError, match=message):
        greit(model, **arguments)


def test_thin_bodies_are_refused():
    strip = Rectangle(1.0, 0.01)
    ends = PointElectrodes(perimeter(strip, 4, start=0.01))
    thin = ForwardModel(strip.mesh(num_points=300), ends, adjacent(4))
    # A fifth of the radius of a disc with the area of the strip.
    with pytest.raises(ValueError, match=r"no disc of 11\.3 mm radius fits into this body"):
        greit(thin, 1.0, target_radius=0.2)


def test_a_ball_in_a_solid_is_imaged_at_its_position():
    """Within a seventh of the box's side, measured with fourteen points."""
    sides = np.concatenate([np.eye(3), -np.eye(3)]) * 0.05
    middle = np.array([0, 0, 0.05])
    corners = np.stack(np.meshgrid(*3 * [[-0.05, 0.05]], indexing="ij"), axis=-1).reshape(-1, 3)
    electrodes = PointElectrodes(np.concatenate([sides, corners]) + middle)
    body = ForwardModel(box(0.1, 0.1, 0.1, num_points=1500), electrodes, two_terminal(14))
    centre, volume = np.asarray(centroids(body.mesh)), np.asarray(measures(body.mesh))
    target = np.array([0.015, -0.01, 0.06])
    ball = np.linalg.norm(centre - target, axis=1) < 0.018
    found = greit(body, 1.0, radius=0.5, target_radius=0.2, hyperparameter=1.0, noise=1e-3)
    image = np.asarray(found.image(np.asarray(body.jacobian(1.0)) @ ball))
    assert np.linalg.norm((volume * image) @ centre / (volume @ image) - target) < 0.015
