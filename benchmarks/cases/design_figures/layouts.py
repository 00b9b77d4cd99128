"""Optimised layouts and selected measurements, for the case `design_figures`."""

from __future__ import annotations

import numpy as np

from benchmarks.harness.case import Table

CONDUCTANCE = 2e-3


def optimised(nodes: tuple[int, int], columns: tuple[int, int], starts: int, steps: int) -> Table:
    """A table of layouts before and after optimisation, on a sheet of 2 mS. `nodes` and `columns` are the numbers of
    nodes, and of touches along a side, for optimisation and for evaluation on a finer mesh.
    """
    import jax

    from jeit.design import (
        Bell,
        DesignSpace,
        Objective,
        Skin,
        TouchPrior,
        layout_scores,
        optimise_layout,
        sensitivity_map,
        touch_grid,
    )
    from jeit.design.skin.sheet_touches import sheet_touches
    from jeit.forward import ForwardModel
    from jeit.layout import Layout, named_layout
    from jeit.mesh import Rectangle, rectangle
    from jeit.protocol import two_terminal

    skin, start = Rectangle(0.2, 0.2), named_layout("park-boundary")

    def setting(nodes: int, columns: int):
        mesh, grid = rectangle(0.2, 0.2, num_points=nodes), touch_grid(skin, columns, columns)
        model = ForwardModel(mesh, start.sheet_discs(1e-4), two_terminal(32, current=1e-3))
        touches = sheet_touches(mesh, Bell(), grid.places, thickness=10e-3)
        return model, grid, touches, {"prior": TouchPrior.create(grid.places, correlation=15e-3), "noise": 1e-4}

    model, _, touches, options = setting(nodes[0], columns[0])
    sheet = Skin(start, model, thickness=10e-3, conductivity=CONDUCTANCE / 10e-3)
    limits = {"starts": starts, "steps": steps, "key": jax.random.key(0)}
    found = optimise_layout(sheet, Objective(touches, **options), DesignSpace(minimum_spacing=8e-3), **limits)
    coarse = model.mesh.num_points
    layouts = {name: named_layout(name) for name in ("park-inner", "grid-8x4", "park-boundary")}
    for number, (centres, radii) in enumerate(zip(found.centres, found.radii, strict=True)):
        begun = f"random layout {number}" if number else "park-boundary"
        layouts[f"optimised from {begun}"] = Layout(centres, 2 * radii, outline=skin)
    model, grid, touches, options = setting(nodes[1], columns[1])
    figures_of = {}
    for name, layout in layouts.items():
        moved = model.with_electrodes(layout.sheet_discs(1e-4))
        least = float(sensitivity_map(moved, CONDUCTANCE, grid, thickness=10e-3).minimum)
        variance = float(layout_scores(moved, CONDUCTANCE, touches, **options).mean_variance)
        figures_of[name] = least, variance
    best = list(figures_of.values())[3 + int(np.argmax(found.values))]
    rows = []
    for name, (least, variance) in figures_of.items():
        margins = (
            [f"×{best[0] / least:.1f}", f"×{variance / best[1]:.2f}"] if name in list(figures_of)[:3] else ["", ""]
        )
        rows.append([name, f"{1e3 * least:.1f}", f"{variance:.4f}", *margins])
    header = ["layout", "least Θ, mV", "A, mean variance", "best start's Θ, times", "best start's A, lower by"]
    caption = (
        f"Optimised on a sheet of {coarse:,} nodes with {columns[0]} × {columns[0]} touches ({found.status} of {steps} "
        f"steps), confirmed on {model.mesh.num_points:,} nodes with {columns[1]} × {columns[1]}; best by its score: "
        f"start {1 + int(np.argmax(found.values))}."
    )
    return Table(header, rows, "Optimised layouts", caption)


def selected(name: str, number: int, cell_sizes: tuple[float, float], correlations, noises, count: int) -> Table:
    """A table of the fraction of information that `number` selected electrode pairs of a layout keep.

    Rows are for `correlations` (correlation lengths of the prior in metres) and `noises` (relative to each voltage).
    `cell_sizes` are those of the sheet and under electrodes, in metres. The table states the median of `count` random
    selections for comparison.
    """
    import jax

    from jeit.design import Candidates, information_bound, select_measurements
    from jeit.design.measurements import information, nearest_pairs, random_selections
    from jeit.forward import ForwardModel
    from jeit.inverse import Gaussian
    from jeit.layout import named_layout
    from jeit.mesh import Refine, rectangle
    from jeit.protocol import two_terminal

    layout, conductance = named_layout(name), 10e-3
    protocol = two_terminal(layout.num_electrodes)
    finer = Refine(layout.centres, cell_size=cell_sizes[1], distance=3e-3)
    mesh = rectangle(0.2, 0.2, cell_size=cell_sizes[0], refine=finer)
    model = ForwardModel(mesh, layout.sheet_discs(1e-4), protocol)
    voltages, jacobian = model.voltages_and_jacobian(conductance)
    random = random_selections(jax.random.key(0), protocol.num_measurements, number, count)
    rows = []
    for correlation in correlations:
        # Conductance varies by a quarter, as if a layer of 10 mm were indented by 2.5 mm.
        product = (0.25 * conductance) ** 2 * Gaussian(correlation).covariance_product(mesh, jacobian)
        for noise in noises:
            candidates = Candidates.create(jacobian, product, noise * voltages)
            chosen = select_measurements(candidates, number)
            kept = [chosen.information, information_bound(candidates, number)]
            kept.append(np.median(information(candidates, random)))
            kept.append(information(candidates, nearest_pairs(layout.centres, number)))
            shares = [f"{100 * min(float(value / chosen.total), 1):.0f} %" for value in kept]
            rows.append([f"{1e3 * correlation:g}", f"{noise:.0e}", f"{float(chosen.total):.0f}", *shares])
    header = ["correlation, mm", "noise, of each voltage", "all pairs, nats"]
    header += [f"{number} chosen keep", f"bound of any {number}", f"median of {count:,} random", f"{number} nearest"]
    caption = f"Of {protocol.num_measurements} pairs, on a sheet of {mesh.num_points:,} nodes."
    return Table(header, rows, "Chosen measurements", caption)
