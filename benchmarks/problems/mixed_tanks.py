"""Tanks with one to three strong bodies, drawn at random and solved without jeit: metal, plastic, or both.

Mesh and solver are independent of jeit: points in rings on the bodies' outlines and in a jittered grid are triangulated
by SciPy, and `scipy_baseline` solves for the voltages. Tanks differ in size, electrodes and the fraction of the
boundary that they cover, contact impedance, currents, channels, and in the number, size, place, shape and conductivity
of the bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.opponents.scipy_baseline import ScipyBaseline
from benchmarks.problems.disk_meshes import meshed_disk
from jeit.data import Measurement
from jeit.electrodes import BoundaryElectrodes
from jeit.image import Inclusion
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import Protocol, adjacent, all_against_one, opposite, skip

NOISE = 0.01
"""Relative noise of each voltage."""
REACH = 0.3
"""Distance, in units of the tank's radius, within which an inclusion may be a body's."""
_APART, _FROM_WALL = 0.12, 0.06
_SPACING = 0.035


class Body(NamedTuple):
    """Body in a tank. **Fields**: `centre` (2,), and `radius` of a disk of the same area, in units of the tank's
    radius. `corners`: 0 for a disk, 4 for a square. `turned`: angle of rotation in radians. `factor`: conductivity of
    the body divided by that of the background.
    """

    centre: np.ndarray
    radius: float
    corners: int
    turned: float
    factor: float

    @property
    def sign(self) -> int:
        """+1 for a conductive body, -1 for a resistive body."""
        return 1 if self.factor > 1 else -1

    def outline(self, number: int, grown: float = 0.0) -> np.ndarray:
        """Points (number, 2) of the body's outline, moved outwards by `grown`."""
        angle = 2 * np.pi * (np.arange(number) + 0.5) / number
        return self.centre + (self._reach(angle) + grown)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Mask of the `points` (points, 2) that lie inside the body."""
        offset = points - self.centre
        return np.hypot(*offset.T) < self._reach(np.arctan2(offset[:, 1], offset[:, 0]))

    def _reach(self, angle) -> np.ndarray:
        if not self.corners:
            return np.full(np.shape(angle), self.radius)
        half = np.pi / self.corners
        apothem = self.radius * np.sqrt(half / np.tan(half))
        return apothem / np.cos((angle - self.turned) % (2 * half) - half)


class Tank(NamedTuple):
    """Simulated tank. **Fields**: `frame`, measured with the `bodies`; `reference`, measured without bodies; `radius`
    in metres."""

    frame: Measurement
    reference: Measurement
    bodies: tuple[Body, ...]
    radius: float


def draw(seed: int, noise: float = NOISE) -> Tank:
    """Draw a tank, reproducible from its seed."""
    rng = np.random.default_rng(seed)
    radius = np.exp(rng.uniform(np.log(0.02), np.log(0.2)))
    count = int(rng.choice([16, 16, 32]))
    width = rng.uniform(0.2, 0.75) * 2 * np.pi * radius / count
    electrodes = BoundaryElectrodes(ring(radius, count, start_angle=rng.uniform(0, 2 * np.pi)), width, 1.0)
    conductivity = np.exp(rng.uniform(np.log(1e-4), np.log(1e-1)))
    impedance = np.exp(rng.uniform(np.log(1e-4), np.log(0.1))) * radius / conductivity
    protocol = _protocol(rng, count)
    bodies = _bodies(rng)
    points, cells = _mesh(bodies, rng)
    problem = {
        "points": radius * points,
        "cells": cells,
        "position": np.asarray(electrodes.position),
        "width": np.full(count, width),
        "contact_impedance": np.full(count, impedance),
        "drive": np.asarray(protocol.drive),
        "measurement": np.asarray(protocol.measurement),
        "drive_index": np.asarray(protocol.drive_index),
        "measurement_index": np.asarray(protocol.measurement_index),
    }
    solver = ScipyBaseline(problem, choose=False)
    centres = points[cells].mean(axis=1)
    factors = np.ones(len(cells))
    for body in bodies:
        factors[body.holds(centres)] = body.factor
    domain = Disk(radius)
    electrodes = electrodes.with_contact_impedance(np.full(count, impedance))

    def measured(factor, name):
        voltages = solver.voltages(conductivity * factor)
        deviation = noise * np.hypot(voltages, 0.02 * np.median(np.abs(voltages)))
        voltages = voltages + deviation * rng.normal(size=voltages.shape)
        mask = np.ones(voltages.shape, bool)
        return Measurement(voltages, mask, protocol, electrodes=electrodes, domain=domain, name=name)

    return Tank(measured(factors, f"tank {seed}"), measured(np.ones(len(cells)), "empty"), bodies, radius)


def matched(tank: Tank, inclusions: Sequence[Inclusion]) -> tuple[np.ndarray, int]:
    """Distance of each body, in units of the tank's radius, from the nearest inclusion of the same sign.

    The distance is infinite if there is no such inclusion within `REACH`. Also returns the number of inclusions that
    match no body.
    """
    if not inclusions:
        return np.full(len(tank.bodies), np.inf), 0
    places = np.array([one.centroid for one in inclusions]) / tank.radius
    distance = np.linalg.norm(np.array([body.centre for body in tank.bodies])[:, None] - places, axis=2)
    same = np.array([[body.sign == one.sign for one in inclusions] for body in tank.bodies])
    distance = np.where(same & (distance < REACH), distance, 1e3)
    body, inclusion = linear_sum_assignment(distance)
    found = np.full(len(tank.bodies), np.inf)
    near = distance[body, inclusion] < REACH
    found[body[near]] = distance[body, inclusion][near]
    return found, len(inclusions) - int(near.sum())


def _protocol(rng, count: int) -> Protocol:
    current = np.exp(rng.uniform(np.log(1e-4), np.log(1e-2)))
    kind = rng.integers(5)
    if kind == 0:
        return adjacent(count, current=current)
    if kind == 1:
        return adjacent(count, current=current, driven_electrodes=True)
    if kind == 2:
        return opposite(count, current=current)
    if kind == 3:
        return skip(count, int(rng.integers(1, 4)), current=current)
    return all_against_one(count, current=current)


def _bodies(rng) -> tuple[Body, ...]:
    number = int(rng.integers(1, 4))
    while True:
        bodies: list[Body] = []
        for _ in range(200):
            radius = rng.uniform(0.17, 0.3)
            centre = rng.uniform(-1, 1, 2)
            corners = int(rng.choice([0, 0, 4]))
            grown = radius * (1.26 if corners else 1.0)
            if np.hypot(*centre) + grown + _FROM_WALL > 1:
                continue
            if any(
                np.hypot(*(centre - one.centre)) < grown + one.radius * (1.26 if one.corners else 1) + _APART
                for one in bodies
            ):
                continue
            factor = np.exp(rng.choice([-1, 1]) * rng.uniform(np.log(3), np.log(1e3)))
            bodies.append(Body(centre, radius, corners, rng.uniform(0, np.pi / 2), float(factor)))
            if len(bodies) == number:
                return tuple(bodies)


def _mesh(bodies, rng) -> tuple[np.ndarray, np.ndarray]:
    """Mesh of the unit disk: nodes (n, 2) and cells (m, 3) that are aligned with the bodies' outlines."""
    angle = 2 * np.pi * np.arange(512) / 512
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = [circle, 0.985 * circle[::2], 0.96 * circle[1::4]]
    for body in bodies:
        number = int(np.ceil(2 * np.pi * body.radius / _SPACING * 1.6))
        rings += [body.outline(number, grown) for grown in (-0.008, 0.008)]
    fixed = np.concatenate(rings)
    return meshed_disk(fixed, _SPACING, rng)
