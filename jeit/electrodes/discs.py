"""Disc electrodes inside a sheet, on faces of a 3-D body, and on surfaces in space."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike
from scipy.special import roots_jacobi

from jeit.electrodes.electrodes import (
    AbstractMovableElectrodes,
    AbstractPlacedElectrodes,
    Contact,
    ElectrodePen,
    as_electrode_values,
    as_positions,
    check_dimension,
)
from jeit.electrodes.facets import is_undistorted_from_above, same_face, tangent_frames
from jeit.mesh import Body, Mesh, Refine, measures, normals
from jeit.mesh.geodesic import Triangles, unfold
from jeit.mesh.mesh import facet_measures
from jeit_solvers.engines import has_values, host, namespace, on_host, sum_into, undifferentiated, values_at_once

# Half-width of the smooth edge of a disc's window, relative to the local cell size. Smaller values approximate the
# sharp electrode better, until the edge falls between quadrature points; see tests/electrodes for the convergence.
RELATIVE_EDGE_HALF_WIDTH = 0.5
_MAX_DISCS_PER_TRIANGLE = 8


def triangle_quadrature(order: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Jacobi rule on a triangle: barycentric coordinates of points (order², 3), and weights (order²,) that sum to
    one.

    Exact for polynomials of degree 2·order - 1 (the collapsed-square rule; Stroud 1971).
    """
    u, legendre_weights = np.polynomial.legendre.leggauss(order)
    v, jacobi_weights = roots_jacobi(order, 1, 0)
    u, v = (u + 1) / 2, (v + 1) / 2
    second_coordinates = np.outer(1 - v, u).ravel()
    third_coordinates = np.repeat(v, order)
    quadrature_weights = np.outer(jacobi_weights, legendre_weights).ravel()
    return np.stack(
        [1 - second_coordinates - third_coordinates, second_coordinates, third_coordinates], axis=1
    ), quadrature_weights / quadrature_weights.sum()


