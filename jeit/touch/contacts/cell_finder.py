"""Detect contacts on a mesh: smooth the image, find the regions of cells above a level, and trace their outlines."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import KDTree

from jeit.arguments import describe, is_number
from jeit.image.segmentation import shared_facets, watershed_basins
from jeit.mesh import Mesh, centroids, measures
from jeit.mesh.geodesic import Triangles
from jeit.touch.contacts.finder import AbstractFinder, Contact, ImageNoise, check_finder, check_share

# Number of standard deviations beyond which a Gaussian is treated as zero.
_SMOOTHING_CUTOFF_DEVIATIONS = 3.0
# Default smoothing length, divided by the square root of the mesh's area.
_RELATIVE_SMOOTHING_LENGTH = 0.03


def gaussian_means(mesh: Mesh, length: float | None) -> sparse.csr_array:
    """Compute the matrix (m, m) that smooths an image: Gaussian means over the neighbourhood of each cell.

    Cells are weighted by their areas and by a Gaussian of the distance between centroids. `length`: standard deviation
    of the Gaussian, metres; None: 3 % of the square root of the mesh's area; 0: no smoothing. Raises `ValueError` if
    `length` is negative, or not less than the square root of the mesh's area.
    """
    cell_centres, cell_areas = np.asarray(centroids(mesh)), np.asarray(measures(mesh))
    skin_size = float(np.sqrt(cell_areas.sum()))
    length = _RELATIVE_SMOOTHING_LENGTH * skin_size if length is None else length
    if not (is_number(length) and 0 <= length < skin_size):
        raise ValueError(
            f"smoothing must be metres, zero or more and less than the skin is wide ({skin_size:.3g} m); it is "
            f"{describe(length)}."
        )
    if not length:
        return sparse.csr_array(sparse.diags_array(np.ones(len(cell_areas))))
    cell_tree = KDTree(cell_centres)
    cell_distances = cell_tree.sparse_distance_matrix(
        cell_tree, _SMOOTHING_CUTOFF_DEVIATIONS * length, output_type="coo_matrix"
    )
    gaussian_weights = np.exp(-((cell_distances.data / length) ** 2) / 2) * cell_areas[cell_distances.col]
    weighted_sums = sparse.csr_array(
        (gaussian_weights, (cell_distances.row, cell_distances.col)), shape=cell_distances.shape
    )
    return sparse.csr_array(sparse.diags_array(1 / weighted_sums.sum(axis=1)) @ weighted_sums)


def outline_of_cells(points: Float[np.ndarray, "n d"], cells: Int[np.ndarray, "c 3"]) -> Float[np.ndarray, "k d"]:
    """Return the outline of a set of c cells: k vertices (k, d), metres, of the longest loop of its boundary edges.

    Boundary edges belong to only one of the `cells` (c, 3). All cells must have the same orientation, so that boundary
    edges follow one another. Where the set touches itself in a node, the loop may continue either way.
    """
    edges = np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])
    _, edge_numbers, edge_counts = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    following_nodes: dict[int, list[int]] = {}
    for start_node, end_node in edges[edge_counts[edge_numbers] == 1].tolist():
        following_nodes.setdefault(start_node, []).append(end_node)
    longest_boundary_loop: list[int] = []
    while following_nodes:
        boundary_loop = [next(iter(following_nodes))]
        while boundary_loop[-1] in following_nodes:
            next_nodes = following_nodes[boundary_loop[-1]]
            last_node = boundary_loop[-1]
            boundary_loop.append(next_nodes.pop())
            if not next_nodes:
                del following_nodes[last_node]
        longest_boundary_loop = max(longest_boundary_loop, boundary_loop[:-1], key=len)
    return points[longest_boundary_loop]


class CellFinder(AbstractFinder):
    """Finds contacts in images on a mesh: each contact is a peak, with the cells around it that exceed a share of its
    height.

    In the centroid of a contact, cells are weighted by their excess above this share of the peak. The excess is zero at
    the contact's edge, so that the centroid does not jump when a cell joins or leaves the contact. Peaks that are weak,
    or rise little above the saddle between them and a higher peak, are taken for artefacts or shoulders, and left out.

    The default arguments give the smallest error of places on simulated skins (`python -m benchmarks contacts`).

    **Arguments:**

    - `mesh`: mesh of the images: a flat sheet, or a surface in space; on a surface, centroids are points (3,) on it.
    - `smoothing`: standard deviation of the Gaussian that smooths images before contacts are found, metres; by default
      3 % of the square root of the mesh's area.
    - `level`: share of the peak's height that cells of a contact exceed.
    - `least_peak`: minimum height of a peak, as a share of the strongest peak.
    - `least_prominence`: minimum rise of a peak above the saddle between it and a higher peak, as a share of the lower
      peak's height.
    - `floor`: number of standard deviations of the noise that a cell must exceed to belong to a contact.
    - `sign`: 1 if touched skin conducts better, -1 if it conducts worse.

    **Fields**: `level`, `least_peak`, `least_prominence`, `floor`, `sign`: as given; `smoothing` (m, m): matrix that
    smooths images of m cells; `cells` (m, 3), `points` (n, d): cells and n nodes of the mesh; `centres` (m, d), `areas`
    (m,): centroids and areas of the cells; `shared` (m, 3): numbers of the facets that each cell shares with another
    cell; `surface`: the surface of a mesh in space, otherwise None.

    **Example:**

    ```python
    finder = CellFinder(model.mesh, least_peak=0.3)
    print(len(find_contacts(finder, image, noise)))
    ```
    """

    smoothing: sparse.csr_array
    cells: Int[np.ndarray, "m 3"]
    points: Float[np.ndarray, "n d"]
    centres: Float[np.ndarray, "m d"]
    areas: Float[np.ndarray, " m"]
    shared: Int[np.ndarray, "m 3"]
    surface: Triangles | None
    level: float
    least_peak: float
    least_prominence: float
    floor: float
    sign: int

    def __init__(
        self,
        mesh: Mesh,
        *,
        smoothing: float | None = None,
        level: float = 0.7,
        least_peak: float = 0.15,
        least_prominence: float = 0.1,
        floor: float = 5.0,
        sign: int = 1,
    ):
        """Create a finder for images on a mesh.

        `smoothing`: standard deviation, metres, of the Gaussian that smooths images, by default 3 % of the square root
        of the mesh's area; `floor`, `sign`: see `AbstractFinder`. Raises `ValueError` for a three-dimensional mesh, an
        invalid smoothing length, and thresholds that are not from 0 to below 1.
        """
        check_finder(mesh, sign, floor, flat=False)
        for option_name, option_value in (
            ("level", level),
            ("least_peak", least_peak),
            ("least_prominence", least_prominence),
        ):
            check_share(option_name, option_value)
        self.cells, self.points = np.asarray(mesh.cells), np.asarray(mesh.points)
        self.centres, self.areas = np.asarray(centroids(mesh)), np.asarray(measures(mesh))
        self.surface = Triangles.of(mesh) if mesh.is_surface else None
        self.smoothing = gaussian_means(mesh, smoothing)
        self.shared = shared_facets(mesh)
        self.level, self.least_peak, self.least_prominence = float(level), float(least_peak), float(least_prominence)
        self.floor, self.sign = float(floor), int(sign)

    def find(self, change, noise):
        """Find the contacts in an image; see `find_contacts`."""
        change, clear_change = self.above_noise(change, noise)
        basin_peaks = watershed_basins(clear_change, self.shared, min_value=0.0, least_prominence=self.least_prominence)
        peak_cells = np.unique(basin_peaks[basin_peaks >= 0])
        strong_peak_cells = peak_cells[change[peak_cells] >= self.least_peak * change[peak_cells].max(initial=0.0)]
        return [
            self._describe_contact(change, noise, peak_cell, basin_peaks == peak_cell)
            for peak_cell in strong_peak_cells.tolist()
        ]

    def _describe_contact(
        self, change: np.ndarray, noise: ImageNoise, peak_cell: int, is_in_basin: np.ndarray
    ) -> Contact:
        contact_level = self.level * change[peak_cell]
        contact_cells = np.flatnonzero(is_in_basin & (change >= contact_level))
        contact_cell_areas, contact_cell_centres = self.areas[contact_cells], self.centres[contact_cells]
        centroid_weights = contact_cell_areas * (change[contact_cells] - contact_level)
        contact_centroid = centroid_weights @ contact_cell_centres / centroid_weights.sum()
        # Derivative of the centroid Σ a (v − level v_peak) x / Σ a (v − level v_peak) with respect to the values v.
        centroid_derivative = np.zeros(self.centres.shape)
        centroid_derivative[contact_cells] = (
            contact_cell_areas[:, None] * (contact_cell_centres - contact_centroid) / centroid_weights.sum()
        )
        centroid_derivative[peak_cell] -= self.level * centroid_derivative[contact_cells].sum(axis=0)
        if self.surface is not None:
            contact_centroid = self.surface.nearest(contact_centroid[None]).points[0]
        return Contact(
            centroid=contact_centroid,
            area=float(contact_cell_areas.sum()),
            peak=float(change[peak_cell]),
            integral=float(contact_cell_areas @ change[contact_cells]),
            contour=outline_of_cells(self.points, self.cells[contact_cells]),
            deviation=noise.distance(self.smoothing.T @ centroid_derivative),
        )
