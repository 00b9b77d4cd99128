"""A problem of bodies on a mesh that is finer on their surfaces.

A mesh that is even enough for a smooth image holds a body of a few cells badly: its voltages are off by the first order
of the edges on its surface, not all by the same factor, and what is off looks like another body. So bodies that were
found are fitted again where the mesh has been bisected for them; everything else stays as it was, the voltages of the
background included.
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

# How many times the nodes a finer mesh may have.
_MOST = 2.5


class Finer(NamedTuple):
    """**Fields**: the `problem` on the finer mesh, and the `bodies` on it; `cell` (f,), which of the given mesh's each
    of its cells comes from."""

    problem: ShapeProblem
    bodies: Ellipsoids
    cell: Int[np.ndarray, " f"]

    def change(self, protocol: Protocol, image: Float[np.ndarray, " f"], field: Any) -> Float[np.ndarray, " M"]:
        """How voltages of a protocol change, volts, by the `image` of bodies and a `field` (m,) or 0, of log σ."""
        model, background = self.problem.model.with_protocol(protocol), self.problem.background
        after = self.conductivity(image, field)
        return solved_fields(model, after).voltages - solved_fields(model, background).voltages

    def conductivity(self, image: Float[np.ndarray, " f"], field: Any) -> Float[np.ndarray, " f"]:
        """Of the finer cells, S/m, for the `image` of bodies and a `field` (m,) or 0, of log σ."""
        return self.problem.background * np.exp(image + np.broadcast_to(field, self.cell.max() + 1)[self.cell])


def finer(problem: ShapeProblem, fit: Fit, edges: Sequence[float]) -> Finer:
    """The problem on a mesh that is finer on the surfaces of the bodies of a fit, ellipsoids: of `edges`, times the
    least half axis, the first with which it grows little, or the last.

    What that does to the voltages of the background, it does to the data as well: they are told from it.
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
