"""Layout optimisation of curved sheets: electrodes are moved along the surface by gradients through the forward model.

The score is raised by gradient ascent with a line search. Electrodes move in their tangent planes and are then
projected to the nearest point of the surface, which agrees with a step along the surface to second order. A step that
does not raise the score, or that brings electrodes too close to each other or to the edge, is halved.
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
_MAX_STEP_FRACTION, _MIN_STEP_FRACTION = 0.3, 1e-3


class SurfaceOptimisation(Module):
    """Result of `optimise_surface_layout`.

    **Fields**: `layout`: the best layout; `value`: score of the best layout; `start_value`: score of the given layout;
    `history` (T,): score initially and after every step, non-decreasing; `snapshots` (T, L, 3): centres of the L
    electrodes initially and after every step, metres.
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

    - `skin`: a curved sheet with the initial layout; `objective`: the maximised function of the scores, as for
      `optimise_layout`.
    - `steps`: maximum number of steps of the gradient ascent.
    - `minimum_spacing`: minimum distance between the electrodes' centres, metres; electrodes never overlap, even if
      this distance is 0.
    - `margin`: minimum distance of an electrode's rim from the edge of the surface, metres.
    - `callback`: function called after each step with the step's index, from 0, and the score.

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
    for argument_name, argument_value in (("minimum_spacing", minimum_spacing), ("margin", margin)):
        if not is_number(argument_value) or argument_value < 0:
            raise ValueError(f"{argument_name} must be in metres, not negative; it is {describe(argument_value)}.")
    skin_surface, electrode_radii = Triangles.of(layout.surface), np.asarray(layout.diameters) / 2
    min_centre_distances = np.maximum(minimum_spacing, electrode_radii[:, None] + electrode_radii)
    np.fill_diagonal(min_centre_distances, 0.0)
    score_and_gradient = _score_function(skin, objective)
    electrode_positions = np.asarray(layout.centres)
    layout_score, score_gradient = score_and_gradient(electrode_positions)
    electrode_spacing = float(np.sqrt(skin_surface.areas.sum() / len(electrode_positions)))
    step_length, score_history, position_snapshots = (
        _MAX_STEP_FRACTION * electrode_spacing,
        [layout_score],
        [electrode_positions],
    )
    for step_index in range(steps):
        surface_normals = skin_surface.normals_at(skin_surface.nearest(electrode_positions))
        tangential_gradient = (
            score_gradient - (score_gradient * surface_normals).sum(axis=1, keepdims=True) * surface_normals
        )
        max_gradient_norm = np.linalg.norm(tangential_gradient, axis=1).max()
        accepted_step = None
        while max_gradient_norm > 0 and step_length > _MIN_STEP_FRACTION * electrode_spacing:
            candidate_positions = skin_surface.nearest(
                electrode_positions + step_length / max_gradient_norm * tangential_gradient
            ).points
            if _is_feasible(candidate_positions, min_centre_distances, skin_surface, electrode_radii + margin):
                candidate_score, candidate_gradient = score_and_gradient(candidate_positions)
                if candidate_score > layout_score:
                    accepted_step = candidate_positions, candidate_score, candidate_gradient
                    break
            step_length /= 2
        if accepted_step is None:
            break
        electrode_positions, layout_score, score_gradient = accepted_step
        step_length = min(1.5 * step_length, _MAX_STEP_FRACTION * electrode_spacing)
        score_history.append(layout_score)
        position_snapshots.append(electrode_positions)
        if callback is not None:
            callback(step_index, layout_score)
    layout_options = {"contact_impedance": layout.contact_impedance, "outward": layout.outward, "labels": layout.labels}
    final_layout = SurfaceLayout(
        electrode_positions, layout.diameters, layout.surface, name=layout.name, **layout_options
    )
    return SurfaceOptimisation(
        final_layout, layout_score, score_history[0], np.array(score_history), np.array(position_snapshots)
    )


def surface_scores(skin: Skin, objective: Objective, positions: Float[Array, "L 3"]) -> Scores:
    """Compute all scores of a curved sheet with its electrodes moved to `positions` (L, 3), metres. The scores are
    differentiable with respect to the positions."""
    disc_electrodes = skin.model.electrodes
    assert isinstance(disc_electrodes, SurfaceDiscs)
    moved_model = skin.model.with_electrodes(
        SurfaceDiscs(positions, disc_electrodes.radius, disc_electrodes.contact_impedance)
    )
    return objective.scores(eqx.tree_at(lambda skin_to_change: skin_to_change.model, skin, moved_model))


def _score_function(skin: Skin, objective: Objective):
    """Return a compiled function that computes the score of electrode positions (L, 3), metres, and the gradient (L, 3)
    of the score."""
    compiled_score = jax.jit(
        jax.value_and_grad(lambda score_positions: objective.score(surface_scores(skin, objective, score_positions)))
    )

    def score_and_gradient(electrode_positions):
        layout_score, score_gradient = compiled_score(as_array(electrode_positions))
        return float(layout_score), np.asarray(score_gradient)

    return score_and_gradient


def _is_feasible(electrode_positions, min_centre_distances, skin_surface: Triangles, min_edge_distances) -> bool:
    """Whether the straight distances between the centres (L, 3) are at least `min_centre_distances` (L, L), and the
    distances of the centres from the edge are at least `min_edge_distances` (L,), all in metres."""
    centre_distances = np.linalg.norm(electrode_positions[:, None] - electrode_positions, axis=-1)
    return bool(
        (centre_distances >= min_centre_distances).all()
        and (skin_surface.distance_to_border(electrode_positions) >= min_edge_distances).all()
    )
