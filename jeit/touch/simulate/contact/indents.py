"""Indents, which are presses of bodies into a skin to a given depth; distributions of random presses and indents."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.arguments import check_key, check_kind, check_metres, describe, is_number, real_array
from jeit.design import Skin
from jeit.design.skin.touched_cells import TouchedCells, pad_rows
from jeit.design.skin.voltage_changes import RestingSkin
from jeit.mesh import Domain, centroids
from jeit.touch.simulate.contact.combined_skins import check_angle, check_position
from jeit.touch.simulate.contact.indenters import AbstractIndenter, check_indenter
from jeit.touch.simulate.contact.materials import material
from jeit.touch.simulate.contact.press import Press
from jeit.touch.simulate.contact.pressed_skin import PressedSkin
from jeit.touch.simulate.contact.samples import lattice
from jeit_solvers.engines import as_array
from jeit_solvers.module import Module

# Number of random places drawn at once for each press; places off the skin are left out.
_NUM_CANDIDATES_PER_PLACE = 20


class PressDraws(Module):
    """Distribution of random touches, each of one or several presses with random indenters, loads, places and angles.

    All draws are independent and uniform, except for the load, whose logarithm is uniform.

    **Arguments:**

    - `indenters`: indenters, one of which is drawn for each press.
    - `outline`: outline of the skin, within which places are drawn.
    - `load`: minimum and maximum load, newtons.
    - `margin`: minimum distance of places from the outline, metres.
    - `at_once`: maximum number of simultaneous presses of a touch; the minimum is one.

    **Example:**

    ```python
    draws = PressDraws([DiscIndenter(0.01)], outline, load=(1.0, 5.0), margin=0.01)
    frames = skin.frames(key, draws.draw(key, 5))
    ```
    """

    indenters: tuple[AbstractIndenter, ...]
    outline: Domain
    load: tuple[float, float]
    margin: float
    at_once: int

    def __init__(
        self,
        indenters: Sequence[AbstractIndenter],
        outline: Domain,
        load: tuple[float, float],
        *,
        margin: float = 0.0,
        at_once: int = 1,
    ):
        """Create the distribution. Raises `ValueError` without indenters, for invalid arguments, for loads that are not
        positive or not in ascending order, and for a `margin` that leaves no place on the skin."""
        check_kind("indenters", indenters, (list, tuple), "a list of them, such as [ball_indenter(0.015)]")
        indenters = tuple(indenters)
        if not indenters:
            raise ValueError("indenters: give one at least, such as [ball_indenter(0.015)].")
        for indenter_index, indenter in enumerate(indenters):
            check_indenter(f"indenters[{indenter_index}]", indenter)
        check_kind("outline", outline, Domain, "an outline, such as Disk(0.05)")
        load_requirement = "the least and the greatest, positive, in newtons, such as (0.3, 10.0)"
        load_range = real_array("load", load, load_requirement)
        if load_range.shape != (2,) or not 0 < load_range[0] <= load_range[1] < np.inf:
            raise ValueError(f"load must be {load_requirement}; it is {load!r}.")
        if not (isinstance(at_once, int) and at_once >= 1):
            raise ValueError(f"at_once must be a whole number, 1 or more; it is {at_once!r}.")
        if not (is_number(margin) and margin >= 0):
            raise ValueError(f"margin must be metres, zero or more; it is {describe(margin)}.")
        self.indenters, self.outline, self.at_once = indenters, outline, at_once
        self.load, self.margin = (float(load_range[0]), float(load_range[1])), float(margin)
        if not self._is_inside(self._random_places(np.random.default_rng(0), 1000)).any():
            raise ValueError(f"margin is {1e3 * self.margin:g} mm, which leaves no place on the skin; give less.")

    def draw(self, key: Array, number: int) -> list[tuple[Press, ...]]:
        """Draw `number` touches, each a tuple of presses. Raises `ValueError` for an invalid key or number."""
        check_key(key)
        if not (isinstance(number, (int, np.integer)) and not isinstance(number, bool) and number >= 0):
            raise ValueError(f"number must be a whole number of touches, 0 or more; it is {describe(number)}.")
        random_generator = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        press_counts = random_generator.integers(1, self.at_once, number, endpoint=True)
        num_presses = press_counts.sum()
        indenter_indices = random_generator.integers(len(self.indenters), size=num_presses)
        press_loads = np.exp(random_generator.uniform(np.log(self.load[0]), np.log(self.load[1]), num_presses))
        press_angles = random_generator.uniform(-np.pi, np.pi, num_presses)
        places = np.zeros((0, 2))
        while len(places) < num_presses:
            candidate_places = self._random_places(random_generator, _NUM_CANDIDATES_PER_PLACE * int(num_presses))
            places = np.concatenate([places, candidate_places[self._is_inside(candidate_places)]])
        presses = [
            Press(self.indenters[indenter_index], float(press_load), press_position, float(press_angle))
            for indenter_index, press_load, press_position, press_angle in zip(
                indenter_indices, press_loads, places[:num_presses], press_angles, strict=True
            )
        ]
        end_indices = np.cumsum(press_counts)
        return [
            tuple(presses[end_index - press_count : end_index])
            for end_index, press_count in zip(end_indices, press_counts, strict=True)
        ]

    def innermost(self) -> np.ndarray:
        """Return the place (x, y), metres, approximately farthest from the edge of the skin: the farthest of a thousand
        random places."""
        places = self._random_places(np.random.default_rng(0), 1000)
        return places[np.asarray(self.outline.signed_distance(places)).argmax()]

    def _random_places(self, random_generator: np.random.Generator, num_places: int) -> np.ndarray:
        low_x, high_x, low_y, high_y = map(float, self.outline.extent)
        return random_generator.uniform((low_x, low_y), (high_x, high_y), (num_places, 2))

    def _is_inside(self, places: np.ndarray) -> np.ndarray:
        return np.asarray(self.outline.signed_distance(places)) >= self.margin


# Fineness of the lattice of samples in each cell, see `lattice`.
_LATTICE_FINENESS = 2
# Minimum fraction of the conductivity of a sheet that remains where it is indented through its whole thickness.
_MIN_CONDUCTIVITY_RATIO = 1e-3
# Minimum divisor of relative changes of voltages, as a fraction of the maximum voltage.
_MIN_RELATIVE_DIVISOR = 1e-3


class Indent(Module):
    """An indenter pressed into a skin to a given depth.

    **Fields**: `indenter`: the indenter; `depth`: depth of its lowest point below the skin's surface, metres;
    `position`: position (x, y) of its origin, metres; `angle`: counter-clockwise angle of the indenter, radians.

    **Example:**

    ```python
    indent = Indent(DiscIndenter(0.02), depth=2e-3, position=(0.01, 0.0))
    changes = relative_changes(sheet, [[indent]])
    ```
    """

    indenter: AbstractIndenter
    depth: float
    position: Float[np.ndarray, "2"]
    angle: float

    def __init__(self, indenter: AbstractIndenter, depth: float, position: ArrayLike = (0.0, 0.0), angle: float = 0.0):
        """Create an indent. Raises `ValueError` for an invalid indenter, depth, position or angle."""
        check_indenter("indenter", indenter)
        check_metres("depth", depth)
        self.indenter, self.depth = indenter, float(depth)
        self.position, self.angle = check_position(position), check_angle(angle)

    def depth_at(self, points: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
        """Compute the depth of the indentation at `points` (…, 2), metres; 0 where the skin is not indented."""
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        local_points = (np.asarray(points) - self.position) @ np.array([[cos, -sin], [sin, cos]])
        return np.maximum(self.depth - self.indenter.gap(local_points), 0.0)


class IndentDraws(Module):
    """Distribution of random touches, each of one or several indents with random indenters, depths, places and angles.

    All draws are independent and uniform, except for the depth, whose logarithm is uniform.

    **Arguments:**

    - `indenters`: indenters, one of which is drawn for each indent.
    - `outline`: outline of the skin, within which places are drawn.
    - `depth`: minimum and maximum depth, metres.
    - `margin`: minimum distance of places from the outline, metres.
    - `at_once`: maximum number of simultaneous indents of a touch; the minimum is one.

    **Example:**

    ```python
    draws = IndentDraws([DiscIndenter(0.01)], outline, depth=(1e-3, 3e-3), margin=0.01)
    touches = draws.draw(key, 10)
    ```
    """

    presses: PressDraws

    def __init__(
        self,
        indenters: Sequence[AbstractIndenter],
        outline: Domain,
        depth: tuple[float, float],
        *,
        margin: float = 0.0,
        at_once: int = 1,
    ):
        """Create the distribution. Raises `ValueError` as `PressDraws` does, and for invalid depths."""
        for depth_limit in depth:
            check_metres("depth", depth_limit, 0.1, "any skin is thick")
        # The presses hold depths in metres in place of loads in newtons.
        self.presses = PressDraws(indenters, outline, depth, margin=margin, at_once=at_once)

    @property
    def depth(self) -> tuple[float, float]:
        """Minimum and maximum depth, metres."""
        return self.presses.load

    def draw(self, key: Array, number: int) -> list[tuple[Indent, ...]]:
        """Draw `number` touches, each a tuple of indents. Raises `ValueError` for an invalid key or number."""
        press_touches = self.presses.draw(key, number)
        return [
            tuple(Indent(press.indenter, press.load, press.position, press.angle) for press in touch)
            for touch in press_touches
        ]


def depth_maps(
    touches: Sequence[Sequence[Indent]], places: Float[np.ndarray, "*shape 2"]
) -> Float[np.ndarray, "n *shape"]:
    """Compute the depth (n, …) to which each of n touches indents a skin, metres: the maximum over a touch's indents.

    **Arguments:**

    - `touches`: the touches, each a sequence of indents.
    - `places`: positions (…, 2) at which depths are computed, metres.

    **Example:**

    ```python
    depths = depth_maps([[Indent(DiscIndenter(0.02), 2e-3)]], grid(0.06, 0.06, 8, 8))
    print(depths.shape)  # (1, 64)
    ```
    """
    indentation_depths = np.zeros((len(touches), *places.shape[:-1]))
    for touch_index, touch in enumerate(touches):
        for indent in touch:
            indentation_depths[touch_index] = np.maximum(indentation_depths[touch_index], indent.depth_at(places))
    return indentation_depths


def indented_cells(skin: Skin, touches: Sequence[Sequence[Indent]]) -> TouchedCells:
    """Compute relative changes of the conductivity of a skin's cells due to n touches: the indented volume does not
    conduct (Park et al. 2022, text S4).

    The conductivity of a cell decreases by the indented share of its volume in a 3-D layer, and by the indented share
    of its thickness in a 2-D sheet. Raises `ValueError` for indents at least as deep as the skin is thick.
    """
    check_kind("skin", skin, Skin, "a Skin, as of Skin.create(named_layout('park-inner'))")
    mesh, thickness = skin.model.mesh, float(skin.thickness)
    max_depth = max((indent.depth for touch in touches for indent in touch), default=0.0)
    if max_depth >= thickness:
        raise ValueError(
            f"depth is {1e3 * max_depth:.3g} mm, and the skin {1e3 * thickness:.3g} mm thick; indent it less."
        )
    sample_points = lattice(np.asarray(mesh.points)[np.asarray(mesh.cells)], _LATTICE_FINENESS)
    sample_depths = sample_points[..., 2].max() - sample_points[..., 2] if skin.num_layers else None
    cell_centres = np.asarray(centroids(mesh))[:, :2]
    max_cell_radius = float(np.linalg.norm(sample_points[..., :2] - cell_centres[:, None], axis=-1).max())
    cell_tree = KDTree(cell_centres)
    rows_of_cells, conductivity_changes = [], []
    for touch in touches:
        nearby_cells = [
            cell_tree.query_ball_point(indent.position, indent.indenter.reach + max_cell_radius) for indent in touch
        ]
        touch_cells = np.unique(
            np.concatenate([np.zeros(1, int), *(np.asarray(nearby_indices, int) for nearby_indices in nearby_cells)])
        )
        indentation_depths = depth_maps([touch], sample_points[touch_cells, :, :2])[0]
        if sample_depths is None:
            indented_fractions = np.minimum(indentation_depths.mean(axis=1) / thickness, 1 - _MIN_CONDUCTIVITY_RATIO)
        else:
            indented_fractions = (indentation_depths > sample_depths[touch_cells]).mean(axis=1)
        is_indented_cell = indented_fractions > 0
        rows_of_cells.append(touch_cells[is_indented_cell])
        conductivity_changes.append(-indented_fractions[is_indented_cell])
    touch_cells, is_row_entry = pad_rows(rows_of_cells)
    padded_changes = np.zeros(touch_cells.shape)
    padded_changes[is_row_entry] = np.concatenate(conductivity_changes)
    touch_places = np.array([touch[0].position if touch else np.zeros(2) for touch in touches])
    return TouchedCells(as_array(touch_places), as_array(touch_cells), as_array(padded_changes), mesh.num_cells)


def relative_changes(
    skin: Skin, touches: Sequence[Sequence[Indent]], resting: RestingSkin | None = None
) -> Float[np.ndarray, "n M"]:
    """Compute noise-free changes (n, M) of a skin's voltages due to n touches, relative to the voltages at rest.

    **Arguments:**

    - `skin`: the skin.
    - `touches`: the touches, each a sequence of indents.
    - `resting`: data of the same skin at rest, from `resting_skin`, which several calls can share.

    The changes are divided by the voltages at rest, as in `relative_voltage_changes`. Raises `ValueError` as
    `indented_cells` does.

    **Example:**

    ```python
    changes = relative_changes(sheet, [[Indent(DiscIndenter(0.02), 2e-3)]])
    frames = rest * (1 + changes)
    ```
    """
    changed_cells = indented_cells(skin, touches)
    if resting is not None:
        rest_voltages = np.asarray(resting.voltages)
        return relative_voltage_changes(rest_voltages, rest_voltages + resting.changes(changed_cells))
    # The choice of material does not matter: only exact voltages are used, without gains and noise.
    pressed_skin = PressedSkin(
        jax.random.key(0), skin.model, material("hydrogel"), conductivity=skin.model_conductivity
    )
    rest_voltages = np.asarray(skin.model.voltages(skin.model_conductivity))
    return relative_voltage_changes(rest_voltages, pressed_skin.voltages_under(changed_cells))


def resting_skin(skin: Skin, depth: float) -> RestingSkin | None:
    """Prepare data of a skin at rest for indents up to a `depth` in metres; None if they would need too much memory."""
    mesh = skin.model.mesh
    is_touchable = np.ones(mesh.num_points, bool)
    if skin.num_layers:
        sample_heights = lattice(np.asarray(mesh.points)[np.asarray(mesh.cells)], _LATTICE_FINENESS)[..., 2]
        is_touchable[:] = False
        is_touchable[np.asarray(mesh.cells)[(sample_heights.max() - sample_heights < depth).any(axis=1)]] = True
    return RestingSkin.create(skin.model, skin.model_conductivity, is_touchable)


def relative_voltage_changes(
    reference: Float[np.ndarray, " M"], voltages: Float[np.ndarray, "n M"]
) -> Float[np.ndarray, "n M"]:
    """Compute changes (n, M) of voltages relative to reference voltages (M,), channel by channel, without unit.

    The divisor is at least a thousandth of the maximum reference voltage.
    """
    reference_magnitudes = np.abs(reference)
    return (voltages - reference) / np.maximum(reference_magnitudes, _MIN_RELATIVE_DIVISOR * reference_magnitudes.max())
