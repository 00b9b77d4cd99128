"""Nonlinear least-squares solvers on the same inverse problems: `python -m benchmarks.cases.optimisers`.

jeit's Gauss-Newton and Levenberg-Marquardt, which solve each step in the smaller of the spaces of data and of images,
beside the same methods as optimistix and jaxopt have them, given the residuals of data and prior stacked on each other,
and jaxopt's bounded solvers. All start from the background and run until their own tolerance of 1e-6 (or 200 steps, the
bounded ones 2,000). What they reach is compared with jeit's minimum to rounding.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings

from benchmarks.harness import machine
from benchmarks.harness.contest import CORES
from benchmarks.harness.report import duration, markdown

MOST_STEPS, MOST_BOUNDED_STEPS, TOLERANCE = 200, 2000, 1e-6
# Above the least objective, in parts of it, within which a solver counts as having found it.
REACHED = 1e-3
HEADER = ["solver", "iterations", "objective above the least", "misfit", "time", "times jeit's", "compile"]


def problems(num_points: int):
    """Name, inversion and its minimum: a touch halves the conductivity, simulated on a finer mesh with 0.1 % noise."""
    import jax.numpy as jnp
    import numpy as np

    from benchmarks.cases.realtime import bodies, simulate
    from jeit.inverse import Gaussian, Noser, reconstruct

    for name, (make, reach) in bodies().items():
        model = make(num_points)
        frames, _ = simulate(make(2 * num_points), reach, 8)
        noise = 1e-2 * np.abs(frames[1]) + 1e-3 * np.abs(frames[1]).max()
        for prior in (Gaussian(0.03), Noser()):
            best = reconstruct(
                model, jnp.asarray(frames[1]), 1.0, prior=prior, hyperparameter=3.0, noise=noise, rtol=1e-13
            )
            size = best.inversion.num_coefficients
            yield (
                f"{name}, {model.mesh.num_points} nodes, {type(prior).__name__}, {size} unknowns",
                best.inversion,
                best.coefficients,
            )


def solvers():
    """Name: function of an inversion that gives coefficients and iterations, to be compiled."""
    import jax.numpy as jnp
    import optimistix as optx

    from jeit.inverse.nonlinear.bounded import minimise_between
    from jeit_solvers import Descent

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
            return minimise_between(inversion, first, least, greatest, method, MOST_BOUNDED_STEPS, TOLERANCE)[:2]

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
        "jaxopt L-BFGS-B": bounded("l-bfgs-b"),
        "jaxopt projected gradient": bounded("projected-gradient"),
    }


def measure(solve, inversion, rounds: int):
    """Coefficients, iterations, seconds of one run (median) and of compiling."""
    import statistics

    import equinox as eqx
    import jax

    compiled = eqx.filter_jit(solve)
    start = time.perf_counter()
    coefficients, iterations = jax.block_until_ready(compiled(inversion))
    first, seconds = time.perf_counter() - start, []
    for _ in range(rounds):
        start = time.perf_counter()
        jax.block_until_ready(compiled(inversion))
        seconds.append(time.perf_counter() - start)
        if sum(seconds) > 10:
            break
    spent = statistics.median(seconds)
    return coefficients, int(iterations), spent, max(first - spent, 0.0)


def main() -> int:
    """Run, print a table for every problem, and return 1 if one of jeit's solvers misses the least objective."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cases.optimisers", description=__doc__)
    parser.add_argument("--nodes", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    machine.use_cores(CORES)
    print("\n".join(f"- {line}" for line in machine.heading()))
    import jax.numpy as jnp
    import numpy as np

    missed = []
    for name, inversion, minimum in problems(options.nodes):
        least = float(inversion.cost(minimum))
        rows, own = [], float("nan")
        for label, solve in solvers().items():
            print(f"{name}: {label} …", file=sys.stderr, flush=True)
            coefficients, iterations, spent, compiling = measure(solve, inversion, options.rounds)
            own = spent if label == "jeit Gauss-Newton" else own
            above = float(inversion.cost(coefficients)) / least - 1
            data = inversion.data
            squares = jnp.sum(data.whiten(inversion.residual(coefficients)) ** 2)
            misfit = float(jnp.sqrt(squares / len(data.voltages)))
            if label.startswith("jeit") and not above < REACHED:
                missed.append(f"{name}: {label}")
            reached = f"{above:.0e}" if np.isfinite(above) else "failed"
            figures = [str(iterations), reached, f"{misfit:.3f}", duration(spent), f"{spent / own:.1f}×"]
            rows.append([label, *figures, duration(compiling)])
        print(f"\n{name}\n\n{markdown(HEADER, rows)}", flush=True)
    print("\nmissed: " + ("; ".join(missed) or "nothing"))
    return bool(missed)


if __name__ == "__main__":
    raise SystemExit(main())
