"""Boxes and cylinders with one or two balls or columns, drawn at random and solved on meshes that follow the surfaces
of these bodies.

The meshes differ from those of the images, and are finer. Tanks differ in size, electrodes, contact impedances,
currents and measurements, and in number, size, place and conductivity of the balls. Columns stand in cylinders with a
ring of tall strips, as in most tanks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from jeit.data import Measurement
from jeit.electrodes import FacePatches
from jeit.electrodes.face_patches import body_mesh
from jeit.forward import ForwardModel
from jeit.forward.changes import solved_fields
from jeit.mesh import Disk, Mesh, Rectangle, Solid, bisect, centroids, cut
from jeit.protocol import Protocol, adjacent, from_matrices, haar, opposite, skip, trigonometric
from jeit_solvers.engines import on_host

FACTORS = (0.1, 0.3, 3.0, 12.0)
"""Conductivities of balls over that of the bath."""
KINDS = ("plates", "strips", "rings")
"""Boxes with plates all round, cylinders with a ring of tall strips, and with two rings of patches."""
_NODES, _NOISE, _FLOOR = 14_000, 2e-4, 3e-5
_EDGE, _COLUMNS_EDGE = 0.25, 0.35
_REACH = 2.0


class Ball(NamedTuple):
    """Ball or column in a tank. **Fields**: `centre` (3,) and `radius` in metres. `factor`: conductivity of the ball
    divided by that of the bath. `height`: height of the tank in metres, for a column through the tank instead of a
    ball.
    """

    centre: np.ndarray
    radius: float
    factor: float
    height: float | None = None

    @property
    def volume(self) -> float:
        """Volume, m³."""
        return np.pi * self.radius**2 * (4 / 3 * self.radius if self.height is None else self.height)

    def level(self, points: np.ndarray) -> np.ndarray:
        """Distance in metres of `points` (points, 3) from the surface of the body, negative inside."""
        along = 3 if self.height is None else 2
        return np.linalg.norm((points - self.centre)[..., :along], axis=-1) - self.radius

    def edge(self, corners: np.ndarray) -> np.ndarray:
        """Maximum length in metres of the edges of cells with `corners` (cells, 4, 3): short for cells on the surface
        of the body, otherwise infinite."""
        outside, edge = self.level(corners), _EDGE if self.height is None else _COLUMNS_EDGE
        return np.where((outside.min(axis=1) < 0) & (outside.max(axis=1) > 0), edge * self.radius, np.inf)


class SolidTank(NamedTuple):
    """Simulated tank. **Fields**: `frame`, measured with the `balls`; `reference`, measured without balls; `kind`, one
    of `KINDS`."""

    frame: Measurement
    reference: Measurement
    balls: tuple[Ball, ...]
    kind: str


def draw(seed: int, *, columns: bool = False) -> SolidTank:
    """Draw a tank, reproducible from its seed. With `columns` instead of balls, the tank is a cylinder with strips."""
    rng = np.random.default_rng(seed)
    kind = "strips" if columns else KINDS[int(rng.integers(len(KINDS)))]
    domain, electrodes, protocol = empty_tank(rng, kind)
    conductivity = np.exp(rng.uniform(np.log(0.01), np.log(1.0)))
    size = float(domain.outline.area) ** 0.5
    impedance = np.exp(rng.uniform(np.log(1e-3), np.log(0.03))) * size / conductivity
    electrodes = electrodes.with_contact_impedance(impedance * np.exp(rng.normal(0, 0.2, electrodes.num_electrodes)))
    balls = balls_in(rng, domain, middle=kind == "strips")
    if columns:
        balls = tuple(ball._replace(height=domain.thickness) for ball in balls)
    mesh, factors_of_cells = mesh_along(domain, electrodes, balls)
    model = on_host(ForwardModel(mesh, electrodes, protocol))

    def measured(factors, name):
        voltages = solved_fields(model, conductivity * factors).voltages
        floor = _FLOOR * np.median(np.abs(voltages))
        voltages = voltages * (1 + _NOISE * rng.normal(size=voltages.shape)) + floor * rng.normal(size=voltages.shape)
        mask = np.ones(voltages.shape, bool)
        unknown = electrodes.with_contact_impedance(np.full(electrodes.num_electrodes, impedance))
        return Measurement(voltages, mask, protocol, electrodes=unknown, domain=domain, name=name)

    frame = measured(factors_of_cells, f"tank {seed}")
    return SolidTank(frame, measured(np.ones(mesh.num_cells), "empty"), balls, kind)


def mesh_along(domain: Solid, electrodes: FacePatches, balls: Sequence[Ball]) -> tuple[Mesh, np.ndarray]:
    """A mesh with cell faces on the surfaces of the balls, and the conductivity of each cell divided by that of the
    bath."""
    mesh = body_mesh(domain, electrodes, _NODES)
    for ball in balls:
        mesh = bisect(mesh, ball.edge)
    for ball in balls:
        mesh = cut(mesh, ball.level)
    centres = np.asarray(centroids(mesh))
    factors = np.ones(len(centres))
    for ball in balls:
        factors[ball.level(centres) < 0] = ball.factor
    return mesh, factors


def empty_tank(rng, kind: str) -> tuple[Solid, FacePatches, Protocol]:
    """A tank of a `kind` (see `KINDS`), its electrodes with contact impedances of 1, and its measurements."""
    current = np.exp(rng.uniform(np.log(1e-4), np.log(1e-2)))
    scale = np.exp(rng.uniform(np.log(0.3), np.log(2.0)))
    if kind == "plates":
        x, y, z = scale * np.array([0.17, 0.17 * rng.uniform(1, 1.6), 0.17])
        at = [(a * x / 4, s * y / 2, b * z / 4) for s in (-1, 1) for a in (-1, 1) for b in (1, 3)]
        at += [(s * x / 2, a * y / 3, b * z / 4) for s in (-1, 1) for a in (-1, 0, 1) for b in (1, 3)]
        at += [(a * x / 4, b * y / 3, s * z) for s in (0, 1) for a in (-1, 1) for b in (-1, 0, 1)]
        side = rng.uniform(0.5, 0.94) * min(x / 2, y / 3, z / 2)
        electrodes = FacePatches(np.array(at), side, side, 1.0)
        return Solid(Rectangle(x, y), z), electrodes, _by_number(rng, haar, 32, current, 8)
    radius = scale * 0.1
    height = radius * rng.uniform(0.8, 2.0)
    angle = 2 * np.pi * np.arange(16) / 16
    around = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    width = rng.uniform(0.3, 0.75) * 2 * np.pi * radius / 16
    if kind == "strips":
        at = np.column_stack([around, np.full(16, height / 2)])
        electrodes = FacePatches(at, width, height * rng.uniform(0.3, 0.95), 1.0)
        return Solid(Disk(radius), height), electrodes, _by_number(rng, adjacent, 16, current, 4)
    low, high = rng.uniform(0.2, 0.35), rng.uniform(0.65, 0.8)
    at = np.concatenate([np.column_stack([around, np.full(16, one * height)]) for one in (low, high)])
    electrodes = FacePatches(at, width, height * rng.uniform(0.1, 0.35), 1.0)
    if rng.integers(2):
        return Solid(Disk(radius), height), electrodes, _by_number(rng, haar, 32, current, 8)
    return Solid(Disk(radius), height), electrodes, _pairs(rng, current)


def _by_number(rng, own: Callable[..., Protocol], count: int, current: float, most: int) -> Protocol:
    """Draw a protocol that depends only on the numbers of the electrodes: trigonometric, opposite, with up to `most`
    skipped electrodes, or the tank kind's `own` protocol."""
    kind = (trigonometric, own, opposite, skip)[int(rng.integers(4))]
    skipped = (int(rng.integers(1, most + 1)),) if kind is skip else ()
    return kind(count, *skipped, current=current)


