"""Total variation: its quadratic model, and the edge of a block that smooth priors blur."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import (
    Gaussian,
    Laplace,
    Noser,
    Parametrisation,
    Tikhonov,
    TotalVariation,
    one_step,
    reconstruct,
)
from jeit.inverse.channels import IndependentChannels
from jeit.inverse.nonlinear import GaussNewton, LevenbergMarquardt
from jeit.layout import perimeter
from jeit.mesh import Rectangle, box, centroids, measures, rectangle
from jeit.mesh.mesh import interior_facets
from jeit.protocol import adjacent

OUTLINE = Rectangle(0.2, 0.16)
BLOCK = np.array([0.05, 0.04])  # half its size, centred


def model_of(num_points):
    electrodes = BoundaryElectrodes(perimeter(OUTLINE, 16), 0.015, 1e-3)
    return ForwardModel(OUTLINE.mesh(num_points=num_points), electrodes, adjacent(16))


@pytest.fixture(scope="module")
def model():
    return model_of(700)


@pytest.fixture(scope="module")
def frame():
    """Voltages of a block of half the conductivity with noise of 0.1 %, and this noise."""
    fine = model_of(4000)
    inside = (np.abs(np.asarray(centroids(fine.mesh))) < BLOCK).all(axis=1)
    voltages = fine.voltages(jnp.where(inside, 0.5, 1.0))
    noise = 1e-3 * jnp.abs(voltages)
    return voltages + noise * jax.random.normal(jax.random.key(0), voltages.shape), noise


def edge_width(mesh, conductivity):
    """Metres over which log σ changes from a tenth to nine tenths of its depth along the block's long middle line."""
    centre, values = np.asarray(centroids(mesh)), np.log(np.asarray(conductivity))
    band = np.abs(centre[:, 1]) < 0.03
    bins = np.arange(0.005, 0.1, 0.005)
    profile = np.array([values[band & (np.abs(np.abs(centre[:, 0]) - b) < 0.004)].mean() for b in bins])
    share = (profile - profile[-3:].mean()) / (profile[:3].mean() - profile[-3:].mean())
    return np.interp(-0.1, -share, bins) - np.interp(-0.9, -share, bins)


@pytest.mark.slow
def test_an_edge_is_sharper_than_with_any_smooth_prior(model, frame):
    voltages, noise = frame
    sharpen = GaussNewton(max_steps=60)
    sharp = reconstruct(model, voltages, 1.0, prior=TotalVariation(), noise=noise, hyperparameter=100.0, solver=sharpen)
    assert sharp.status == "converged"
    assert (np.diff(sharp.costs) < 0).all()
    width = edge_width(model.mesh, sharp.conductivity)
    for prior in (Gaussian(0.017), Laplace(), Noser(), Tikhonov()):
        smooth = reconstruct(model, voltages, 1.0, prior=prior, noise=noise, hyperparameter="discrepancy")
        assert smooth.status == "converged"
        assert width < 0.8 * edge_width(model.mesh, smooth.conductivity), type(prior).__name__
    inside = (np.abs(np.asarray(centroids(model.mesh))) < 0.8 * BLOCK).all(axis=1)
    area = np.asarray(measures(model.mesh))[inside]
    assert area @ np.asarray(sharp.conductivity)[inside] / area.sum() == pytest.approx(0.5, rel=0.1)


@pytest.mark.slow
def test_both_solvers_give_the_same_image(model, frame):
    options = {"prior": TotalVariation(), "noise": frame[1], "hyperparameter": 100.0}
    first, second = (
        reconstruct(model, frame[0], 1.0, solver=kind(max_steps=200, rtol=1e-7), **options)
        for kind in (GaussNewton, LevenbergMarquardt)
    )
    assert first.status == second.status == "converged"
    assert float(second.costs[-1]) == pytest.approx(float(first.costs[-1]), rel=1e-4)
    np.testing.assert_allclose(second.conductivity, first.conductivity, rtol=0.02)


def small_penalty(mesh):
    reference = 0.3 * jnp.cos(30 * centroids(mesh)[:, 0])
    return TotalVariation(0.05).penalty(mesh, reference, 20.0)[1]


@pytest.mark.parametrize(
    "mesh",
    [
        pytest.param(OUTLINE.mesh(num_points=150), id="2d", marks=pytest.mark.slow),
        pytest.param(box(0.1, 0.1, 0.05, cell_size=0.05), id="3d"),
    ],
)
def test_the_quadratic_model_bounds_the_energy_from_above(mesh):
    """Its slope along any step is that of the energy; for a linear misfit the true cost never exceeds the model."""
    penalty = small_penalty(mesh)
    m = mesh.num_cells
    data = IndependentChannels.create(adjacent(6, driven_electrodes=True)).weigh(jnp.ones(36)).combine(jnp.ones(36))
    random = np.random.default_rng(0)
    jacobian, point = random.normal(size=(len(data.voltages), m)), 0.1 * random.normal(size=m)
    start = np.ones(len(jacobian))

    def total(c):
        residual = start + jacobian @ (c - point)
        return 0.5 * residual @ data.precision @ residual + penalty.cost(c)

    @jax.jit
    def modelled(point):
        cost, step = penalty.model(start, jacobian, point, data)
        direction, slope, curvature = step(jnp.zeros(()))
        return cost, direction, slope, curvature, jax.jvp(total, (point,), (direction,))

    cost, direction, slope, curvature, (value, expected) = modelled(point)
    energy = jax.jit(total)
    assert float(cost) == pytest.approx(float(value), rel=1e-12)
    assert float(slope) == pytest.approx(float(expected), rel=1e-9)
    assert float(slope) == pytest.approx(-float(curvature), rel=1e-7)  # the step ends at the model's minimum
    for scale in (0.1, 0.5, 1.0, 1.5):
        above = float(cost + scale * slope + scale**2 * curvature / 2)
        assert float(energy(point + scale * np.asarray(direction))) <= above * (1 + 1e-12)


