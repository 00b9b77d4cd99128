"""`SurfaceLayout`: round electrodes on a surface in space, and positions spread evenly over a surface."""

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
from jeit_solvers.module import Module

# Minimum number of nodes of a surface per electrode position: a coarser surface is refined by dividing its triangles.
_MIN_NODES_PER_POSITION = 30
# Number of nodes from which the surface is not refined any further.
_MAX_REFINED_NODES = 60_000
# Number of electrode positions above which paths between neighbouring positions are nearly straight: the nearest
# position is then found by the distance in space and the direction of the normal.
_MAX_GEODESIC_POSITIONS = 128


def spread(
    surface: Triangles | Mesh,
    number: int,
    *,
    face: str | None = None,
    margin: float = 0.0,
    iterations: int = 20,
) -> Float[np.ndarray, "L 3"]:
    """Positions on a surface, spread evenly over it: (L, 3) metres.

    The counterpart of `quasi_uniform` for surfaces: each position is the centroid of the part of the surface that is
    closer, along the surface, to this position than to any other. The positions are computed by Lloyd's algorithm,
    starting from farthest-point sampling, and are deterministic.

    **Arguments:**

    - `surface`: a surface in space, its triangles, or a shell.
    - `number`: number of positions L.
    - `face`: face of a shell, "inner" or "outer".
    - `margin`: minimum distance of positions from the edge of the surface, metres.
    - `iterations`: maximum number of iterations.

    Raises `ValueError` for fewer than one position, a margin that leaves no room for electrodes, and as `Triangles.of`
    does.

    **Example:**

    ```python
    positions = spread(sleeve, 12, margin=0.005)
    ```
    """
    check_count(number, 1)
    triangles = surface if isinstance(surface, Triangles) else Triangles.of(surface, face)
    while len(triangles.points) < min(_MIN_NODES_PER_POSITION * number, _MAX_REFINED_NODES):
        triangles = triangles.finer()
    weight = triangles.node_areas * (triangles.distance_to_border(triangles.points) >= margin)
    usable = np.flatnonzero(weight > 0)
    if len(usable) < number:
        raise ValueError(f"margin: {1e3 * margin:g} mm leaves no room for {number} electrodes on the surface.")
    geodesics = Geodesics.create(triangles)
    position = triangles.points[_initial_nodes(geodesics, usable, weight, number)]
    for _ in range(iterations):
        nearest_electrodes = (
            geodesics.owners(position)[0]
            if number <= _MAX_GEODESIC_POSITIONS
            else _nearest_positions(triangles, position)
        )[usable]
        position_weights = np.bincount(nearest_electrodes, weight[usable], number)
        centroid_sums = np.stack(
            [np.bincount(nearest_electrodes, weight[usable] * x, number) for x in triangles.points[usable].T], axis=1
        )
        new_positions = np.where(
            position_weights[:, None] > 0, centroid_sums / np.maximum(position_weights, 1e-300)[:, None], position
        )
        new_positions = triangles.nearest(new_positions).points
        is_converged = np.linalg.norm(new_positions - position, axis=1).max() < 1e-3 * np.sqrt(weight.sum() / number)
        position = new_positions
        if is_converged:
            break
    return position


def _nearest_positions(triangles: Triangles, position: Float[np.ndarray, "L 3"]) -> np.ndarray:
    """Index of the position nearest to each node, according to the distance in space and the difference of the
    normals."""
    half_spacing = 0.5 * np.sqrt(triangles.areas.sum() / len(position))
    scaled_normals = half_spacing * triangles.normals[triangles.nearest(position).triangle]
    tree = KDTree(np.hstack([position, scaled_normals]))
    return np.asarray(tree.query(np.hstack([triangles.points, half_spacing * triangles.node_normals]))[1])


def _initial_nodes(geodesics: Geodesics, usable: np.ndarray, weight: np.ndarray, number: int) -> np.ndarray:
    """Indices of `number` nodes with which Lloyd's algorithm starts: by farthest-point sampling or, for many positions,
    drawn at random with probabilities proportional to their areas."""
    if number > _MAX_GEODESIC_POSITIONS:
        probabilities = weight[usable] / weight.sum()
        return np.random.default_rng(0).choice(usable, number, replace=False, p=probabilities)
    points = geodesics.surface.points
    # The first node is the node farthest from the centroid, so that the result depends on the surface only.
    centroid = np.average(points[usable], axis=0, weights=weight[usable])
    nodes = [usable[np.linalg.norm(points[usable] - centroid, axis=1).round(9).argmax()]]
    distances = geodesics.distances(points[nodes[:1]])[0]
    while len(nodes) < number:
        nodes.append(usable[distances[usable].argmax()])
        max_distance = float(distances[usable].max())
        distances = np.minimum(distances, geodesics.distances(points[nodes[-1:]], limit=max_distance)[0])
    return np.array(nodes)