def _pairs(rng, current: float) -> Protocol:
    """Protocol with drives across each of two rings and between the rings, and measurements between neighbours in a
    ring and between the rings."""
    one, ring = np.eye(32), np.arange(16)
    across = int(rng.integers(3, 9))
    ends = [(a + r, (a + across) % 16 + r) for r in (0, 16) for a in ring] + [(a, (a + across) % 16 + 16) for a in ring]
    read = [(a + r, (a + 1) % 16 + r) for r in (0, 16) for a in ring] + [(a, a + 16) for a in ring]
    drive, measurement = (np.array([one[a] - one[b] for a, b in pairs]) for pairs in (ends, read))
    return from_matrices(current * drive, measurement)


def balls_in(rng, domain: Solid, *, middle: bool) -> tuple[Ball, ...]:
    """Draw balls at any position or, if `middle`, at half of the height, because one ring of strips does not
    distinguish above from below."""
    number, balls = int(rng.integers(1, 3)), []
    height = domain.thickness
    disk = isinstance(domain.outline, Disk)
    x_max, y_max = (domain.extent[1], domain.extent[3])
    least = min(x_max, height / 2)
    while len(balls) < number:
        radius = rng.uniform(0.28, 0.5) * least
        room, gap = radius + 0.06 * least, 0.3 * least
        centre = rng.uniform([-x_max, -y_max, 0], [x_max, y_max, height])
        if middle:
            centre[2] = height / 2
        wall = x_max - np.hypot(*centre[:2]) if disk else np.min([x_max, y_max] - np.abs(centre[:2]))
        apart = all(np.linalg.norm(centre - other.centre) > radius + other.radius + gap for other in balls)
        if wall > room and apart and room < centre[2] < height - room:
            balls.append(Ball(centre, radius, float(rng.choice(FACTORS))))
    return tuple(balls)


def matched(tank: SolidTank, places: Sequence[np.ndarray], signs: Sequence[int]) -> tuple[np.ndarray, int]:
    """For each ball, the index of the matching detected body, and the number of detected bodies that match no ball.
    `places`: positions of the detected bodies in metres.

    The matching body is the nearest body of the same sign within two radii; the index is -1 if there is none.
    """
    if not len(places):
        return np.full(len(tank.balls), -1), 0
    distance = np.array([np.linalg.norm(np.array(places) - ball.centre, axis=1) / ball.radius for ball in tank.balls])
    same = np.array([[(ball.factor > 1) == (sign > 0) for sign in signs] for ball in tank.balls])
    distance = np.where(same & (distance < _REACH), distance, 1e3)
    ball, one = linear_sum_assignment(distance)
    found = np.full(len(tank.balls), -1)
    near = distance[ball, one] < _REACH
    found[ball[near]] = one[near]
    return found, len(places) - int(near.sum())
