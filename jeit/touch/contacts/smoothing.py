"""Smooth images on a mesh: back-projected ones have an edge along every band, and each edge has peaks."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from jeit.arguments import describe, is_number
from jeit.mesh import Mesh, centroids, measures

# Standard deviations beyond which a Gaussian is taken as zero.
_REACH = 3.0
# Default length, as a share of the root of the mesh's area.
_SHARE = 0.03


def gaussian_means(mesh: Mesh, length: float | None) -> sparse.csr_array:
    """Matrix (m, m) that takes an image to means over the cells round each, by area and a Gaussian.

    `length` is its standard deviation, metres: 3 % of the root of the mesh's area if None; 0 changes nothing. Raises
    `ValueError` for a length that is none, or as wide as the mesh.
    """
    centres, areas = np.asarray(centroids(mesh)), np.asarray(measures(mesh))
    widest = float(np.sqrt(areas.sum()))
    length = _SHARE * widest if length is None else length
    if not (is_number(length) and 0 <= length < widest):
        raise ValueError(
            f"smoothing must be metres, zero or more and less than the skin is wide ({widest:.3g} m); it is "
            f"{describe(length)}."
        )
    if not length:
        return sparse.csr_array(sparse.diags_array(np.ones(len(areas))))
    tree = KDTree(centres)
    near = tree.sparse_distance_matrix(tree, _REACH * length, output_type="coo_matrix")
    weight = np.exp(-((near.data / length) ** 2) / 2) * areas[near.col]
    means = sparse.csr_array((weight, (near.row, near.col)), shape=near.shape)
    return sparse.csr_array(sparse.diags_array(1 / means.sum(axis=1)) @ means)
