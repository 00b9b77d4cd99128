"""Tanks like the Kuopio challenge's, with missing electrodes, drawn at random and solved without jeit.

Tanks have 32 electrodes, 76 drives, measurements of all differences of adjacent electrodes, and one to four strong
bodies of metal or plastic: disks, triangles to hexagons, bars, crosses, L and T shapes. As in a real tank, electrodes
are slightly displaced and vary in width and contact, the electrodes' channels have gains and offsets, one contact is
sometimes loose, and the bath drifts between the two frames. Mesh and solver are those of `mixed_tanks`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from matplotlib.path import Path

from benchmarks.opponents.scipy_baseline import ScipyBaseline
from benchmarks.problems.disk_meshes import meshed_disk
from jeit.data import Measurement
from jeit.electrodes import BoundaryElectrodes
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import Protocol, from_matrices
from jeit_solvers.engines import as_array

RADIUS, ELECTRODES, CURRENT = 0.115, 32, 1.47e-3
CONDUCTIVITY, CONTACT = 7.5e-4, 0.01
_WIDTH = np.radians(5.625) * RADIUS
_SPACING, _APART, _FROM_WALL = 0.032, 0.1, 0.04
# Standard deviations: position (m), width and contact impedance (relative) of electrodes, gain, offset (V), drift of
# the bath, noise.
_PLACE, _UNEVEN, _CONTACT, _GAIN, _OFFSET, _DRIFT, _NOISE = 3e-4, 0.05, 0.7, 0.005, 8e-3, 0.03, 2e-3


class Tank(NamedTuple):
    """Simulated tank. **Fields**: `frame` and `reference` of all electrodes. `truth` (256, 256): pixels with the
    challenge's labels."""

    frame: Measurement
    reference: Measurement
    truth: np.ndarray

    def without(self, number: int) -> Tank:
        """The same tank with the first `number` electrodes missing."""
        frame, reference = (without(one, range(number)) for one in self[:2])
        return Tank(frame, reference, self.truth)


def without(measurement: Measurement, gone: Sequence[int]) -> Measurement:
    """The measurement with the channels masked that would be missing without the electrodes `gone`."""
    if not len(gone):
        return measurement
    mask = np.asarray(measurement.mask) & measurement.protocol.mask_without(list(gone))
    return eqx.tree_at(lambda one: one.mask, measurement, as_array(mask))


def protocol() -> Protocol:
    """The challenge's protocol: 16 drives between every other electrode, then 15 against each of four electrodes."""
    pairs = [(k, (k + 2) % ELECTRODES) for k in range(0, ELECTRODES, 2)]
    pairs += [(k, one) for k in range(0, ELECTRODES, 8) for one in range(0, ELECTRODES, 2) if one != k]
    unit = np.eye(ELECTRODES)
    drive = CURRENT * np.array([unit[a] - unit[b] for a, b in pairs])
    return from_matrices(drive, np.array([unit[k + 1] - unit[k] for k in range(ELECTRODES - 1)]))


def draw(seed: int) -> Tank:
    """Draw a tank, reproducible from its seed."""
    rng = np.random.default_rng(seed)
    bodies = _bodies(rng)
    points, cells = _mesh([outline for outline, _ in bodies], rng)
    plan = protocol()
    nominal = ring(RADIUS, ELECTRODES)
    angle = np.arctan2(nominal[:, 1], nominal[:, 0]) + rng.normal(size=ELECTRODES) * _PLACE / RADIUS
    problem = {
        "points": RADIUS * points,
        "cells": cells,
        "position": RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1),
        "width": _WIDTH * (1 + _UNEVEN * rng.normal(size=ELECTRODES)),
        "contact_impedance": CONTACT * np.exp(_CONTACT * rng.normal(size=ELECTRODES)),
        # Unit currents enter at every electrode but the last and leave at the last; all potentials are measured.
        "drive": (np.eye(ELECTRODES) - np.eye(ELECTRODES)[-1])[:-1],
        "measurement": np.eye(ELECTRODES),
        "drive_index": np.repeat(np.arange(ELECTRODES - 1), ELECTRODES),
        "measurement_index": np.tile(np.arange(ELECTRODES), ELECTRODES - 1),
    }
    solver, current = ScipyBaseline(problem, choose=False), np.asarray(plan.drive)[:, :-1]
    centres = points[cells].mean(axis=1)
    factors = np.ones(len(cells))
    for outline, factor in bodies:
        factors[Path(outline).contains_points(centres)] = factor
    spread = np.ones(ELECTRODES)
    spread[rng.integers(ELECTRODES)] = rng.choice([1, 1, 10])  # a loose contact in every third tank
    gain, offset = 1 + _GAIN * spread * rng.normal(size=ELECTRODES), _OFFSET * spread * rng.normal(size=ELECTRODES)

    def measured(factor, name):
        bath = CONDUCTIVITY * np.exp(_DRIFT * rng.normal())
        potential = current @ solver.voltages(bath * factor).reshape(ELECTRODES - 1, ELECTRODES)
        # The electronics measure every electrode against one of the driven electrodes.
        against = potential[np.arange(plan.num_drives), np.argmin(np.asarray(plan.drive), axis=1)]
        read = gain * (potential - against[:, None]) + offset
        voltages = (read[:, 1:] - read[:, :-1]).ravel()
        voltages = voltages + _NOISE * np.hypot(voltages, 0.2 * np.std(voltages)) * rng.normal(size=voltages.shape)
        electrodes = BoundaryElectrodes(nominal, _WIDTH, CONTACT)
        mask = np.ones(voltages.shape, bool)
        return Measurement(voltages, mask, plan, electrodes=electrodes, domain=Disk(RADIUS), name=name)

    axis = (np.arange(256) + 0.5) / 128 - 1
    pixels = np.stack(np.meshgrid(axis, -axis), axis=-1).reshape(-1, 2)
    truth = np.zeros(256**2, int)
    for outline, factor in bodies:
        truth[Path(outline).contains_points(pixels)] = 2 if factor > 1 else 1
    reference = measured(np.ones(len(cells)), "empty")
    return Tank(measured(factors, f"tank {seed}"), reference, truth.reshape(256, 256))


