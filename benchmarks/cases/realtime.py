"""Frame rates: a touch moves over two sensors, streamed frame by frame.

Frames are simulated on finer meshes, with noise. For each sensor, the case measures the latency of every frame, for
linear images and with four Gauss-Newton iterations; the distance of the latter images from converged images; and the
time of the parts of an iteration, compared with the time that the same number of operations takes in a large matrix
product.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness.case import Asked, Case, Headline, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say, timed
from benchmarks.problems.touched_sensors import NOISE, bodies, simulate
from jeit.inverse import Imager, Parametrisation, stream
from jeit.inverse.nonlinear import GaussNewton, OneStep

BUDGET_MS, LINEAR_MS, ERROR = 16.7, 0.1, 0.02
NODES, FRAMES, CONVERGED = 1193, 400, 20
HEADER = ["sensor", "image", "median", "99 %", "iterations", "greatest error"]


class Streamed(NamedTuple):
    """Images of all frames, and the median and 99th percentile of their latencies in milliseconds."""

    images: list
    median: float
    high: float


def run(options: Options) -> Result:
    """Measure both sensors."""
    nodes, count = (options.nodes or (200 if options.quick else NODES,))[0], 20 if options.quick else FRAMES
    rows, asked, parts, headline = [], [], [], None
    sensors = list(bodies().items())[:1] if options.quick else bodies().items()
    for name, (make, reach) in sensors:
        model = make(nodes)
        frames, rest = simulate(make(2 * nodes), reach, count)
        noise = 2 * NOISE * np.abs(rest) + 1e-2 * NOISE * np.abs(rest).max()
        common = {"reference": rest, "noise": noise, "hyperparameter": 3.0}  # the imager's own prior
        label = f"{name}, {model.mesh.num_points} nodes, {model.mesh.num_cells} cells, {frames.shape[1]} voltages"
        linear = stream_all(Imager.create(model, 1.0, solver=OneStep(), **common), frames)
        imager = Imager.create(model, 1.0, solver=GaussNewton(max_steps=4, rtol=0.0), **common)
        found = stream_all(imager, frames)
        error = _error(model, found.images, frames, common)
        steps = np.mean([one.iterations for one in found.images])
        rows += [
            [label, "linear", f"{linear.median:.3f} ms", f"{linear.high:.3f} ms", "1", ""],
            [
                label,
                "Gauss-Newton",
                f"{found.median:.1f} ms",
                f"{found.high:.1f} ms",
                f"{steps:.1f}",
                f"{100 * error:.2g} %",
            ],
        ]
        for row in rows[-2:]:
            say(" | ".join(row))
        asked += _asked(name, linear, found, error)
        if options.quick:
            continue
        rows_of_parts = [[part, f"{spent:.2f}", f"{least:.2f}"] for part, spent, least in breakdown(imager)]
        parts.append(Table(["part", "ms", "ms at the speed of a large product"], rows_of_parts, label))
        job = f"a streamed frame, four Gauss-Newton iterations, {model.mesh.num_points:,} nodes"
        mine = f"{duration(found.median / 1e3)} (99 %: {duration(found.high / 1e3)})"
        # The README shows the last sensor, the disk.
        headline = Headline(
            job, mine, f"asked: {BUDGET_MS} ms", accuracy=f"{100 * error:.2g} % from the converged image"
        )
    return Result([Table(HEADER, rows), *parts], asked, headline=headline)


def stream_all(imager: Imager, frames: np.ndarray) -> Streamed:
    """Image all frames, one after the other. The stream compiles before the first frame."""
    found = list(stream(imager, iter(frames)))
    assert all(one.imaged for one in found)
    latency = 1e3 * np.array([one.latency for one in found])
    return Streamed(found, float(np.median(latency)), float(np.quantile(latency, 0.99)))


def _error(model, images: list, frames: np.ndarray, common: dict) -> float:
    """Largest distance of some images from converged images, relative to the difference of the converged images from
    the background."""
    longer, every = GaussNewton(max_steps=30, rtol=1e-12), Parametrisation(informative=0.0)
    exact = Imager.create(model, 1.0, solver=longer, parametrisation=every, **common)
    weighing, errors = exact.weighing(exact.mask), []
    for one in images[:: max(1, len(images) // CONVERGED)]:
        limit = np.asarray(exact.estimate(frames[one.number], weighing, exact.start).conductivity)
        errors.append(np.linalg.norm(one.conductivity - limit) / np.linalg.norm(limit - 1))
    return float(max(errors))


def _asked(name: str, linear: Streamed, found: Streamed, error: float) -> list[Asked]:
    linear_asked, asked = f"99 % of linear images ≤ {LINEAR_MS} ms", f"99 % of Gauss-Newton images ≤ {BUDGET_MS} ms"
    return [
        judged(f"{name}: {linear_asked}", f"{linear.high:.3f} ms", linear.high <= LINEAR_MS),
        judged(f"{name}: {asked}", f"{found.high:.1f} ms", found.high <= BUDGET_MS),
        judged(f"{name}: ≤ {100 * ERROR:g} % from converged images", f"{100 * error:.2g} %", error <= ERROR),
    ]


def _median(function, *arguments, rounds: int = 100) -> float:
    """Median seconds of a call of `function`."""
    return timed(lambda: function(*arguments), rounds).median


def breakdown(imager) -> list[tuple[str, float, float]]:
    """Parts of one Gauss-Newton iteration: name, measured milliseconds, and milliseconds at the speed of a large matrix
    product."""
    from jeit.forward.system import cell_conductivity
    from jeit_solvers import factorise, ridge_model, solve

    large = jnp.ones((1000, 1000))
    speed = 2e9 / _median(jax.jit(lambda a: a @ a), large, rounds=10)
    inversion, model = imager.inversion, imager.inversion.model
    start, mesh = imager.start, model.mesh
    conductivity = inversion.conductivity(start)
    contact = model.electrodes.contact(mesh)
    operator, load = model.system.grounded_system(
        mesh, cell_conductivity(mesh, conductivity), model.electrodes, contact
    )
    plan = model.system.solver.plan
    factor = factorise(plan, operator.values)
    residual, jacobian = jax.jit(type(inversion).linearise)(inversion, start)
    r, n = jacobian.shape
    m, electrodes = mesh.num_cells, model.electrodes.num_electrodes
    patterns = model.protocol.num_drives + model.protocol.measurement.shape[0]
    everything = jax.jit(lambda i, s: i.model.voltages_and_jacobian(s))
    _, full = everything(inversion, conductivity)
    step = jax.jit(lambda a, b, c, d: ridge_model(a, b, c, d.covariance, d.precision)[1](0.0))
    restrict = jax.jit(lambda basis, rows: basis.restrict(rows))
    forward = 4 * m * patterns * electrodes + 4 * r * m + plan.num_operations
    parts = [
        ("factorise", _median(jax.jit(factorise), plan, operator.values), plan.num_operations),
        ("solve", _median(jax.jit(solve), plan, factor, load), 4 * plan.num_factor_entries * electrodes),
        ("voltages and Jacobian, those two included", _median(everything, inversion, conductivity), forward),
        ("Jacobian times the prior's shapes", _median(restrict, inversion.basis, full), r * m * n),
        ("normal equations and step", _median(step, residual, jacobian, start, inversion.data), 2 * r * r * n + r**3),
    ]
    return [(name, 1e3 * seconds, 1e3 * operations / speed) for name, seconds, operations in parts]


CASE = Case("realtime", "latency of streamed frames, and the parts of a Gauss-Newton iteration", run, 2)
