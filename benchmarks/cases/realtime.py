"""Frames a second: `python -m benchmarks.cases.realtime`. A touch moves over two sensors, streamed frame by frame.

The sheet of Silvera Tawil et al. 2011 (320 × 200 mm, 16 electrodes round it and one in its centre, 224 voltages) and a
disk of 16 electrodes (208 voltages). Frames are simulated on finer meshes, with noise. For each: the latency of every
frame, linear and with four Gauss-Newton iterations; how far those images are from converged ones; and what the parts of
an iteration cost, beside the time that their arithmetic takes at the speed of a large matrix product.
"""

from __future__ import annotations

import argparse
import time

from benchmarks.harness import machine

CORES, NOISE = 2, 1e-3
BUDGET_MS, LINEAR_MS = 16.7, 0.1


def bodies():
    """Name: function that makes the model for about so many nodes."""
    import numpy as np

    from jeit.electrodes import BoundaryElectrodes, CombinedElectrodes, SheetDiscs
    from jeit.forward import ForwardModel
    from jeit.layout import perimeter, ring
    from jeit.mesh import Disk, Rectangle, Refine
    from jeit.protocol import adjacent, reference_electrode

    def sheet(num_points):
        outline = Rectangle(0.32, 0.2)
        edge = BoundaryElectrodes(perimeter(outline, 16), 0.01, 1e-3)
        electrodes = CombinedElectrodes(edge, SheetDiscs(np.zeros((1, 2)), 0.006, 1e-3))
        return ForwardModel(outline.mesh(num_points=num_points), electrodes, reference_electrode(16))

    def disk(num_points):
        electrodes = BoundaryElectrodes(ring(0.1, 16), 0.012, 1e-3)
        refine = Refine(np.asarray(electrodes.position), factor=2.0)
        return ForwardModel(Disk(0.1).mesh(num_points=num_points, refine=refine), electrodes, adjacent(16))

    return {"sheet, 16 + 1 electrodes": (sheet, (0.1, 0.06)), "disk, 16 electrodes": (disk, (0.06, 0.06))}


