"""Electrodes on the edge of a sheet: arcs of the boundary of a 2-D mesh, integrated exactly."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.electrodes.electrodes import (
    AbstractElectrodes,
    Contact,
    as_electrode_values,
    as_positions,
    check_dimension,
    is_concrete,
)
from jeit.mesh import Mesh, facet_measures


class BoundaryElectrodes(AbstractElectrodes):
    """Complete electrodes that cover arcs of the boundary of a 2-D mesh, free of its nodes.

    Electrode l covers the points of the boundary within `width[l]` / 2 of `position[l]`, measured along the
    boundary polygon. Its integrals over partly covered edges are polynomials in its two end points, so they are
    exact and differentiable in position and width at once.

    **Fields**: `position` (L, 2) metres, projected to the nearest boundary edge; `width` (L,) metres;
    `contact_impedance` (L,) ohm·m (sheet: contact impedance in ohm·m² over the sheet's thickness).
    """

    position: Float[Array, "L 2"]
    width: Float[Array, " L"]
    contact_impedance: Float[Array, " L"]
    is_point: ClassVar[bool] = False

    def __init__(self, position, width, contact_impedance):
        """`width` and `contact_impedance` may be one number for all electrodes. Raises `ValueError`."""
        self.position = as_positions(position, (2,))
        self.width = as_electrode_values("width", width, self.num_electrodes, unit="metres")
        self.contact_impedance = as_electrode_values(
            "contact_impedance", contact_impedance, self.num_electrodes, unit="ohm·m"
        )

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L."""
        return self.position.shape[0]

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """The boundary edges of `mesh`."""
        return (mesh.facets,)

    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals over the boundary edges of `mesh`, exact for P1 basis functions."""
        start, end = _covered(self, mesh)
        length = facet_measures(mesh)[:, None, None]
        # Basis functions on an edge: φ_1 = t / length, φ_0 = 1 - φ_1; these are their integrals over [start, end].
        one = end - start
        first = (end**2 - start**2) / (2 * length)
        second = (end**3 - start**3) / (3 * length**2)
        phi = jnp.stack([one - first, first]).sum(axis=-1)  # (2, b, L)
        phi_phi = jnp.stack([one - 2 * first + second, first - second, second]).sum(axis=-1)
        admittance = 1 / self.contact_impedance
        entries = phi_phi @ admittance  # (3, b)
        mass = jnp.stack([entries[:2], entries[1:]]).transpose(2, 0, 1)
        load = jnp.zeros((mesh.num_points, self.num_electrodes), phi.dtype)
        load = load.at[mesh.facets.T].add(phi * admittance)
        return Contact((mesh.facets,), (mass,), load)

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` for electrodes off the boundary, wider than it, or overlapping."""
        check_dimension("BoundaryElectrodes", mesh, 2)
        if not is_concrete(self.position, self.width, mesh.points, mesh.facets):
            return
        _, distance = map(np.asarray, _project(self.position, mesh))
        far = np.flatnonzero(distance > np.maximum(0.5 * self.width, 2e-3 * np.ptp(mesh.points, axis=0).max()))
        if far.size:
            raise ValueError(
                f"position: electrode {far[0] + 1} lies {distance[far[0]]:.3g} m from the boundary of the mesh; "
                "they must lie on it (are both in metres?). For electrodes inside a sheet use SheetDiscs."
            )
        start, end = map(np.asarray, _covered(self, mesh))
        covered = np.clip(end - start, 0, None).sum(axis=-1)  # (b, L)
        short = np.flatnonzero(covered.sum(axis=0) < (1 - 1e-9) * np.asarray(self.width))
        if short.size:
            raise ValueError(
                f"width: electrode {short[0] + 1} is {float(self.width[short[0]]):.3g} m wide, more than the boundary "
                "it lies on; widths are in metres."
            )
        pairs = overlapping_pairs(np.asarray(start), np.asarray(end))
        if pairs:
            first, second = pairs[0]
            raise ValueError(
                f"Electrodes {first + 1} and {second + 1} overlap; move them apart or make them narrower "
                "(positions and widths are in metres along the boundary)."
            )


def overlapping_pairs(start: np.ndarray, end: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of electrodes that cover a common piece of an edge, given intervals (b, L, 3) along each edge."""
    start, end = start.transpose(1, 0, 2), end.transpose(1, 0, 2)
    pairs = []
    for first in range(start.shape[0]):
        for second in range(first + 1, start.shape[0]):
            common = np.minimum(end[first][:, :, None], end[second][:, None, :]) - np.maximum(
                start[first][:, :, None], start[second][:, None, :]
            )
            if common.max() > 1e-9 * end.max():
                pairs.append((first, second))
    return pairs


def _project(position, mesh: Mesh):
    """Arc length of the boundary point nearest to each position, with its facet; and the distance to it.

    Returns ((facet (L,), arc length (L,)), distance (L,)).
    """
    tail, head = mesh.points[mesh.facets[:, 0]], mesh.points[mesh.facets[:, 1]]
    along = head - tail
    offset = position[:, None, :] - tail  # (L, b, 2)
    fraction = jnp.sum(offset * along, axis=-1) / jnp.sum(along**2, axis=-1)
    clipped = jnp.clip(fraction, 0, 1)
    squared = jnp.sum((offset - clipped[..., None] * along) ** 2, axis=-1)
    facet = jnp.argmin(jax.lax.stop_gradient(squared), axis=1)
    chosen = facet[:, None]
    # Not clipped: at a corner either edge's tangent is a one-sided derivative, where clipping would give zero.
    fraction = jnp.take_along_axis(fraction, chosen, 1)[:, 0]
    distance = jnp.sqrt(jnp.take_along_axis(jax.lax.stop_gradient(squared), chosen, 1)[:, 0])
    length = jnp.sqrt(jnp.sum(along**2, axis=-1))
    _, arc_start, _ = _loops(mesh, length)
    return (facet, arc_start[facet] + fraction * length[facet]), distance


def _loops(mesh: Mesh, length):
    """For every boundary edge: its loop, the arc length from the loop's beginning, and the loop's perimeter."""
    tail, head = mesh.facets[:, 0], mesh.facets[:, 1]
    begins = jnp.concatenate([jnp.zeros(1, bool), tail[1:] != head[:-1]])
    loop = jnp.cumsum(begins)
    travelled = jnp.cumsum(length) - length
    perimeters = jax.ops.segment_sum(length, loop, num_segments=length.shape[0], indices_are_sorted=True)
    before = jnp.cumsum(perimeters) - perimeters
    return loop, travelled - before[loop], perimeters[loop]


def _covered(electrodes: BoundaryElectrodes, mesh: Mesh):
    """Interval of each edge that each electrode covers: start and end (b, L, 3), zero ≤ start ≤ end ≤ length.

    The last axis goes round the loop: an electrode may lie across the point where arc length begins.
    """
    length = facet_measures(mesh)
    (facet, centre), _ = _project(electrodes.position, mesh)
    loop, arc_start, perimeter = _loops(mesh, length)
    turns = jnp.array([-1.0, 0.0, 1.0]) * perimeter[facet][:, None]
    middle = (centre[:, None] + turns)[None] - arc_start[:, None, None]  # (b, L, 3)
    half = 0.5 * electrodes.width[:, None]
    limit = length[:, None, None]
    start, end = jnp.clip(middle - half, 0, limit), jnp.clip(middle + half, 0, limit)
    same = (loop[:, None] == loop[facet])[..., None]
    return jnp.where(same, start, 0), jnp.where(same, end, 0)
