"""Inclusions: connected regions where an image exceeds a level, with their areas, centroids and shapes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import sparse

from jeit.arguments.checks import Interval
from jeit.image.segmentation import shared_facets, watershed_basins
from jeit.mesh import Mesh, centroids, measures
from jeit_solvers.module import Module

if TYPE_CHECKING:
    from jeit.image.plane import TriangleSurface

# Numbers of columns and rows of quadrilaterals on the drawn surface of an ellipsoid; a column has three rows.
_SURFACE_COLUMNS, _SURFACE_ROWS = 48, 24
# Level of the image at the edge of the strongest region, as a share of the region's peak.
_STRONGEST_REGION_LEVEL = 0.5


class SolidForm(Module):
    """An ellipsoid, or an upright elliptic column.

    **Fields**: `centre`: (3,) in metres; `axes`: three semi-axes as rows, in metres; the last semi-axis of a column
    points to the upper end; `column`: whether the shape is a column.

    **Example:**

    ```python
    form = SolidForm((0.0, 0.0, 0.03), ((0.02, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.01)), column=False)
    form.surface().enclosed
    ```
    """

    centre: tuple[float, ...]
    axes: tuple[tuple[float, ...], ...]
    column: bool

    def surface(self) -> TriangleSurface:
        """Closed surface of the ellipsoid or column, as triangles."""
        from jeit.image.plane import TriangleSurface

        polar_angles = np.linspace(0, np.pi, _SURFACE_ROWS + 1)
        ring_radii, ring_heights = np.sin(polar_angles), -np.cos(polar_angles)
        if self.column:
            ring_radii, ring_heights = np.array([0.0, 1.0, 1.0, 0.0]), np.array([-1.0, -1.0, 1.0, 1.0])
        ring_angles = 2 * np.pi * np.arange(_SURFACE_COLUMNS) / _SURFACE_COLUMNS
        ring_points = ring_radii[:, None, None] * np.stack([np.cos(ring_angles), np.sin(ring_angles)], axis=1)
        unit_points = np.concatenate(
            [ring_points, np.broadcast_to(ring_heights[:, None, None], (len(ring_heights), _SURFACE_COLUMNS, 1))],
            axis=2,
        )
        semi_axes = np.array(self.axes)
        semi_axes[0] *= np.sign(np.linalg.det(semi_axes))  # a right-handed system, so that all normals point outward
        lower_ring_nodes = _SURFACE_COLUMNS * np.arange(len(ring_heights) - 1)[:, None] + np.arange(_SURFACE_COLUMNS)
        next_lower_nodes = np.roll(lower_ring_nodes, -1, axis=1)
        upper_ring_nodes, next_upper_nodes = lower_ring_nodes + _SURFACE_COLUMNS, next_lower_nodes + _SURFACE_COLUMNS
        triangle_corners = [
            np.stack([lower_ring_nodes, next_lower_nodes, upper_ring_nodes], axis=-1),
            np.stack([next_lower_nodes, next_upper_nodes, upper_ring_nodes], axis=-1),
        ]
        return TriangleSurface(
            unit_points.reshape(-1, 3) @ semi_axes + np.array(self.centre), np.stack(triangle_corners).reshape(-1, 3)
        )


# Minimum area of an inclusion as a fraction of a sheet (a disc with a fourteenth of the sheet's width), and minimum
# volume as a fraction of a solid (a ball with an eighth of the solid's width). Images of solids have a coarser
# resolution.
_MIN_RELATIVE_AREA = {2: 0.004, 3: 0.001}
# Default minimum peak of an inclusion as a multiple of the noise of the image.
DEFAULT_MIN_SIGNIFICANCE = 5.5


class Inclusion(Module):
    """A region of an image where the conductivity is raised or lowered.

    **Fields**: `sign`: +1 for conductive, -1 for resistive; `centroid`: in metres, weighted by the change of
    conductivity; `area`: in m² (in solids: volume in m³); `peak`: the strongest change in the region, in the unit of
    the image, or the posterior median of the change if the inclusion was fitted as a body with intervals; `on_surface`:
    whether the region lies on a surface in space, in which case it has an area although its centroid has three
    coordinates; `form`: shape of an inclusion that was fitted to data as a body in a solid, else None. The other fields
    are None if not estimated: `contrast_interval`: 68 % interval of the change relative to the background;
    `area_interval`: 68 % interval of the area, m², or volume, m³; `strength` and `strength_interval`: see
    `jeit.inverse.shapes.Quantities`; `centroid_radius`: radius, metres, of the circle (in a solid, of the ball) about
    `centroid` that contains the true centroid with a probability of 68 %.

    **Example:**

    ```python
    inclusion = find_inclusions(mesh, image)[0]
    inclusion.kind, inclusion.centroid, inclusion.radius
    ```
    """

    sign: int
    centroid: tuple[float, ...]
    area: float
    peak: float
    on_surface: bool = False
    form: SolidForm | None = None
    contrast_interval: Interval | None = None
    area_interval: Interval | None = None
    strength: float | None = None
    strength_interval: Interval | None = None
    centroid_radius: float | None = None

    @property
    def is_solid(self) -> bool:
        """Whether the inclusion lies in a solid, so that its `area` is a volume in m³."""
        return len(self.centroid) == 3 and not self.on_surface

    @property
    def kind(self) -> str:
        """Kind of the inclusion: 'conductive' or 'resistive'."""
        return "conductive" if self.sign > 0 else "resistive"

    @property
    def is_column(self) -> bool:
        """Whether the inclusion extends through the whole height of a solid."""
        return self.form is not None and self.form.column

    @property
    def radius(self) -> float:
        """Radius in metres of the disk of the same area as the inclusion, or in 3-D of the ball of the same volume."""
        if self.is_solid:
            return float(np.cbrt(3 * self.area / (4 * np.pi)))
        return float(np.sqrt(self.area / np.pi))


def find_inclusions(
    mesh: Mesh,
    image: Float[Array, " m"],
    *,
    level: float = 0.5,
    least_peak: float = 0.3,
    least_prominence: float = 0.1,
    least_area: float | None = None,
    noise: Float[Array, " m"] | None = None,
    least_significance: float = DEFAULT_MIN_SIGNIFICANCE,
) -> list[Inclusion]:
    """Find inclusions: the peaks of an image, each with the surrounding region where the change exceeds `level` times
    the peak. The strongest inclusion comes first. Peaks below the minimum values in the arguments are regarded as
    artefacts and left out.

    **Arguments:**

    - `mesh`: the mesh.
    - `image` (m,): change of conductivity in every cell of the mesh.
    - `level`: change at the edge of an inclusion, as a share of its peak.
    - `least_peak`: minimum height of a peak, as a share of the strongest change of either sign.
    - `least_prominence`: minimum height of a peak above the saddle towards a higher peak, as a share of the height of
      the lower peak.
    - `least_area`: minimum area (volume) of a region, as a fraction of the mesh; default 0.004 for a sheet and 0.001
      for a solid (0.004 of a solid would be a ball with a fifth of the solid's width).
    - `noise` (m,): standard deviation of the image in every cell, in the unit of the image.
    - `least_significance`: minimum height of a peak, as a multiple of the `noise`; not used without `noise`.

    Raises `ValueError` for an image of the wrong size or with NaN.

    **Example:**

    ```python
    for inclusion in find_inclusions(mesh, image):
        print(inclusion)
    ```
    """
    regions = inclusion_regions(
        mesh,
        image,
        level=level,
        least_peak=least_peak,
        least_prominence=least_prominence,
        least_area=least_area,
        noise=noise,
        least_significance=least_significance,
    )
    return [inclusion for inclusion, _ in regions]


class StrongestRegion:
    """Computes the position of the strongest change in an image: the centroid, weighted by area (volume) and change, of
    the connected region around the peak where the change exceeds half of the peak.

    The position of the peak itself is biased towards electrodes, where voltages are most sensitive; the centroid is
    less biased. Quantities that depend on the `mesh` alone are computed in advance.
    """

    def __init__(self, mesh: Mesh):
        shared_indices = np.asarray(mesh.cells if mesh.dimension == 3 else shared_facets(mesh))
        cell_rows, index_columns = np.nonzero(shared_indices >= 0)  # facets of the boundary are not shared
        incidence_entries = np.ones(len(cell_rows), np.float32), (cell_rows, shared_indices[cell_rows, index_columns])
        self._incidence = sparse.csr_array(
            incidence_entries, shape=(len(shared_indices), int(shared_indices.max()) + 1)
        )
        self._transposed_incidence = sparse.csr_array(self._incidence.T)
        self._cell_measures, self._cell_centroids = np.asarray(measures(mesh)), np.asarray(centroids(mesh))

    def __call__(self, change: Float[np.ndarray, " m"]) -> tuple[Float[np.ndarray, " d"], float]:
        """Return the centroid of the strongest region, in metres, and the signed peak of a `change` (m,) per cell."""
        peak_cell = int(np.abs(change).argmax())
        relative_change = change / change[peak_cell] if change[peak_cell] else np.zeros_like(change)
        exceeds_threshold = relative_change >= _STRONGEST_REGION_LEVEL
        region_indicator = np.zeros(len(change), np.float32)
        region_indicator[peak_cell] = 1
        num_region_cells = 0
        while num_region_cells != (num_region_cells := int(region_indicator.sum())):
            region_indicator = (
                (self._incidence @ (self._transposed_incidence @ region_indicator) > 0) & exceeds_threshold
            ).astype(np.float32)
            region_indicator[peak_cell] = 1
        region_cells = region_indicator > 0
        centroid_weights = self._cell_measures[region_cells] * np.maximum(
            relative_change[region_cells], _STRONGEST_REGION_LEVEL
        )
        return centroid_weights @ self._cell_centroids[region_cells] / centroid_weights.sum(), float(change[peak_cell])


def inclusion_regions(
    mesh: Mesh,
    image: Float[Array, " m"],
    *,
    level: float,
    least_peak: float,
    least_prominence: float = 0.1,
    least_area: float | None = None,
    noise: Float[Array, " m"] | None = None,
    least_significance: float = DEFAULT_MIN_SIGNIFICANCE,
) -> list[tuple[Inclusion, Bool[np.ndarray, " m"]]]:
    """Return the inclusions of `find_inclusions`, each with a mask (m,) of the cells of its region. Raises `ValueError`
    as `find_inclusions` does."""
    image_values = np.asarray(image)
    if image_values.shape != (mesh.num_cells,):
        raise ValueError(
            f"image has shape {image_values.shape}; give one value for each of the {mesh.num_cells} cells."
        )
    if np.iscomplexobj(image_values):
        raise ValueError("image is complex; look for inclusions in its real or imaginary part.")
    if not (0 < level < 1 and 0 <= least_peak <= 1):
        raise ValueError(f"level must lie between 0 and 1 and least_peak too; they are {level} and {least_peak}.")
    if not np.isfinite(image_values).all():
        raise ValueError("image has NaN or infinite values; reconstruct it from unmasked channels first.")
    if noise is not None and np.shape(noise) != image_values.shape:
        raise ValueError(f"noise has shape {np.shape(noise)}; give one value for each of the {mesh.num_cells} cells.")
    max_change = np.abs(image_values).max()
    if max_change == 0:
        return []
    cell_measures, cell_centres = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    # In solids, cells that share a node count as neighbours, because a tetrahedron shares facets with only some of the
    # adjacent cells of higher value.
    shared_indices = np.asarray(mesh.cells) if mesh.dimension == 3 else shared_facets(mesh)
    if least_area is None:
        least_area = _MIN_RELATIVE_AREA[mesh.dimension]
    inclusions_with_regions = []
    for sign in (1, -1):
        signed_change = sign * image_values
        basin_indices = watershed_basins(
            signed_change, shared_indices, min_value=level * least_peak * max_change, least_prominence=least_prominence
        )
        for peak_cell in np.unique(basin_indices[basin_indices >= 0]):
            peak_change = signed_change[peak_cell]
            region_cells = (basin_indices == peak_cell) & (signed_change >= level * peak_change)
            if noise is not None and peak_change < least_significance * noise[peak_cell]:
                continue
            if (
                peak_change < least_peak * max_change
                or cell_measures[region_cells].sum() < least_area * cell_measures.sum()
            ):
                continue
            centroid_weights = (cell_measures * signed_change)[region_cells]
            centroid = tuple(
                float(coordinate)
                for coordinate in centroid_weights @ cell_centres[region_cells] / centroid_weights.sum()
            )
            inclusions_with_regions.append(
                (
                    Inclusion(
                        sign,
                        centroid,
                        float(cell_measures[region_cells].sum()),
                        float(sign * peak_change),
                        mesh.is_surface,
                    ),
                    region_cells,
                )
            )
    return sorted(inclusions_with_regions, key=lambda inclusion_and_region: -abs(inclusion_and_region[0].peak))
