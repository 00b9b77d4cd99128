"""Sheets that deviate from their description: disks, rectangles and polygons with one to three round bodies.

Voltages are computed on another, finer mesh, for electrodes that are displaced from their description, with different
contact impedances. Some tanks have one more kind of deviation. Tanks of the kind "in space" have a height, upright
bodies, and electrodes that cover part of the height, but are described as sheets. The defaults of jeit were set on
other tanks of the kinds `SET_ON`; the kinds `KEPT_BACK` are never used to set defaults.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.problems.solid_tanks import Ball, mesh_along
from jeit.data import Measurement
from jeit.electrodes import BoundaryElectrodes, FacePatches
from jeit.electrodes.face_patches import body_mesh
from jeit.forward import ForwardModel
from jeit.forward.changes import solved_fields
from jeit.image import Inclusion
from jeit.mesh import Disk, Domain, Polygon, Rectangle, Solid, centroids, measures
from jeit.protocol import adjacent, skip
from jeit_solvers.engines import as_array, on_host

KEPT_BACK = ("drifting contacts", "size", "gains", "few digits")
KINDS = ("exact description", "electrodes", "contacts", "electrodes and contacts", *KEPT_BACK, "in space")
SET_ON = tuple(kind for kind in KINDS if kind not in KEPT_BACK)
_SIZE = 0.1
REACH = 0.3
"""Distance, in units of half the width of a tank, within which an inclusion may be a body's."""
_NODES = 7000
# Least distance between the two ends of a strip, in units of the strip's width.
_STRAIGHT = 0.98


class Body(NamedTuple):
    """Body in a tank. **Fields**: `centre` (2,) or (3,) and `radius` in metres; `change` of conductivity relative to
    the background; `measure`: area of the body's cells in m², or volume in m³; `axes`: number of axes along which the
    body is bounded."""

    centre: np.ndarray
    radius: float
    change: float
    measure: float = np.nan
    axes: int = 2

    @property
    def strength(self) -> float:
        """Strength of the body: area or volume times (σ/σ₀ - 1) / (σ/σ₀ + axes - 1), in m² or m³, for the
        conductivities σ of the body and σ₀ of the background."""
        return self.measure * self.change / (self.axes + self.change)


class Tank(NamedTuple):
    """Simulated tank. **Fields**: `frame`: measured with the `bodies`; `reference`: measured without bodies; `kind` of
    deviation; `outline`; `noise`: relative noise of each voltage; `size`: half of the width in metres."""

    frame: Measurement
    reference: Measurement
    bodies: tuple[Body, ...]
    kind: str
    outline: str
    noise: float
    size: float = _SIZE


def draw(seed: int) -> Tank:
    """Draw a tank, reproducible from its seed. The kind of deviation is `seed` modulo the number of kinds."""
    rng = np.random.default_rng(seed)
    kind, outline = KINDS[seed % len(KINDS)], ("disk", "rectangle", "polygon")[seed // len(KINDS) % 3]
    while True:
        try:
            return _draw(rng, kind, outline)
        except ValueError:  # electrodes overlap: draw others
            continue


def _draw(rng, kind: str, outline: str) -> Tank:
    domain = _outline(outline, rng)
    count = int(rng.choice([16, 16, 32]))
    edge = domain.loops(2000)[0]
    lengths = np.linalg.norm(np.roll(edge, -1, axis=0) - edge, axis=1)
    perimeter = float(lengths.sum())
    conductivity = np.exp(rng.uniform(np.log(1e-4), np.log(1e-1)))
    width = rng.uniform(0.25, 0.5) * perimeter / count
    impedance = np.exp(rng.uniform(np.log(1e-3), np.log(2e-2))) * _SIZE / conductivity
    middle = perimeter * (np.arange(count) + 0.5) / count
    described = BoundaryElectrodes(_along(edge, lengths, middle), width, impedance)
    off, spread = kind not in ("exact description", "contacts"), kind not in ("exact description", "electrodes")
    shift = off * rng.uniform(0, 3) / 360 * perimeter * rng.normal(size=count)
    contact = impedance * np.exp(spread * rng.uniform(0, np.log(3)) * rng.normal(size=count))
    drifted = contact * np.exp((kind == "drifting contacts") * rng.uniform(0, 0.3) * rng.normal(size=count))
    scale = 1 + (kind == "size") * rng.uniform(-0.03, 0.03)
    noise = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.08))))
    place = _along(edge, lengths, middle + shift)
    height, covered = (rng.uniform(0.3, 1.5) * _SIZE, rng.uniform(0.3, 0.99)) if kind == "in space" else (None, 1.0)
    ends = [_along(edge, lengths, middle + shift + side * width / 2) for side in (-1, 1)]
    if height is not None and (np.linalg.norm(ends[1] - ends[0], axis=1) < _STRAIGHT * width).any():
        raise ValueError("a strip bends round a corner.")
    truth = _electrodes(place, width, contact, height, covered)
    mesh = None
    if isinstance(truth, BoundaryElectrodes):
        mesh = body_mesh(domain, truth, _NODES)
        truth.check(mesh)
    current = np.exp(rng.uniform(np.log(1e-4), np.log(1e-2)))
    protocol = (
        skip(count, int(rng.integers(1, 4)), current=current)
        if rng.random() < 0.3
        else adjacent(count, current=current, driven_electrodes=bool(rng.integers(2)))
    )
    bodies = _bodies(rng, domain)
    if isinstance(truth, FacePatches):
        assert height is not None
        columns = [Ball(np.append(one.centre, height / 2), one.radius, 1 + one.change, height) for one in bodies]
        mesh, _ = mesh_along(Solid(domain, height), truth, columns)
        truth.check(mesh)
    assert mesh is not None
    middles = np.asarray(centroids(mesh))[:, :2]
    whole = np.full(len(middles), conductivity / (height or 1.0))
    held = whole.copy()
    inside = [np.linalg.norm(middles - body.centre, axis=1) < body.radius for body in bodies]
    for body, cells in zip(bodies, inside, strict=True):
        held[cells] *= 1 + body.change
    gain = gains(rng, kind, protocol.num_measurements)
    measured = []
    for values, impedances in ((whole, contact), (held, drifted)):
        electrodes = _electrodes(scale * place, width, impedances, height, covered)
        there = replace(mesh, points=as_array(scale * np.asarray(mesh.points)))
        model = on_host(ForwardModel(there, electrodes, protocol))
        voltages = gain * np.asarray(solved_fields(model, values).voltages)
        measured.append(recorded(rng, kind, voltages, noise))
    frames = [
        Measurement(one, np.ones(one.shape, bool), protocol, electrodes=described, domain=domain, name=name)
        for one, name in zip(measured, ("reference", "frame"), strict=True)
    ]
    areas = [scale**2 * float(np.asarray(measures(mesh))[cells].sum()) / (height or 1.0) for cells in inside]
    bodies = tuple(
        Body(scale * body.centre, scale * body.radius, body.change, area)
        for body, area in zip(bodies, areas, strict=True)
    )
    return Tank(frames[1], frames[0], bodies, kind, outline, noise)


