"""One model called from eight threads at once: the same bits as from one thread, and the time."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table, judged
from jeit.design import Skin
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import named_layout, ring
from jeit.mesh import Disk, Rectangle
from jeit.protocol import adjacent

THREADS, CALLS = 8, 64
HEADER = ["model", "asked for", "one thread", "eight threads", "same bits"]


def _disk(nodes: int) -> ForwardModel:
    electrodes = BoundaryElectrodes(ring(0.1, 16), 0.01, 0.01)
    return ForwardModel(Disk(0.1).mesh(num_points=nodes), electrodes, adjacent(16, current=1e-3))


def _layer() -> ForwardModel:
    return Skin.create(named_layout("grid-4x4", Rectangle(0.1, 0.1)), num_layers=3, cell_size=9e-3).model


def run(options: Options) -> Result:
    """Measure a sheet and a layer, with jeit's NumPy engine, because concrete values are never compiled."""
    calls = THREADS if options.quick else CALLS
    rows, right = [], []
    for name, make in (("disk", lambda: _disk(1000)), ("layer", _layer)):
        for quantity in ("voltages", "voltages_and_jacobian"):
            model = make()
            cells = model.mesh.num_cells
            sigmas = [(1 + 0.1 * (call % THREADS)) * np.linspace(0.5, 2.0, cells) for call in range(calls)]
            seconds, found = [], []
            for threads in (1, THREADS):
                fresh = make()
                start = time.perf_counter()
                with ThreadPoolExecutor(threads) as pool:
                    found.append(list(pool.map(getattr(fresh, quantity), sigmas)))
                seconds.append(time.perf_counter() - start)
            same = all(_equal(one, other) for one, other in zip(*found, strict=True))
            right.append(same)
            model_label = f"{name}, {model.mesh.num_points:,} nodes"
            equal = ["yes" if same else "no"]
            rows.append([model_label, f"{quantity} × {calls}", *(f"{one:.2f} s" for one in seconds), *equal])
    asked = [judged("the same bits as one thread", f"{sum(right)} of {len(right)}", all(right))]
    return Result([Table(HEADER, rows)], asked)


def _equal(one, other) -> bool:
    pairs = zip(one, other, strict=True) if isinstance(one, tuple) else [(one, other)]
    return all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


CASE = Case("threads", "one model called from eight threads at once: the same bits, and seconds", run, 1)
