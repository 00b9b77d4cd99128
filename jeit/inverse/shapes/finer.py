"""Refinement of a shape problem: the mesh is made finer on the surfaces of the bodies.

A mesh that suffices for a smooth image resolves a body of a few cells badly: the error of its voltages is of first
order in the edges on its surface, is not the same factor for all of them, and looks like another body. So bodies that
were found are fitted again on a mesh that is bisected at their surfaces; everything else stays as it was, the voltages
of the background included.
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
from jeit.inverse.shapes.problem import Fit, ShapeProblem
from jeit.mesh import Mesh
from jeit.mesh.bisection import bisected
from jeit.protocol import Protocol
from jeit_solvers.engines import on_host

# Factor by which a finer mesh may have more nodes.
_MOST = 2.5


class Finer(NamedTuple):
    """**Fields**: the `problem` on the finer mesh, and the `bodies` on it; `cell` (f,), which of the given mesh's each
    of its cells comes from."""

    problem: ShapeProblem
    bodies: Ellipsoids
    cell: Int[np.ndarray, " f"]

    def change(self, protocol: Protocol, image: Float[np.ndarray, " f"], field: Any) -> Float[np.ndarray, " M"]:
        """Change of a protocol's voltages, volts, due to the `image` of bodies and a `field` (m,) or 0, of log σ."""
        model, background = self.problem.model.with_protocol(protocol), self.problem.background
        after = self.conductivity(image, field)
        return solved_fields(model, after).voltages - solved_fields(model, background).voltages

    def conductivity(self, image: Float[np.ndarray, " f"], field: Any) -> Float[np.ndarray, " f"]:
        """Conductivity of the finer cells, S/m, for the `image` of bodies and a `field` (m,) or 0, of log σ."""
        return self.problem.background * np.exp(image + np.broadcast_to(field, self.cell.max() + 1)[self.cell])


def finer(problem: ShapeProblem, fit: Fit, edges: Sequence[float]) -> Finer:
    """The problem on a mesh refined on the surfaces of a fit's ellipsoids. The length of edges there, in units of the
    least half axis, is the first of `edges` with which the mesh grows little, or the last.

    The change that the finer mesh makes to the voltages of the background is added to the data as well.
    """
    bodies, model = fit.bodies, problem.model
    assert isinstance(bodies, Ellipsoids)
    tagged, names = _tagged(model.mesh, model.electrodes)
    mesh, cell = bisected(tagged, partial(bodies.edges, fit.coefficients, edges[0]))
    for edge in edges[1:]:
        if mesh.num_points < _MOST * tagged.num_points:
            break
        mesh, cell = bisected(tagged, partial(bodies.edges, fit.coefficients, edge))
    there = on_host(ForwardModel(mesh, _on(mesh, model.electrodes, iter(names)), model.protocol))
    background = problem.background[cell]
    moved = solved_fields(there, background).voltages - solved_fields(model, problem.background).voltages
    data = eqx.tree_at(lambda data: data.voltages, problem.data, np.asarray(problem.data.voltages) + moved)
    return Finer(ShapeProblem(there, data, background), bodies.on(mesh), cell)


def _tagged(mesh: Mesh, electrodes: AbstractElectrodes) -> tuple[Mesh, list[str]]:
    """The mesh with the facets that electrodes cover as its tags, which stay where it is divided; and their names."""
    parts = electrodes.parts if isinstance(electrodes, CombinedElectrodes) else (electrodes,)
    covers = [column for part in parts if isinstance(part, FacetElectrodes) for column in np.asarray(part.covers).T]
    tags: dict[str, Any] = {str(k): np.flatnonzero(column) for k, column in enumerate(covers)}
    return replace(mesh, tags=tags), list(tags)


def _on(mesh: Mesh, electrodes: AbstractElectrodes, names) -> AbstractElectrodes:
    """Electrodes on the divided mesh: those that are facets by the names of these, all others by where they are."""
    if isinstance(electrodes, CombinedElectrodes):
        return CombinedElectrodes(*[_on(mesh, part, names) for part in electrodes.parts])
    if isinstance(electrodes, FacetElectrodes):
        return plates(mesh, [next(names) for _ in range(electrodes.num_electrodes)], electrodes.contact_impedance)
    return electrodes