def gains(rng, kind: str, number: int) -> np.ndarray:
    """Gains (number,) of channels, with a standard deviation of up to 5 % if `kind` is "gains", otherwise 1."""
    return 1 + (kind == "gains") * rng.uniform(0, 0.05) * rng.normal(size=number)


def recorded(rng, kind: str, voltages: np.ndarray, noise: float) -> np.ndarray:
    """Voltages with relative `noise`, and rounded to two or three digits if the `kind` of deviation is few digits."""
    deviation = noise * np.hypot(voltages, 0.02 * np.median(np.abs(voltages)))
    voltages = voltages + deviation * rng.normal(size=voltages.shape)
    if kind == "few digits":
        digits = rng.integers(2, 4) - 1 - np.floor(np.log10(np.abs(voltages)))
        voltages = np.round(voltages * 10**digits) / 10**digits
    return voltages


def matched(tank: Tank, inclusions: Sequence[Inclusion]) -> tuple[list[Inclusion | None], int]:
    """For each body, the nearest inclusion of the same sign within `REACH`, or None; and the number of inclusions that
    match no body."""
    found: list[Inclusion | None] = [None] * len(tank.bodies)
    if not inclusions:
        return found, 0
    places = np.array([one.centroid for one in inclusions]) / tank.size
    distance = np.linalg.norm(np.array([body.centre / tank.size for body in tank.bodies])[:, None] - places, axis=2)
    same = np.array([[(body.change > 0) == (one.sign > 0) for one in inclusions] for body in tank.bodies])
    distance = np.where(same & (distance < REACH), distance, 1e3)
    for body, inclusion in zip(*linear_sum_assignment(distance), strict=True):
        if distance[body, inclusion] < REACH:
            found[body] = inclusions[inclusion]
    return found, len(inclusions) - sum(one is not None for one in found)


def _electrodes(place, width, contact, height: float | None, covered: float) -> BoundaryElectrodes | FacePatches:
    """Electrodes: arcs on the edge of a sheet or, in a tank with a `height`, strips at half of the height that cover
    the fraction `covered` of the height.

    `contact` is the contact impedance on the sheet in ohm·m.
    """
    if height is None:
        return BoundaryElectrodes(place, width, contact)
    place = np.column_stack([place, np.full(len(place), height / 2)])
    return FacePatches(place, width, covered * height, contact * height)


def _outline(name: str, rng) -> Domain:
    if name == "disk":
        return Disk(_SIZE)
    if name == "rectangle":
        return Rectangle(2 * _SIZE, 2 * _SIZE * rng.uniform(0.6, 1.0))
    angle = 2 * np.pi * np.arange(6) / 6
    radius = _SIZE * rng.uniform(0.85, 1.1, 6)
    return Polygon(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1))


def _along(edge: np.ndarray, lengths: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Points of a closed outline at the arc lengths `places`."""
    arc = np.append(0, np.cumsum(lengths))
    closed = np.vstack([edge, edge[:1]])
    places = places % arc[-1]
    return np.stack([np.interp(places, arc, closed[:, axis]) for axis in range(2)], axis=1)


def drawn_change(rng) -> float:
    """Draw the change of a body's conductivity relative to the background: -30 to -99 %, or +42 to +1,000 %."""
    contrast = np.exp(rng.uniform(np.log(0.35), np.log(4.6)))
    return float(np.expm1(-contrast)) if rng.random() < 0.5 else float(np.expm1(min(contrast, 2.4)))


def _bodies(rng, domain: Domain) -> tuple[Body, ...]:
    """Draw one to three bodies that are separate from each other and from the edge."""
    number, (x_min, x_max, y_min, y_max) = int(rng.integers(1, 4)), domain.extent
    while True:
        bodies: list[Body] = []
        for _ in range(300):
            radius = _SIZE * rng.uniform(0.12, 0.28)
            centre = rng.uniform([x_min, y_min], [x_max, y_max])
            inside = float(np.asarray(domain.signed_distance(centre[None]))[0]) > radius + 0.08 * _SIZE
            apart = all(np.linalg.norm(centre - one.centre) > radius + one.radius + 0.12 * _SIZE for one in bodies)
            if inside and apart:
                bodies.append(Body(centre, radius, drawn_change(rng)))
                if len(bodies) == number:
                    return tuple(bodies)
