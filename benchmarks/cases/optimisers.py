"""Nonlinear least-squares solvers of jeit, optimistix and jaxopt on the same inverse problems.

jeit's Gauss-Newton and Levenberg-Marquardt solve each step in the smaller of the spaces of data and of images. They are
compared with the same methods of optimistix and jaxopt, applied to the stacked residuals of data and prior, and with
jaxopt's bounded solvers. All solvers start from the background and run to their own tolerance of 1e-6 (at most 200
steps; bounded solvers 2,000). The objectives that they reach are compared with the minimum that jeit computes to
rounding errors.
"""

from __future__ import annotations

import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from benchmarks.harness.case import Asked, Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration, times
from benchmarks.harness.timing import say, timed
from benchmarks.problems.touched_sensors import bodies, simulate
from jeit.inverse import Gaussian, Noser, reconstruct
from jeit.inverse.nonlinear import GaussNewton
from jeit.inverse.nonlinear.solvers import minimise_within_bounds
from jeit_solvers import Descent, lbfgsb, projected_gradient

MOST_STEPS, MOST_BOUNDED_STEPS, TOLERANCE = 200, 2000, 1e-6
# A solver has converged if its objective exceeds the minimum by at most this fraction.
REACHED = 1e-3
NODES, ROUNDS, BUDGET = 500, 5, 4.0
QUICK = ("jeit Gauss-Newton", "optimistix Gauss-Newton")
HEADER = ["solver", "iterations", "objective above the least", "misfit", "time", "times jeit's", "compile"]


def run(options: Options) -> Result:
    """Run every solver on every problem."""
    nodes = (options.nodes or (150 if options.quick else NODES,))[0]
    tables, asked = [], []
    for name, inversion, minimum in problems(nodes, quick=options.quick):
        say(name)
        rows, checks = _contest(name, inversion, minimum, options)
        tables.append(Table(HEADER, rows, name))
        asked += checks
    return Result(tables, asked)


def _contest(name: str, inversion, minimum, options: Options) -> tuple[list[list[str]], list[Asked]]:
    """The table's rows for one problem, and checks of whether jeit's solvers reach the minimum."""
    least, rows, asked, own = float(inversion.cost(minimum)), [], [], float("nan")
    for label, solve in solvers().items():
        if options.quick and label not in QUICK:
            continue
        compiled = eqx.filter_jit(solve)
        try:
            spent, compiling, answer = timed(lambda f=compiled: f(inversion), options.rounds or ROUNDS, BUDGET)
        except Exception as error:
            # A failure of another library is reported in its row, and does not affect the others.
            rows.append([label, "", f"failed: {type(error).__name__}", "", "", "", ""])
            continue
        coefficients, iterations = answer
        own = spent if label == "jeit Gauss-Newton" else own
        above = float(inversion.cost(coefficients)) / least - 1
        squares = jnp.sum(inversion.data.whiten(inversion.residual(coefficients)) ** 2)
        misfit = float(jnp.sqrt(squares / len(inversion.data.voltages)))
        reached = f"{above:.0e}" if np.isfinite(above) else "failed"
        figures = [str(int(iterations)), reached, f"{misfit:.3f}", duration(spent), times(spent / own)]
        rows.append([label, *figures, duration(compiling)])
        say(" | ".join(rows[-1]))
        if label.startswith("jeit"):
            asked.append(judged(f"{name}: {label}: ≤ {REACHED:g} above the least", reached, above < REACHED))
    return rows, asked


def problems(num_points: int, *, quick: bool = False):
    """Name, inversion and minimum of each problem: a touch halves the conductivity, simulated on a finer mesh with 0.1
    % noise."""
    for name, (make, reach) in list(bodies().items())[: 1 if quick else None]:
        model = make(num_points)
        frames, _ = simulate(make(2 * num_points), reach, 8)
        noise = 1e-2 * np.abs(frames[1]) + 1e-3 * np.abs(frames[1]).max()
        for prior in (Gaussian(0.03),) if quick else (Gaussian(0.03), Noser()):
            best = reconstruct(
                model,
                jnp.asarray(frames[1]),
                1.0,
                prior=prior,
                hyperparameter=3.0,
                noise=noise,
                solver=GaussNewton(rtol=1e-13),
            )
            size = best.inversion.num_coefficients
            yield (
                f"{name}, {model.mesh.num_points} nodes, {type(prior).__name__}, {size} unknowns",
                best.inversion,
                best.coefficients,
            )


def solvers():
    """For each solver by name, a function of an inversion that returns coefficients and number of iterations, to be
    compiled."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt

    def start(inversion):
        return jnp.zeros(inversion.num_coefficients)

    def stacked(coefficients, inversion):
        return jnp.concatenate([inversion.data.whiten(inversion.residual(coefficients)), coefficients])

    def descent(damping):
        def solve(inversion):
            solver = Descent(rtol=TOLERANCE, damping=damping, history=MOST_STEPS)
            options = {"expand": lambda c, i: i.quadratic_model(c)}
            found = optx.least_squares(
                stacked, solver, start(inversion), inversion, options=options, max_steps=MOST_STEPS, throw=False
            )
            return found.value, found.state.num_accepted - 1

        return solve

    def optimistix(solver):
        def solve(inversion):
            found = optx.least_squares(stacked, solver, start(inversion), inversion, max_steps=MOST_STEPS, throw=False)
            return found.value, found.stats["num_steps"]

        return solve

    def jaxopt_solver(kind, **options):
        def solve(inversion):
            solver = kind(lambda c: stacked(c, inversion), maxiter=MOST_STEPS, **options)
            found = solver.run(start(inversion))
            return found.params, found.state.iter_num

        return solve

    def bounded(method):
        def solve(inversion):
            first = start(inversion)
            least, greatest = jnp.full_like(first, -jnp.inf), jnp.full_like(first, jnp.inf)
            found = minimise_within_bounds(inversion, first, least, greatest, method, MOST_BOUNDED_STEPS, TOLERANCE)
            return found.x, found.steps

        return solve

    tolerance = {"rtol": TOLERANCE, "atol": TOLERANCE}
    marquardt = {"materialize_jac": True, "solver": "cholesky", "tol": TOLERANCE, "gtol": TOLERANCE, "xtol": TOLERANCE}
    return {
        "jeit Gauss-Newton": descent(0.0),
        "jeit Levenberg-Marquardt": descent(1.0),
        "optimistix Gauss-Newton": optimistix(optx.GaussNewton(**tolerance)),
        "optimistix Levenberg-Marquardt": optimistix(optx.LevenbergMarquardt(**tolerance)),
        "optimistix Dogleg": optimistix(optx.Dogleg(**tolerance)),
        "jaxopt Gauss-Newton": jaxopt_solver(jaxopt.GaussNewton, tol=TOLERANCE),
        "jaxopt Levenberg-Marquardt": jaxopt_solver(jaxopt.LevenbergMarquardt, **marquardt),
        "jaxopt L-BFGS-B": bounded(lbfgsb),
        "jaxopt projected gradient": bounded(projected_gradient),
    }


CASE = Case("optimisers", "nonlinear least-squares solvers on one problem: jeit, optimistix, jaxopt", run, 4)
