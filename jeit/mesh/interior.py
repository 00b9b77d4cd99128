"""Interior facets: which cells are neighbours, and through what."""

import numpy as np
from jax.core import Tracer

from jeit.mesh._topology import cell_facets, pair_facets
from jeit.mesh.mesh import Mesh


def interior_facets(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of cells that share a facet, (f, 2), and the nodes of that facet, (f, d). NumPy; once per mesh.

    Raises `ValueError` for a mesh that is being traced.
    """
    if isinstance(mesh.cells, Tracer):
        raise ValueError("interior_facets needs a mesh with values; call it outside jit and vmap.")
    cells = np.asarray(mesh.cells)
    first, second, _ = pair_facets(cells)
    return np.stack([first, second], axis=1) // cells.shape[1], cell_facets(cells)[first]
