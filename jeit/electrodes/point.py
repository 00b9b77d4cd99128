"""Point electrodes, and electrodes whose contact integrals are computed in advance."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.electrodes.electrodes import AbstractElectrodes, AbstractPointElectrodes, Contact, ElectrodePen, as_positions
from jeit.mesh import Body, Mesh, Refine, gradients, measures, normals
from jeit_solvers.engines import (
    has_values,
    namespace,
    numpy_or_compiled,
    on_device,
    on_host,
    sum_into,
    undifferentiated,
    values_at_once,
)


class PointElectrodes(AbstractPointElectrodes):
    """Point electrodes at any position in a mesh, on its boundary, or on a surface in space.

    Current is injected, and voltage is measured, by P1 interpolation in the cell that contains the position. The
    potential of a point source is singular, so voltages at driven electrodes depend on the mesh.

    **Fields**: `position` (L, d): positions of the L electrodes, metres.

    **Example:**

    ```python
    electrodes = PointElectrodes(ring(0.05, 8))
    electrodes.check(mesh)
    ```
    """

    position: Float[Array, "L d"]

    def __init__(self, position: ArrayLike):
        """Raises `ValueError` for anything but finite (L, 2) or (L, 3) positions."""
        self.position = as_positions(position, (2, 3))

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L."""
        return self.position.shape[0]

    def geometry(self) -> dict[str, Array]:
        """Positions of the electrodes."""
        return {"position": self.position}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Draw each electrode as a dot."""
        for position in np.asarray(self.position):
            pen.dot(position)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Halve the cell size at the positions, seen from above."""
        return (Refine(np.asarray(self.position)[:, :2], factor=2.0),)

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Values of the n basis functions at the L electrodes as `load` (n, L) of the contact, with zero mass."""
        cell, barycentric_weights, _ = _find_containing_cells(self.position, mesh)
        node_indices = mesh.cells[cell], np.arange(self.num_electrodes)[:, None]
        load = sum_into((mesh.num_points, self.num_electrodes), node_indices, barycentric_weights)
        return _point_contact(self.contact_nodes(mesh), load)

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` for electrodes outside the mesh, or two electrodes at the same position."""
        if self.position.shape[1] != mesh.space_dimension:
            raise ValueError(
                f"position has {self.position.shape[1]} coordinates and the mesh is in {mesh.space_dimension}-D."
            )
        if not has_values(self.position, mesh.points, mesh.cells):
            return
        position, mesh_points = np.asarray(self.position), np.asarray(mesh.points)
        distances_outside = np.asarray(_find_containing_cells(self.position, mesh)[2])
        # A point on a curved boundary lies slightly outside the polygon: allow a third of a cell.
        electrodes_outside = np.flatnonzero(distances_outside < -1 / 3)
        if electrodes_outside.size and mesh.is_surface:
            raise ValueError(
                f"position: electrode {electrodes_outside[0] + 1} at {position[electrodes_outside[0]].tolist()} m lies "
                "off the surface, by more than a third of the nearest triangle; the surface spans "
                f"{mesh_points.min(axis=0).tolist()} to {mesh_points.max(axis=0).tolist()} m. Move it onto the surface."
            )
        if electrodes_outside.size:
            raise ValueError(
                f"position: electrode {electrodes_outside[0] + 1} at {position[electrodes_outside[0]].tolist()} m lies "
                f"outside the mesh, which spans {mesh_points.min(axis=0).tolist()} to "
                f"{mesh_points.max(axis=0).tolist()} m."
            )
        distances_between_electrodes = (
            np.linalg.norm(position[:, None] - position, axis=-1) + np.eye(len(position)) * 1e300
        )
        if distances_between_electrodes.min() < 1e-9 * np.ptp(mesh_points, axis=0).max():
            first_electrode, second_electrode = np.unravel_index(
                distances_between_electrodes.argmin(), distances_between_electrodes.shape
            )
            raise ValueError(f"Electrodes {first_electrode + 1} and {second_electrode + 1} are at the same position.")


