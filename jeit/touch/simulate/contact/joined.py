"""Sheets of two layers, and joined skins.

Two conducting sheets, one on the other, that touch where they are pressed: why a touch raises conductivity.

    ∇·(σ₁∇u) = g (u − w),    ∇·(σ₂∇w) = g (w − u),

u in the lower sheet, which has the electrodes, w in the upper one, whose edge is insulated; g(x, y) is the conductance
between them per area. Where g = 0 the upper sheet carries nothing; where √(σ/g) is small beside the contact both carry
the current. Sheets that touch everywhere conduct like σ₁ + σ₂, no better however hard they are pressed, and so does a
contact that an upper sheet is cut to. A contact on a whole upper sheet, which leads current past the contact too, tends
to σ₁ + 2σ₂ (u = w on a disc in an unbounded sheet has the dipole σ₂/(σ₁ + σ₂), that of a disc so conductive). A
`Material` whose `saturation` is σ₂/σ₁, or twice that, is the short form.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import is_number, real_array
from jeit.forward import ForwardModel
from jeit.forward.model import channel_voltages, check_model
from jeit.forward.system import cell_conductivity, check_conductivity, ground_conductance, stiffness, with_ground
from jeit.forward.transfer import contact_resistance, electrode_impedance
from jeit.mesh import measures
from jeit.touch.simulate.contact.indenters import AbstractIndenter, check_indenter
from jeit_solvers import FactorisationPlan, SparsityPattern, analyse, factorise, quadratic_form
from jeit_solvers.engines import host, on_host

# Of σ₂ over the area of the skin: the least conductance, which keeps an upper sheet from floating.
_LEAST = 1e-9


class TwoSheets(eqx.Module):
    """A sheet on the sheet of `model`, on the same mesh; the whole system of 2n unknowns is factorised at every call.

    **Fields**: `model` of the lower sheet; `pattern` and `plan` of the system of both.
    """

    model: ForwardModel
    pattern: SparsityPattern
    plan: FactorisationPlan

    def __init__(self, model: ForwardModel):
        """Raises `ValueError` for what is no model of a sheet with electrodes that have a size."""
        check_model(model)
        if model.mesh.dimension != 2 or model.electrodes.is_point:
            raise ValueError("model must be of a sheet (2-D mesh), with electrodes that have a contact impedance.")
        number = model.mesh.num_points
        lower = np.asarray(model.mesh.cells)
        nodes = [np.asarray(one) for one in model.electrodes.contact_nodes(model.mesh)]
        self.model = model
        self.pattern = SparsityPattern.from_elements([np.hstack([lower, lower + number]), *nodes], size=2 * number)
        self.plan = analyse(self.pattern, np.tile(np.asarray(model.mesh.points), (2, 1)))

    def voltages(
        self, conductivity: ArrayLike, upper_conductivity: ArrayLike, conductance: ArrayLike
    ) -> Float[np.ndarray, " M"]:
        """Voltages (M,) of the lower sheet's channels.

        `conductivity` of the lower sheet and `upper_conductivity`, S, one or one a cell; `conductance` between them per
        area, S/m², one or one a cell (m,). Raises `ValueError` for those of other shapes, conductivities that are not
        positive and conductances that are negative.
        """
        mesh, electrodes = on_host((self.model.mesh, self.model.electrodes))
        sheets = [
            cell_conductivity(mesh, host.asarray(check_conductivity(mesh, one)))
            for one in (conductivity, upper_conductivity)
        ]
        lower, upper = (_matrices(np.asarray(stiffness(mesh, one))) for one in sheets)
        area = np.asarray(measures(mesh))
        between = np.maximum(_checked(conductance, mesh.num_cells), _LEAST * sheets[1] / area.sum())
        coupling = (between * area / 12)[:, None, None] * (1 + np.eye(3))
        element = host.block([[lower + coupling, -coupling], [-coupling, upper + coupling]])
        contact = electrodes.contact(mesh)
        load = host.concatenate([contact.load, np.zeros_like(contact.load)])
        matrix = self.pattern.assemble(element, *[None] * len(contact.mass))
        ground = ground_conductance(self.pattern.diagonal(matrix), load)
        matrix = matrix + self.pattern.assemble(None, *contact.mass)
        matrix[: len(ground)] += ground
        product = quadratic_form(self.plan, factorise(self.plan, matrix), with_ground(load, ground))
        impedance = electrode_impedance(product, contact_resistance(electrodes, contact))
        return np.asarray(channel_voltages(on_host(self.model.protocol), impedance))


def _matrices(packed: Float[np.ndarray, "6 m"]) -> Float[np.ndarray, "m 3 3"]:
    rows, columns = np.tril_indices(3)
    full = np.zeros((packed.shape[1], 3, 3))
    full[:, rows, columns] = full[:, columns, rows] = packed.T
    return full


def _checked(conductance, number: int) -> Float[np.ndarray, " m"]:
    conductance = np.asarray(conductance, float)
    if conductance.shape not in [(), (number,)] or not np.isfinite(conductance).all() or (conductance < 0).any():
        raise ValueError(
            f"conductance must be zero or more, S/m², one for all or one a cell ({number},); it has shape "
            f"{conductance.shape}."
        )
    return np.broadcast_to(conductance, number)


class Placed(AbstractIndenter):
    """An `indenter` turned by `angle` radians, counter-clockwise, then moved to `position` (x, y), metres."""

    indenter: AbstractIndenter
    position: Float[np.ndarray, "2"]
    angle: float

    def __init__(self, indenter: AbstractIndenter, position: ArrayLike = (0.0, 0.0), angle: float = 0.0):
        """Raises `ValueError` for what is no indenter, place or angle."""
        check_indenter("indenter", indenter)
        self.indenter, self.position, self.angle = indenter, check_position(position), check_angle(angle)

    def gap(self, points):
        """The indenter's, at the points as they lie in its frame."""
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return self.indenter.gap((np.asarray(points) - self.position) @ np.array([[cos, -sin], [sin, cos]]))

    @property
    def reach(self) -> float:
        """The indenter's, and how far it was moved."""
        return float(np.hypot(*self.position) + self.indenter.reach)


class Joined(AbstractIndenter):
    """Several `parts`, one rigid body under one load: their lowest points are level. Mostly `Placed` ones."""

    parts: tuple[AbstractIndenter, ...]

    def __init__(self, *parts: AbstractIndenter):
        """Raises `ValueError` for no parts, and for what is no indenter."""
        if not parts:
            raise ValueError(
                "parts: give one indenter at least, such as Joined(Disc(0.01), Placed(Disc(0.01), (0.02, 0)))"
            )
        for number, part in enumerate(parts):
            check_indenter(f"part {number}", part)
        self.parts = parts

    def gap(self, points):
        """The least of the parts'."""
        return np.min([part.gap(points) for part in self.parts], axis=0)

    @property
    def reach(self) -> float:
        """The farthest of the parts'."""
        return max(part.reach for part in self.parts)


def check_position(position, *, in_space: bool = False) -> Float[np.ndarray, " d"]:
    """A place (x, y) in metres as an array, or where it may be `in_space` (x, y, z). Raises `ValueError` for what is
    none."""
    where = real_array("position", position, "(x, y) in metres")
    if where.shape not in ((2,), (3,))[: 1 + in_space] or not np.isfinite(where).all():
        raise ValueError(f"position: give (x, y) in metres, not {position!r}.")
    return where


def check_angle(angle) -> float:
    """An angle in radians. Raises `ValueError` for what is none."""
    if not is_number(angle):
        raise ValueError(f"angle: give radians, not {angle!r}.")
    return float(angle)
