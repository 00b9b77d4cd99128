"""Electrodes on the edge of a sheet: arcs of the boundary of a 2-D mesh, integrated exactly."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.electrodes.electrodes import (
    AbstractMovableElectrodes,
    Contact,
    ElectrodePen,
    as_electrode_values,
    as_positions,
    check_dimension,
)
from jeit.mesh import Body, Mesh, Refine
from jeit.mesh.mesh import boundary_loops, facet_measures
from jeit.mesh.outline.straight_sided import points_on_loop
from jeit.mesh.topology import project_to_loop
from jeit_solvers.engines import (
    has_values,
    namespace,
    numpy_or_compiled,
    on_host,
    sum_into,
    undifferentiated,
    values_at_once,
)


class BoundaryElectrodes(AbstractMovableElectrodes):
    """Complete electrodes that cover arcs of the boundary of a 2-D mesh, independent of its nodes.

    Electrode l covers the points of the boundary within `width[l]` / 2 of `position[l]`, measured along the boundary
    polygon. The integrals over partly covered edges are polynomials in the two end points of the electrode, so they are
    exact and differentiable in position and width.

    **Fields**: `position` (L, 2): positions of the L electrodes, metres, projected to the nearest boundary edge;
    `width` (L,): metres; `contact_impedance` (L,): ohm·m (for a sheet, the contact impedance in ohm·m² divided by the
    thickness of the sheet).

    **Example:**

    ```python
    electrodes = BoundaryElectrodes(ring(0.1, 16), width=0.01, contact_impedance=1e-3)
    electrodes.check(mesh)
    ```
    """

    position: Float[Array, "L 2"]
    width: Float[Array, " L"]
    contact_impedance: Float[Array, " L"]

    def __init__(self, position: ArrayLike, width: ArrayLike, contact_impedance: ArrayLike):
        """`width` and `contact_impedance` may each be one number for all electrodes. Raises `ValueError` for values
        that are not positive and for positions that are not finite."""
        self.position = as_positions(position, (2,))
        self.width = as_electrode_values("width", width, len(self.position), unit="metres")
        self.contact_impedance = as_electrode_values(
            "contact_impedance", contact_impedance, len(self.position), unit="ohm·m"
        )

    def geometry(self) -> dict[str, Array]:
        """Positions and widths of the electrodes, metres."""
        return {"position": self.position, "width": self.width}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Draw the arcs of the boundary of `mesh` that the electrodes cover."""
        for position, electrode_width in zip(np.asarray(self.position), np.asarray(self.width), strict=True):
            pen.lines([_arc_points(mesh, position, electrode_width)], position)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Refine cells to a quarter of their size at the ends of the electrodes, where the current density is largest
        (unbounded for zero contact impedance z).

        Example: with 32 electrodes that cover a fraction of 0.73 of a disk's boundary, z·σ = 1e-4 radii and 2,000
        nodes, the error of adjacent voltages is 3 %; with cells of half the size at the middles of the electrodes
        instead, the error is 57 %.
        """
        outer_loop = body.loops(720)[0]
        centres, half_width = (
            project_to_loop(np.asarray(self.position), np.asarray(outer_loop)),
            np.asarray(self.width) / 2,
        )
        end_points = points_on_loop(outer_loop, np.concatenate([centres - half_width, centres + half_width]))
        return (Refine(np.asarray(end_points), factor=4.0),)

    def directions(self, mesh: Mesh) -> Float[np.ndarray, "L a 2"]:
        """Unit tangents of the boundary of `mesh` at the electrodes, counter-clockwise."""
        edge_starts, edge_ends = np.asarray(mesh.points)[np.asarray(mesh.facets)].swapaxes(0, 1)
        positions = np.asarray(self.position)
        nearest_edges = np.argmin(np.linalg.norm(positions[:, None] - (edge_starts + edge_ends) / 2, axis=-1), axis=1)
        tangents = (edge_ends - edge_starts)[nearest_edges]
        return (tangents / np.linalg.norm(tangents, axis=1, keepdims=True))[:, None]

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """Nodes of the boundary edges of `mesh`."""
        return (mesh.facets,)

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals over the boundary edges of `mesh`, exact for P1 basis functions."""
        xp = namespace(self, mesh)
        covered_starts, covered_ends = _covered_intervals(self.position, self.width, mesh)
        edge_length = facet_measures(mesh)[:, None]
        # The basis functions on an edge are φ_1 = t / edge length and φ_0 = 1 - φ_1. Simpson's rule is exact for their
        # products over [start, end]. It sums only positive terms, so it is also accurate for edges of which an
        # electrode covers only a small part.
        end_hat_function = xp.stack([covered_starts, (covered_starts + covered_ends) / 2, covered_ends]) / edge_length
        start_hat_function = 1 - end_hat_function
        simpson_weights = (
            (covered_ends - covered_starts) * np.array([1.0, 4.0, 1.0], covered_starts.dtype)[:, None, None, None] / 6
        )

        # The sum over the turns around the loop, (b, L), is explicit, because XLA converts a sum over such a short axis
        # into a slow matrix product.
        def integral_over_covered(integrand_values):
            integrand_values = (
                simpson_weights[0] * integrand_values[0]
                + simpson_weights[1] * integrand_values[1]
                + simpson_weights[2] * integrand_values[2]
            )
            return integrand_values[0] + integrand_values[1] + integrand_values[2]

        hat_integrals = xp.stack([integral_over_covered(start_hat_function), integral_over_covered(end_hat_function)])
        hat_product_integrals = xp.stack(
            [
                integral_over_covered(start_hat_function**2),
                integral_over_covered(start_hat_function * end_hat_function),
                integral_over_covered(end_hat_function**2),
            ]
        )
        admittance_per_area = 1 / self.contact_impedance
        admittance_entries = hat_product_integrals @ admittance_per_area  # (3, b)
        mass = xp.stack([admittance_entries[:2], admittance_entries[1:]]).transpose(2, 0, 1)
        load = sum_into((mesh.num_points, self.num_electrodes), mesh.facets.T, hat_integrals * admittance_per_area)
        return Contact((mesh.facets,), (mass,), load)

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` for electrodes that lie off the boundary, are wider than the boundary is long, or
        overlap."""
        check_dimension("BoundaryElectrodes", mesh, 2)
        if not has_values(self.position, self.width, mesh):
            return
        position, width, mesh = on_host((self.position, self.width, mesh))
        distance_from_boundary, (covered_starts, covered_ends) = (
            _project(position, mesh)[2],
            _covered_intervals(position, width, mesh),
        )
        electrodes_off_boundary = np.flatnonzero(
            distance_from_boundary > np.maximum(0.5 * width, 2e-3 * np.ptp(mesh.points, axis=0).max())
        )
        if electrodes_off_boundary.size:
            raise ValueError(
                f"position: electrode {electrodes_off_boundary[0] + 1} lies "
                f"{distance_from_boundary[electrodes_off_boundary[0]]:.3g} m from the boundary of the mesh; they must "
                "lie on it (are both in metres?). For electrodes inside a sheet use SheetDiscs."
            )
        covered_lengths = np.clip(covered_ends - covered_starts, 0, None).sum(axis=0)  # (b, L)
        rounding_error = max(1e-9, 1e3 * np.finfo(covered_lengths.dtype).eps)
        too_wide_electrodes = np.flatnonzero(covered_lengths.sum(axis=0) < (1 - rounding_error) * width)
        if too_wide_electrodes.size:
            raise ValueError(
                f"width: electrode {too_wide_electrodes[0] + 1} is {float(self.width[too_wide_electrodes[0]]):.3g} m "
                "wide, more than the boundary it lies on; widths are in metres."
            )
        overlapping_electrodes = overlapping_pairs(covered_starts, covered_ends)
        if overlapping_electrodes:
            first_electrode, second_electrode = overlapping_electrodes[0]
            raise ValueError(
                f"Electrodes {first_electrode + 1} and {second_electrode + 1} overlap; move them apart or make them "
                "narrower (positions and widths are in metres along the boundary)."
            )


def overlapping_pairs(start: np.ndarray, end: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of electrodes that cover a common part of an edge, given the `start` and `end` (3, b, L) of the intervals
    of the b edges that they cover, see `_covered_intervals`."""
    start, end = start.transpose(2, 1, 0), end.transpose(2, 1, 0)
    is_edge_covered = (end > start).any(axis=2).astype(float)
    electrode_pairs = []
    for first_electrode, second_electrode in np.argwhere(
        np.triu(is_edge_covered @ is_edge_covered.T, 1)
    ).tolist():  # both cover a part of one edge
        common_lengths = np.minimum(end[first_electrode][:, :, None], end[second_electrode][:, None, :]) - np.maximum(
            start[first_electrode][:, :, None], start[second_electrode][:, None, :]
        )
        if common_lengths.max() > max(1e-9, 1e3 * np.finfo(end.dtype).eps) * end.max():
            electrode_pairs.append((first_electrode, second_electrode))
    return electrode_pairs


def _arc_points(mesh: Mesh, centre: np.ndarray, width: float) -> np.ndarray:
    """Points (k, 2) of the arc of the boundary with length `width` in metres around the point nearest to `centre`."""
    mesh_points, facets = np.asarray(mesh.points), np.asarray(mesh.facets)
    edge_points = mesh_points[facets]
    edge_vectors = edge_points[:, 1] - edge_points[:, 0]
    squared_lengths = np.sum(edge_vectors**2, axis=1)
    fractions_along_edges = np.clip(np.sum((centre - edge_points[:, 0]) * edge_vectors, axis=1) / squared_lengths, 0, 1)
    nearest_edge = np.argmin(
        np.sum((edge_points[:, 0] + fractions_along_edges[:, None] * edge_vectors - centre) ** 2, axis=1)
    )
    # The loop that contains this edge, as vertices with their arc length from the start of the loop.
    loop_of_edge = np.cumsum(np.concatenate([[0], facets[1:, 0] != facets[:-1, 1]]))
    edges_of_loop = np.flatnonzero(loop_of_edge == loop_of_edge[nearest_edge])
    lengths_of_edges = np.sqrt(squared_lengths[edges_of_loop])
    arc = np.concatenate([[0], np.cumsum(lengths_of_edges)])
    middle_position = arc[nearest_edge - edges_of_loop[0]] + fractions_along_edges[nearest_edge] * np.sqrt(
        squared_lengths[nearest_edge]
    )
    vertices = np.concatenate([edge_points[edges_of_loop, 0], edge_points[edges_of_loop[-1:], 1]])
    vertex_positions = np.concatenate([arc - arc[-1], arc, arc + arc[-1]])
    covered_positions = vertex_positions[
        (vertex_positions > middle_position - width / 2) & (vertex_positions < middle_position + width / 2)
    ]
    arc_positions = np.mod(
        np.concatenate([[middle_position - width / 2], covered_positions, [middle_position + width / 2]]), arc[-1]
    )
    return np.stack([np.interp(arc_positions, arc, vertices[:, axis]) for axis in range(2)], axis=1)


@numpy_or_compiled
def _project(position, mesh: Mesh):
    """Nearest boundary facet (L,) of each position, arc length (L,) of the foot point along this facet, and distance
    (L,) from the boundary.

    The foot point p(t) on an edge is where the offset of the position from p(t) is perpendicular to the tangent τ(t) =
    (1-t)τ_0 + tτ_1, interpolated between the corners of the edge; the tangent at a corner bisects the tangents of the
    two edges that meet there. For positions on the edge, the foot point is the ordinary projection, but its derivative
    is continuous where an electrode slides across a corner.
    """
    xp = namespace(position, mesh)
    corners = mesh.points[mesh.facets]
    edge_vectors = corners[:, 1] - corners[:, 0]
    offset_from_edges = position[:, None, :] - corners[:, 0]  # (L, b, 2)
    fraction_along_edges = xp.clip(
        _dot_products(offset_from_edges, edge_vectors) / _dot_products(edge_vectors, edge_vectors), 0, 1
    )
    perpendicular_offset = offset_from_edges - fraction_along_edges[..., None] * edge_vectors
    squared_distances = undifferentiated(_dot_products(perpendicular_offset, perpendicular_offset))
    facet = xp.argmin(squared_distances, axis=1)
    start_node, end_node = mesh.facets[facet].T
    previous_edge = xp.argmax(mesh.facets[:, 1] == start_node[:, None], axis=1)
    next_edge = xp.argmax(mesh.facets[:, 0] == end_node[:, None], axis=1)
    edge_vectors = edge_vectors[facet]
    edge_length = xp.sqrt(_dot_products(edge_vectors, edge_vectors))
    previous_edge, tangent, next_edge = (
        _normalised(corners[:, 1] - corners[:, 0])[index] for index in (previous_edge, facet, next_edge)
    )
    start_tangent, end_tangent = _normalised(previous_edge + tangent), _normalised(tangent + next_edge)
    offset_from_edges = position - corners[facet, 0]
    # (offset - t along)·τ(t) = 0 reads constant + linear t + quadratic t² = 0; take the root that is regular as
    # quadratic → 0.
    constant_coefficient = _dot_products(offset_from_edges, start_tangent)
    linear_coefficient = _dot_products(offset_from_edges, end_tangent - start_tangent) - _dot_products(
        edge_vectors, start_tangent
    )
    quadratic = -_dot_products(edge_vectors, end_tangent - start_tangent)
    fraction_along_facet = (
        2
        * constant_coefficient
        / (xp.sqrt(xp.maximum(linear_coefficient**2 - 4 * quadratic * constant_coefficient, 0)) - linear_coefficient)
    )
    return facet, fraction_along_facet * edge_length, xp.sqrt(squared_distances.min(axis=1))


def _dot_products(first_vectors, second_vectors):
    """Dot products of plane vectors, as an explicit sum, because XLA converts a sum over such a short axis into a slow
    matrix product."""
    return first_vectors[..., 0] * second_vectors[..., 0] + first_vectors[..., 1] * second_vectors[..., 1]


def _normalised(vectors):
    return vectors / namespace(vectors).sqrt(_dot_products(vectors, vectors))[..., None]


@numpy_or_compiled
def _covered_intervals(position, width, mesh: Mesh):
    """Interval of each of b edges that each of L electrodes covers: start and end (3, b, L), with 0 ≤ start ≤ end ≤
    length.

    The first axis counts turns around the boundary loop, because an electrode may extend across the point where arc
    length starts.
    """
    xp = namespace(position, width, mesh)
    edge_length = facet_measures(mesh)
    loop_of_edge, arc_start = boundary_loops(mesh)
    facet, arc_offset, _ = _project(position, mesh)
    is_same_loop = loop_of_edge[:, None] == loop_of_edge[facet]  # (b, L)
    perimeter = xp.sum(xp.where(is_same_loop, edge_length[:, None], 0), axis=0)
    centre = arc_start[facet] + arc_offset
    perimeter_offsets = np.array([-1.0, 0.0, 1.0], edge_length.dtype)[:, None] * perimeter
    electrode_centres = (centre + perimeter_offsets)[:, None, :] - arc_start[:, None]
    half_width, edge_lengths = 0.5 * width, edge_length[:, None]
    covered_starts, covered_ends = (
        xp.clip(electrode_centres - half_width, 0, edge_lengths),
        xp.clip(electrode_centres + half_width, 0, edge_lengths),
    )
    return xp.where(is_same_loop, covered_starts, 0), xp.where(is_same_loop, covered_ends, 0)
