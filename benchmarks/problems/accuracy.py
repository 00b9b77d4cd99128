"""Accuracy of results: differences between contestants, and from exact solutions for the homogeneous disk."""

from __future__ import annotations

import numpy as np

from benchmarks.problems import disk as problems
from jeit.forward.exact import ConductingDisk, arc_transfer_impedance, point_transfer_impedance


def difference(result: np.ndarray, reference: np.ndarray) -> float:
    """Relative difference of a result from a reference in the Euclidean (Frobenius) norm."""
    return float(np.linalg.norm(result - reference) / np.linalg.norm(reference))


def exact_voltages(problem: dict[str, np.ndarray]) -> np.ndarray:
    """Exact voltages (channels,) of the homogeneous disk, for point electrodes at any positions, or for arcs equally
    spaced on the circle."""
    disk = ConductingDisk(radius=problems.RADIUS, conductivity=float(problem["background"]))
    if "nodes" in problem:
        x, y = problem["points"][problem["nodes"]].T
        impedance = point_transfer_impedance(disk, np.arctan2(y, x))
    else:
        num = len(problem["width"])
        width = np.full(num, problems.COVERED * 2 * np.pi * problems.RADIUS / num)
        angles = 2 * np.pi * (np.arange(num) + problems.FIRST) / num
        impedance = arc_transfer_impedance(disk, angles, width, problem["contact_impedance"])
    table = problem["measurement"] @ impedance @ problem["drive"].T
    return table[problem["measurement_index"], problem["drive_index"]]
