"""The problem that all contestants solve: a disk, its electrodes and its protocol, as plain arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

RADIUS = 0.05  # m
CONDUCTIVITY = 0.02  # S: a conductive skin of a few mm
CONTACT_IMPEDANCE = 0.05  # ohm·m
COVERED = 0.5  # fraction of the boundary covered by electrodes
FIRST = 0.25  # centre of the first electrode, in spacings from angle 0
NUM_CONDUCTIVITIES = 64
NUM_FRAMES = 1000
GAUSS_NEWTON, STEPS = "Gauss-Newton", 5  # a task's name, and the number of iterations of each image
NOISE = 1e-3  # standard deviation, of each voltage
HYPERPARAMETER = 0.5  # the data are fitted slightly closer than pyEIT does with its best setting


def make(
    num_points: int,
    num_electrodes: int,
    model: str = "complete",
    *,
    conductivities: int = NUM_CONDUCTIVITIES,
    frames: int = NUM_FRAMES,
) -> dict[str, np.ndarray]:
    """Arrays of one problem: mesh, electrodes, adjacent protocol, conductivities (conductivities, cells) and frames
    (frames, channels).

    `model`: "complete" (arcs covering half of the boundary, with contact impedance) or "point" (boundary nodes).
    Centres of arcs lie on the boundary polygon of the mesh, so that every contestant integrates the same arcs.
    """
    from jeit.mesh import Disk
    from jeit.protocol import adjacent

    mesh = Disk(RADIUS).mesh(num_points=num_points)
    protocol = adjacent(num_electrodes)
    points, cells, facets = np.asarray(mesh.points), np.asarray(mesh.cells), np.asarray(mesh.facets)
    corners = points[facets[:, 0]]
    length = np.linalg.norm(points[facets[:, 1]] - corners, axis=1)
    reached = np.concatenate([[0.0], np.cumsum(length)])
    middle = (np.arange(num_electrodes) + FIRST) * reached[-1] / num_electrodes
    closed = np.concatenate([corners, corners[:1]])
    position = np.stack([np.interp(middle, reached, closed[:, d]) for d in range(2)], axis=1)
    problem = {
        "points": points,
        "cells": cells,
        "background": np.array(CONDUCTIVITY),
        "drive": np.asarray(protocol.drive),
        "measurement": np.asarray(protocol.measurement),
        "drive_index": np.asarray(protocol.drive_index),
        "measurement_index": np.asarray(protocol.measurement_index),
    }
    if model == "complete":
        problem["position"] = position
        problem["width"] = np.full(num_electrodes, COVERED * reached[-1] / num_electrodes)
        problem["contact_impedance"] = np.full(num_electrodes, CONTACT_IMPEDANCE)
    else:
        distance = np.linalg.norm(corners[None] - position[:, None], axis=2)
        problem["nodes"] = facets[np.argmin(distance, axis=1), 0]
    random = np.random.default_rng(2)
    problem["conductivities"] = _smooth_conductivities(points[cells].mean(axis=1), conductivities, random)
    problem["frames"] = 1e-4 * random.normal(size=(frames, protocol.num_measurements))
    return problem


def measure(problem: dict[str, np.ndarray], voltages, rest) -> None:
    """Add to the problem the voltages `measured` (conductivities, channels) with noise, the standard deviation `noise`
    (channels,) in volts, and the λ of the NOSER prior."""
    problem["noise"] = NOISE * np.abs(rest) + 1e-2 * NOISE * np.abs(rest).max()
    random = np.random.default_rng(3)
    problem["measured"] = voltages + problem["noise"] * random.normal(size=np.shape(voltages))
    problem["hyperparameter"] = np.array(HYPERPARAMETER)


def _smooth_conductivities(centroids, count, random):
    """Conductivities (count, cells) in siemens, each with two smooth increases or decreases by about a factor of
    two."""
    conductivities = np.full((count, len(centroids)), CONDUCTIVITY)
    for conductivity in conductivities:
        for _ in range(2):
            centre = random.uniform(-0.6, 0.6, size=2) * RADIUS
            distance = np.linalg.norm(centroids - centre, axis=1)
            conductivity *= np.exp(random.choice([-0.7, 0.7]) * np.exp(-((distance / (0.25 * RADIUS)) ** 2)))
    return conductivities


def save(problem: dict[str, np.ndarray], path: Path) -> None:
    """Write the arrays of a problem to an NPZ file for the worker processes."""
    np.savez(path, allow_pickle=False, **problem)
