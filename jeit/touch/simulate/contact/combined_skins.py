"""Skins of two sheets, and indenters that are moved or joined.

A model of two conducting sheets, one on the other, that touch where they are pressed, so that a touch raises
conductivity:

    ∇·(σ₁∇u) = g (u − w),    ∇·(σ₂∇w) = g (w − u),

where u is the potential of the lower sheet, which has the electrodes, w that of the upper sheet, whose edge is
insulated, and g(x, y) the conductance between the sheets per area. If g = 0, the upper sheet carries no current; if
√(σ/g) is small compared with the contact, both sheets carry current. Sheets in contact everywhere conduct like one
sheet of at most σ₁ + σ₂, and so does a contact if the upper sheet is only as large as the contact. For a contact on a
larger upper sheet, which also conducts current around the contact, the limit is σ₁ + 2σ₂: if u = w on a disc in
unbounded sheets, the contact acts as a dipole of relative strength σ₂/(σ₁ + σ₂), like a disc of conductivity σ₁ + 2σ₂
in the lower sheet. A `Material` with `saturation` σ₂/σ₁, or 2σ₂/σ₁ for a larger upper sheet, approximates this model.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import is_number, real_array
from jeit.forward import ForwardModel
from jeit.forward.model import channel_voltages, check_model
from jeit.forward.system import append_ground, cell_conductivity, check_conductivity, ground_conductance, stiffness
from jeit.forward.transfer import contact_resistance, electrode_impedance
from jeit.mesh import measures
from jeit.touch.simulate.contact.indenters import AbstractIndenter, check_indenter
from jeit_solvers import FactorisationPlan, SparsityPattern, analyse, factorise, quadratic_form
from jeit_solvers.engines import host, on_host
from jeit_solvers.module import Module

# Minimum conductance per area between the sheets, relative to σ₂ divided by the area of the skin. It determines the
# potential of an upper sheet without contact.
_MIN_RELATIVE_CONDUCTANCE = 1e-9


class TwoSheets(Module):
    """Forward model of two conducting sheets, one on the other, that touch where they are pressed.

    Both sheets have the same mesh. The system of 2n unknowns, for n nodes, is factorised at every call.

    **Fields**: `model`: forward model of the lower sheet; `pattern`, `plan`: sparsity pattern and factorisation plan of
    the system.

    **Example:**

    ```python
    sheets = TwoSheets(model)
    voltages = sheets.voltages(2e-5, 2e-5, 1e-3)
    ```
    """

    model: ForwardModel
    pattern: SparsityPattern
    plan: FactorisationPlan

    def __init__(self, model: ForwardModel):
        """Create the model. Raises `ValueError` unless `model` is that of a sheet whose electrodes have a contact
        impedance."""
        check_model(model)
        if model.mesh.dimension != 2 or model.electrodes.is_point:
            raise ValueError("model must be of a sheet (2-D mesh), with electrodes that have a contact impedance.")
        num_nodes = model.mesh.num_points
        lower_cells = np.asarray(model.mesh.cells)
        contact_nodes = [np.asarray(electrode_nodes) for electrode_nodes in model.electrodes.contact_nodes(model.mesh)]
        self.model = model
        self.pattern = SparsityPattern.from_elements(
            [np.hstack([lower_cells, lower_cells + num_nodes]), *contact_nodes], size=2 * num_nodes
        )
        self.plan = analyse(self.pattern, np.tile(np.asarray(model.mesh.points), (2, 1)))

    def voltages(
        self, conductivity: ArrayLike, upper_conductivity: ArrayLike, conductance: ArrayLike
    ) -> Float[np.ndarray, " M"]:
        """Compute the voltages (M,) of the channels of the lower sheet.

        `conductivity` and `upper_conductivity`: conductivities of the lower and of the upper sheet, S, one value or one
        per cell (m,); `conductance`: conductance between the sheets per area, S/m², one value or one per cell (m,).
        Raises `ValueError` for other shapes, conductivities that are not positive, and negative conductances.
        """
        mesh, electrodes = on_host((self.model.mesh, self.model.electrodes))
        sheet_conductivities = [
            cell_conductivity(mesh, host.asarray(check_conductivity(mesh, sheet_conductivity)))
            for sheet_conductivity in (conductivity, upper_conductivity)
        ]
        lower_matrices, upper_matrices = (
            _symmetric_matrices(np.asarray(stiffness(mesh, sheet_conductivity)))
            for sheet_conductivity in sheet_conductivities
        )
        cell_areas = np.asarray(measures(mesh))
        cell_conductances = np.maximum(
            _check_conductance(conductance, mesh.num_cells),
            _MIN_RELATIVE_CONDUCTANCE * sheet_conductivities[1] / cell_areas.sum(),
        )
        coupling_matrices = (cell_conductances * cell_areas / 12)[:, None, None] * (1 + np.eye(3))
        element_matrices = host.block(
            [
                [lower_matrices + coupling_matrices, -coupling_matrices],
                [-coupling_matrices, upper_matrices + coupling_matrices],
            ]
        )
        electrode_contact = electrodes.contact(mesh)
        electrode_loads = host.concatenate([electrode_contact.load, np.zeros_like(electrode_contact.load)])
        system_matrix = self.pattern.assemble(element_matrices, *[None] * len(electrode_contact.mass))
        ground_conductances = ground_conductance(self.pattern.diagonal(system_matrix), electrode_loads)
        system_matrix = system_matrix + self.pattern.assemble(None, *electrode_contact.mass)
        system_matrix[: len(ground_conductances)] += ground_conductances
        electrode_admittance = quadratic_form(
            self.plan, factorise(self.plan, system_matrix), append_ground(electrode_loads, ground_conductances)
        )
        transfer_impedance = electrode_impedance(
            electrode_admittance, contact_resistance(electrodes, electrode_contact)
        )
        return np.asarray(channel_voltages(on_host(self.model.protocol), transfer_impedance))


def _symmetric_matrices(packed_triangles: Float[np.ndarray, "6 m"]) -> Float[np.ndarray, "m 3 3"]:
    """Build m symmetric matrices (m, 3, 3) from the six entries (6, m) of their lower triangles."""
    row_indices, column_indices = np.tril_indices(3)
    symmetric_matrices = np.zeros((packed_triangles.shape[1], 3, 3))
    symmetric_matrices[:, row_indices, column_indices] = symmetric_matrices[:, column_indices, row_indices] = (
        packed_triangles.T
    )
    return symmetric_matrices


def _check_conductance(conductance, num_cells: int) -> Float[np.ndarray, " m"]:
    conductance = np.asarray(conductance, float)
    if conductance.shape not in [(), (num_cells,)] or not np.isfinite(conductance).all() or (conductance < 0).any():
        raise ValueError(
            f"conductance must be zero or more, S/m², one for all or one a cell ({num_cells},); it has shape "
            f"{conductance.shape}."
        )
    return np.broadcast_to(conductance, num_cells)


class PlacedIndenter(AbstractIndenter):
    """An indenter that is rotated counter-clockwise, then moved, to be a part of `JoinedIndenters`.

    **Fields**: `indenter`: the indenter; `position`: position (x, y) of its origin, metres; `angle`: angle by which it
    is rotated, radians.

    **Example:**

    ```python
    beside = PlacedIndenter(BarIndenter(0.02, 0.005), (0.015, 0.0), angle=0.6)
    press = Press(JoinedIndenters(ball_indenter(0.01), beside), load=3.0)
    ```
    """

    indenter: AbstractIndenter
    position: Float[np.ndarray, "2"]
    angle: float

    def __init__(self, indenter: AbstractIndenter, position: ArrayLike = (0.0, 0.0), angle: float = 0.0):
        """Create the indenter. Raises `ValueError` for an invalid indenter, position or angle."""
        check_indenter("indenter", indenter)
        self.indenter, self.position, self.angle = indenter, check_position(position), check_angle(angle)

    def gap(self, points):
        """Return the height of the moved indenter's surface above its lowest point at `points` (…, 2), metres."""
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return self.indenter.gap((np.asarray(points) - self.position) @ np.array([[cos, -sin], [sin, cos]]))

    @property
    def reach(self) -> float:
        """Reach of the indenter plus the distance by which it was moved, metres."""
        return float(np.hypot(*self.position) + self.indenter.reach)


