"""Improvement of an electrode layout on a sheet: optimisation on a coarse mesh, then comparison with the given layout
on a finer mesh."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jeit.design.defaults import MINIMUM_SPACING, NOISE, NUM_POINTS, STEPS
from jeit.design.optimisation.design_space import DesignSpace
from jeit.design.optimisation.optimise import Optimisation, optimise_layout
from jeit.design.optimisation.variables import Objective
from jeit.design.scores import Scores
from jeit.design.skin.skin import Skin
from jeit.design.skin.touch_shapes import touch_grid
from jeit.layout import Layout
from jeit.layout.surface_layout import check_layout, flat_layout
from jeit.protocol import two_terminal
from jeit_solvers.module import Module

# Ratio of the number of nodes of the mesh for the final scores to the number of nodes of the mesh for the optimisation;
# number of touched positions along a side in the optimisation, and for the final scores.
_REFINEMENT_RATIO, _NUM_OPTIMISED_POSITIONS, _NUM_SCORED_POSITIONS = 4, 16, 24


class ImprovedLayout(Module):
    """Result of `improve_layout`: the optimised layout, with the scores of both layouts.

    **Fields**

    - `start`: the given layout; `skin`: the skin with this layout and the coarse mesh; `optimisation`: result of
      `optimise_layout`.
    - `before`, `after`: scores of the given and of the optimised layout on a finer mesh, for touches at more positions.
    - `space`, `noise` (volts), `seed`, `num_points`: the arguments of `improve_layout`.
    """

    start: Layout
    skin: Skin
    optimisation: Optimisation
    before: Scores
    after: Scores
    space: DesignSpace
    noise: float
    seed: int = eqx.field(static=True)
    num_points: int = eqx.field(static=True)

    @property
    def layout(self) -> Layout:
        """The optimised layout, or the given layout if no better layout was found."""
        return flat_layout(self.optimisation.layout)


def improve_layout(
    layout: Layout,
    space: DesignSpace | None = None,
    *,
    noise: float = NOISE,
    steps: int = STEPS,
    starts: int = 1,
    seed: int = 0,
    num_points: int = NUM_POINTS,
    progress: Callable[[str], None] | None = None,
    callback: Callable[[int, np.ndarray], None] | None = None,
    **material: Any,
) -> ImprovedLayout:
    """Optimise the electrode positions of `layout` to increase the lowest sensitivity and decrease the mean variance,
    as the command `jeit layout optimise` does.

    All two-terminal pairs of a sheet are measured, so the order of the electrodes does not matter.

    **Arguments:**

    - `layout`: the initial layout, with the outline of its skin.
    - `space`: the allowed layouts; by default all layouts on the skin whose electrodes' centres are at least 8 mm
      apart.
    - `noise`: standard deviation of the noise of a voltage at 1 mA, volts.
    - `steps`, `starts`, `callback`: as in `optimise_layout`; `seed`: random seed of the random starts.
    - `num_points`: approximate number of nodes of the mesh used in the optimisation; the final scores are computed on a
      mesh with four times as many nodes.
    - `progress`: function called with the name of each step ("mesh", "optimise", "confirm") as the step begins.
    - `material`: thickness, conductivity and contact impedance, as in `Skin.create`.

    Raises `ValueError` if no layout satisfies the constraints, and in the cases of `Skin.create` and `optimise_layout`.

    **Example:**

    ```python
    improved = improve_layout(layout, DesignSpace(minimum_spacing=0.012), steps=1, num_points=400)
    write_improved_layout(improved, "out")
    ```
    """
    check_layout("layout", layout)
    report_progress = progress or (lambda step_name: None)
    space = DesignSpace(minimum_spacing=MINIMUM_SPACING) if space is None else space
    report_progress("mesh")
    coarse_skin, objective = _skin_and_objective(layout, num_points, _NUM_OPTIMISED_POSITIONS, noise, material)
    report_progress("optimise")
    random_key = jax.random.key(seed)
    optimisation = optimise_layout(
        coarse_skin, objective, space, steps=steps, starts=starts, key=random_key, callback=callback
    )
    if optimisation.status == "infeasible":
        raise ValueError(f"no layout found: {optimisation.reason}")
    report_progress("confirm")
    num_fine_points = _REFINEMENT_RATIO * num_points
    skin_with_fine_mesh, objective = _skin_and_objective(
        layout, num_fine_points, _NUM_SCORED_POSITIONS, noise, material
    )
    optimised_skin = skin_with_fine_mesh.with_layout(optimisation.layout, material.get("contact_impedance"))
    scores_before_and_after = objective.scores(skin_with_fine_mesh), objective.scores(optimised_skin)
    return ImprovedLayout(layout, coarse_skin, optimisation, *scores_before_and_after, space, noise, seed, num_points)


def _skin_and_objective(
    layout: Layout, num_mesh_points: int, num_touches_per_side: int, noise: float, skin_options: dict
) -> tuple[Skin, Objective]:
    protocol = two_terminal(layout.num_electrodes)
    skin = Skin.create(layout, num_layers=0, num_points=num_mesh_points, protocol=protocol, **skin_options)
    return skin, Objective.create(
        skin, touch_grid(skin.outline, num_touches_per_side, num_touches_per_side).places, noise=noise
    )
