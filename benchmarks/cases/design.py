"""Maps of touched skins, jeit beside SciPy and scikit-learn in one run: `python -m benchmarks.cases.design`.

Exact maps of 48 × 48 touches on a sheet and on a layer, beside one SuperLU factorisation per touch (a few touches of
each map, times their number); linear maps of many layouts in one batch and one by one; k-means of the same vectors. And
what exact maps cost against the number of nodes.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time

import numpy as np

from benchmarks.harness import machine
from benchmarks.harness.contest import CORES, ROOT
from benchmarks.harness.report import duration, markdown, write_between_markers
from benchmarks.opponents.scipy_touches import PlainTouches

HEADER = ["task", "nodes", "jeit", "opponent", "times jeit's", "compile", "agreement"]
FASTER, SAME = 30.0, 1e-8
SIDE, THICKNESS = 0.2, 0.01


def skin(kind: str, cell_size: float):
    """A model of the paper's inner layout, its conductivity (m,), and what `touched_cells` needs to know."""
    from jeit.electrodes import FaceDiscs
    from jeit.forward import ForwardModel
    from jeit.layout import named_layout
    from jeit.mesh import layer, rectangle
    from jeit.protocol import two_terminal

    layout, plane = named_layout("park-inner"), rectangle(SIDE, SIDE, cell_size=cell_size)
    if kind == "sheet":
        model = ForwardModel(plane, layout.sheet_discs(1e-3), two_terminal(32))
        return model, np.full(plane.num_cells, 1e-2), {"thickness": THICKNESS}
    mesh = layer(plane, THICKNESS, 5)
    bottom = np.column_stack([layout.centres, np.zeros(32)])
    return ForwardModel(mesh, FaceDiscs(bottom, 3e-3, 1e-4), two_terminal(32)), np.ones(mesh.num_cells), {}


def seconds(function, rounds: int) -> tuple[float, float]:
    """Median of some runs, and how much longer the first one took."""
    spent = []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        function()
        spent.append(time.perf_counter() - start)
    middle = statistics.median(spent[1:])
    return middle, max(spent[0] - middle, 0.0)


def exact_map(kind: str, cell_size: float, places: int, sample: int, rounds: int):
    """A row of the table, times faster than SciPy, whether both agree, nodes, and seconds."""
    import jax

    from jeit.design import Bell, touch_changes, touch_grid, touched_cells
    from jeit.mesh import Rectangle

    model, conductivity, options = skin(kind, cell_size)
    grid = touch_grid(Rectangle(SIDE, SIDE), places, places)
    presses = touched_cells(model.mesh, Bell(), grid.places, **options)
    spent, compiling = seconds(lambda: jax.block_until_ready(touch_changes(model, conductivity, presses)), rounds)
    nodes, name = model.mesh.num_points, f"exact map, {kind}, {len(grid.places)} touches"
    if not sample:
        return [name, str(nodes), duration(spent), "", "", duration(compiling), ""], 0.0, True, nodes, spent
    found = np.asarray(touch_changes(model, conductivity, presses))
    plain = PlainTouches(model, conductivity)
    chosen = np.linspace(0, len(grid.places) - 1, sample).astype(int)
    each, worst = [], 0.0
    for k in chosen:
        start = time.perf_counter()
        expected = plain.change(np.asarray(presses.cells[k]), np.asarray(presses.change[k]))
        each.append(time.perf_counter() - start)
        worst = max(worst, float(np.abs(found[k] - expected).max() / np.abs(expected).max()))
    theirs = statistics.median(each) * len(grid.places)
    row = [name, str(nodes), duration(spent), duration(theirs), f"{theirs / spent:.0f}×", duration(compiling)]
    return [*row, f"{worst:.0e}"], theirs / spent, worst < SAME, nodes, spent


