"""Combination of several kinds of electrodes, and shapes of electrodes as polygons for drawing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jeit.electrodes.electrodes import (
    AbstractCompleteElectrodes,
    AbstractElectrodes,
    Contact,
    ElectrodePen,
    as_electrode_values,
)
from jeit.mesh import Body, Mesh, Refine
from jeit_solvers.engines import namespace, values_at_once


class CombinedElectrodes(AbstractCompleteElectrodes):
    """Complete electrodes of several kinds, numbered consecutively from one kind to the next.

    **Fields**: `parts`: the electrodes of each kind, not including point electrodes.

    **Example:**

    ```python
    rim = BoundaryElectrodes(ring(0.1, 8), 0.01, 1e-3)
    both = CombinedElectrodes(rim, SheetDiscs([[0.0, 0.0]], 0.02, 1e-4))
    ```
    """

    parts: tuple[AbstractElectrodes, ...]

    def __init__(self, *parts: AbstractElectrodes):
        """Raises `ValueError` if there are no parts, or for point electrodes, which have no contact to combine."""
        if not parts:
            raise ValueError("CombinedElectrodes needs at least one set of electrodes.")
        for part in parts:
            if part.is_point:
                raise ValueError(
                    f"{type(part).__name__} cannot be combined with complete electrodes: give them a size and a "
                    "contact impedance (SheetDiscs, FaceDiscs), or make all electrodes points."
                )
        self.parts = parts

    @property
    def contact_impedance(self) -> Float[Array, " L"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Contact impedances (L,) of all parts, ohm·m² (ohm·m for arcs)."""
        return namespace(self).concatenate([part.contact_impedance for part in self.parts])

    def with_contact_impedance(self, contact_impedance: ArrayLike) -> AbstractCompleteElectrodes:
        """Copy with other contact impedances, ohm·m² (ohm·m for arcs). Raises `ValueError` for invalid values."""
        values = as_electrode_values("contact_impedance", contact_impedance, self.num_electrodes, unit="ohm·m²")
        pieces = jnp.split(values, np.cumsum([part.num_electrodes for part in self.parts])[:-1])
        return CombinedElectrodes(
            *(part.with_contact_impedance(piece) for part, piece in zip(self.parts, pieces, strict=True))
        )

    def geometry(self) -> dict[str, Any]:
        """Descriptions of all parts."""
        return {"parts": [part.describe() for part in self.parts]}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Draw all parts, one after the other."""
        for part in self.parts:
            part.draw(mesh, pen)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Refinements of all parts."""
        return tuple(refine for part in self.parts for refine in part.refinement(body))

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """Nodes of the facets and cells of all parts."""
        return tuple(nodes for part in self.parts for nodes in part.contact_nodes(mesh))

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals of all parts, concatenated."""
        contacts = [part.contact(mesh) for part in self.parts]
        return Contact(
            tuple(nodes for contact in contacts for nodes in contact.nodes),
            tuple(mass for contact in contacts for mass in contact.mass),
            namespace(contacts).concatenate([contact.load for contact in contacts], axis=1),
        )

    def check(self, mesh: Mesh) -> None:
        """Check every part on its own. Raises `ValueError` as the parts do."""
        for part in self.parts:
            part.check(mesh)


_CIRCLE_CORNERS, _SIDE_CORNERS = 32, 8
# Number of triangles near a point, by nearest centroids, that are searched when it is projected onto the surface.
_NUM_CANDIDATES = 24


@dataclass(frozen=True)
class ElectrodeShapes:
    """Polygons for drawing electrodes, one or more per electrode.

    **Fields**: `corners` (q, d): corners of all polygons in turn, metres, in space counter-clockwise as seen from
    outside; a dot has a single corner; `sizes` (p,): number of corners of each polygon; `electrode` (p,): index of the
    electrode that each polygon belongs to.

    **Example:**

    ```python
    shapes = shapes_of(mesh, BoundaryElectrodes(ring(0.1, 16), 0.01, 1e-3))
    shapes.number, shapes.middles
    ```
    """

    corners: Float[np.ndarray, "q d"]
    sizes: Int[np.ndarray, " p"]
    electrode: Int[np.ndarray, " p"]

    @property
    def number(self) -> int:
        """Number of electrodes."""
        return int(self.electrode.max()) + 1 if len(self.electrode) else 0

    def polygons(self) -> list[Float[np.ndarray, "k d"]]:
        """Corners of each polygon."""
        return np.split(self.corners, np.cumsum(self.sizes)[:-1])

    def middles(self) -> Float[np.ndarray, "L d"]:
        """Mean of the corners of every electrode."""
        of_corner = np.repeat(self.electrode, self.sizes)
        count = np.bincount(of_corner, minlength=self.number)
        return np.stack([np.bincount(of_corner, one, self.number) / count for one in self.corners.T], axis=1)


def shapes_of(mesh: Mesh, electrodes: AbstractElectrodes) -> ElectrodeShapes:
    """Polygons that draw electrodes on a mesh.

    **Arguments:**

    - `mesh`: a solid, a surface in space or a plane mesh.
    - `electrodes`: the electrodes on it.

    **Example:**

    ```python
    shapes_of(solid, plates(solid, ["left", "right"], 0.01)).polygons
    ```
    """
    polygons: list[np.ndarray] = []
    owner: list[int] = []
    for number, of_one in enumerate(_all_polygons(mesh, electrodes)):
        polygons += of_one
        owner += [number] * len(of_one)
    return ElectrodeShapes(np.concatenate(polygons), np.array([len(one) for one in polygons]), np.array(owner))


def _all_polygons(mesh: Mesh, electrodes: AbstractElectrodes) -> list[list[np.ndarray]]:
    """Polygons of each electrode."""
    points = np.asarray(mesh.points)
    if points.shape[1] == 2:
        pen = _PlanePen()
        electrodes.draw(mesh, pen)
        return pen.drawn
    from jeit.electrodes.facets import FacetElectrodes

    if isinstance(electrodes, CombinedElectrodes):
        return [one for part in electrodes.parts for one in _all_polygons(mesh, part)]
    triangles = surface_triangles(mesh)
    if isinstance(electrodes, FacetElectrodes):
        corners = points[np.asarray(mesh.facets)]
        return [list(corners[covered > 0]) for covered in np.asarray(electrodes.covers).T]
    said = {name: np.asarray(value) for name, value in electrodes.geometry().items() if name != "parts"}
    if "position" not in said:
        load = np.asarray(electrodes.contact(mesh).load)
        return [[one[None]] for one in (load / load.sum(axis=0)).T @ points]
    places = said["position"]
    surface = ProjectionSurface(points, triangles)
    frames = surface.frames(places)
    if "radius" in said:
        angle = 2 * np.pi * np.arange(_CIRCLE_CORNERS) / _CIRCLE_CORNERS
        sizes = np.broadcast_to(said["radius"], len(places))
        flat = [size * np.stack([np.cos(angle), np.sin(angle)], axis=1) for size in sizes]
    elif "width" in said and "height" in said:
        side = np.arange(_SIDE_CORNERS) / _SIDE_CORNERS * 2 - 1
        one = np.ones(_SIDE_CORNERS)
        square = np.concatenate(
            [np.stack(pair, axis=1) for pair in ((side, -one), (one, side), (-side, one), (-one, -side))]
        )
        sizes = np.broadcast_to(said["width"], len(places)), np.broadcast_to(said["height"], len(places))
        flat = [square * [width / 2, height / 2] for width, height in zip(*sizes, strict=True)]
    else:
        return [[place[None]] for place in places]
    return [
        [surface.project(place + shape @ frame[1:], frame[0])]
        for place, shape, frame in zip(places, flat, frames, strict=True)
    ]


def surface_triangles(mesh: Mesh) -> Int[np.ndarray, "m 3"]:
    """Boundary triangles of a solid, or cells of a surface in space."""
    return np.asarray(mesh.facets if mesh.cells.shape[1] == 4 else mesh.cells)


class ProjectionSurface:
    """A surface of triangles onto which flat shapes are projected: `points` (n, 3), `triangles` (m, 3)."""

    def __init__(self, points: Float[np.ndarray, "n 3"], triangles: Int[np.ndarray, "m 3"]):
        self._corners = points[triangles]
        normal = np.cross(self._corners[:, 1] - self._corners[:, 0], self._corners[:, 2] - self._corners[:, 0])
        self._normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        self._tree = KDTree(self._corners.mean(axis=1))

    def normals(self, places: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 3"]:
        """Outward normals of the triangle nearest to each point."""
        return self._normal[self._tree.query(places)[1]]

    def frames(self, places: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 3 3"]:
        """Unit vectors at each point: outward, horizontal and upward, as in `FacePatches`."""
        normal = self.normals(places)
        upward = np.where(np.abs(normal[:, 2:]) > 0.9, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
        across = np.cross(upward, normal)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        return np.stack([normal, across, np.cross(normal, across)], axis=1)

    def project(self, places: Float[np.ndarray, "k 3"], normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "k 3"]:
        """Project points along the normal onto the nearest triangle in that direction; points that meet no triangle are
        returned unchanged."""
        near = self._tree.query(places, k=min(_NUM_CANDIDATES, len(self._corners)))[1].reshape(len(places), -1)
        corners = self._corners[near]
        edge, other = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
        # Möller and Trumbore: place + t normal = corner + a edge + b other.
        across = np.cross(normal, other)
        volume = np.sum(edge * across, axis=-1)
        flat = np.abs(volume) < 1e-12 * np.linalg.norm(edge, axis=-1) * np.linalg.norm(other, axis=-1)
        volume = np.where(flat, 1.0, volume)
        offset = places[:, None] - corners[:, :, 0]
        a = np.sum(offset * across, axis=-1) / volume
        turned = np.cross(offset, edge)
        b = turned @ normal / volume
        t = np.sum(other * turned, axis=-1) / volume
        met = ~flat & (a > -1e-6) & (b > -1e-6) & (a + b < 1 + 1e-6)
        far = np.where(met, np.abs(t), np.inf)
        nearest, row = far.argmin(axis=1), np.arange(len(places))
        moved = np.where(np.isfinite(far[row, nearest]), t[row, nearest], 0.0)
        return places + moved[:, None] * normal


class _PlanePen:
    """Pen that collects the electrodes of a plane mesh as polygons; arcs become segments with two corners."""

    def __init__(self):
        self.drawn: list[list[np.ndarray]] = []

    def lines(self, pieces: list[np.ndarray], middle: np.ndarray) -> None:
        ends = [np.asarray(one) for one in pieces]
        self.drawn.append([one[k : k + 2] for one in ends for k in range(len(one) - 1)])

    def disc(self, middle: np.ndarray, radius: float) -> None:
        angle = 2 * np.pi * np.arange(_CIRCLE_CORNERS) / _CIRCLE_CORNERS
        self.drawn.append([middle[:2] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)])

    def rectangle(self, middle: np.ndarray, width: float, height: float) -> None:
        self.drawn.append([middle[:2] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]])

    def dot(self, middle: np.ndarray) -> None:
        self.drawn.append([np.asarray(middle[:2])[None]])
