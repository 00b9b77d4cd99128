"""Indents: presses of bodies into a layer, and their random places and depths."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.arguments import check_key, check_kind, check_metres, describe, is_number, real_array
from jeit.design import Skin
from jeit.design.skin.resting_skin import RestingSkin
from jeit.design.skin.touched_cells import TouchedCells, padded
from jeit.mesh import Domain, centroids
from jeit.touch.simulate.contact.indenters import AbstractIndenter, check_indenter
from jeit.touch.simulate.contact.joined import check_angle, check_position
from jeit.touch.simulate.contact.materials import material
from jeit.touch.simulate.contact.press import Press
from jeit.touch.simulate.contact.pressed_skin import PressedSkin
from jeit.touch.simulate.contact.samples import lattice
from jeit_solvers.engines import as_array

# The number of places drawn at once for each that is needed, until one is on the skin.
_TRIES = 20


class PressDraws(eqx.Module):
    """Touches of one to `at_once` presses, each number as likely as another, all independent.

    **Fields**: `indenters`, each as likely as another, turned by any angle; `outline` of the places, and their least
    distance `margin` from it, metres, all over alike; `load`, least and greatest, newtons, its logarithm uniform.
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
        """Raises `ValueError` for no indenters, no outline, loads that are not positive and rising, and a margin that
        leaves no place."""
        check_kind("indenters", indenters, (list, tuple), "a list of them, such as [ball(0.015)]")
        indenters = tuple(indenters)
        if not indenters:
            raise ValueError("indenters: give one at least, such as [ball(0.015)].")
        for number, indenter in enumerate(indenters):
            check_indenter(f"indenters[{number}]", indenter)
        check_kind("outline", outline, Domain, "an outline, such as Disk(0.05)")
        wanted = "the least and the greatest, positive, in newtons, such as (0.3, 10.0)"
        span = real_array("load", load, wanted)
        if span.shape != (2,) or not 0 < span[0] <= span[1] < np.inf:
            raise ValueError(f"load must be {wanted}; it is {load!r}.")
        if not (isinstance(at_once, int) and at_once >= 1):
            raise ValueError(f"at_once must be a whole number, 1 or more; it is {at_once!r}.")
        if not (is_number(margin) and margin >= 0):
            raise ValueError(f"margin must be metres, zero or more; it is {describe(margin)}.")
        self.indenters, self.outline, self.at_once = indenters, outline, at_once
        self.load, self.margin = (float(span[0]), float(span[1])), float(margin)
        if not self._inside(self._anywhere(np.random.default_rng(0), 1000)).any():
            raise ValueError(f"margin is {1e3 * self.margin:g} mm, which leaves no place on the skin; give less.")

    def draw(self, key: Array, number: int) -> list[tuple[Press, ...]]:
        """Draw `number` touches. Raises `ValueError` for what is no key, and no number."""
        check_key(key)
        if not (isinstance(number, (int, np.integer)) and not isinstance(number, bool) and number >= 0):
            raise ValueError(f"number must be a whole number of touches, 0 or more; it is {describe(number)}.")
        random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        counts = random.integers(1, self.at_once, number, endpoint=True)
        total = counts.sum()
        which = random.integers(len(self.indenters), size=total)
        load = np.exp(random.uniform(np.log(self.load[0]), np.log(self.load[1]), total))
        angle = random.uniform(-np.pi, np.pi, total)
        place = np.zeros((0, 2))
        while len(place) < total:
            tried = self._anywhere(random, _TRIES * int(total))
            place = np.concatenate([place, tried[self._inside(tried)]])
        presses = [
            Press(self.indenters[one], float(newtons), where, float(turned))
            for one, newtons, where, turned in zip(which, load, place[:total], angle, strict=True)
        ]
        ends = np.cumsum(counts)
        return [tuple(presses[end - count : end]) for end, count in zip(ends, counts, strict=True)]

    def innermost(self) -> np.ndarray:
        """Of a thousand places (x, y), metres, on the skin, the one farthest from its edge."""
        places = self._anywhere(np.random.default_rng(0), 1000)
        return places[np.asarray(self.outline.signed_distance(places)).argmax()]

    def _anywhere(self, random: np.random.Generator, number: int) -> np.ndarray:
        low_x, high_x, low_y, high_y = map(float, self.outline.extent)
        return random.uniform((low_x, low_y), (high_x, high_y), (number, 2))

    def _inside(self, places: np.ndarray) -> np.ndarray:
        return np.asarray(self.outline.signed_distance(places)) >= self.margin


# Places in each cell of a mesh, see `lattice`; what of a sheet conducts at least, where it is pressed through.
_LATTICE, _LEAST = 2, 1e-3
# Voltages are not divided by less than this share of the greatest.
_FLOOR = 1e-3


