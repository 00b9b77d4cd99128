"""Reconstruction with bounds on the conductivity."""

import equinox as eqx
import jax
import numpy as np
import pytest

from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import Gaussian, Noser, Parametrisation, TotalVariation, reconstruct
from jeit.inverse.nonlinear import (
    LBFGSB,
    Bounded,
    GaussNewton,
    LevenbergMarquardt,
    Linear,
    Log,
    ProjectedGradient,
)
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent


@pytest.fixture(scope="module")
def model():
    """Six points and 25 nodes, because bounded solvers take seconds to compile; twice as long for electrodes with a
    width."""
    return ForwardModel(Disk(0.1).mesh(num_points=25), PointElectrodes(ring(0.09, 6)), adjacent(6))


def disturbed(model, inside):
    """The voltages of a body with a threefold conductivity in a part, and their noise."""
    voltages = np.asarray(model.voltages(np.where(inside, 3.0, 1.0)))
    return voltages, 1e-2 * np.abs(voltages)


@pytest.fixture(scope="module")
def frame(model):
    return disturbed(model, np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.03, 0.02], axis=1) < 0.05)


def between(model, frame, solver, prior, bounds, link=None):
    """A reconstruction of a kind that another test has compiled.

    A kind is a solver with its settings, prior and link; bounds do not change it.
    """
    own = {"bounds": bounds} | ({} if link is None else {"link": link})
    options = {} if isinstance(prior, TotalVariation) else {"hyperparameter": 1.0}
    return reconstruct(
        model, frame[0], 1.0, prior=prior, noise=frame[1], parametrisation=Parametrisation(**own), solver=solver,
        **options,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("solver", "prior"),
    [
        (ProjectedGradient(), Noser()),
        pytest.param(LBFGSB(), Noser(), marks=pytest.mark.slow),
        pytest.param(LBFGSB(), TotalVariation(), marks=pytest.mark.slow),
        pytest.param(ProjectedGradient(), TotalVariation(), marks=pytest.mark.slow),
    ],
)
def test_bounds_hold_and_are_reached(solver, prior, model, frame):
    """With the Laplace prior; see test_solver_table.py for others."""
    result = between(model, frame, solver, prior, (0.95, 1.6))
    values = np.asarray(result.conductivity)
    assert values.min() >= 0.95 * (1 - 1e-12)
    assert values.max() <= 1.6 * (1 + 1e-12)
    assert values.max() == pytest.approx(1.6, rel=1e-6)
    assert result.costs[-1] < result.costs[0]


@pytest.mark.slow
def test_bounds_select_a_bounded_solver(model, frame):
    alone = between(model, frame, None, Noser(), (0.9, 2.0))
    chosen = between(model, frame, LBFGSB(), Noser(), (0.9, 2.0))
    assert alone.iterations == chosen.iterations > 2
    np.testing.assert_array_equal(alone.conductivity, chosen.conductivity)
    assert float(alone.conductivity.max()) <= 2.0 * (1 + 1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bounds": (2.0, 1.0)}, "lower < upper"),
        ({"bounds": (1.5, 2.0)}, "background must lie"),
        ({"bounds": 5}, "two numbers"),
        ({"bounds": (1.0,)}, "two numbers"),
        ({"bounds": "ab"}, "two numbers"),
        ({"bounds": (2.0, 1.0), "prior": Gaussian(0.02)}, "lower < upper"),
        ({"bounds": (0.5, 2.0), "link": Bounded(0.1, 4.0)}, "bounded already"),
        ({"bounds": (0.5, 2.0), "solver": "levenberg-marquardt"}, "levenberg-marquardt knows none; use l-bfgs-b or"),
        ({"bounds": (0.5, 2.0), "solver": LevenbergMarquardt()}, "knows none"),
        ({"bounds": (0.5, 2.0), "solver": "gauss-newton"}, "gauss-newton knows none; use l-bfgs-b or"),
        ({"bounds": (0.5, 2.0), "solver": GaussNewton()}, "knows none"),
        ({"bounds": (0.5, 2.0), "prior": Gaussian(0.02)}, "in place of bounds"),
        ({"bounds": (0.5, 2.0), "regions": True}, "every cell"),
    ],
)
def test_bad_input(change, message, model, frame):
    change = dict(change)
    if "regions" in change:
        change = {**change, "regions": np.zeros(model.mesh.num_cells, int)}
    own = {name: change.pop(name) for name in ("bounds", "link", "regions") if name in change}
    arguments = {"prior": Noser(), "noise": frame[1], **change}
    with pytest.raises(ValueError, match=message):
        reconstruct(model, frame[0], 1.0, parametrisation=Parametrisation(**own), **arguments)


@pytest.mark.parametrize(("link", "ends"), [(Linear(), (0.0, 1.5)), (Log(), (-np.inf, np.log(1.5)))])
def test_bounds_on_the_link_s_scale(link, ends):
    """Zero is outside of the logarithm's range and is no bound there; conductivity itself stays above it."""
    background = np.array([0.5, 1.0])
    lower, upper = (
        np.asarray(end) + np.asarray(link.estimate(background))
        for end in Parametrisation(bounds=(0.0, 1.5), link=link).box(background)
    )
    np.testing.assert_allclose(upper, ends[1], rtol=1e-12)
    np.testing.assert_allclose(lower, ends[0], atol=1e-5)
    assert (lower > 0).all() == isinstance(link, Linear)


@pytest.mark.parametrize("link", [pytest.param(Linear(), marks=pytest.mark.slow), Log()], ids=["linear", "log"])
def test_lower_bound_of_zero(link, model, frame):
    """Zero is outside of the logarithm's range and is no bound there."""
    result = between(model, frame, ProjectedGradient(), Noser(), (0.0, 1.5), link)
    assert (np.asarray(result.conductivity) > 0).all()
    assert result.costs[-1] < result.costs[0]


@pytest.mark.slow
def test_too_few_steps_are_reported_and_gradient_of_the_cost(model, frame):
    """The gradient used by the bounded solvers, against finite differences, away from the minimum."""
    result = between(model, frame, ProjectedGradient(max_steps=2), Noser(), (0.9, 2.0))
    assert float(result.conductivity.max()) <= 2.0 * (1 + 1e-12)
    assert result.status == "step limit"
    assert "after 2 iterations;" in result.reason
    direction = jax.random.normal(jax.random.key(0), result.coefficients.shape)
    cost = eqx.filter_jit(result.inversion.cost)
    slope = jax.grad(cost)(result.coefficients) @ direction
    step = 1e-5
    ahead, behind = (cost(result.coefficients + sign * step * direction) for sign in (1, -1))
    assert float(slope) == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-5)
