"""Rectangular electrodes on the surface of a 3-D body, such as the plates round a tank."""

import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.electrodes.discs import facet_normals, nearest_facets, seen_flat
from jeit.electrodes.electrodes import (
    AbstractPlacedElectrodes,
    Contact,
    ElectrodePen,
    as_electrode_values,
    as_positions,
    check_dimension,
)
from jeit.electrodes.window import EDGE, smooth_step, triangle_quadrature, window_contact
from jeit.mesh import Body, Mesh, Refine
from jeit.mesh.geometry import facet_measures
from jeit_solvers.engines import has_values, namespace, on_host, undifferentiated


class FacePatches(AbstractPlacedElectrodes):
    """Complete electrodes that are rectangles on the surface of a 3-D mesh, free of its nodes.

    A patch lies in the tangent plane at its position: its width runs horizontally (perpendicular to z) and its
    height up the surface; on a horizontal face width runs along x and height along y. On a curved face it covers what
    lies beneath that rectangle: round a cylinder of radius R a plate of arc length a has the width 2 R sin(a / 2 R).

    **Fields**: `position` (L, 3) metres, on the surface; `width`, `height` (L,) metres; `contact_impedance` (L,)
    ohm·m².
    """

    position: Float[Array, "L 3"]
    width: Float[Array, " L"]
    height: Float[Array, " L"]
    contact_impedance: Float[Array, " L"]

    def __init__(self, position: ArrayLike, width: ArrayLike, height: ArrayLike, contact_impedance: ArrayLike):
        """Sizes and `contact_impedance` may be one number for all electrodes. Raises `ValueError`."""
        self.position = as_positions(position, (3,))
        self.width = as_electrode_values("width", width, len(self.position), unit="metres")
        self.height = as_electrode_values("height", height, len(self.position), unit="metres")
        self.contact_impedance = as_electrode_values(
            "contact_impedance", contact_impedance, len(self.position), unit="ohm·m²"
        )

    def geometry(self) -> dict[str, Array]:
        """Positions, widths and heights."""
        return {"position": self.position, "width": self.width, "height": self.height}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Rectangles on horizontal faces, dots elsewhere."""
        places, flat = np.asarray(self.position), seen_flat(mesh, self.position)
        sizes = np.asarray(self.width), np.asarray(self.height)
        for place, width, height, whole in zip(places, *sizes, flat, strict=True):
            if whole:
                pen.rectangle(place, width, height)
            else:
                pen.dot(place)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """None: they are not of a plane mesh."""
        return ()

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """The boundary triangles of `mesh`."""
        return (mesh.facets,)

    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals over the boundary triangles, by quadrature of the windows."""
        xp = namespace(self, mesh)
        area = facet_measures(mesh)
        barycentric, _ = triangle_quadrature()
        points = xp.einsum("pi,bid->bpd", barycentric, mesh.points[mesh.facets])
        normal, across, up = _frames(mesh, self.position)
        offset = points[:, :, None, :] - self.position  # (b, p, L, 3)
        edge = EDGE * xp.sqrt(area)[:, None, None]
        window = smooth_step((self.width / 2 - abs((offset * across).sum(axis=-1))) / edge)
        window = window * smooth_step((self.height / 2 - abs((offset * up).sum(axis=-1))) / edge)
        # The same side of the body: facing as the electrode does, and no deeper than the patch is large.
        facing = facet_normals(mesh) @ normal.T > 0.5
        depth = abs((offset.mean(axis=1) * normal).sum(axis=-1))
        near = depth < xp.maximum(self.width, self.height) / 2
        window = window * undifferentiated(facing & near)[:, None, :]
        every = xp.broadcast_to(xp.arange(self.num_electrodes), (len(area), self.num_electrodes))
        window = xp.swapaxes(window, 1, 2)
        return window_contact(mesh.facets, area, window, every, self.contact_impedance, mesh.num_points)

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` for patches off the surface, overlapping, or too small for the mesh."""
        check_dimension("FacePatches", mesh, 3)
        if not has_values(self, mesh):
            return
        electrodes, mesh = on_host((self, mesh))
        touched = electrodes.contact(mesh).load * electrodes.contact_impedance
        share = touched.sum(axis=0) / (electrodes.width * electrodes.height)
        # A patch bent round a wall is longer than its chord, by a tenth at 80° of arc.
        wrong = np.flatnonzero((share < 0.8) | (share > 1.25))
        if wrong.size:
            raise ValueError(
                f"position: {100 * share[wrong[0]]:.0f} % of electrode {wrong[0] + 1}'s area is found on the mesh's "
                "surface; move it onto the surface, or refine the mesh there if the patch is smaller than a facet."
            )
        overlap = (touched.T @ touched) / np.sqrt(np.outer(*(2 * [(touched**2).sum(axis=0)])))
        np.fill_diagonal(overlap, 0)
        if overlap.max() > 0.2:
            first, second = np.unravel_index(overlap.argmax(), overlap.shape)
            raise ValueError(f"Electrodes {first + 1} and {second + 1} overlap; move them apart.")


def _frames(mesh: Mesh, position):
    """Unit vectors (L, 3) at each electrode: normal of the nearest facet, across, and up. Not differentiated."""
    xp = namespace(mesh, position)
    normal = facet_normals(mesh)[nearest_facets(mesh, position)]
    horizontal = abs(normal[:, 2:]) > 0.9
    upward = xp.where(horizontal, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])).astype(normal.dtype)
    across = xp.cross(upward, normal)
    across = across / xp.linalg.norm(across, axis=1, keepdims=True)
    return tuple(map(undifferentiated, (normal, across, xp.cross(normal, across))))
