"""Every solver on every problem, with the maximum number of iterations of each."""

import functools
import itertools

import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jeit.electrodes import BoundaryElectrodes, SheetDiscs
from jeit.forward import ForwardModel
from jeit.inverse import Laplace, Parametrisation, reconstruct
from jeit.inverse.nonlinear import LBFGSB, GaussNewton, LevenbergMarquardt, ProjectedGradient
from jeit.inverse.nonlinear.solvers import LeastSquares
from jeit.layout import perimeter, ring, ring_and_centre
from jeit.mesh import Disk, Rectangle, centroids
from jeit.protocol import adjacent, opposite, reference_electrode


def disk(num_points):
    electrodes = BoundaryElectrodes(ring(0.1, 16), 0.012, 1e-3)
    return ForwardModel(Disk(0.1).mesh(num_points=num_points), electrodes, adjacent(16))


def sheet(num_points):
    outline = Rectangle(0.3, 0.2)
    electrodes = BoundaryElectrodes(perimeter(outline, 12), 0.012, 1e-3)
    return ForwardModel(outline.mesh(num_points=num_points), electrodes, opposite(12))


def centred(num_points):
    electrodes = SheetDiscs(ring_and_centre(0.08, 9), 0.008, 1e-3)
    return ForwardModel(Disk(0.1).mesh(num_points=num_points), electrodes, reference_electrode(9, reference=8))


# Position and size of the inclusion (metres), and its conductivity in a body of 1 S.
PROBLEMS = {
    "conductive in a disk": (disk, (0.03, 0.02), 0.025, 3.0),
    "resistive in a disk": (disk, (-0.04, 0.0), 0.03, 0.3),
    "resistive in a sheet": (sheet, (0.05, 0.02), 0.035, 0.4),
    "conductive in a sheet": (sheet, (-0.06, 0.03), 0.03, 2.5),
    "conductive among discs": (centred, (0.02, 0.04), 0.025, 2.5),
}
# Solver, and the maximum number of iterations on any of the problems: the recorded number and a fifth more.
SOLVERS = {
    "gauss-newton": (GaussNewton(max_steps=1000), 8),
    "levenberg-marquardt": (LevenbergMarquardt(max_steps=1000), 12),
    "optimistix LM": (LeastSquares(optx.LevenbergMarquardt(1e-6, 1e-6), max_steps=1000), 40),
    "optimistix Dogleg": (LeastSquares(optx.Dogleg(1e-6, 1e-6), max_steps=1000), 40),
    "l-bfgs-b": (LBFGSB(max_steps=1000), 700),
    "projected-gradient": (ProjectedGradient(max_steps=1000), 1000),
}


@functools.cache
def pose_least_squares(name):
    """Model, voltages of a finer one, options, and the best possible reconstruction."""
    make, centre, radius, conductivity = PROBLEMS[name]
    fine, model = make(2000), make(300)
    inside = np.linalg.norm(np.asarray(centroids(fine.mesh)) - centre, axis=1) < radius
    voltages = fine.voltages(jnp.where(inside, conductivity, 1.0))
    noise = 1e-2 * jnp.abs(voltages) + 1e-3 * jnp.abs(voltages).max()
    options = {"prior": Laplace(), "noise": noise, "hyperparameter": 3.0}
    best = reconstruct(model, voltages, 1.0, solver=GaussNewton(rtol=1e-12), **options)
    return model, voltages, options, best


# jeit's own solvers are tested on every problem; those that are compiled for each body, on the two problems of one
# body.
OWN = ("gauss-newton", "levenberg-marquardt")
BODIES = {"optimistix LM": "disk", "optimistix Dogleg": "sheet", "l-bfgs-b": "disk", "projected-gradient": "sheet"}
BOUNDED = [(f"conductive in a {BODIES[name]}", name) for name in ("l-bfgs-b", "projected-gradient")]


def cases():
    """The pairs to test; the quick tests use the solvers that need no compilation (others: test_reconstruct.py)."""
    for problem, solver in itertools.product(PROBLEMS, SOLVERS):
        if solver in OWN or problem.endswith(f"a {BODIES[solver]}"):
            quick = problem == "conductive in a disk" and solver in OWN
            yield pytest.param(problem, solver, marks=() if quick else pytest.mark.slow)


@pytest.mark.parametrize(("problem", "name"), list(cases()))
def test_every_solver_on_every_problem(problem, name):
    model, voltages, options, best = pose_least_squares(problem)
    solver, limit = SOLVERS[name]
    result = reconstruct(model, voltages, 1.0, solver=solver, **options)
    assert result.status == "converged", result.reason
    assert result.iterations <= limit
    assert float(result.costs[-1]) <= 1.005 * float(best.costs[-1])
    assert float(result.costs[-1]) < float(result.costs[0])
    largest = np.abs(np.log(best.conductivity)).max()
    assert np.abs(np.log(result.conductivity / best.conductivity)).max() < 0.1 * largest


@pytest.mark.slow
@pytest.mark.parametrize(("problem", "name"), BOUNDED)
def test_inactive_bounds_change_nothing(problem, name):
    model, voltages, options, free = pose_least_squares(problem)
    within = Parametrisation(bounds=(1e-3, 1e3))
    result = reconstruct(model, voltages, 1.0, solver=SOLVERS[name][0], parametrisation=within, **options)
    assert result.status == "converged"
    assert float(result.costs[-1]) < 1.01 * float(free.costs[-1])
    np.testing.assert_allclose(result.conductivity, free.conductivity, rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("problem", "name"), BOUNDED)
def test_bounds_hold_and_are_reached(problem, name):
    """With other priors; see test_bounded.py."""
    model, voltages, options, _ = pose_least_squares(problem)
    between = Parametrisation(bounds=(0.95, 1.6))
    result = reconstruct(model, voltages, 1.0, solver=SOLVERS[name][0], parametrisation=between, **options)
    values = np.asarray(result.conductivity)
    assert values.min() >= 0.95 * (1 - 1e-12)
    assert values.max() <= 1.6 * (1 + 1e-12)
    assert values.max() == pytest.approx(1.6, rel=1e-6)
    assert result.costs[-1] < result.costs[0]
