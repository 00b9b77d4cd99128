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
    refined_surface = surface if isinstance(surface, Triangles) else Triangles.of(surface, face)
    while len(refined_surface.points) < min(_MIN_NODES_PER_POSITION * number, _MAX_REFINED_NODES):
        refined_surface = refined_surface.finer()
    node_weights = refined_surface.node_areas * (refined_surface.distance_to_border(refined_surface.points) >= margin)
    usable_nodes = np.flatnonzero(node_weights > 0)
    if len(usable_nodes) < number:
        raise ValueError(f"margin: {1e3 * margin:g} mm leaves no room for {number} electrodes on the surface.")
    geodesics = Geodesics.create(refined_surface)
    electrode_positions = refined_surface.points[_initial_nodes(geodesics, usable_nodes, node_weights, number)]
    for _ in range(iterations):
        nearest_electrodes = (
            geodesics.owners(electrode_positions)[0]
            if number <= _MAX_GEODESIC_POSITIONS
            else _nearest_positions(refined_surface, electrode_positions)
        )[usable_nodes]
        position_weights = np.bincount(nearest_electrodes, node_weights[usable_nodes], number)
        centroid_sums = np.stack(
            [
                np.bincount(nearest_electrodes, node_weights[usable_nodes] * x, number)
                for x in refined_surface.points[usable_nodes].T
            ],
            axis=1,
        )
        moved_positions = np.where(
            position_weights[:, None] > 0,
            centroid_sums / np.maximum(position_weights, 1e-300)[:, None],
            electrode_positions,
        )
        moved_positions = refined_surface.nearest(moved_positions).points
        is_converged = np.linalg.norm(moved_positions - electrode_positions, axis=1).max() < 1e-3 * np.sqrt(
            node_weights.sum() / number
        )
        electrode_positions = moved_positions
        if is_converged:
            break
    return electrode_positions


def _nearest_positions(triangles: Triangles, electrode_positions: Float[np.ndarray, "L 3"]) -> np.ndarray:
    """Index of the position nearest to each node, according to the distance in space and the difference of the
    normals."""
    half_spacing = 0.5 * np.sqrt(triangles.areas.sum() / len(electrode_positions))
    scaled_normals = half_spacing * triangles.normals[triangles.nearest(electrode_positions).triangle]
    position_tree = KDTree(np.hstack([electrode_positions, scaled_normals]))
    return np.asarray(position_tree.query(np.hstack([triangles.points, half_spacing * triangles.node_normals]))[1])


def _initial_nodes(
    geodesics: Geodesics, usable_nodes: np.ndarray, node_weights: np.ndarray, num_nodes: int
) -> np.ndarray:
    """Indices of `num_nodes` nodes with which Lloyd's algorithm starts: by farthest-point sampling or, for many
    positions, drawn at random with probabilities proportional to their areas."""
    if num_nodes > _MAX_GEODESIC_POSITIONS:
        node_probabilities = node_weights[usable_nodes] / node_weights.sum()
        return np.random.default_rng(0).choice(usable_nodes, num_nodes, replace=False, p=node_probabilities)
    node_positions = geodesics.surface.points
    # The first node is the node farthest from the centroid, so that the result depends on the surface only.
    surface_centroid = np.average(node_positions[usable_nodes], axis=0, weights=node_weights[usable_nodes])
    start_nodes = [
        usable_nodes[np.linalg.norm(node_positions[usable_nodes] - surface_centroid, axis=1).round(9).argmax()]
    ]
    node_distances = geodesics.distances(node_positions[start_nodes[:1]])[0]
    while len(start_nodes) < num_nodes:
        start_nodes.append(usable_nodes[node_distances[usable_nodes].argmax()])
        max_distance = float(node_distances[usable_nodes].max())
        node_distances = np.minimum(
            node_distances, geodesics.distances(node_positions[start_nodes[-1:]], limit=max_distance)[0]
        )
    return np.array(start_nodes)


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
        num_electrodes = len(self.centres)
        self.diameters = as_electrode_values("diameters", diameters, num_electrodes, unit="metres")
        self.contact_impedance = (
            None
            if contact_impedance is None
            else as_electrode_values("contact_impedance", contact_impedance, num_electrodes, unit="ohm·m²")
        )
        self.surface, self.outward = surface, bool(outward)
        self.labels = check_labels(labels, num_electrodes)
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
        edge_distance = margin + float(np.max(np.asarray(diameters, float))) / 2
        spread_centres = spread(surface, number, margin=edge_distance)
        layout_options = {"contact_impedance": contact_impedance, "outward": outward, "name": name}
        return cls(spread_centres, diameters, surface, **layout_options)

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
        disc_impedance = self.contact_impedance if contact_impedance is None else contact_impedance
        if disc_impedance is None:
            raise ValueError(f"contact_impedance: '{self.name}' does not say it; give it in ohm·m².")
        return (SurfaceDiscs if sheet else FaceDiscs)(self.centres, self.diameters / 2, disc_impedance)


def _check_no_overlap(electrode_centres: np.ndarray, diameters: np.ndarray, labels: Sequence[str]) -> None:
    """Raise `ValueError` for discs that overlap. Straight-line distances are used, since for discs that overlap they
    hardly differ from distances along the surface."""
    electrode_gaps = (
        np.linalg.norm(electrode_centres[:, None] - electrode_centres, axis=-1) - (diameters[:, None] + diameters) / 2
    )
    np.fill_diagonal(electrode_gaps, np.inf)
    if electrode_gaps.min() < -_OVERLAP_TOLERANCE:
        first_electrode, second_electrode = map(int, np.unravel_index(electrode_gaps.argmin(), electrode_gaps.shape))
        raise ValueError(
            f"centres: electrode {first_electrode + 1} ('{labels[first_electrode]}') and electrode "
            f"{second_electrode + 1} ('{labels[second_electrode]}') overlap by "
            f"{-1e3 * electrode_gaps.min():.3g} mm; remove one or move them apart."
        )


def check_layout(name: str, layout) -> None:
    """Raise `ValueError`, about the argument `name`, unless `layout` is a `Layout` or `SurfaceLayout`."""
    check_kind(name, layout, (Layout, SurfaceLayout), "a Layout, as of named_layout('park-inner') or read_layout(path)")


def flat_layout(layout: Layout | SurfaceLayout) -> Layout:
    """Return the layout of a flat skin unchanged. Raises `ValueError` for the layout of a curved skin."""
    if isinstance(layout, SurfaceLayout):
        raise ValueError(f"layout: '{layout.name}' is of a curved skin, and this is of flat ones; unroll it first.")
    return layout
