"""Improvement of a sheet's layout: optimised on a coarse mesh, and compared with the given layout on a finer one."""

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
from jeit.design.skin.touch_grid import touch_grid
from jeit.layout import Layout
from jeit.layout.surface_layout import check_layout, flat_layout
from jeit.protocol import two_terminal

# Nodes of the mesh for the final scores, relative to the mesh optimised on; and positions along a side.
_FINER, _PLACES, _MORE_PLACES = 4, 16, 24


class ImprovedLayout(eqx.Module):
    """Result of `improve_layout`: the optimised layout, with the scores of both layouts.

    **Fields**: `start`, the layout given; `optimisation`, of the `skin` on the mesh optimised on; `before` and `after`,
    scores of both layouts on a finer mesh, at more places; `space`, `noise` (volts), `seed` and
    `num_points`, as they were asked for.
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
        """The optimised layout, or the given one if none is better."""
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
    """Optimise the electrode positions of `layout` for worst sensitivity and mean variance; as `jeit layout optimise`.

    All two-terminal pairs of a sheet are measured, so the order of electrodes does not matter.

    **Arguments:**

    - `space`: the allowed layouts; unless given, all on the skin with electrodes' centres 8 mm apart or more.
    - `noise`: standard deviation of a voltage at 1 mA, volts.
    - `steps`, `starts`, `callback`: as in `optimise_layout`; `seed`: of the random starts.
    - `num_points`: nodes of the mesh to optimise on, about; results are confirmed on four times as many.
    - `progress`: called with the name of each step as it begins.
    - `material`: thickness, conductivity and contact impedance, as in `Skin.create`.

    Raises `ValueError` where no layout satisfies the constraints, and as `Skin.create` and `optimise_layout` do.
    """
    check_layout("layout", layout)
    report = progress or (lambda step: None)
    space = DesignSpace(minimum_spacing=MINIMUM_SPACING) if space is None else space
    report("mesh")
    sheet, objective = _setting(layout, num_points, _PLACES, noise, material)
    report("optimise")
    key = jax.random.key(seed)
    found = optimise_layout(sheet, objective, space, steps=steps, starts=starts, key=key, callback=callback)
    if found.status == "infeasible":
        raise ValueError(f"no layout found: {found.reason}")
    report("confirm")
    finer, objective = _setting(layout, _FINER * num_points, _MORE_PLACES, noise, material)
    moved = finer.with_layout(found.layout, material.get("contact_impedance"))
    before, after = objective.scores(finer), objective.scores(moved)
    return ImprovedLayout(layout, sheet, found, before, after, space, noise, seed, num_points)


def _setting(layout: Layout, num_points: int, places: int, noise: float, options: dict) -> tuple[Skin, Objective]:
    pairs = two_terminal(layout.num_electrodes)
    skin = Skin.create(layout, num_layers=0, num_points=num_points, protocol=pairs, **options)
    return skin, Objective.create(skin, touch_grid(skin.outline, places, places).places, noise=noise)
