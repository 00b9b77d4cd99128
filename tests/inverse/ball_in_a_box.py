"""A box with sixteen discs on its walls and a ball or a column in it, for tests of ellipsoids."""

from typing import Any

import numpy as np

from jeit.electrodes import FaceDiscs
from jeit.forward import ForwardModel
from jeit.inverse.nonlinear.problem import independent_data
from jeit.inverse.shapes.problem import ShapeProblem
from jeit.mesh import bisect, box, centroids, cut
from jeit.protocol import opposite

SIZE, BATH = (0.1, 0.14, 0.1), 0.02
BALL, RADIUS = np.array([0.012, -0.025, 0.055]), 0.022


def discs():
    """Sixteen discs on the four upright walls of the box."""
    x, y = np.array([-0.025, 0.025]), np.array([-0.035, 0.035])
    along_x = [(a, side * 0.07, z) for side in (-1, 1) for z in (0.03, 0.07) for a in x]
    along_y = [(side * 0.05, b, z) for side in (-1, 1) for z in (0.03, 0.07) for b in y]
    return FaceDiscs(np.array(along_x + along_y), 0.012, 0.01)


def model(num_points):
    return ForwardModel(box(*SIZE, num_points=num_points), discs(), opposite(16, current=1e-3))


def sharp(num_points, along=3):
    """A model whose mesh is cut along the ball, or the column along two axes, and the mask of the cells inside."""

    def outside(points):
        return np.linalg.norm((points - BALL)[..., :along], axis=-1) - RADIUS

    def edge(corners):
        on_surface = (outside(corners).min(axis=1) < 0) & (outside(corners).max(axis=1) > 0)
        return np.where(on_surface, RADIUS / (3 if along == 3 else 2), np.inf)

    mesh = cut(bisect(model(num_points).mesh, edge), outside)
    return ForwardModel(mesh, discs(), opposite(16, current=1e-3)), outside(np.asarray(centroids(mesh))) < 0


def shape_problem(given):
    """A shape problem for the voltages of the bath alone."""
    number: Any = given.protocol.num_measurements
    every, noise = np.ones(number, bool), np.full(number, 1e-6)
    small, data = independent_data(given, given.voltages(BATH), every, noise, at_once=True)  # pyright: ignore
    return ShapeProblem(small, data, np.full(given.mesh.num_cells, BATH))
