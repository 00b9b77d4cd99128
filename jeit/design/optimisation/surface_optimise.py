"""Layout optimisation of curved sheets: electrodes are moved along the surface by gradients through the forward model.

Gradient ascent with a line search: electrodes move in their tangent planes and are then projected to the nearest point
of the surface, which agrees with a step along the surface to second order. A step that does not raise the score, or
that brings electrodes too close to each other or to the edge, is halved.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_kind, describe, is_number
from jeit.design.optimisation.variables import Objective
from jeit.design.scores import Scores
from jeit.design.skin.skin import Skin, check_skin
from jeit.electrodes import SurfaceDiscs
from jeit.layout import SurfaceLayout
from jeit.mesh.geodesic import Triangles
from jeit_solvers.engines import as_array
from jeit_solvers.module import Module

# Maximum and minimum step length, as fractions of the mean spacing of the electrodes.
_LONGEST, _SHORTEST = 0.3, 1e-3


class SurfaceOptimisation(Module):
    """Result of `optimise_surface_layout`.

    **Fields**: `layout`: the best layout; `value`: its score; `start_value`: score of the given layout; `history` (T,):
    score after every step, non-decreasing; `snapshots` (T, L, 3): centres after every step, metres.
    """

    layout: SurfaceLayout
    value: float
    start_value: float
    history: Float[np.ndarray, " T"]
    snapshots: Float[np.ndarray, "T L 3"]


def optimise_surface_layout(
    skin: Skin,
    objective: Objective,
    *,
    steps: int = 30,
    minimum_spacing: float = 0.0,
    margin: float = 0.0,
    callback: Callable[[int, float], None] | None = None,
) -> SurfaceOptimisation:
    """Maximise the `objective` of a curved sheet over the positions of its electrodes, by gradient ascent along the
    surface.

    **Arguments:**

    - `skin`: a curved sheet with the initial layout; `objective`: as for `optimise_layout`.
    - `steps`: maximum number of steps.
    - `minimum_spacing`: minimum distance between centres, metres; electrodes never overlap, even if it is 0.
    - `margin`: minimum distance of an electrode's rim from the edge, metres.
    - `callback`: called after each step with its number and the score.

    Raises `ValueError` for flat skins and layers, if `steps` is not a positive whole number, and for negative lengths.

    **Example:**

    ```python
    optimised = optimise_surface_layout(curved, curved_objective, steps=1, minimum_spacing=0.012)
    print(optimised.start_value, optimised.value)
    ```
    """
    check_skin("skin", skin)
    check_kind("objective", objective, Objective, "an Objective, as of Objective.create(skin, places)")
    layout = skin.layout
    if not isinstance(layout, SurfaceLayout) or skin.num_layers:
        raise ValueError("skin must be a curved sheet: Skin.create(surface_layout, num_layers=0); see optimise_layout.")
    if not isinstance(steps, int) or steps < 1:
        raise ValueError(f"steps must be a whole number from 1; it is {describe(steps)}.")
    for name, length in (("minimum_spacing", minimum_spacing), ("margin", margin)):
        if not is_number(length) or length < 0:
            raise ValueError(f"{name} must be in metres, not negative; it is {describe(length)}.")
    surface, radii = Triangles.of(layout.surface), np.asarray(layout.diameters) / 2
    apart = np.maximum(minimum_spacing, radii[:, None] + radii)
    np.fill_diagonal(apart, 0.0)
    value_and_slope = _cost(skin, objective)
    position = np.asarray(layout.centres)
    value, slope = value_and_slope(position)
    pitch = float(np.sqrt(surface.areas.sum() / len(position)))
    length, history, snapshots = _LONGEST * pitch, [value], [position]
    for step in range(steps):
        normal = surface.normals_at(surface.nearest(position))
        along = slope - (slope * normal).sum(axis=1, keepdims=True) * normal
        steepest = np.linalg.norm(along, axis=1).max()
        moved = None
        while steepest > 0 and length > _SHORTEST * pitch:
            tried = surface.nearest(position + length / steepest * along).points
            if _is_feasible(tried, apart, surface, radii + margin):
                new, new_slope = value_and_slope(tried)
                if new > value:
                    moved = tried, new, new_slope
                    break
            length /= 2
        if moved is None:
            break
        position, value, slope = moved
        length = min(1.5 * length, _LONGEST * pitch)
        history.append(value)
        snapshots.append(position)
        if callback is not None:
            callback(step, value)
    options = {"contact_impedance": layout.contact_impedance, "outward": layout.outward, "labels": layout.labels}
    found = SurfaceLayout(position, layout.diameters, layout.surface, name=layout.name, **options)
    return SurfaceOptimisation(found, value, history[0], np.array(history), np.array(snapshots))


def surface_scores(skin: Skin, objective: Objective, position: Float[Array, "L 3"]) -> Scores:
    """Compute all scores of a curved sheet with its electrodes moved to `position` (L, 3), metres; differentiable with
    respect to the positions."""
    discs = skin.model.electrodes
    assert isinstance(discs, SurfaceDiscs)
    model = skin.model.with_electrodes(SurfaceDiscs(position, discs.radius, discs.contact_impedance))
    return objective.scores(eqx.tree_at(lambda one: one.model, skin, model))


def _cost(skin: Skin, objective: Objective):
    compiled = jax.jit(jax.value_and_grad(lambda place: objective.score(surface_scores(skin, objective, place))))

    def value_and_slope(position):
        value, slope = compiled(as_array(position))
        return float(value), np.asarray(slope)

    return value_and_slope


def _is_feasible(position, apart, surface: Triangles, room) -> bool:
    """Whether the centres are at least `apart` metres from each other, in a straight line, and at least `room` metres
    from the edge."""
    distance = np.linalg.norm(position[:, None] - position, axis=-1)
    return bool((distance >= apart).all() and (surface.distance_to_border(position) >= room).all())
