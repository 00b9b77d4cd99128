"""`Mesh`: points, simplicial cells, boundary facets and named groups of facets."""



import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class Mesh(eqx.Module):
    """A conforming mesh of triangles (2-D) or tetrahedra (3-D).

    Build one with `jeit.mesh.disk` and its siblings, `jeit.mesh.read`, or from raw arrays with
    `Mesh.create`, which checks and orients them. All array fields are pytree leaves, so a mesh can be
    traced, batched over its points, and differentiated with respect to them.

    **Fields**: `points` (n, d) in metres; `cells` (m, d + 1) node indices, positively oriented;
    `facets` (b, d) boundary edges or triangles, oriented with the domain on the left (2-D) or the normal
    outward (3-D), and in 2-D ordered head to tail, loop after loop, the outer loop first; `tags` maps a
    name to indices into `facets`.
    """

    points: Float[Array, "n d"]
    cells: Int[Array, "m k"]
    facets: Int[Array, "b d"]
    tags: dict[str, Int[Array, " t"]]

    @property
    def dimension(self) -> int:
        """Space dimension, 2 or 3."""
        return self.points.shape[1]

    @property
    def num_points(self) -> int:
        """Number of nodes n."""
        return self.points.shape[0]

    @property
    def num_cells(self) -> int:
        """Number of cells m."""
        return self.cells.shape[0]
