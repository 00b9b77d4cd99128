"""Inclusions: connected regions of an image above a level, with their areas, centroids and forms."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.image.segmentation import basins, shared_facets
from jeit.mesh import Mesh, centroids, measures

if TYPE_CHECKING:
    from jeit.image.plane import TriangleSurface

_ROUND, _UP = 48, 24


class SolidForm(eqx.Module):
    """An ellipsoid, or an elliptic column that stands.

    **Fields**: `centre`, metres; `axes`, three half axes as rows, metres, of a column the last up to its upper end;
    `column`, whether it is one.
    """

    centre: tuple[float, ...]
    axes: tuple[tuple[float, ...], ...]
    column: bool

    def surface(self) -> TriangleSurface:
        """Triangles all round it."""
        from jeit.image.plane import TriangleSurface

        up = np.linspace(0, np.pi, _UP + 1)
        radius, height = np.sin(up), -np.cos(up)
        if self.column:
            radius, height = np.array([0.0, 1.0, 1.0, 0.0]), np.array([-1.0, -1.0, 1.0, 1.0])
        angle = 2 * np.pi * np.arange(_ROUND) / _ROUND
        level = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        unit = np.concatenate([level, np.broadcast_to(height[:, None, None], (len(height), _ROUND, 1))], axis=2)
        axes = np.array(self.axes)
        axes[0] *= np.sign(np.linalg.det(axes))  # outward all round
        low = _ROUND * np.arange(len(height) - 1)[:, None] + np.arange(_ROUND)
        low_next = np.roll(low, -1, axis=1)
        high, high_next = low + _ROUND, low_next + _ROUND
        corners = [np.stack([low, low_next, high], axis=-1), np.stack([low_next, high_next, high], axis=-1)]
        return TriangleSurface(unit.reshape(-1, 3) @ axes + np.array(self.centre), np.stack(corners).reshape(-1, 3))


# Share of a sheet, and of a solid, whose images are of coarser grain: a disc of a fourteenth of its width, and a ball
# of an eighth.
_LEAST_AREA = {2: 0.004, 3: 0.001}


class Inclusion(eqx.Module):
    """One region of raised or lowered conductivity.

    **Fields**: `sign`, +1 conductive or -1 resistive; `centroid` in metres, weighted by the change; `area` in m² (of
    solids volume in m³); `peak`, the strongest change in it, in the image's unit; `on_surface`, whether it lies on a
    surface in space, which has an area though its centroid has three coordinates; `form`, of what was fitted to data as
    a body of a solid.
    """

    sign: int
    centroid: tuple[float, ...]
    area: float
    peak: float
    on_surface: bool = False
    form: SolidForm | None = None

    @property
    def is_solid(self) -> bool:
        """Whether `area` is a volume."""
        return len(self.centroid) == 3 and not self.on_surface

    @property
    def kind(self) -> str:
        """'conductive' or 'resistive'."""
        return "conductive" if self.sign > 0 else "resistive"

    @property
    def is_column(self) -> bool:
        """Whether it stands through the whole height of a solid."""
        return self.form is not None and self.form.column

    @property
    def radius(self) -> float:
        """Radius of the disk of the same area, or in 3-D of the ball of the same volume, metres."""
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
    least_significance: float = 5.5,
) -> list[Inclusion]:
    """Peaks of an image, each with the region round it where the change exceeds `level` times that peak.

    `image` (m,): change of conductivity in every cell. A peak counts if it is at least `least_peak` times the
    strongest change of either sign, stands at least `least_prominence` times its own height above the saddle to a
    higher one, and its region covers at least `least_area` of the mesh; the rest are artefacts. Unless given that is
    0.004 of a sheet and 0.001 of a solid, of which 0.004 would be a ball of a fifth of its width. Artefacts are also
    peaks of less than `least_significance` times `noise` (m,), the standard deviation of the image, where given.
    Strongest first. Raises `ValueError` for an image of another size or with NaN.
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


def inclusion_regions(
    mesh: Mesh,
    image: Float[Array, " m"],
    *,
    level: float,
    least_peak: float,
    least_prominence: float = 0.1,
    least_area: float | None = None,
    noise: Float[Array, " m"] | None = None,
    least_significance: float = 5.5,
) -> list[tuple[Inclusion, Bool[np.ndarray, " m"]]]:
    """The inclusions of `find_inclusions`, each with its cells. Raises `ValueError` as that does."""
    values = np.asarray(image)
    if values.shape != (mesh.num_cells,):
        raise ValueError(f"image has shape {values.shape}; give one value for each of the {mesh.num_cells} cells.")
    if np.iscomplexobj(values):
        raise ValueError("image is complex; look for inclusions in its real or imaginary part.")
    if not (0 < level < 1 and 0 <= least_peak <= 1):
        raise ValueError(f"level must lie between 0 and 1 and least_peak too; they are {level} and {least_peak}.")
    if not np.isfinite(values).all():
        raise ValueError("image has NaN or infinite values; reconstruct it from unmasked channels first.")
    if noise is not None and np.shape(noise) != values.shape:
        raise ValueError(f"noise has shape {np.shape(noise)}; give one value for each of the {mesh.num_cells} cells.")
    strongest = np.abs(values).max()
    if strongest == 0:
        return []
    measure, centre = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    # A tetrahedron is next to a higher one across some of its facets only: along a ridge the way goes over nodes.
    shared = np.asarray(mesh.cells) if mesh.dimension == 3 else shared_facets(mesh)
    if least_area is None:
        least_area = _LEAST_AREA[mesh.dimension]
    found = []
    for sign in (1, -1):
        change = sign * values
        basin = basins(change, shared, floor=level * least_peak * strongest, least_prominence=least_prominence)
        for label in np.unique(basin[basin >= 0]):
            peak = change[label]
            region = (basin == label) & (change >= level * peak)
            if noise is not None and peak < least_significance * noise[label]:
                continue
            if peak < least_peak * strongest or measure[region].sum() < least_area * measure.sum():
                continue
            weight = (measure * change)[region]
            centroid = tuple(float(value) for value in weight @ centre[region] / weight.sum())
            found.append(
                (Inclusion(sign, centroid, float(measure[region].sum()), float(sign * peak), mesh.is_surface), region)
            )
    return sorted(found, key=lambda one: -abs(one[0].peak))
