"""Solid bodies: images of a box with 32 plates, first call included, each in a fresh process with its peak memory."""

from __future__ import annotations

import subprocess
import sys

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say

LIMIT = 1200.0
# Number of nodes of a body that is imaged without limits of time and memory, and the images that are computed for it.
LARGE = 50_000
AT_LARGE = ("one step, NOSER", "one step, Gaussian", "Gauss-Newton, Gaussian, with error bars")
# Script that simulates a box of 0.17 × 0.255 × 0.17 m with plates of 8 × 8 cm, like published tanks, with a ball, and
# noise of 0.1 % of the change.
_SETUP = """
import itertools, time
import numpy as np
from benchmarks.harness.memory import peak_memory
from jeit.electrodes import FacePatches
from jeit.electrodes.face_patches import body_mesh
from jeit.forward import ForwardModel
from jeit.inverse import Gaussian, Laplace, Matern, Noser, TotalVariation, greit, one_step, posterior, reconstruct
from jeit.mesh import Rectangle, Solid, centroids
from jeit.protocol import opposite

x, y, z = 0.085, 0.1275, 0.17
half, three = (-0.0425, 0.0425), (-0.085, 0.0, 0.085)
places = [(a, s * y, b) for s in (-1, 1) for a in half for b in (0.0425, 0.1275)]
places += [(s * x, a, b) for s in (-1, 1) for a in three for b in (0.0425, 0.1275)]
places += [(a, b, s) for s in (0.0, z) for a in half for b in three]
plates = FacePatches(np.array(places), 0.08, 0.08, 1e-2)
mesh = body_mesh(Solid(Rectangle(2 * x, 2 * y), z), plates, {nodes})
model = ForwardModel(mesh, plates, opposite(32, current=1e-3))
ball = np.linalg.norm(np.asarray(centroids(mesh)) - [0.03, -0.05, 0.1], axis=1) < 0.03
rest = np.asarray(model.voltages(0.024))
change = np.asarray(model.voltages(np.where(ball, 0.05, 0.024))) - rest
change = change + 1e-3 * np.std(change) * np.random.default_rng(0).normal(size=change.shape)
noise = 0.02 * np.std(change)
start = time.perf_counter()
"""
_DONE = """
print(mesh.num_points, mesh.num_cells, time.perf_counter() - start, peak_memory())
"""
_LINEAR = "one_step(model, 0.024, prior={}, hyperparameter={}).image(change)"
_NEWTON = "reconstruct(model, rest + change, 0.024, prior={}, hyperparameter={}, noise=noise)"
# Name of the image, code, and limit in seconds.
JOBS = {
    "one step, NOSER": (_LINEAR.format("Noser()", 3.0), 10.0),
    "one step, Gaussian": (_LINEAR.format("Gaussian(0.04)", 3.0), 10.0),
    "one step, Matérn": (_LINEAR.format("Matern(0.04)", 3.0), 10.0),
    "one step, Laplace": (_LINEAR.format("Laplace()", 3.0), 10.0),
    "GREIT": ("greit(model, 0.024).image(change)", 10.0),
    "Gauss-Newton, Gaussian, with error bars": (
        f"posterior({_NEWTON.format('Gaussian(0.04)', 5.0)}).standard_deviation()",
        60.0,
    ),
    "total variation": (_NEWTON.format("TotalVariation()", 300.0), 60.0),
    "total variation, with error bars": (
        f"posterior({_NEWTON.format('TotalVariation()', 300.0)}).standard_deviation()",
        60.0,
    ),
}
# The jobs of a smoke run.
QUICK_JOBS = ("one step, NOSER", "GREIT", "total variation, with error bars")
_MEMORY = 2048.0


def run(options: Options) -> Result:
    """Compute every image in a separate process, with mesh and model ready before the clock starts. For large bodies,
    only some of the images are computed.
    """
    rows, checks, wrong = [], [], []
    for nodes in options.nodes or (800 if options.quick else 20_000,):
        for name in QUICK_JOBS if options.quick else JOBS if nodes <= LARGE else AT_LARGE:
            script, most = JOBS[name]
            text = _SETUP.replace("{nodes}", str(nodes)) + script + _DONE
            done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=LIMIT)
            if done.returncode:
                wrong.append(f"{name}, {nodes} nodes: {(done.stderr.strip().splitlines() or ['no answer'])[-1]}")
                continue
            points, cells, seconds, memory = (float(one) for one in done.stdout.split()[-4:])
            rows.append([name, f"{points:.0f}", f"{cells:.0f}", duration(seconds), f"{memory:.0f} MB"])
            say(" | ".join(rows[-1]))
            if nodes <= LARGE:
                checks.append(judged(f"{name} ≤ {most:g} s, first call included", duration(seconds), seconds <= most))
                checks.append(judged(f"{name} ≤ 2 GB", f"{memory:.0f} MB", memory <= _MEMORY))
    heads = ["image of a box with 32 plates", "nodes", "cells", "first call", "peak memory"]
    return Result([Table(heads, rows)], checks, wrong=wrong)


CASE = Case("solids", "images of a box with 32 plates, first call included: seconds and memory", run, 6)
