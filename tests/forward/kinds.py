"""A small model with every kind of electrode."""

import numpy as np

from jeit.electrodes import (
    BoundaryElectrodes,
    CombinedElectrodes,
    FaceDiscs,
    FacePatches,
    FacetElectrodes,
    NodeElectrodes,
    PointElectrodes,
    SheetDiscs,
)
from jeit.forward import ForwardModel
from jeit.layout import ring, ring_and_centre
from jeit.mesh import cylinder, disk, layer, rectangle
from jeit.protocol import adjacent, trigonometric


def _sheet():
    return disk(0.1, num_points=60)


def _boundary():
    position = ring(0.1, 8, start_angle=0.3)
    return ForwardModel(
        _sheet(), BoundaryElectrodes(position, 0.03, np.geomspace(1e-3, 1e-2, 8)), adjacent(8, current=1e-3)
    )


def _inside():
    electrodes = SheetDiscs(0.6 * ring(0.1, 6), 0.014, np.geomspace(1e-5, 1e-4, 6))
    return ForwardModel(_sheet(), electrodes, adjacent(6, current=1e-3))


def _combined():
    electrodes = CombinedElectrodes(
        BoundaryElectrodes(ring(0.1, 7), 0.03, 2e-3), SheetDiscs(np.zeros((1, 2)), 0.015, 1e-4)
    )
    return ForwardModel(_sheet(), electrodes, trigonometric(8, current=1e-3))


def _point():
    return ForwardModel(
        _sheet(),
        PointElectrodes(0.9 * ring_and_centre(0.1, 7, start_angle=0.2) + [1.3e-3, 0.7e-3]),
        adjacent(8, current=1e-3),
    )


def _node():
    mesh = rectangle(0.2, 0.1, num_points=60)
    corners = np.asarray(mesh.facets[:, 0])
    return ForwardModel(mesh, NodeElectrodes(corners[:: len(corners) // 8][:8]), adjacent(8, current=1e-3))


def _facet():
    mesh = _sheet()
    groups = np.array_split(np.arange(mesh.facets.shape[0]), 16)[::2]
    return ForwardModel(mesh, FacetElectrodes(mesh, groups, np.geomspace(1e-3, 1e-2, 8)), adjacent(8, current=1e-3))


def _face():
    mesh = layer(rectangle(0.1, 0.08, num_points=60), 0.01, 1)
    corners = [[x, y, float(mesh.points[:, 2].max())] for x in (-0.03, 0.0, 0.03) for y in (-0.02, 0.02)]
    centre = np.asarray(mesh.points[:, :2].mean(axis=0))
    position = np.array(corners) + np.array([*centre, 0])
    return ForwardModel(mesh, FaceDiscs(position, 0.01, 1e-4), adjacent(6, current=1e-3))


def _patch():
    mesh = cylinder(0.1, 0.08, num_points=250)
    middle = float(mesh.points[:, 2].mean())
    # Not at the angles of nodes, where the normal of the wall depends on the chosen facet.
    electrodes = FacePatches(ring(0.1, 6, height=middle, start_angle=0.03), 0.04, 0.04, 1e-3)
    return ForwardModel(mesh, electrodes, adjacent(6, current=1e-3))


MODELS = {f.__name__.strip("_"): f for f in (_boundary, _inside, _combined, _point, _node, _facet, _face, _patch)}


# Every kind of electrode is tested; the quick tests have one for each method of contact integration.
QUICK = ("boundary", "inside", "point")