def _bodies(rng) -> list[tuple[np.ndarray, float]]:
    number = int(rng.choice([1, 2, 2, 3, 3, 4]))
    bodies: list[tuple[np.ndarray, float]] = []
    tries = 0
    while len(bodies) < number and tries < 400:
        tries += 1
        outline = _turned(_outline(rng), rng.uniform(0, 2 * np.pi)) + rng.uniform(-1, 1, 2)
        dense = _along(outline, 0.02)
        if np.hypot(*dense.T).max() > 1 - _FROM_WALL:
            continue
        if any(np.linalg.norm(dense[:, None] - _along(one, 0.02), axis=2).min() < _APART for one, _ in bodies):
            continue
        if any(Path(one).contains_point(outline[0]) or Path(outline).contains_point(one[0]) for one, _ in bodies):
            continue
        bodies.append((outline, float(np.exp(rng.choice([-1, 1]) * rng.uniform(np.log(20), np.log(1e4))))))
    return bodies


def _outline(rng) -> np.ndarray:
    """Corners (n, 2) of a random body about the origin, in units of the tank's radius."""
    kind, size = rng.integers(6), rng.uniform(0.15, 0.33)
    if kind == 0:
        return _turned(np.array([[size, 0.0]]), 2 * np.pi * np.arange(48) / 48)
    if kind == 1:
        number = int(rng.integers(3, 7))
        return _turned(np.array([[1.15 * size, 0.0]]), 2 * np.pi * np.arange(number) / number)
    length, width = 1.5 * size, rng.uniform(0.35, 0.6) * size
    if kind == 2:
        return np.array([[length, width], [-length, width], [-length, -width], [length, -width]])
    if kind == 3:
        arm = [[length, -width], [length, width], [width, width]]
        return np.concatenate([_turned(np.array(arm), k * np.pi / 2) for k in range(4)])
    across = 2 * width
    if kind == 4:
        corners = [[0, 0], [2 * length, 0], [2 * length, across], [across, across], [across, 2 * length]]
        corners.append([0, 2 * length])
        return np.array(corners) - 0.65 * length
    corners = [[-length, width], [-length, -width], [length, -width], [length, width]]
    return np.array([*corners, [width, width], [width, 2 * length], [-width, 2 * length], [-width, width]])


def _turned(points: np.ndarray, angle) -> np.ndarray:
    """Points rotated by one angle, or one point by many."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = points.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)


def _along(outline: np.ndarray, spacing: float) -> np.ndarray:
    """Points along a polygon, about `spacing` apart, without the corners."""
    found = []
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        number = max(1, round(float(np.linalg.norm(end - start)) / spacing))
        found.append(start + ((np.arange(number) + 0.5) / number)[:, None] * (end - start))
    return np.concatenate(found)


def _beside(outline: np.ndarray, distance: float) -> np.ndarray:
    """Points on both sides of the edges of a polygon, at the given `distance`."""
    ahead, behind = _along(outline, _SPACING / 2), []
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        number = max(1, round(float(np.linalg.norm(end - start)) / (_SPACING / 2)))
        normal = np.array([end[1] - start[1], start[0] - end[0]]) / np.linalg.norm(end - start)
        behind.append(np.tile(normal, (number, 1)))
    normals = np.concatenate(behind)
    return np.concatenate([ahead + distance * normals, ahead - distance * normals])


def _mesh(outlines, rng) -> tuple[np.ndarray, np.ndarray]:
    """Mesh of the unit disk: nodes (n, 2) and cells (m, 3) that are aligned with the bodies' outlines."""
    angle = 2 * np.pi * np.arange(1024) / 1024
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = [circle, 0.9925 * circle[::2], 0.98 * circle[1::4], 0.96 * circle[2::8]]
    fixed = np.concatenate(rings + [_beside(outline, 0.005) for outline in outlines])
    return meshed_disk(fixed, _SPACING, rng)
