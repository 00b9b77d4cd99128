"""Touches of a sheet, with the derivatives of their conductivity changes with respect to the touched positions."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.design.defaults import CONTRAST
from jeit.design.skin.indentation import AbstractIndentation
from jeit.design.skin.touched_cells import TouchedCells, touched_cells
from jeit.mesh import Mesh, centroids
from jeit.mesh.geodesic import Geodesics, Triangles
from jeit_solvers.engines import gather, host, namespace, sum_into
from jeit_solvers.module import Module


class SheetTouches(Module):
    """Touches of a sheet at n positions, with derivatives with respect to the positions; create them with
    `sheet_touches`.

    **Fields**

    - `touched`: the touched cells and their conductivity changes.
    - `slope` (n, c, 2): derivative of `touched.change` with respect to the position, per metre; on a curved sheet in
      two orthogonal tangential directions.
    - `thickness`: thickness of the layer that the sheet represents, metres; `depth`: maximum depth of the touches,
      metres.
    """

    touched: TouchedCells
    slope: Float[Array, "n c 2"]
    thickness: Float[Array, ""]
    depth: float

    def at_thickness(self, thickness) -> "SheetTouches":
        """The same touches on a layer of another `thickness`, metres; the conductivity changes are proportional to
        depth / thickness."""
        share = self.thickness / thickness
        touched = eqx.tree_at(lambda one: one.change, self.touched, self.touched.change * share)
        return SheetTouches(touched, self.slope * share, jnp.asarray(thickness), self.depth)

    def weights(self, conductivity: Float[Array, " m"]) -> tuple[Float[Array, "n m"], Float[Array, "2 n m"]]:
        """Change of the conductivity of every cell by every touch (n, m), siemens, and its derivatives with respect to
        the two coordinates of the position (2, n, m), siemens per metre."""
        cells = self.touched.cells
        index = np.arange(len(cells))[:, None], cells

        def spread(change):
            return sum_into((len(cells), len(conductivity)), index, change * gather(conductivity, cells))

        slopes = [spread(self.slope[..., axis]) for axis in range(2)]
        return spread(self.touched.change), namespace(conductivity).stack(slopes)


def sheet_touches(
    mesh: Mesh, indentation: AbstractIndentation, places, *, thickness: float, contrast: float = CONTRAST
) -> SheetTouches:
    """Compute touches at `places` (n, 2), metres, of a sheet (2-D mesh) that represents a layer of `thickness` metres.

    Other arguments as in `touched_cells`. The derivatives are those of the indentation's depth at the centroids of the
    cells. Raises `ValueError` as `touched_cells` does, and for a mesh that is not a sheet.
    """
    if mesh.dimension != 2:
        raise ValueError(f"mesh is {mesh.dimension}-D; these touches are of the equivalent sheet, with a 2-D mesh.")
    touched = touched_cells(mesh, indentation, places, thickness=thickness, contrast=contrast)

    def change(place, middle):
        # The square root has no derivative at 0; adding a nanometre does not change the depth noticeably.
        distance = jnp.sqrt(jnp.sum((place - middle) ** 2) + 1e-18)
        return (contrast - 1) * indentation.depth_at(distance) / thickness

    middles, origin = centroids(mesh)[touched.cells], touched.places
    if mesh.is_surface:
        middles, origin = _flatten_centroids(mesh, touched, indentation.reach), jnp.zeros_like(origin[:, :2])
    slope = jax.jit(jax.vmap(jax.vmap(jax.grad(change), (None, 0))))(origin, middles)
    slope = jnp.where(touched.change[..., None] != 0, slope, 0.0)
    return SheetTouches(touched, slope, jnp.asarray(thickness, float), float(indentation.depth_at(host.zeros(()))))


def _flatten_centroids(mesh: Mesh, touched: TouchedCells, reach: float) -> Float[np.ndarray, "n c 2"]:
    """Map the centroids of touched cells to the tangent plane at the position of their touch, keeping the distance
    along the surface: coordinates (n, c, 2) relative to that position, metres."""
    surface, places, cells = Triangles.of(mesh), np.asarray(touched.places), np.asarray(touched.cells)
    middles = np.asarray(centroids(mesh))
    normal = surface.normals_at(surface.nearest(places))
    aside = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(aside, normal)
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    frame = np.stack([first, np.cross(normal, first)], axis=1)
    flat = np.einsum("nid,ncd->nci", frame, middles[cells] - places[:, None])
    length, known = np.zeros(cells.shape), np.zeros(mesh.num_cells)
    for row, (index, own) in enumerate(Geodesics.create(surface).near(places, surface.nearest(middles), reach)):
        known[index] = own
        length[row] = known[cells[row]]
    straight = np.linalg.norm(flat, axis=-1)
    return flat * np.where(straight > 0, length / np.where(straight > 0, straight, 1.0), 1.0)[..., None]