# Overlap of two discs that is tolerated.
_OVERLAP_TOLERANCE = 1e-9  # m


class SurfaceLayout(Module):
    """Round electrodes on a surface in space: the counterpart of `Layout` for a curved skin.

    **Fields**

    - `centres`: centres of the electrodes on the surface (L, 3), metres.
    - `diameters`: diameters (L,), metres.
    - `contact_impedance`: contact impedances (L,), ohm·m², or None if not known.
    - `surface`: a mesh of triangles in space: the sheet itself, or the face of a layer that carries the electrodes.
    - `outward`: whether a layer extends outwards from the surface, so that electrodes are on its inner face and touches
      on its outer face. If False, it extends inwards, and electrodes are on its outer face.
    - `labels`: labels of the electrodes (L,), all different and on one line each; by default "1", "2", …
    - `name`: name of the layout, for reports.

    **Example:**

    ```python
    layout = SurfaceLayout([[0.04, 0.0, 0.02], [-0.04, 0.0, 0.08]], 0.01, sleeve)
    layout.lengths, layout.discs(contact_impedance=1e-4)
    ```
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
        """`diameters` and `contact_impedance` may be one value for all electrodes. Centres are moved to the nearest
        point of the surface, which must be within the radius of the electrode.

        Raises `ValueError` for a mesh that is not a surface in space; for electrodes that are farther from the surface
        than their radius, extend beyond the edge of the surface, are as large as its radius of curvature, or overlap;
        if labels are repeated or not one for each electrode; and for a surface so small or so large that its lengths
        cannot be in metres.
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
            _check_no_overlap(np.asarray(self.centres), np.asarray(self.diameters), self.labels)

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
        """Create a layout of `number` electrodes spread evenly over a surface, as by `jeit.layout.spread`.

        `diameters`: diameters of the electrodes, metres; `margin`: minimum distance of their rims from the edge of the
        surface, metres; other arguments as in `SurfaceLayout`. Raises `ValueError` as `jeit.layout.spread` and
        `SurfaceLayout` do.
        """
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
        """Face of a layer that carries the electrodes: "inner" or "outer"."""
        return "inner" if self.outward else "outer"

    def lengths(self) -> Float[np.ndarray, "L L"]:
        """Distances (L, L) between the centres of the electrodes along the surface, metres."""
        return Geodesics.create(self.surface).between(self.centres)

    def discs(self, contact_impedance: ArrayLike | None = None, *, sheet: bool = True) -> SurfaceDiscs | FaceDiscs:
        """Create the electrodes for a forward model of the surface as a sheet if `sheet` is True, otherwise of a layer
        on the surface.

        `contact_impedance`: contact impedance, ohm·m², by default the layout's. Raises `ValueError` if the contact
        impedance is neither specified nor known from the layout.
        """
        impedance = self.contact_impedance if contact_impedance is None else contact_impedance
        if impedance is None:
            raise ValueError(f"contact_impedance: '{self.name}' does not say it; give it in ohm·m².")
        return (SurfaceDiscs if sheet else FaceDiscs)(self.centres, self.diameters / 2, impedance)


def _check_no_overlap(centres: np.ndarray, diameters: np.ndarray, labels: Sequence[str]) -> None:
    """Raise `ValueError` for discs that overlap. Straight-line distances are used, since for discs that overlap they
    hardly differ from distances along the surface."""
    gaps = np.linalg.norm(centres[:, None] - centres, axis=-1) - (diameters[:, None] + diameters) / 2
    np.fill_diagonal(gaps, np.inf)
    if gaps.min() < -_OVERLAP_TOLERANCE:
        first_electrode, second_electrode = map(int, np.unravel_index(gaps.argmin(), gaps.shape))
        raise ValueError(
            f"centres: electrode {first_electrode + 1} ('{labels[first_electrode]}') and electrode "
            f"{second_electrode + 1} ('{labels[second_electrode]}') overlap by "
            f"{-1e3 * gaps.min():.3g} mm; remove one or move them apart."
        )


def check_layout(name: str, layout) -> None:
    """Raise `ValueError`, about the argument `name`, unless `layout` is a `Layout` or `SurfaceLayout`."""
    check_kind(name, layout, (Layout, SurfaceLayout), "a Layout, as of named_layout('park-inner') or read_layout(path)")


def flat_layout(layout: Layout | SurfaceLayout) -> Layout:
    """Return the layout of a flat skin unchanged. Raises `ValueError` for the layout of a curved skin."""
    if isinstance(layout, SurfaceLayout):
        raise ValueError(f"layout: '{layout.name}' is of a curved skin, and this is of flat ones; unroll it first.")
    return layout