class Indent(eqx.Module):
    """An `indenter` at a `depth` in metres, turned by `angle` radians, its origin at `position` (x, y), metres."""

    indenter: AbstractIndenter
    depth: float
    position: Float[np.ndarray, "2"]
    angle: float

    def __init__(self, indenter: AbstractIndenter, depth: float, position: ArrayLike = (0.0, 0.0), angle: float = 0.0):
        """Raises `ValueError` for what is no indenter, depth, place or angle."""
        check_indenter("indenter", indenter)
        check_metres("depth", depth)
        self.indenter, self.depth = indenter, float(depth)
        self.position, self.angle = check_position(position), check_angle(angle)

    def depth_at(self, points: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
        """Depth of the indentation at `points` (…, 2), metres."""
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        local = (np.asarray(points) - self.position) @ np.array([[cos, -sin], [sin, cos]])
        return np.maximum(self.depth - self.indenter.gap(local), 0.0)


class IndentDraws(eqx.Module):
    """Touches of one to `at_once` indents, drawn as `PressDraws` draws presses, with a `depth`, least and greatest,
    metres, its logarithm uniform, in place of a load."""

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
        """Raises `ValueError` as `PressDraws` does, and for depths that are no metres."""
        for one in depth:
            check_metres("depth", one, 0.1, "any skin is thick")
        # Loads in newtons of the presses are depths in metres here.
        self.presses = PressDraws(indenters, outline, depth, margin=margin, at_once=at_once)

    @property
    def depth(self) -> tuple[float, float]:
        """Least and greatest depth, metres."""
        return self.presses.load

    def draw(self, key: Array, number: int) -> list[tuple[Indent, ...]]:
        """Draw `number` touches. Raises `ValueError` for what is no key, and no number."""
        drawn = self.presses.draw(key, number)
        return [tuple(Indent(one.indenter, one.load, one.position, one.angle) for one in touch) for touch in drawn]


def depth_maps(
    touches: Sequence[Sequence[Indent]], places: Float[np.ndarray, "*shape 2"]
) -> Float[np.ndarray, "n *shape"]:
    """Indentation depth of each of n touches at `places` (…, 2), metres: the deepest of its indents there."""
    maps = np.zeros((len(touches), *places.shape[:-1]))
    for number, touch in enumerate(touches):
        for indent in touch:
            maps[number] = np.maximum(maps[number], indent.depth_at(places))
    return maps


def indented_cells(skin: Skin, touches: Sequence[Sequence[Indent]]) -> TouchedCells:
    """Changes of a skin's cells by n touches: nothing conducts where it is indented (Park et al. 2022, text S4).

    In a layer every cell loses the share of it that is indented; in a sheet, the share of its thickness. Raises
    `ValueError` for indents as deep as the skin.
    """
    check_kind("skin", skin, Skin, "a Skin, as of Skin.create(named_layout('park-inner'))")
    mesh, thickness = skin.model.mesh, float(skin.thickness)
    deepest = max((one.depth for touch in touches for one in touch), default=0.0)
    if deepest >= thickness:
        raise ValueError(
            f"depth is {1e3 * deepest:.3g} mm, and the skin {1e3 * thickness:.3g} mm thick; indent it less."
        )
    samples = lattice(np.asarray(mesh.points)[np.asarray(mesh.cells)], _LATTICE)
    below = samples[..., 2].max() - samples[..., 2] if skin.num_layers else None
    middles = np.asarray(centroids(mesh))[:, :2]
    radius = float(np.linalg.norm(samples[..., :2] - middles[:, None], axis=-1).max())
    tree = KDTree(middles)
    rows, changes = [], []
    for touch in touches:
        near = [tree.query_ball_point(one.position, one.indenter.reach + radius) for one in touch]
        cells = np.unique(np.concatenate([np.zeros(1, int), *(np.asarray(one, int) for one in near)]))
        depth = depth_maps([touch], samples[cells, :, :2])[0]
        if below is None:
            share = np.minimum(depth.mean(axis=1) / thickness, 1 - _LEAST)
        else:
            share = (depth > below[cells]).mean(axis=1)
        kept = share > 0
        rows.append(cells[kept])
        changes.append(-share[kept])
    cells, there = padded(rows)
    change = np.zeros(cells.shape)
    change[there] = np.concatenate(changes)
    places = np.array([touch[0].position if touch else np.zeros(2) for touch in touches])
    return TouchedCells(as_array(places), as_array(cells), as_array(change), mesh.num_cells)


def relative_changes(
    skin: Skin, touches: Sequence[Sequence[Indent]], resting: RestingSkin | None = None
) -> Float[np.ndarray, "n M"]:
    """Exact changes (n, M) of a skin's voltages by n touches, relative to those at rest, see `relative_to`.

    `resting`: the same skin at rest, as of `resting_skin`, which many calls may share. Raises `ValueError` as
    `indented_cells` does.
    """
    touched = indented_cells(skin, touches)
    if resting is not None:
        rest = np.asarray(resting.rest)
        return relative_to(rest, rest + resting.changes(touched))
    # The material's gains and noise apply to its readings only; these voltages are the model's own.
    pressed = PressedSkin(jax.random.key(0), skin.model, material("hydrogel"), conductivity=skin.model_conductivity)
    rest = np.asarray(skin.model.voltages(skin.model_conductivity))
    return relative_to(rest, pressed.voltages_under(touched))


def resting_skin(skin: Skin, depth: float) -> RestingSkin | None:
    """Prepare a skin at rest, for indents up to a `depth`, metres; None where it would take too much memory."""
    mesh = skin.model.mesh
    touchable = np.ones(mesh.num_points, bool)
    if skin.num_layers:
        height = lattice(np.asarray(mesh.points)[np.asarray(mesh.cells)], _LATTICE)[..., 2]
        touchable[:] = False
        touchable[np.asarray(mesh.cells)[(height.max() - height < depth).any(axis=1)]] = True
    return RestingSkin.create(skin.model, skin.model_conductivity, touchable)


def relative_to(reference: Float[np.ndarray, " M"], voltages: Float[np.ndarray, "n M"]) -> Float[np.ndarray, "n M"]:
    """Changes (n, M) relative to a reference, volts, channel by channel.

    Channels that read next to nothing at rest are relative to a thousandth of the greatest.
    """
    size = np.abs(reference)
    return (voltages - reference) / np.maximum(size, _FLOOR * size.max())
