"""Layouts on surfaces in space, and electrodes spread evenly over them."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.arguments import check_kind
from jeit.electrodes import FaceDiscs, SurfaceDiscs
from jeit.electrodes.discs import check_on_surface
from jeit.electrodes.electrodes import as_electrode_values, as_positions
from jeit.layout.layout import Layout, check_labels, check_size
from jeit.layout.names import check_count
from jeit.mesh import Mesh
from jeit.mesh.geodesic import Geodesics, Triangles
from jeit_solvers.engines import as_array, has_values

# Nodes that each place is to have round it; more are made by halving triangles.
_NODES = 30
# Halved no further than this many nodes.
_MOST = 60_000
# More places than this lie so near each other that ways between them are nearly straight: the nearest is found by
# distance in space, and by the side that it faces.
_BY_WAYS = 128


def spread(
    surface: Triangles | Mesh,
    number: int,
    *,
    face: str | None = None,
    margin: float = 0.0,
    iterations: int = 20,
) -> Float[np.ndarray, "L 3"]:
    """Positions spread evenly over a surface: (L, 3) metres, on it.

    `quasi_uniform` for surfaces: each position is the middle of the part of the surface that is nearer to it than to
    any other by ways along the surface (Lloyd's algorithm, begun from farthest points). `face`: of a shell, "inner" or
    "outer". `margin`: least distance from the edge, metres. Deterministic. Raises `ValueError` for fewer than one, a
    margin that leaves no room, and as `Triangles.of` does.
    """
    check_count(number, 1)
    triangles = surface if isinstance(surface, Triangles) else Triangles.of(surface, face)
    while len(triangles.points) < min(_NODES * number, _MOST):
        triangles = triangles.finer()
    weight = triangles.node_areas * (triangles.distance_to_border(triangles.points) >= margin)
    usable = np.flatnonzero(weight > 0)
    if len(usable) < number:
        raise ValueError(f"margin: {1e3 * margin:g} mm leaves no room for {number} electrodes on the surface.")
    ways = Geodesics.create(triangles)
    position = triangles.points[_begin(ways, usable, weight, number)]
    for _ in range(iterations):
        owner = (ways.owners(position)[0] if number <= _BY_WAYS else _nearest(triangles, position))[usable]
        own = np.bincount(owner, weight[usable], number)
        middle = np.stack([np.bincount(owner, weight[usable] * x, number) for x in triangles.points[usable].T], axis=1)
        moved = np.where(own[:, None] > 0, middle / np.maximum(own, 1e-300)[:, None], position)
        moved = triangles.nearest(moved).points
        settled = np.linalg.norm(moved - position, axis=1).max() < 1e-3 * np.sqrt(weight.sum() / number)
        position = moved
        if settled:
            break
    return position


def _nearest(triangles: Triangles, position: Float[np.ndarray, "L 3"]) -> np.ndarray:
    """Nearest position of each node, by distance in space and by the side that they face."""
    half = 0.5 * np.sqrt(triangles.areas.sum() / len(position))
    facing = half * triangles.normals[triangles.nearest(position).triangle]
    tree = KDTree(np.hstack([position, facing]))
    return np.asarray(tree.query(np.hstack([triangles.points, half * triangles.node_normals]))[1])


def _begin(ways: Geodesics, usable: np.ndarray, weight: np.ndarray, number: int) -> np.ndarray:
    """Nodes to begin with."""
    if number > _BY_WAYS:
        share = weight[usable] / weight.sum()
        return np.random.default_rng(0).choice(usable, number, replace=False, p=share)
    points = ways.surface.points
    # Farthest from the middle: a way to begin that depends on nothing but the surface.
    middle = np.average(points[usable], axis=0, weights=weight[usable])
    chosen = [usable[np.linalg.norm(points[usable] - middle, axis=1).round(9).argmax()]]
    lengths = ways.distances(points[chosen[:1]])[0]
    while len(chosen) < number:
        chosen.append(usable[lengths[usable].argmax()])
        farthest = float(lengths[usable].max())
        lengths = np.minimum(lengths, ways.distances(points[chosen[-1:]], limit=farthest)[0])
    return np.array(chosen)


# Discs may overlap by so much.
_ROUNDING = 1e-9  # m


class SurfaceLayout(eqx.Module):
    """Round electrodes on a surface in space: `Layout` of a curved skin, with the same uses.

    **Fields**

    - `centres`: (L, 3) metres, on the surface.
    - `diameters`: (L,) metres.
    - `contact_impedance`: (L,) ohm·m², or None if it is not known.
    - `surface`: a mesh of triangles in space: a sheet, or the face of a layer that the electrodes are on.
    - `outward`: whether a layer on that surface is outside of it, so that electrodes are on its inner face, the core,
      and touches on its outer one; False where electrodes are on the outer face, and the layer inside.
    - `labels`: (L,) names of the electrodes, all different, on one line each; "1", "2", … if not given.
    - `name`: of the layout, for reports.
    """

    centres: Float[Array, "L 3"]
    diameters: Float[Array, " L"]
    contact_impedance: Float[Array, " L"] | None
    surface: Mesh
    outward: bool = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(
        self,
        centres: ArrayLike,
        diameters: ArrayLike,
        surface: Mesh,
        *,
        contact_impedance: ArrayLike | None = None,
        outward: bool = True,
        labels: Sequence[str] | None = None,
        name: str = "layout",
    ):
        """`diameters` and `contact_impedance` may be one number for all electrodes. Centres are moved to the nearest
        point of the surface, which may not be farther than an electrode's radius.

        Raises `ValueError` for a mesh that is no surface in space, electrodes farther off it, over its edge, as large
        as its radius of curvature, or that overlap, for labels that are not one for each and different, and for a
        surface so small or so large that its lengths cannot be metres.
        """
        check_kind("surface", surface, Mesh, "a surface in space, such as jeit.mesh.tube(0.03, 0.15)")
        if not surface.is_surface:
            raise ValueError("surface is flat or a solid; a Layout is of flat skins, and a shell is made of a surface.")
        self.centres = as_positions(centres, (3,))
        number = len(self.centres)
        self.diameters = as_electrode_values("diameters", diameters, number, unit="metres")
        self.contact_impedance = (
            None
            if contact_impedance is None
            else as_electrode_values("contact_impedance", contact_impedance, number, unit="ohm·m²")
        )
        self.surface, self.outward = surface, bool(outward)
        self.labels = check_labels(labels, number)
        self.name = name
        if has_values(self.centres, self.diameters, surface):
            check_size(float(np.ptp(np.asarray(surface.points), axis=0).max()))
            triangles = Triangles.of(surface)
            check_on_surface(self.centres, self.diameters / 2, triangles)
            self.centres = as_array(triangles.nearest(self.centres).points)
            _check_apart(np.asarray(self.centres), np.asarray(self.diameters), self.labels)

    @classmethod
    def spread(
        cls,
        surface: Mesh,
        number: int,
        diameters: ArrayLike,
        *,
        margin: float = 0.0,
        outward: bool = True,
        contact_impedance: ArrayLike | None = None,
        name: str = "spread",
    ) -> "SurfaceLayout":
        """`number` electrodes spread evenly over a surface by ways along it, as by `jeit.layout.spread`, `margin`
        metres and their own radius from its edge. Raises `ValueError` as that and `SurfaceLayout` do."""
        check_kind("surface", surface, Mesh, "a surface in space, such as jeit.mesh.tube(0.03, 0.15)")
        room = margin + float(np.max(np.asarray(diameters, float))) / 2
        centres = spread(surface, number, margin=room)
        options = {"contact_impedance": contact_impedance, "outward": outward, "name": name}
        return cls(centres, diameters, surface, **options)

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L."""
        return self.centres.shape[0]

    @property
    def face(self) -> str:
        """Face of a layer that electrodes are on: "inner" or "outer"."""
        return "inner" if self.outward else "outer"

    def lengths(self) -> Float[np.ndarray, "L L"]:
        """Lengths of the ways along the surface between the electrodes' centres, metres."""
        return Geodesics.create(self.surface).between(self.centres)

    def discs(self, contact_impedance: ArrayLike | None = None, *, sheet: bool = True) -> SurfaceDiscs | FaceDiscs:
        """The electrodes for a forward model, on the surface as a `sheet` or on a layer of it; `contact_impedance` in
        ohm·m² replaces the layout's. Raises `ValueError` if neither is known."""
        chosen = self.contact_impedance if contact_impedance is None else contact_impedance
        if chosen is None:
            raise ValueError(f"contact_impedance: '{self.name}' does not say it; give it in ohm·m².")
        return (SurfaceDiscs if sheet else FaceDiscs)(self.centres, self.diameters / 2, chosen)


def _check_apart(centres: np.ndarray, diameters: np.ndarray, labels: Sequence[str]) -> None:
    """Straight through space: discs that overlap are so near that it is as good as along the surface."""
    gap = np.linalg.norm(centres[:, None] - centres, axis=-1) - (diameters[:, None] + diameters) / 2
    np.fill_diagonal(gap, np.inf)
    if gap.min() < -_ROUNDING:
        first, second = map(int, np.unravel_index(gap.argmin(), gap.shape))
        raise ValueError(
            f"centres: electrode {first + 1} ('{labels[first]}') and electrode {second + 1} ('{labels[second]}') "
            f"overlap by {-1e3 * gap.min():.3g} mm; remove one or move them apart."
        )


def check_layout(name: str, given) -> None:
    """Raise `ValueError`, about the argument `name`, for what is no `Layout` or `SurfaceLayout`."""
    check_kind(name, given, (Layout, SurfaceLayout), "a Layout, as of named_layout('park-inner') or read_layout(path)")


def flat_layout(layout: Layout | SurfaceLayout) -> Layout:
    """A layout that must be of a flat skin. Raises `ValueError` for another."""
    if isinstance(layout, SurfaceLayout):
        raise ValueError(f"layout: '{layout.name}' is of a curved skin, and this is of flat ones; unroll it first.")
    return layout