def simulate(model, reach, count: int):
    """Frames (count, M) of a touch that travels round the body: half the conductivity within 15 mm; and one at rest."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jeit.mesh import centroids

    centre, rest = centroids(model.mesh), model.voltages(1.0)
    angle = jnp.linspace(0, 2 * jnp.pi, count)
    places = jnp.stack([reach[0] * jnp.cos(angle), reach[1] * jnp.sin(3 * angle)], axis=1)

    def frame(place, key):
        touched = jnp.sum((centre - place) ** 2, axis=1) < 0.015**2
        voltages = model.voltages(jnp.where(touched, 0.5, 1.0))
        return voltages + NOISE * jnp.abs(rest) * jax.random.normal(key, rest.shape)

    keys = jax.random.split(jax.random.key(0), count)
    frames = jax.lax.map(lambda pair: frame(*pair), (places, keys))
    return np.asarray(frames), np.asarray(rest)


def stream_all(imager, frames):
    """Images and latencies in milliseconds of all frames; the stream compiles before its first frame."""
    import numpy as np

    from jeit.inverse import stream

    found = list(stream(imager, iter(frames)))
    assert all(one.imaged for one in found)
    return found, 1e3 * np.array([one.latency for one in found])


def best(function, *arguments, rounds: int = 100) -> float:
    """Median seconds of a call."""
    import jax
    import numpy as np

    jax.block_until_ready(function(*arguments))
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def breakdown(imager) -> list[tuple[str, float, float]]:
    """(part, milliseconds, milliseconds at the speed of a large matrix product) of one Gauss-Newton iteration."""
    import jax
    import jax.numpy as jnp

    from jeit.forward.assembly import cell_conductivity
    from jeit_solvers import factorise, ridge_model, solve

    large = jnp.ones((1000, 1000))
    speed = 2e9 / best(jax.jit(lambda a: a @ a), large, rounds=10)
    inversion, model = imager.inversion, imager.inversion.model
    start, mesh = imager.start, model.mesh
    conductivity = inversion.conductivity(start)
    contact = model.electrodes.contact(mesh)
    operator = model.system.operator(mesh, cell_conductivity(mesh, conductivity), model.electrodes, contact)
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
        ("factorise", best(jax.jit(factorise), plan, operator.values), plan.num_operations),
        ("solve", best(jax.jit(solve), plan, factor, contact.load), 4 * plan.num_factor_entries * electrodes),
        ("voltages and Jacobian, those two included", best(everything, inversion, conductivity), forward),
        ("Jacobian times the prior's shapes", best(restrict, inversion.basis, full), r * m * n),
        ("normal equations and step", best(step, residual, jacobian, start, inversion.data), 2 * r * r * n + r**3),
    ]
    return [(name, 1e3 * seconds, 1e3 * operations / speed) for name, seconds, operations in parts]


def main() -> int:
    """Run, print the tables, and return 1 if a figure is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cases.realtime", description=__doc__)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--nodes", type=int, default=1193)
    options = parser.parse_args()
    machine.use_cores(CORES)
    heading = machine.heading()

    import numpy as np

    from jeit.inverse import Imager

    lines = ["| sensor | image | median ms | 99 % ms | limit ms | iterations | error |", "|---" * 7 + "|"]
    details, missed = [], []
    for name, (make, reach) in bodies().items():
        model = make(options.nodes)
        frames, rest = simulate(make(2 * options.nodes), reach, options.frames)
        noise = 2 * NOISE * np.abs(rest) + 1e-2 * NOISE * np.abs(rest).max()
        common = {"reference": rest, "noise": noise, "hyperparameter": 3.0}  # the imager's own prior
        label = f"{name}, {model.mesh.num_points} nodes, {model.mesh.num_cells} cells, {frames.shape[1]} voltages"
        linear = Imager.create(model, 1.0, method="linear", **common)
        _, latency = stream_all(linear, frames)
        high = np.quantile(latency, 0.99)
        lines.append(f"| {label} | linear | {np.median(latency):.3f} | {high:.3f} | {LINEAR_MS} | 1 | |")
        missed += [] if high <= LINEAR_MS else [f"{name}, linear: {high:.3f} ms"]
        imager = Imager.create(model, 1.0, steps=4, rtol=0.0, **common)
        images, latency = stream_all(imager, frames)
        exact = Imager.create(model, 1.0, steps=30, rtol=1e-12, informative=0.0, **common)
        weighing, errors = exact.weighing(exact.mask), []
        for one in images[:: max(1, len(images) // 50)]:
            limit = np.asarray(exact.estimate(frames[one.number], weighing, exact.start).conductivity)
            errors.append(np.linalg.norm(one.conductivity - limit) / np.linalg.norm(limit - 1))
        high, error = np.quantile(latency, 0.99), max(errors)
        lines.append(
            f"| {label} | Gauss-Newton, 4 linearisations | {np.median(latency):.1f} | {high:.1f} | {BUDGET_MS} | "
            f"{np.mean([one.iterations for one in images]):.1f} | {100 * error:.2g} % |"
        )
        missed += [] if high <= BUDGET_MS else [f"{name}, Gauss-Newton: {high:.1f} ms"]
        missed += [] if error <= 0.02 else [f"{name}: {100 * error:.1f} % from the converged image"]
        details += ["", label, "", "| part | ms | ms at the speed of a large product |", "|---|---|---|"]
        details += [f"| {part} | {spent:.2f} | {least:.2f} |" for part, spent, least in breakdown(imager)]
    print("\n".join([*heading, "", *lines, *details]))
    print("\nmissed: " + ("; ".join(missed) or "nothing"))
    return bool(missed)


if __name__ == "__main__":
    raise SystemExit(main())