class NodeElectrodes(AbstractPointElectrodes):
    """Point electrodes at nodes of a mesh, as in imported models, without interpolation.

    **Fields**: `nodes` (L,): indices into `mesh.points`.

    **Example:**

    ```python
    electrodes = NodeElectrodes([0, 5, 10, 15])
    electrodes.num_electrodes
    ```
    """

    nodes: Int[Array, " L"]

    def __init__(self, nodes: ArrayLike):
        """Raises `ValueError` for anything but L distinct non-negative integers."""
        node_array = np.asarray(nodes)
        if node_array.ndim != 1 or node_array.size == 0 or not np.issubdtype(node_array.dtype, np.integer):
            raise ValueError("nodes must be a list of node indices, one integer for each electrode.")
        if node_array.min() < 0 or len(np.unique(node_array)) != len(node_array):
            raise ValueError("nodes must be distinct, non-negative, zero-based node indices.")
        self.nodes = jnp.asarray(node_array, jnp.int32)

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L."""
        return self.nodes.shape[0]

    def geometry(self) -> dict[str, Array]:
        """Empty: the electrodes are defined by nodes of a mesh."""
        return {}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Draw each electrode as a dot."""
        for position in np.asarray(mesh.points)[np.asarray(self.nodes)]:
            pen.dot(position)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Empty, because the electrodes belong to an existing mesh."""
        return ()

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """`load` (n, L) with 1 at the node of each electrode, and zero mass."""
        unit_weights = namespace(self, mesh).ones(self.num_electrodes, mesh.points.dtype)
        index = self.nodes, np.arange(self.num_electrodes)
        return _point_contact(
            self.contact_nodes(mesh), sum_into((mesh.num_points, self.num_electrodes), index, unit_weights)
        )

    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` for an electrode whose index is not that of a node of `mesh`."""
        if has_values(self.nodes) and int(self.nodes.max()) >= mesh.num_points:
            raise ValueError(
                f"nodes: index {int(self.nodes.max())} is out of range for a mesh of {mesh.num_points} nodes; indices "
                "count from 0."
            )


def _point_contact(nodes, load) -> Contact:
    return Contact(nodes, (namespace(load).zeros((1, 1, 1), load.dtype),), load)


@numpy_or_compiled
def _find_containing_cells(position, mesh: Mesh):
    """Cell that contains each position, barycentric coordinates in the cell, and the smallest of the coordinates, which
    is negative for a position outside the mesh."""
    xp = namespace(position, mesh)
    corners = mesh.points[mesh.cells]  # (m, d + 1, d)
    # Basis functions are linear, so their values at a position follow from their gradients.
    local_coordinates = xp.einsum("mij,lmj->lmi", gradients(mesh)[:, 1:], position[:, None] - corners[:, 0])
    barycentric_coordinates = xp.concatenate(
        [1 - local_coordinates.sum(axis=-1, keepdims=True), local_coordinates], axis=-1
    )
    smallest_weights = undifferentiated(barycentric_coordinates).min(axis=-1)
    if mesh.is_surface:  # a position may project into many triangles: prefer the closest
        distance_off_plane = xp.einsum("mi,lmi->lm", normals(mesh), position[:, None] - corners[:, 0])
        smallest_weights = xp.minimum(smallest_weights, 0) - abs(undifferentiated(distance_off_plane)) / xp.sqrt(
            2 * undifferentiated(measures(mesh))
        )
    cell = xp.argmax(smallest_weights, axis=1)
    barycentric_weights = xp.take_along_axis(barycentric_coordinates, cell[:, None, None], 1)[:, 0]
    return cell, barycentric_weights, smallest_weights.max(axis=1)


class IntegratedElectrodes(AbstractElectrodes):
    """Precomputed contact integrals of other electrodes on a mesh; the electrodes cannot be changed afterwards.

    **Fields**: `integrals`: contact integrals of the electrodes on the mesh; `point`: whether the integrals are those
    of point electrodes.
    """

    integrals: Contact
    point: bool = eqx.field(static=True)

    def __init__(self, electrodes: AbstractElectrodes, mesh: Mesh):
        if has_values(electrodes, mesh):
            contact_integrals = on_host(electrodes).contact(on_host(mesh))
            self.integrals = contact_integrals if namespace(electrodes, mesh) is np else on_device(contact_integrals)
        else:
            self.integrals = electrodes.contact(mesh)
        self.point = electrodes.is_point

    @property
    def is_point(self) -> bool:
        """Whether the integrals were computed for point electrodes."""
        return self.point

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L."""
        return self.integrals.load.shape[1]

    @property
    def contact_impedance(self) -> Float[Array, " L"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Raises `AttributeError`: the contact impedance is part of the integrals."""
        raise AttributeError(
            "IntegratedElectrodes hold contact integrals only; take the contact impedance of the "
            "electrodes from which they were computed."
        )

    def with_contact_impedance(self, contact_impedance: ArrayLike) -> AbstractElectrodes:
        """Raises `ValueError`: the contact impedance is part of the integrals."""
        raise ValueError("IntegratedElectrodes cannot be changed; change the electrodes and integrate them anew.")

    def geometry(self) -> dict[str, Any]:
        """Empty, because positions and sizes are not stored."""
        return {}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Raises `ValueError`: positions are not stored."""
        raise ValueError("IntegratedElectrodes hold no positions; draw the electrodes from which they were computed.")

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Empty, because the electrodes belong to an existing mesh."""
        return ()

    def contact_nodes(self, mesh: Mesh):
        """Nodes of the original electrodes' contact integrals."""
        return self.integrals.nodes

    def contact(self, mesh: Mesh) -> Contact:
        """The precomputed integrals; `mesh` is ignored."""
        return self.integrals

    def check(self, mesh: Mesh) -> None:
        """Does nothing; the original electrodes must be checked instead."""