def many_layouts(numbers: tuple[int, ...], rounds: int):
    """Rows: linear maps of so many layouts in one batch, and one after the other; and seconds of each batch."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from jeit.design import Bell, touch_changes, touch_grid, touched_cells
    from jeit.mesh import Rectangle

    model, conductivity, options = skin("sheet", 6.3e-3)
    presses = touched_cells(model.mesh, Bell(), touch_grid(Rectangle(SIDE, SIDE), 24, 24).places, **options)
    sigma = jnp.asarray(conductivity)

    def theta(move):
        electrodes = eqx.tree_at(lambda e: e.position, model.electrodes, model.electrodes.position + move)
        changes = touch_changes(eqx.tree_at(lambda m: m.electrodes, model, electrodes), sigma, presses, linear=True)
        return jnp.linalg.norm(changes, axis=1)

    batch, one = jax.jit(lambda moves: jax.lax.map(theta, moves)), jax.jit(theta)
    rows, cost = [], []
    for number in numbers:
        moves = 1e-3 * jax.random.normal(jax.random.key(0), (number, 32, 2))
        together, compiling = seconds(lambda moves=moves: jax.block_until_ready(batch(moves)), rounds)
        alone, _ = seconds(lambda moves=moves: [jax.block_until_ready(one(move)) for move in moves], rounds)
        same = float(jnp.max(jnp.abs(batch(moves)[-1] / one(moves[-1]) - 1)))
        needed = batch.lower(moves).compile().memory_analysis()
        memory = (needed.temp_size_in_bytes + needed.output_size_in_bytes) / 2**20
        name = f"linear maps of {number} layouts, 576 touches, each; {memory:.0f} MB for all"
        row = [name, str(model.mesh.num_points), duration(together / number), f"{duration(alone / number)} (a loop)"]
        rows.append([*row, f"{alone / together:.1f}×", duration(compiling), f"{same:.0e}"])
        cost.append((number, together))
    return rows, cost


def clusters(rounds: int):
    """A row: 90 clusters of the changes of 2,304 touches by 94 voltages, beside scikit-learn on one thread."""
    import jax
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    from jeit.design import Bell, nearest_pairs, touch_changes, touch_grid, touched_cells
    from jeit.layout import named_layout
    from jeit.mesh import Rectangle
    from jeit_solvers import kmeans

    model, conductivity, options = skin("sheet", 5e-3)
    presses = touched_cells(model.mesh, Bell(), touch_grid(Rectangle(SIDE, SIDE)).places, **options)
    chosen = np.sort(nearest_pairs(named_layout("park-inner").centres, 94))
    vectors = np.asarray(touch_changes(model, conductivity, presses, linear=True))[:, chosen]
    spent, compiling = seconds(lambda: jax.block_until_ready(kmeans(vectors, 90, jax.random.key(0))), rounds)
    with threadpool_limits(1):
        theirs, _ = seconds(lambda: KMeans(90, n_init=10, random_state=0).fit(vectors), rounds)
        inertia = statistics.median(KMeans(90, n_init=10, random_state=k).fit(vectors).inertia_ for k in range(3))
    mine = statistics.median(float(kmeans(vectors, 90, jax.random.key(k)).inertia) for k in range(3))
    row = ["k-means, 90 clusters of 2304 × 94, 10 restarts", "", duration(spent), duration(theirs)]
    return [*row, f"{theirs / spent:.1f}×", duration(compiling), f"inertia {100 * (mine / inertia - 1):+.1f} %"]


def main() -> int:
    """Run, print the table and the checks; fail if jeit and SciPy disagree."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cases.design", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smoke run, figures not judged")
    parser.add_argument("--write-readme", action="store_true", help="put the table into benchmarks/README.md")
    options = parser.parse_args()
    machine.use_cores(CORES)
    heading = machine.heading()
    if options.quick:
        cases, places, sample, rounds, numbers = [("sheet", 7e-3)], 12, 3, 1, (2, 4)
    else:
        cases, places, sample, rounds = [("sheet", 3.07e-3), ("layer", 4.34e-3)], 48, 12, 3
        numbers = (16, 64, 256)
    rows, checks, agree, cost = [], [], True, {}
    for kind, cell_size in cases:
        row, faster, same, nodes, spent = exact_map(kind, cell_size, places, sample, 3 * rounds)
        rows.append(row)
        agree &= same
        cost[kind] = [(nodes, spent)]
        verdict = "met" if faster >= FASTER else "missed"
        checks.append([f"exact map, {kind}: ≥ 30× one factorisation per touch", f"{faster:.0f}×", verdict])
    if not options.quick:
        for kind, sizes in (("sheet", (6.3e-3, 4.3e-3)), ("layer", (8e-3, 6e-3))):
            for cell_size in sizes:
                row, _, _, nodes, spent = exact_map(kind, cell_size, places, 0, 1)
                rows.append(row)
                cost[kind].append((nodes, spent))
            slope = np.polyfit(*np.log(np.array(cost[kind]).T), 1)[0]
            checks.append([f"exact map, {kind}: cost grows as nodes to the power", f"{slope:.2f}", ""])
        rows.append(clusters(rounds))
    maps, spent = many_layouts(numbers, rounds)
    rows += maps
    slope = np.polyfit(*np.log(np.array(spent).T), 1)[0]
    checks.append(["linear maps: cost grows as layouts to the power", f"{slope:.2f}", ""])
    memory = f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB, of all together"
    text = "\n\n".join(
        [
            "\n".join(f"- {line}" for line in [*heading, memory]),
            markdown(HEADER, rows),
            markdown(["asked", "measured", ""], checks),
        ]
    )
    print(text)
    if not agree:
        raise SystemExit("jeit and SciPy disagree.")
    if options.write_readme:
        write_between_markers(ROOT / "benchmarks" / "README.md", text, "design")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