def smooth_step(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Smooth step from 0 at x ≤ -1 to 1 at x ≥ 1, with two continuous derivatives; odd about (0, 1/2)."""
    t = namespace(x).clip((x + 1) / 2, 0, 1)
    return t**3 * (10 - 15 * t + 6 * t**2)


def nearest_electrodes(centres, position, radius) -> Int[Array, "q k"]:
    """Indices (q, k) of the electrodes that may reach each of the triangles with centroids `centres` (q, d); k is 8, or
    the number of electrodes if smaller.

    At most 8 non-overlapping round electrodes, with `position` (L, d) and `radius` (L,), reach a triangle, unless the
    triangle is so much larger than the electrodes that `check` rejects the mesh. The indices have no derivatives.
    """
    xp = namespace(centres, position, radius)
    power_distance = xp.sum((centres[:, None] - position) ** 2, axis=-1) - radius**2
    power_distance = undifferentiated(power_distance).astype(np.float32)  # the order of distant ones does not matter
    num_nearest = min(_MAX_DISCS_PER_TRIANGLE, len(radius))
    if xp is np:
        return host.argsort(power_distance, axis=1, kind="stable")[:, :num_nearest]
    return jax.lax.top_k(-power_distance, num_nearest)[1]


def window_contact(
    nodes: Int[Array, "q 3"],
    measure: Float[Array, " q"],
    window: Float[Array, "q k p"],
    electrode: Int[Array, "q k"],
    contact_impedance: Float[Array, " L"],
    num_points: int,
) -> Contact:
    """Contact integrals from window values at the p quadrature points of q triangles.

    `measure`: areas of the triangles; `window`: value of the window (0 to 1) of each electrode at each quadrature
    point; `electrode`: indices of k electrodes for each triangle.
    """
    barycentric_coordinates, quadrature_weights = triangle_quadrature()
    current = measure[:, None, None] * quadrature_weights * window / contact_impedance[electrode][..., None]
    basis_products = (barycentric_coordinates[:, :, None] * barycentric_coordinates[:, None]).reshape(
        len(quadrature_weights), -1
    )
    mass = (current.sum(axis=1) @ basis_products).reshape(-1, *2 * barycentric_coordinates.shape[1:])
    load_shape = num_points, contact_impedance.shape[0]
    load = sum_into(load_shape, (nodes[:, None], electrode[..., None]), current @ barycentric_coordinates)
    return Contact((nodes,), (mass,), load)


class AbstractDiscs(AbstractPlacedElectrodes):
    """Base class of round electrodes."""

    radius: eqx.AbstractVar[Float[Array, " L"]]

    def geometry(self) -> dict[str, Array]:
        """Positions and radii of the electrodes, metres."""
        return {"position": self.position, "radius": self.radius}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Draw each electrode as a disc, or as a dot if it is on a wall."""
        is_undistorted = is_undistorted_from_above(mesh, self.position)
        for position, radius, is_flat in zip(
            np.asarray(self.position), np.asarray(self.radius), is_undistorted, strict=True
        ):
            if is_flat:
                pen.disc(position, radius)
            else:
                pen.dot(position)


class SheetDiscs(AbstractDiscs, AbstractMovableElectrodes):
    """Complete electrodes that are discs inside a sheet (2-D mesh), independent of its nodes.

    The indicator function of the disc is replaced by a smooth window whose edge is half a cell wide, so that the
    contact integrals are differentiable in position and radius and converge to the integrals of the sharp disc as the
    mesh is refined.

    **Fields**: `position` (L, 2): positions of the L discs, metres; `radius` (L,): metres; `contact_impedance` (L,):
    ohm·m².

    **Example:**

    ```python
    electrodes = SheetDiscs([[-0.05, 0.0], [0.05, 0.0]], radius=0.02, contact_impedance=1e-4)
    electrodes.check(sheet)
    ```
    """

    position: Float[Array, "L 2"]
    radius: Float[Array, " L"]
    contact_impedance: Float[Array, " L"]

    def __init__(self, position: ArrayLike, radius: ArrayLike, contact_impedance: ArrayLike):
        """`radius` and `contact_impedance` may each be one number for all electrodes. Raises `ValueError` for values
        that are not positive and for positions that are not finite."""
        self.position, self.radius, self.contact_impedance = as_discs(position, 2, radius, contact_impedance)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Refine cells on the electrodes to 0.7 times the smallest radius."""
        radius = np.asarray(self.radius)
        return (Refine(np.asarray(self.position), cell_size=0.7 * radius.min(), distance=float(radius.max())),)

    def directions(self, mesh: Mesh) -> Float[np.ndarray, "L a 2"]:
        """Unit vectors along x and along y, in which each disc can move."""
        return np.broadcast_to(np.eye(2), (self.num_electrodes, 2, 2))

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """Nodes of the cells of `mesh`."""
        return (mesh.cells,)

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals over the cells, by quadrature of the discs' windows."""
        xp = namespace(self, mesh)
        area = measures(mesh)
        barycentric_coordinates, _ = triangle_quadrature()
        quadrature_points = xp.einsum("pi,mid->mpd", barycentric_coordinates, mesh.points[mesh.cells])
        edge_width = RELATIVE_EDGE_HALF_WIDTH * xp.sqrt(area)
        nearest_electrode = nearest_electrodes(quadrature_points.mean(axis=1), self.position, self.radius)
        soft_disc_indicator = disc_window(
            quadrature_points, self.position[nearest_electrode], self.radius[nearest_electrode], edge_width
        )
        return window_contact(
            mesh.cells, area, soft_disc_indicator, nearest_electrode, self.contact_impedance, mesh.num_points
        )

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` for discs that lie off the sheet, overlap, or are too small for the mesh."""
        check_dimension("SheetDiscs", mesh, 2)
        check_discs(self, mesh, measures(mesh))


class FaceDiscs(AbstractDiscs, AbstractMovableElectrodes):
    """Complete electrodes that are discs on flat or curved faces of a 3-D mesh, independent of its nodes.

    On a curved face a disc covers the points within a straight-line distance `radius` of its position, as cut out by a
    ball. On a face with radius of curvature R, the disc's radius measured along the surface is then larger by the
    fraction radius² / 24 R²: 0.3 % for a radius of R / 4, 1 % for R / 2. Discs with radii up to R are covered
    completely.

    **Fields**: `position` (L, 3): points on the surface, metres; `radius` (L,): metres; `contact_impedance` (L,):
    ohm·m².

    **Example:**

    ```python
    electrodes = FaceDiscs([[-0.05, 0, 0.05], [0.05, 0, 0.05]], radius=0.02, contact_impedance=1e-4)
    electrodes.check(solid)
    ```
    """

    position: Float[Array, "L 3"]
    radius: Float[Array, " L"]
    contact_impedance: Float[Array, " L"]

    def __init__(self, position: ArrayLike, radius: ArrayLike, contact_impedance: ArrayLike):
        """`radius` and `contact_impedance` may each be one number for all electrodes. Raises `ValueError` for values
        that are not positive and for positions that are not finite."""
        self.position, self.radius, self.contact_impedance = as_discs(position, 3, radius, contact_impedance)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Empty, because the electrodes do not lie on a plane mesh."""
        return ()

    def directions(self, mesh: Mesh) -> Float[np.ndarray, "L a 3"]:
        """Unit vectors in the face at each disc: horizontal and upward; on a horizontal face along x and y."""
        return np.stack(tangent_frames(on_host(mesh), np.asarray(self.position))[1:], axis=1)

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """Nodes of the boundary triangles of `mesh`."""
        return (mesh.facets,)

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals over the boundary triangles, by quadrature of the discs' windows."""
        xp = namespace(self, mesh)
        area = facet_measures(mesh)
        barycentric_coordinates, _ = triangle_quadrature()
        quadrature_points = xp.einsum("pi,bid->bpd", barycentric_coordinates, mesh.points[mesh.facets])
        edge_width = RELATIVE_EDGE_HALF_WIDTH * xp.sqrt(area)
        nearest_electrode = nearest_electrodes(quadrature_points.mean(axis=1), self.position, self.radius)
        soft_disc_indicator = disc_window(
            quadrature_points, self.position[nearest_electrode], self.radius[nearest_electrode], edge_width
        )
        is_on_same_face = xp.take_along_axis(same_face(mesh, self.position, self.radius), nearest_electrode, axis=1)
        return window_contact(
            mesh.facets,
            area,
            soft_disc_indicator * is_on_same_face[..., None],
            nearest_electrode,
            self.contact_impedance,
            mesh.num_points,
        )

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` for discs that lie off the surface, overlap, or are too small for the mesh."""
        check_dimension("FaceDiscs", mesh, 3)
        check_discs(self, mesh, facet_measures(mesh))


def as_discs(position, dimension: int, radius, contact_impedance):
    """Check and convert positions (L, d) and radii (L,) in metres and contact impedances (L,) in ohm·m²."""
    position = as_positions(position, (dimension,))
    radius = as_electrode_values("radius", radius, len(position), unit="metres")
    return position, radius, as_electrode_values("contact_impedance", contact_impedance, len(position), unit="ohm·m²")


def disc_window(points, position, radius, edge):
    """Windows (q, k, p), from 0 to 1, of discs at `position` (q, k, d) with `radius` (q, k) at quadrature points (q, p,
    d); `edge` (q,) is the half-width of the smooth edge."""
    return window_within(squared_distances(points, position), radius, edge)


def squared_distances(points, position):
    """Squared distances (q, k, p), m², of quadrature points (q, p, d) from `position` (q, k, d)."""
    return sum((points[:, None, :, i] - position[..., None, i]) ** 2 for i in range(points.shape[-1]))


def window_within(squared, radius, edge):
    """Window of a disc at points with squared distances (q, k, p), m², from its centre."""
    radius = radius[..., None]
    # r² - ρ² = (r - ρ)(r + ρ) avoids the square root, which is not differentiable at the centre.
    return smooth_step((radius**2 - squared) / (2 * radius * edge[:, None, None]))


def check_discs(electrodes: AbstractDiscs, mesh: Mesh, area) -> None:
    """Raise `ValueError` unless every disc lies on the mesh, is separate from the other discs, and is large enough for
    the cells."""
    if not has_values(electrodes, mesh):
        return
    electrodes, mesh = on_host((electrodes, mesh))
    position, radius = electrodes.position, electrodes.radius
    gaps_between_discs = np.linalg.norm(position[:, None] - position, axis=-1) - radius[:, None] - radius
    np.fill_diagonal(gaps_between_discs, np.inf)
    if gaps_between_discs.min() < 0:
        i, j = np.unravel_index(gaps_between_discs.argmin(), gaps_between_discs.shape)
        raise ValueError(
            f"Electrodes {i + 1} and {j + 1} overlap by {-gaps_between_discs.min():.3g} m; move them apart."
        )
    covered_areas = electrodes.contact(mesh).load.sum(axis=0) * electrodes.contact_impedance
    for electrode in range(len(radius)):
        covered_fraction = covered_areas[electrode] / (np.pi * radius[electrode] ** 2)
        electrode_label = (
            f"electrode {electrode + 1} at {position[electrode].tolist()} m with radius {radius[electrode]:.3g} m"
        )
        if covered_fraction < 0.01:
            raise ValueError(
                f"position: {electrode_label} touches nothing; it lies off the mesh, which spans "
                f"{np.asarray(mesh.points).min(axis=0).tolist()} to {np.asarray(mesh.points).max(axis=0).tolist()} m, "
                "or is far smaller than a cell."
            )
        if covered_fraction < 0.8:
            raise ValueError(
                f"position: only {100 * covered_fraction:.0f} % of {electrode_label} lies on the mesh; move it inside, "
                "or refine the mesh there if the disc is smaller than a cell."
            )
        if covered_fraction > 1.2:
            raise ValueError(f"radius: {electrode_label} is too small for the mesh there; refine the mesh around it.")


# Minimum cosine of the angle between normals within a disc: the normal turns by one radian along a radius equal to the
# radius of curvature.
_MIN_NORMAL_COSINE = float(np.cos(1.0))


class SurfaceDiscs(AbstractDiscs):
    """Complete electrodes that are discs in a curved sheet, a surface of triangles in space, independent of its nodes.

    These are the `SheetDiscs` of curved sheets. Where the surface around the centre is developable, as in bent sheets
    and tubes, a disc consists exactly of the points whose geodesic distance from its centre is at most its radius, so
    bending does not change the contact integrals. Elsewhere a disc consists of the points whose straight-line distance
    from its centre is at most its radius, and whose normals point to the same side as the normal at its centre. On a
    surface with radius of curvature R, the radius of such a disc along the surface is larger by the fraction radius² /
    24 R². The integrals are differentiable in position along the surface; a displacement off the surface has no
    first-order effect.

    **Fields**: `position` (L, 3): points on the surface, metres; `radius` (L,): metres; `contact_impedance` (L,):
    ohm·m².

    **Example:**

    ```python
    electrodes = SurfaceDiscs([[0.04, 0, 0.05], [-0.04, 0, 0.05]], radius=0.015, contact_impedance=1e-4)
    electrodes.check(sleeve)
    ```
    """

    position: Float[Array, "L 3"]
    radius: Float[Array, " L"]
    contact_impedance: Float[Array, " L"]

    def __init__(self, position: ArrayLike, radius: ArrayLike, contact_impedance: ArrayLike):
        """`radius` and `contact_impedance` may each be one number for all electrodes. Raises `ValueError` for values
        that are not positive and for positions that are not finite."""
        self.position, self.radius, self.contact_impedance = as_discs(position, 3, radius, contact_impedance)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Empty, because the electrodes do not lie on a plane mesh."""
        return ()

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """Nodes of the triangles of `mesh`."""
        return (mesh.cells,)

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals over the triangles, by quadrature of the discs' windows."""
        xp = namespace(self, mesh)
        area = measures(mesh)
        barycentric_coordinates, _ = triangle_quadrature()
        corners = mesh.points[mesh.cells]
        quadrature_points = xp.einsum("pi,mid->mpd", barycentric_coordinates, corners)
        edge_width = RELATIVE_EDGE_HALF_WIDTH * xp.sqrt(area)
        cell_centres = quadrature_points.mean(axis=1)
        nearest_electrode = nearest_electrodes(cell_centres, self.position, self.radius)
        longest_side = xp.sqrt(((corners - xp.roll(corners, 1, axis=1)) ** 2).sum(axis=-1).max(axis=1))
        unfolded_surface = unfold(mesh, self.position, self.radius[:, None] + edge_width + longest_side)
        normal = xp.asarray(undifferentiated(normals(mesh)))
        centre = xp.argmin(undifferentiated(((self.position[:, None] - cell_centres) ** 2).sum(axis=-1)), axis=1)
        is_exact, is_facing = (
            unfolded_surface.exact[nearest_electrode],
            xp.take_along_axis(normal @ normal[centre].T, nearest_electrode, axis=1) > 0,
        )
        is_covered = xp.where(
            is_exact, xp.take_along_axis(unfolded_surface.reached.T, nearest_electrode, axis=1), is_facing
        )
        squared_distance = xp.where(
            is_exact[..., None],
            unfolded_surface.squared(barycentric_coordinates, nearest_electrode),
            squared_distances(quadrature_points, self.position[nearest_electrode]),
        )
        soft_disc_indicator = (
            window_within(squared_distance, self.radius[nearest_electrode], edge_width) * is_covered[..., None]
        )
        return window_contact(
            mesh.cells, area, soft_disc_indicator, nearest_electrode, self.contact_impedance, mesh.num_points
        )

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` for discs that lie off the surface, extend over its border, are as large as the surface's
        radius of curvature, overlap, or are too small for the mesh."""
        if not mesh.is_surface:
            raise ValueError(
                "SurfaceDiscs need a mesh that is a surface in space, such as jeit.mesh.tube makes; this one is not."
            )
        if not has_values(self, mesh):
            return
        discs, mesh = on_host((self, mesh))
        check_on_surface(discs.position, discs.radius, Triangles.of(mesh))
        check_discs(discs, mesh, measures(mesh))


def check_on_surface(position, radius, surface: Triangles) -> None:
    """Raise `ValueError` for discs at `position` (L, 3) with `radius` (L,), metres, that are farther from the surface
    than their radius, extend over its border, or are as large as the surface's radius of curvature."""
    position, radius = np.asarray(position), np.asarray(radius)
    nearest_points = surface.nearest(position)
    border_distances = surface.distance_to_border(nearest_points.points)
    triangle_centres, normal = surface.corners.mean(axis=1), surface.normals
    for electrode_index, (centre, disc_radius) in enumerate(zip(position, radius, strict=True)):
        x, y, z = 1e3 * centre
        electrode_label = (
            f"electrode {electrode_index + 1}, {2e3 * disc_radius:.3g} mm across at ({x:.4g}, {y:.4g}, {z:.4g}) mm,"
        )
        if nearest_points.away[electrode_index] > disc_radius:
            raise ValueError(
                f"position: {electrode_label} is {1e3 * nearest_points.away[electrode_index]:.3g} mm off the surface, "
                "farther than its radius; move it onto the surface. Are both in metres?"
            )
        if border_distances[electrode_index] < 0.9 * disc_radius:
            raise ValueError(
                f"position: {electrode_label} lies on the surface's edge, "
                f"{1e3 * border_distances[electrode_index]:.3g} mm from it; move it inside."
            )
        is_inside = np.linalg.norm(triangle_centres - nearest_points.points[electrode_index], axis=1) < disc_radius
        normal_cosines = normal[is_inside] @ normal[nearest_points.triangle[electrode_index]]
        if (np.abs(normal_cosines) < _MIN_NORMAL_COSINE).any():
            raise ValueError(
                f"radius: {electrode_label} is larger than the surface's radius of curvature there; a disc so large is "
                "no disc, give less."
            )
