"""Touches of a sheet, with the derivatives of their conductivity changes with respect to the touched positions."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.design.defaults import CONTRAST
from jeit.design.skin.touch_shapes import AbstractIndentation
from jeit.design.skin.touched_cells import TouchedCells, touched_cells
from jeit.mesh import Mesh, centroids
from jeit.mesh.geodesic import Geodesics, Triangles
from jeit_solvers.engines import gather, host, namespace, on_host, sum_into, values_at_once
from jeit_solvers.module import Module


class SheetTouches(Module):
    """Touches of a sheet at n positions, as computed by `sheet_touches`, with derivatives of the conductivity changes
    with respect to the positions.

    **Fields**

    - `touched`: the cells that each touch changes, and their conductivity changes.
    - `slope` (n, c, 2): derivative of the relative conductivity change `touched.change` with respect to the position,
      per metre; on a curved sheet in two orthogonal tangential directions.
    - `thickness`: thickness of the layer that the sheet represents, metres; `depth`: maximum depth of the touches,
      metres.
    """

    touched: TouchedCells
    slope: Float[Array, "n c 2"]
    thickness: Float[Array, ""]
    depth: float

    @values_at_once
    def with_thickness(self, thickness) -> "SheetTouches":
        """Return the same touches for a sheet that represents a layer of a different `thickness`, metres. Conductivity
        changes are proportional to depth / thickness."""
        depth_ratio = self.thickness / thickness
        rescaled_touched_cells = eqx.tree_at(
            lambda cells_to_change: cells_to_change.change, self.touched, self.touched.change * depth_ratio
        )
        return SheetTouches(rescaled_touched_cells, self.slope * depth_ratio, thickness, self.depth)

    def weights(self, conductivity: Float[Array, " m"]) -> tuple[Float[Array, "n m"], Float[Array, "2 n m"]]:
        """Compute the change (n, m) of the conductivity of every cell due to every touch, siemens, and the derivatives
        (2, n, m) of the change with respect to the two coordinates of the position, siemens per metre."""
        changed_cells = self.touched.cells
        touch_and_cell_indices = np.arange(len(changed_cells))[:, None], changed_cells

        def cell_changes(relative_change):
            return sum_into(
                (len(changed_cells), len(conductivity)),
                touch_and_cell_indices,
                relative_change * gather(conductivity, changed_cells),
            )

        position_slopes = [cell_changes(self.slope[..., coordinate_axis]) for coordinate_axis in range(2)]
        return cell_changes(self.touched.change), namespace(conductivity).stack(position_slopes)


def sheet_touches(
    mesh: Mesh, indentation: AbstractIndentation, places, *, thickness: float, contrast: float = CONTRAST
) -> SheetTouches:
    """Compute touches at `places` (n, 2), metres, of a sheet (2-D mesh) that represents a layer of `thickness` metres.

    Other arguments as in `touched_cells`. Derivatives are those of the indentation's depth at the centroids of the
    cells. Raises `ValueError` as `touched_cells` does, and for a mesh that is not a sheet.
    """
    if mesh.dimension != 2:
        raise ValueError(f"mesh is {mesh.dimension}-D; these touches are of the equivalent sheet, with a 2-D mesh.")
    changed_cells = touched_cells(mesh, indentation, places, thickness=thickness, contrast=contrast)

    def relative_change(touch_place, cell_centroid):
        # The square root has no derivative at 0; adding a nanometre does not change the depth noticeably.
        touch_distance = jnp.sqrt(jnp.sum((touch_place - cell_centroid) ** 2) + 1e-18)
        return (contrast - 1) * indentation.depth_at(touch_distance) / thickness

    # In NumPy where values are known, so that only the derivative is compiled.
    all_centroids, changed_cells_on_host = on_host((centroids(mesh), changed_cells))
    cell_centroids, touch_origins = gather(all_centroids, changed_cells_on_host.cells), changed_cells_on_host.places
    if mesh.is_surface:
        cell_centroids = _flatten_centroids(mesh, changed_cells, indentation.reach)
        touch_origins = np.zeros((len(changed_cells.places), 2))
    change_slopes = on_host(
        jax.jit(jax.vmap(jax.vmap(jax.grad(relative_change), (None, 0))))(touch_origins, cell_centroids)
    )
    change_slopes = jnp.asarray(
        namespace(changed_cells_on_host, change_slopes).where(
            changed_cells_on_host.change[..., None] != 0, change_slopes, 0.0
        )
    )
    return SheetTouches(
        changed_cells, change_slopes, jnp.asarray(thickness, float), float(indentation.depth_at(host.zeros(())))
    )


def _flatten_centroids(mesh: Mesh, changed_cells: TouchedCells, max_distance: float) -> Float[np.ndarray, "n c 2"]:
    """Map the centroids of touched cells to the tangent plane at the position of their touch. The distance from the
    position in the plane equals the distance along the surface. Returns coordinates (n, c, 2) relative to the position,
    metres."""
    mesh_surface, touch_places, touched_cell_indices = (
        Triangles.of(mesh),
        np.asarray(changed_cells.places),
        np.asarray(changed_cells.cells),
    )
    cell_centroids = np.asarray(centroids(mesh))
    surface_normals = mesh_surface.normals_at(mesh_surface.nearest(touch_places))
    reference_axes = np.where(np.abs(surface_normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first_tangents = np.cross(reference_axes, surface_normals)
    first_tangents = first_tangents / np.linalg.norm(first_tangents, axis=1, keepdims=True)
    tangent_frames = np.stack([first_tangents, np.cross(surface_normals, first_tangents)], axis=1)
    flat_centroids = np.einsum(
        "nid,ncd->nci", tangent_frames, cell_centroids[touched_cell_indices] - touch_places[:, None]
    )
    geodesic_distances, distances_of_cells = np.zeros(touched_cell_indices.shape), np.zeros(mesh.num_cells)
    for touch_index, (cell_indices, distances_from_touch) in enumerate(
        Geodesics.create(mesh_surface).near(touch_places, mesh_surface.nearest(cell_centroids), max_distance)
    ):
        distances_of_cells[cell_indices] = distances_from_touch
        geodesic_distances[touch_index] = distances_of_cells[touched_cell_indices[touch_index]]
    straight_distances = np.linalg.norm(flat_centroids, axis=-1)
    return (
        flat_centroids
        * np.where(
            straight_distances > 0, geodesic_distances / np.where(straight_distances > 0, straight_distances, 1.0), 1.0
        )[..., None]
    )
