"""Refinement of the mesh of a shape problem at the surfaces of the bodies.

A mesh that suffices for a smooth image resolves a body of a few cells badly. The error of the voltages is proportional
to the edge length on the surface, differs between channels, and resembles the effect of another body. The bodies are
therefore fitted again on a mesh whose cells are bisected at the bodies' surfaces. The rest of the problem, including
the voltages of the background, is unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jeit.electrodes import AbstractElectrodes, CombinedElectrodes, FacetElectrodes, plates
from jeit.forward import ForwardModel
from jeit.forward.changes import solved_fields
from jeit.inverse.shapes.ellipsoid import Ellipsoids
from jeit.inverse.shapes.problem import ShapeFit, ShapeProblem
from jeit.mesh import Mesh
from jeit.mesh.bisection import bisect_with_parents
from jeit.mesh.checks import MAX_POINTS
from jeit.protocol import Protocol
from jeit_solvers.engines import on_host

# Maximum ratio of the number of nodes of the refined mesh to that of the original mesh, unless even the longest edges
# require more.
_MAX_NODE_RATIO = 2.5


class FinerModel(NamedTuple):
    """Shape problem on a refined mesh.

    **Fields**: `problem`: the problem on the refined mesh; `bodies`: the bodies on the refined mesh; `cell` (f,): index
    of the cell of the original mesh that contains each refined cell.
    """

    problem: ShapeProblem
    bodies: Ellipsoids
    cell: Int[np.ndarray, " f"]

    def change(self, protocol: Protocol, image: Float[np.ndarray, " f"], field: Any) -> Float[np.ndarray, " M"]:
        """Change of the voltages of `protocol`, in volts, due to the `image` (f,) of the bodies on the refined mesh and
        a smooth `field`, (m,) on the original mesh or 0, both in log σ/σ₀."""
        model, background = self.problem.model.with_protocol(protocol), self.problem.background
        conductivity = self.conductivity(image, field)
        return solved_fields(model, conductivity).voltages - solved_fields(model, background).voltages

    def conductivity(self, image: Float[np.ndarray, " f"], field: Any) -> Float[np.ndarray, " f"]:
        """Conductivity of the refined cells, S/m, for the `image` (f,) of the bodies on the refined mesh and a smooth
        `field`, (m,) on the original mesh or 0, both in log σ/σ₀."""
        return self.problem.background * np.exp(image + np.broadcast_to(field, self.cell.max() + 1)[self.cell])


def refine_at_surfaces(problem: ShapeProblem, fit: ShapeFit, edges: Sequence[float]) -> FinerModel:
    """Refine the mesh of a shape problem at the surfaces of the ellipsoids of a fit.

    `edges`: edge lengths on the surfaces, in units of an ellipsoid's shortest half axis, in descending order. The mesh
    is refined to one length after the other, as long as this does not add too many nodes. The change of the
    background's voltages due to refinement is added to the data.
    """
    bodies, model = fit.bodies, problem.model
    assert isinstance(bodies, Ellipsoids)
    tagged_mesh, names = _tag_electrodes(model.mesh, model.electrodes)
    mesh, parent_cells, max_points = tagged_mesh, np.arange(tagged_mesh.num_cells), MAX_POINTS
    for relative_edge_length in edges:
        refined_mesh_and_parents = bisect_with_parents(
            mesh, partial(bodies.edges, fit.coefficients, relative_edge_length), max_points
        )
        if refined_mesh_and_parents is None:
            break
        mesh, parent_cells = refined_mesh_and_parents[0], parent_cells[refined_mesh_and_parents[1]]
        max_points = int(_MAX_NODE_RATIO * tagged_mesh.num_points)
    refined_model = on_host(ForwardModel(mesh, _electrodes_on(mesh, model.electrodes, iter(names)), model.protocol))
    background = problem.background[parent_cells]
    voltage_change = (
        solved_fields(refined_model, background).voltages - solved_fields(model, problem.background).voltages
    )
    corrected_data = eqx.tree_at(
        lambda corrected_data: corrected_data.voltages, problem.data, np.asarray(problem.data.voltages) + voltage_change
    )
    return FinerModel(ShapeProblem(refined_model, corrected_data, background), bodies.on(mesh), parent_cells)


def _tag_electrodes(mesh: Mesh, electrodes: AbstractElectrodes) -> tuple[Mesh, list[str]]:
    """Add to the mesh one tag per electrode, which marks the facets that the electrode covers and is preserved by
    bisection. Returns the mesh and the names of the tags."""
    electrode_groups = electrodes.parts if isinstance(electrodes, CombinedElectrodes) else (electrodes,)
    covered_facets = [
        column
        for electrode_group in electrode_groups
        if isinstance(electrode_group, FacetElectrodes)
        for column in np.asarray(electrode_group.covers).T
    ]
    facets_by_tag: dict[str, Any] = {str(index): np.flatnonzero(column) for index, column in enumerate(covered_facets)}
    return replace(mesh, tags=facets_by_tag), list(facets_by_tag)


def _electrodes_on(mesh: Mesh, electrodes: AbstractElectrodes, names) -> AbstractElectrodes:
    """Electrodes on a bisected mesh. Electrodes that cover facets are created from the tags `names`; all other
    electrodes are unchanged."""
    if isinstance(electrodes, CombinedElectrodes):
        return CombinedElectrodes(
            *[_electrodes_on(mesh, electrode_group, names) for electrode_group in electrodes.parts]
        )
    if isinstance(electrodes, FacetElectrodes):
        return plates(mesh, [next(names) for _ in range(electrodes.num_electrodes)], electrodes.contact_impedance)
    return electrodes
