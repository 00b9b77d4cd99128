"""Touches of a sheet whose voltage changes have derivatives in the places touched."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.design.defaults import CONTRAST
from jeit.design.skin.indentation import AbstractIndentation
from jeit.design.skin.touched_cells import TouchedCells, touched_cells
from jeit.mesh import Mesh, centroids
from jeit_solvers.engines import gather, host, namespace, sum_into


class SheetTouches(eqx.Module):
    """Touches of a sheet at n places, and how they change as the places move; make them with `sheet_touches`.

    **Fields**: `touched`; `slope` (n, c, 2), the derivative of `touched.change` in the place, per metre; `thickness` of
    the layer that the sheet stands for and `depth` of the touches, metres.
    """

    touched: TouchedCells
    slope: Float[Array, "n c 2"]
    thickness: Float[Array, ""]
    depth: float

    def at_thickness(self, thickness) -> "SheetTouches":
        """The same touches of a layer of another thickness, metres: they take depth / thickness of the way."""
        share = self.thickness / thickness
        touched = eqx.tree_at(lambda one: one.change, self.touched, self.touched.change * share)
        return SheetTouches(touched, self.slope * share, jnp.asarray(thickness), self.depth)

    def weights(self, conductivity: Float[Array, " m"]) -> tuple[Float[Array, "n m"], Float[Array, "2 n m"]]:
        """Change of every cell's conductivity by every touch, siemens, and its derivative in the place."""
        cells = self.touched.cells
        index = np.arange(len(cells))[:, None], cells

        def spread(change):
            return sum_into((len(cells), len(conductivity)), index, change * gather(conductivity, cells))

        slopes = [spread(self.slope[..., axis]) for axis in range(2)]
        return spread(self.touched.change), namespace(conductivity).stack(slopes)


def sheet_touches(
    mesh: Mesh, indentation: AbstractIndentation, places, *, thickness: float, contrast: float = CONTRAST
) -> SheetTouches:
    """Indent a sheet (2-D mesh) of a layer of `thickness` metres at `places` (n, 2), metres.

    The rest as in `touched_cells`. The derivative is of the indentation's depth at the middles of the cells. Raises
    `ValueError` as `touched_cells` does, and for a mesh that is no sheet.
    """
    if mesh.dimension != 2:
        raise ValueError(f"mesh is {mesh.dimension}-D; these touches are of the equivalent sheet, with a 2-D mesh.")
    touched = touched_cells(mesh, indentation, places, thickness=thickness, contrast=contrast)

    def change(place, middle):
        # The root has no derivative at 0; a thousandth of a micrometre is nothing to a depth.
        distance = jnp.sqrt(jnp.sum((place - middle) ** 2) + 1e-18)
        return (contrast - 1) * indentation.depth_at(distance) / thickness

    middles = centroids(mesh)[touched.cells]
    slope = jax.jit(jax.vmap(jax.vmap(jax.grad(change), (None, 0))))(touched.places, middles)
    slope = jnp.where(touched.change[..., None] != 0, slope, 0.0)
    return SheetTouches(touched, slope, jnp.asarray(thickness, float), float(indentation.depth_at(host.zeros(()))))