class JoinedIndenters(AbstractIndenter):
    """One rigid body of several indenters under one load; their lowest points are at the same height.

    **Arguments:**

    - `parts`: the indenters; an indenter that is not at the origin is a `PlacedIndenter`.

    **Example:**

    ```python
    beside = PlacedIndenter(ball_indenter(0.01), (0.015, 0.0))
    press = Press(JoinedIndenters(DiscIndenter(0.01), beside), load=3.0)
    ```
    """

    parts: tuple[AbstractIndenter, ...]

    def __init__(self, *parts: AbstractIndenter):
        """Create the body. Raises `ValueError` without parts, and for parts that are not indenters."""
        if not parts:
            raise ValueError(
                "parts: give one indenter at least, such as JoinedIndenters(DiscIndenter(0.01), "
                "PlacedIndenter(DiscIndenter(0.01), (0.02, 0)))"
            )
        for part_index, indenter_part in enumerate(parts):
            check_indenter(f"part {part_index}", indenter_part)
        self.parts = parts

    def gap(self, points):
        """Return the minimum over the parts of the height of the surface at `points` (…, 2), metres."""
        return np.min([indenter_part.gap(points) for indenter_part in self.parts], axis=0)

    @property
    def reach(self) -> float:
        """Maximum reach of the parts from the origin, metres."""
        return max(indenter_part.reach for indenter_part in self.parts)


def check_position(position, *, in_space: bool = False) -> Float[np.ndarray, " d"]:
    """Convert a place (x, y) in metres, or (x, y, z) if `in_space`, to an array. Raises `ValueError` for another shape,
    and values that are not finite."""
    coordinates = real_array("position", position, "(x, y) in metres")
    if coordinates.shape not in ((2,), (3,))[: 1 + in_space] or not np.isfinite(coordinates).all():
        raise ValueError(f"position: give (x, y) in metres, not {position!r}.")
    return coordinates


def check_angle(angle) -> float:
    """Convert an angle in radians to a float. Raises `ValueError` for anything but a number."""
    if not is_number(angle):
        raise ValueError(f"angle: give radians, not {angle!r}.")
    return float(angle)