@pytest.mark.parametrize("size", [1.0, 0.1])
def test_the_energy_in_a_solid_is_the_integral_of_the_gradient(size):
    """λ/s² ∫ √(|∇x|² + (β/h)²) dV + ½ · 1e-3 λ mean(c²): of steep and of shallow images, on cells of any size."""
    mesh = box(size, 0.8 * size, 0.4 * size, cell_size=0.4 * size)
    basis, penalty = TotalVariation(0.05).penalty(mesh, np.full(mesh.num_cells, 0.3), 20.0)
    points, volumes = np.asarray(mesh.points), np.asarray(measures(mesh))
    for slope in (np.array([2.0, -1.0, 0.5]) / size, np.array([0.0, 0.01, 0.02]) / size):
        image = points @ slope
        cell_size = np.cbrt(volumes)
        edges = np.sum(volumes * np.sqrt(slope @ slope + (0.05 / cell_size) ** 2)) / size**2
        mean_square = np.sum(volumes * (image[np.asarray(mesh.cells)] ** 2).mean(axis=1)) / volumes.sum()
        expected = 20.0 * edges + 0.5 * 20.0 * 1e-3 * mean_square
        assert float(penalty.cost(image)) == pytest.approx(expected, rel=1e-9)
        assert float(penalty.cost(np.append(image, [3.0, 4.0]))) == pytest.approx(expected + 12.5, rel=1e-9)
    np.testing.assert_allclose(basis.expand(image), image[np.asarray(mesh.cells)].mean(axis=1), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("mesh", [rectangle(0.1, 0.08, cell_size=0.03), box(0.1, 0.08, 0.05, cell_size=0.05)])
def test_the_energy_of_cells_is_that_of_the_jumps_between_them(mesh):
    """λ Σ l √(d² + β²), with the size l of a facet relative to the body's, + ½ · 1e-3 λ mean(c²)."""
    image, reference = np.random.default_rng(0).normal(size=(2, mesh.num_cells))
    pairs, nodes = interior_facets(mesh)
    corners = np.asarray(mesh.points)[nodes]
    edges = [corners[:, k] - corners[:, 0] for k in range(1, mesh.dimension)]
    lengths = np.linalg.norm(edges[0], axis=1) if mesh.dimension == 2 else np.linalg.norm(np.cross(*edges), axis=1) / 2
    jumps = np.diff((image + reference)[pairs], axis=1)[:, 0]
    mean_square = np.average(image**2, weights=measures(mesh))
    expected = 20 * (lengths @ np.hypot(jumps, 0.05)) / 0.1 ** (mesh.dimension - 1) + 0.5 * 20 * 1e-3 * mean_square
    penalty = TotalVariation(0.05).penalty(mesh, reference, 20.0, per_cell=True)[1]
    assert float(penalty.cost(image)) == pytest.approx(expected, rel=1e-9)
    assert float(penalty.cost(np.append(image, [3.0, 4.0]))) == pytest.approx(expected + 12.5, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hyperparameter": "gcv"}, "takes a number"),
        ({"hyperparameter": -1.0}, "positive"),
        ({"solver": optx.LevenbergMarquardt(1e-6, 1e-6)}, "not a sum of squares"),
        ({"regions": "all"}, "finds its own"),
    ],
)
def test_bad_input(change, message, model, frame):
    if "regions" in change:
        change = {"parametrisation": Parametrisation(regions=np.zeros(model.mesh.num_cells, int))}
    with pytest.raises(ValueError, match=message):
        reconstruct(model, frame[0], 1.0, prior=TotalVariation(), noise=frame[1], **change)


def test_there_is_no_linear_image(model, frame):
    """Nor any other property of a quadratic prior."""
    with pytest.raises(ValueError, match="TotalVariation is not quadratic"):
        one_step(model, 1.0, prior=TotalVariation())
    for ask in (TotalVariation().covariance_product, TotalVariation().precision, TotalVariation().basis):
        with pytest.raises(ValueError, match="total variation has no"):
            ask(model.mesh, jnp.ones((3, model.mesh.num_cells)))


def test_smoothing_must_be_positive():
    with pytest.raises(ValueError, match="smoothing"):
        TotalVariation(0.0)
