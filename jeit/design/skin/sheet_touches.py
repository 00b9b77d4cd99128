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
        touched = eqx.tree_at(
            lambda cells_to_change: cells_to_change.change, self.touched, self.touched.change * depth_ratio
        )
        return SheetTouches(touched, self.slope * depth_ratio, thickness, self.depth)

    def weights(self, conductivity: Float[Array, " m"]) -> tuple[Float[Array, "n m"], Float[Array, "2 n m"]]:
        """Compute the change (n, m) of the conductivity of every cell due to every touch, siemens, and the derivatives
        (2, n, m) of the change with respect to the two coordinates of the position, siemens per metre."""
        cells = self.touched.cells
        indices = np.arange(len(cells))[:, None], cells

        def cell_changes(relative_change):
            return sum_into((len(cells), len(conductivity)), indices, relative_change * gather(conductivity, cells))

        position_slopes = [cell_changes(self.slope[..., axis]) for axis in range(2)]
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
    touched = touched_cells(mesh, indentation, places, thickness=thickness, contrast=contrast)

    def relative_change(place, centroid):
        # The square root has no derivative at 0; adding a nanometre does not change the depth noticeably.
        distance = jnp.sqrt(jnp.sum((place - centroid) ** 2) + 1e-18)
        return (contrast - 1) * indentation.depth_at(distance) / thickness

    # In NumPy where values are known, so that only the derivative is compiled.
    all_centroids, touched_values = on_host((centroids(mesh), touched))
    cell_centroids, origins = gather(all_centroids, touched_values.cells), touched_values.places
    if mesh.is_surface:
        cell_centroids = _flatten_centroids(mesh, touched, indentation.reach)
        origins = np.zeros((len(touched.places), 2))
    slopes = on_host(jax.jit(jax.vmap(jax.vmap(jax.grad(relative_change), (None, 0))))(origins, cell_centroids))
    slopes = jnp.asarray(namespace(touched_values, slopes).where(touched_values.change[..., None] != 0, slopes, 0.0))
    return SheetTouches(touched, slopes, jnp.asarray(thickness, float), float(indentation.depth_at(host.zeros(()))))


def _flatten_centroids(mesh: Mesh, touched: TouchedCells, max_distance: float) -> Float[np.ndarray, "n c 2"]:
    """Map the centroids of touched cells to the tangent plane at the position of their touch. The distance from the
    position in the plane equals the distance along the surface. Returns coordinates (n, c, 2) relative to the position,
    metres."""
    surface, places, cells = Triangles.of(mesh), np.asarray(touched.places), np.asarray(touched.cells)
    cell_centroids = np.asarray(centroids(mesh))
    normals = surface.normals_at(surface.nearest(places))
    reference_axes = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first_tangents = np.cross(reference_axes, normals)
    first_tangents = first_tangents / np.linalg.norm(first_tangents, axis=1, keepdims=True)
    tangent_frames = np.stack([first_tangents, np.cross(normals, first_tangents)], axis=1)
    flat_centroids = np.einsum("nid,ncd->nci", tangent_frames, cell_centroids[cells] - places[:, None])
    lengths, cell_lengths = np.zeros(cells.shape), np.zeros(mesh.num_cells)
    for row, (cell_indices, touch_lengths) in enumerate(
        Geodesics.create(surface).near(places, surface.nearest(cell_centroids), max_distance)
    ):
        cell_lengths[cell_indices] = touch_lengths
        lengths[row] = cell_lengths[cells[row]]
    straight_distances = np.linalg.norm(flat_centroids, axis=-1)
    return (
        flat_centroids
        * np.where(straight_distances > 0, lengths / np.where(straight_distances > 0, straight_distances, 1.0), 1.0)[
            ..., None
        ]
    )
