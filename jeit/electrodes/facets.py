"""Electrodes that consist of boundary facets, directions of the facets, and integrals over the part of a triangle that
a rectangle covers.

The integrals of P1 functions over the intersection of a triangle and a rectangle are exact, and differentiable in the
coordinates of triangle and rectangle.

The triangle is clipped by moving the parts beyond a side of the rectangle onto the line of that side. The outline
remains closed: it surrounds the intersection once and otherwise runs back and forth along the side, which contributes
nothing. Every triangle thus becomes a polygon with the same number of corners, which fit into one array, and the
integrals follow from the corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.electrodes.electrodes import (
    AbstractCompleteElectrodes,
    Contact,
    ElectrodePen,
    as_electrode_values,
    replace_contact_impedance,
)
from jeit.mesh import Body, Mesh, Refine
from jeit.mesh.mesh import facet_measures
from jeit_solvers.engines import has_values, namespace, sum_into, undifferentiated, values_at_once

# Covered fraction of a triangle below which the fraction counts as zero: such a fraction has few correct digits, and
# its errors would be amplified by small contact impedances.
_MIN_COVERED_FRACTION = 1e-12


def facet_normals(mesh: Mesh) -> Float[Array, "b 3"]:
    """Outward unit normals of the boundary triangles of a 3-D mesh."""
    corners = mesh.points[mesh.facets]
    xp = namespace(corners)
    normal = xp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / xp.linalg.norm(normal, axis=1, keepdims=True)


def is_undistorted_from_above(mesh: Mesh, position: Float[Array, "L d"]) -> Bool[np.ndarray, " L"]:
    """Whether the surface at each position appears undistorted from above: in a sheet, and on horizontal faces."""
    if mesh.dimension == 2:
        return np.ones(len(position), bool)
    centres, normals = np.asarray(mesh.points)[np.asarray(mesh.facets)].mean(axis=1), np.asarray(facet_normals(mesh))
    return np.abs(normals[KDTree(centres).query(np.asarray(position))[1], 2]) > 0.9


def same_face(mesh: Mesh, position: Float[Array, "L 3"], radius: Float[Array, " L"]) -> Float[Array, "b L"]:
    """Matrix (b, L): 1 if boundary triangle b may lie on the same flat or curved face as electrode L, also if that face
    continues around an edge of the body, otherwise 0.

    The matrix prevents an electrode on a thin layer from reaching through to the opposite face. On a face with radius
    of curvature R, the plane of a triangle at the rim of a disc of radius r passes r² / 2R from the disc's centre and
    is rotated by 2 arcsin(r / 2R); for r = R the distance is r / 2 and the angle 60°. The matrix has no derivatives.
    """
    normal, corner = facet_normals(mesh), mesh.points[mesh.facets[:, 0]]
    height_above_facet = abs(normal @ position.T - (normal * corner).sum(axis=1)[:, None])
    # Near an edge of the body the nearest triangle may lie on the adjacent face; its plane, however, is far from the
    # position.
    facet_below_electrode = nearest_facets(mesh, position, 100 * height_above_facet.T**2)
    normal_cosine = normal @ normal[facet_below_electrode].T
    is_on_curved_face = (height_above_facet < 0.55 * radius) & (normal_cosine > 0.45)
    return undifferentiated((height_above_facet < 0.2 * radius) & (normal_cosine > -0.5) | is_on_curved_face).astype(
        position.dtype
    )


def nearest_facets(
    mesh: Mesh, position: Float[Array, "L 3"], added_distance: Float[Array, "L b"] | float = 0.0
) -> Int[Array, " L"]:
    """Index of the boundary triangle whose centroid is nearest to each position; the first of equally near triangles.

    `added_distance` (L, b): m², added to the squared distances to disfavour some triangles.
    """
    xp = namespace(mesh, position)
    centres = mesh.points[mesh.facets].mean(axis=1)
    squared_distances = xp.sum((position[:, None] - centres) ** 2, axis=-1) + added_distance
    # A tolerance for ties, so that the result does not depend on rounding in the unit of length.
    return xp.argmax(squared_distances <= (1 + 1e-9) * squared_distances.min(axis=1, keepdims=True), axis=1)


def tangent_frames(mesh: Mesh, position):
    """Unit vectors (L, 3) at each electrode: normal of the nearest facet, horizontal and upward direction. The vectors
    have no derivatives."""
    xp = namespace(mesh, position)
    normal = facet_normals(mesh)[nearest_facets(mesh, position)]
    is_horizontal = abs(normal[:, 2:]) > 0.9
    upward_direction = xp.where(is_horizontal, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])).astype(
        normal.dtype
    )
    tangent = xp.cross(upward_direction, normal)
    tangent = tangent / xp.linalg.norm(tangent, axis=1, keepdims=True)
    return tuple(map(undifferentiated, (normal, tangent, xp.cross(normal, tangent))))


def covered_moments(
    corners: Float[Array, "*q 3 2"], half_size: Float[Array, "*q 2"]
) -> tuple[Float[Array, "*q 3"], Float[Array, "*q 3 3"]]:
    """∫φ_i and ∫φ_iφ_j over the part of triangles within rectangles |x| ≤ a, |y| ≤ b, relative to the area of the
    triangle.

    `corners`: corners of the triangles in the coordinates of the rectangle, metres; `half_size`: (a, b), metres.
    Results for triangles of zero area are meaningless.
    """
    if namespace(corners, half_size) is not np:
        return _clipped_moments(corners, half_size)
    half_size_limits = np.broadcast_to(half_size, (*corners.shape[:-2], 2))[..., None, :]
    is_wholly_covered = (abs(corners) <= half_size_limits).all(axis=(-1, -2))
    is_beyond_a_side = ((corners >= half_size_limits).all(axis=-2) | (corners <= -half_size_limits).all(axis=-2)).any(
        axis=-1
    )
    mass: Any = np.where(is_wholly_covered[..., None, None], (1 + np.eye(3)) / 12, 0).astype(corners.dtype)
    is_partly_covered = ~(is_wholly_covered | is_beyond_a_side)
    mass[is_partly_covered] = _clipped_moments(
        corners[is_partly_covered], half_size_limits[is_partly_covered][..., 0, :]
    )[1]
    return mass.sum(axis=-1), mass


def _clipped_moments(corners, half_size):
    """Results of `covered_moments`, by clipping every triangle to its rectangle."""
    xp = namespace(corners, half_size)
    clipped_outline = corners
    for axis in range(2):
        clipped_outline = _clip_to_band(clipped_outline, axis, half_size[..., axis])
    # Barycentric coordinates of the second and third corner, in which the triangle is (0, 0), (1, 0), (0, 1).
    first_sides, second_sides = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    offset_from_corner = clipped_outline - corners[..., :1, :]
    double_area = _cross_product(first_sides, second_sides)[..., None]
    triangle_coordinates = xp.stack(
        [
            _cross_product(offset_from_corner, second_sides[..., None, :]),
            _cross_product(first_sides[..., None, :], offset_from_corner),
        ],
        axis=-1,
    )
    triangle_coordinates = triangle_coordinates / double_area[..., None]
    next_coordinates = xp.roll(triangle_coordinates, -1, axis=-2)
    # Signed areas of a fan of triangles from the first corner, doubled, since the area of the reference triangle is
    # 1/2.
    fan_areas = _cross_product(triangle_coordinates, next_coordinates)
    barycentric_coordinates = [
        xp.concatenate([1 - outline_points.sum(axis=-1, keepdims=True), outline_points], axis=-1)
        for outline_points in (triangle_coordinates, next_coordinates)
    ]
    barycentric_sum = (
        barycentric_coordinates[0]
        + barycentric_coordinates[1]
        + np.array([1.0, 0.0, 0.0]).astype(triangle_coordinates.dtype)
    )
    mass = sum(
        xp.einsum("...k,...ki,...kj->...ij", fan_areas, outline_points, outline_points)
        for outline_points in (barycentric_sum, *barycentric_coordinates)
    )
    corner = np.zeros((3, 3))
    corner[0, 0] = 1
    mass = (mass + fan_areas.sum(axis=-1)[..., None, None] * corner.astype(triangle_coordinates.dtype)) / 12
    # For triangles that are barely touched, only rounding errors remain, which small contact impedances would amplify:
    # set the value to zero, but keep its derivative. The load is computed as the sum of the mass, since for small
    # contact impedances any difference between load and mass would drive currents.
    mass = mass - undifferentiated(xp.where(mass.sum(axis=(-1, -2), keepdims=True) > _MIN_COVERED_FRACTION, 0, mass))
    mass = (mass + xp.swapaxes(mass, -1, -2)) / 2
    return mass.sum(axis=-1), mass


def _clip_to_band(outline: Float[Array, "*q k 2"], axis: int, half_width: Float[Array, "*q"]) -> Float[Array, "*q l 2"]:
    """Move the parts of closed polygons (…, k, 2) beyond ± `half_width` along an axis to ± `half_width`; each corner
    becomes three."""
    xp = namespace(outline, half_width)
    outline_sides = xp.roll(outline, -1, axis=-2) - outline
    axis_steps, half_width = outline_sides[..., axis], half_width[..., None]
    nonzero_axis_steps = xp.where(axis_steps == 0, 1, axis_steps)
    crossing_fractions = [
        xp.clip((band_sign * half_width - outline[..., axis]) / nonzero_axis_steps, 0, 1) for band_sign in (-1, 1)
    ]
    crossing_fractions_in_order = xp.stack(
        [xp.zeros_like(axis_steps), xp.minimum(*crossing_fractions), xp.maximum(*crossing_fractions)], axis=-1
    )
    corners = outline[..., None, :] + crossing_fractions_in_order[..., None] * outline_sides[..., None, :]
    corners = corners.reshape(*corners.shape[:-3], 3 * corners.shape[-3], 2)  # also if there are no triangles
    clipped_coordinates = xp.clip(corners[..., axis], -half_width, half_width)
    other_coordinate = corners[..., 1 - axis]
    return xp.stack(
        [clipped_coordinates, other_coordinate] if axis == 0 else [other_coordinate, clipped_coordinates], axis=-1
    )


def _cross_product(first_vectors: Float[Array, "*q 2"], second_vectors: Float[Array, "*q 2"]) -> Float[Array, "*q"]:
    return first_vectors[..., 0] * second_vectors[..., 1] - first_vectors[..., 1] * second_vectors[..., 0]


class FacetElectrodes(AbstractCompleteElectrodes):
    """Complete electrodes that cover whole boundary facets of a mesh; their contact integrals are exact.

    **Arguments:** `mesh`: the mesh; `facets`: for each electrode, the indices of its boundary facets;
    `contact_impedance`: one number or (L,), ohm·m² (ohm·m in 2-D). **Fields**: `covers` (b, L): 1 where electrode l
    covers boundary facet f, otherwise 0; `contact_impedance` (L,): ohm·m² (ohm·m in 2-D). Create them from facet
    indices, from tags (`plates`), or from nodes (`electrodes_from_nodes`).

    **Example:**

    ```python
    electrodes = FacetElectrodes(mesh, [[0, 1], [10, 11]], contact_impedance=1e-3)
    ```
    """

    covers: Float[Array, "b L"]
    contact_impedance: Float[Array, " L"]

    def __init__(self, mesh: Mesh, facets: Sequence, contact_impedance: ArrayLike):
        """`facets`: for each electrode, the indices into `mesh.facets` of the facets that it covers. Raises
        `ValueError` for invalid indices and overlapping electrodes."""
        if not facets:
            raise ValueError("facets is empty; give one list of facet indices for each electrode.")
        num_facets = mesh.facets.shape[0]
        covered_fractions = np.zeros((num_facets, len(facets)))
        for electrode, indices in enumerate(facets):
            indices = np.asarray(indices)
            if indices.size == 0 or not np.issubdtype(indices.dtype, np.integer):
                raise ValueError(f"facets: electrode {electrode + 1} has no facets; give integer facet indices.")
            if indices.min() < 0 or indices.max() >= num_facets:
                raise ValueError(
                    f"facets: electrode {electrode + 1} names facet {int(indices.max())}, and the mesh has "
                    f"{num_facets} boundary facets, counted from 0."
                )
            covered_fractions[indices, electrode] = 1
        shared_facets = np.flatnonzero(covered_fractions.sum(axis=1) > 1)
        if shared_facets.size:
            first_electrode, second_electrode = np.flatnonzero(covered_fractions[shared_facets[0]])[:2] + 1
            raise ValueError(
                f"Electrodes {first_electrode} and {second_electrode} overlap: both cover boundary facet "
                f"{shared_facets[0]}."
            )
        self.covers = jnp.asarray(covered_fractions)
        self.contact_impedance = as_electrode_values(
            "contact_impedance", contact_impedance, len(facets), unit="ohm·m² (ohm·m in 2-D)"
        )

    def with_contact_impedance(self, contact_impedance: ArrayLike) -> AbstractCompleteElectrodes:
        """Copy of the electrodes with new contact impedances, ohm·m² (ohm·m in 2-D). Raises `ValueError` for values
        that are not positive."""
        return replace_contact_impedance(self, contact_impedance)

    def geometry(self) -> dict[str, Array]:
        """Empty: the electrodes are defined by facets of a mesh."""
        return {}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Draw the facets of a plane mesh; for a solid, a dot in the middle of each electrode."""
        end_points, covered_fractions = np.asarray(mesh.points)[np.asarray(mesh.facets)], np.asarray(self.covers)
        centres = covered_fractions.T @ end_points.mean(axis=1) / covered_fractions.sum(axis=0)[:, None]
        for fractions_of_electrode, centre in zip(covered_fractions.T, centres, strict=True):
            if mesh.dimension == 2:
                pen.lines(list(end_points[fractions_of_electrode > 0]), centre)
            else:
                pen.dot(centre)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Empty, because the electrodes belong to an existing mesh."""
        return ()

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """Nodes of the boundary facets of `mesh`."""
        return (mesh.facets,)

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals over whole facets f with d nodes: ∫φ_i = |f| / d, ∫φ_iφ_j = |f| (1 + δ_ij) / (d (d +
        1))."""
        xp = namespace(self, mesh)
        d = mesh.dimension
        facet_measure = facet_measures(mesh)
        admittance_per_area = self.covers / self.contact_impedance  # (b, L)
        unit_mass_matrix = (np.ones((d, d)) + np.eye(d)).astype(facet_measure.dtype) / (d * (d + 1))
        mass = (facet_measure * admittance_per_area.sum(axis=1))[:, None, None] * unit_mass_matrix
        current = (facet_measure[:, None] * admittance_per_area / d)[:, None, :]
        load_shape = mesh.num_points, self.num_electrodes
        load = sum_into(load_shape, mesh.facets, xp.broadcast_to(current, (*mesh.facets.shape, load_shape[1])))
        return Contact((mesh.facets,), (mass,), load)

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` if the electrodes were created for a mesh with a different number of boundary facets than
        `mesh`."""
        if self.covers.shape[0] != mesh.facets.shape[0]:
            raise ValueError(
                f"These electrodes were made for a mesh of {self.covers.shape[0]} boundary facets, and this one has "
                f"{mesh.facets.shape[0]}; build them again from this mesh."
            )


def plates(mesh: Mesh, tags: Sequence[str], contact_impedance: ArrayLike) -> FacetElectrodes:
    """Create electrodes that cover whole tagged faces of a mesh.

    **Arguments:**

    - `mesh`: the mesh.
    - `tags`: names in `mesh.tags`, one for each electrode.
    - `contact_impedance`: one number or (L,), ohm·m² (2-D: ohm·m).

    Raises `ValueError` for an unknown name.

    **Example:**

    ```python
    electrodes = plates(solid, ["left", "right"], 0.01)
    ```
    """
    for surface_tag in tags:
        if surface_tag not in mesh.tags:
            known_tags = ", ".join(sorted(mesh.tags)) or "none"
            surface_hint = " It is a surface, without tetrahedra: mesh the volume within." if mesh.is_surface else ""
            raise ValueError(
                f"The mesh has no facets tagged '{surface_tag}'; its tags are: {known_tags}.{surface_hint}"
            )
    return FacetElectrodes(mesh, [np.asarray(mesh.tags[surface_tag]) for surface_tag in tags], contact_impedance)


def electrodes_from_nodes(mesh: Mesh, nodes: Sequence, contact_impedance: ArrayLike) -> FacetElectrodes:
    """Create complete electrodes from nodes: each electrode covers the boundary facets whose nodes all belong to it.

    For electrodes with one node each use `NodeElectrodes`.

    **Arguments:**

    - `mesh`: the mesh.
    - `nodes`: for each electrode, its node indices, counted from 0.
    - `contact_impedance`: one number or (L,), ohm·m² (ohm·m in 2-D).

    Raises `ValueError` if an electrode covers no facet.

    **Example:**

    ```python
    ends = [sheet.facets[sheet.tags[side]].ravel() for side in ("left", "right")]
    electrodes = electrodes_from_nodes(sheet, ends, 1e-3)
    ```
    """
    if not has_values(mesh.facets):
        raise ValueError("electrodes_from_nodes needs a mesh with values, not one that is being traced.")
    boundary_facets = np.asarray(mesh.facets)
    facets = []
    for electrode, nodes_of_electrode in enumerate(nodes):
        covered_facets = np.flatnonzero(np.isin(boundary_facets, np.asarray(nodes_of_electrode)).all(axis=1))
        if covered_facets.size == 0:
            raise ValueError(
                f"nodes: the {len(nodes_of_electrode)} nodes of electrode {electrode + 1} span no boundary facet; an "
                "electrode of a single node is a point electrode (NodeElectrodes)."
            )
        facets.append(covered_facets)
    return FacetElectrodes(mesh, facets, contact_impedance)
