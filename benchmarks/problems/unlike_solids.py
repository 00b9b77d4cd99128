"""Cylinders and boxes that deviate from their description, with one or two balls or columns in them.

Voltages are computed on a mesh that follows the surfaces of the balls, and that differs from the mesh of images and is
finer. The deviations are those of `problems/unlike_tanks.py`: of electrode positions in both directions along a face,
of contacts, size, gains and digits.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.problems.solid_tanks import KINDS as FORMS
from benchmarks.problems.solid_tanks import balls_in, empty_tank, mesh_along
from benchmarks.problems.unlike_tanks import KINDS, Body, Tank, drawn_change, gains, recorded
from jeit.data import Measurement
from jeit.electrodes import FacePatches
from jeit.forward import ForwardModel
from jeit.forward.changes import solved_fields
from jeit.mesh import Disk, Solid
from jeit_solvers.engines import as_array, on_host

ERRORS = tuple(kind for kind in KINDS if kind != "in space")
# Maximum shift of an electrode, as a fraction of the distance between the electrode and the edge of its face.
_ROOM = 0.9


def draw(seed: int) -> Tank:
    """Draw a tank, reproducible from its seed. The kind of deviation is `seed` modulo the number of kinds."""
    rng = np.random.default_rng(seed)
    kind, form = ERRORS[seed % len(ERRORS)], FORMS[seed // len(ERRORS) % len(FORMS)]
    while True:
        try:
            return _draw(rng, kind, form)
        except ValueError:  # electrodes overlap or leave their face: draw others
            continue


def _draw(rng, kind: str, form: str) -> Tank:
    domain, described, protocol = empty_tank(rng, form)
    size = float(np.ptp(np.asarray(domain.extent)[:2])) / 2
    conductivity = np.exp(rng.uniform(np.log(0.01), np.log(1.0)))
    impedance = np.exp(rng.uniform(np.log(1e-3), np.log(0.03))) * size / conductivity
    described = described.with_contact_impedance(np.full(described.num_electrodes, impedance))
    number = described.num_electrodes
    off, spread = kind not in ("exact description", "contacts"), kind not in ("exact description", "electrodes")
    degrees = off * rng.uniform(0, 3) * rng.normal(size=(number, 2))
    contact = impedance * np.exp(spread * rng.uniform(0, np.log(3)) * rng.normal(size=number))
    drifted = contact * np.exp((kind == "drifting contacts") * rng.uniform(0, 0.3) * rng.normal(size=number))
    scale = 1 + (kind == "size") * rng.uniform(-0.03, 0.03)
    noise = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.08))))
    balls = balls_in(rng, domain, middle=form == "strips")
    upright = form == "strips" and rng.random() < 0.5
    balls = tuple(
        ball._replace(factor=1 + drawn_change(rng), height=domain.thickness if upright else None) for ball in balls
    )
    truth = _moved(described, domain, degrees)
    mesh, factors = mesh_along(domain, truth, balls)
    truth.check(mesh)
    there = replace(mesh, points=as_array(scale * np.asarray(mesh.points)))
    gain, measured = gains(rng, kind, protocol.num_measurements), []
    for values, impedances in ((np.ones(mesh.num_cells), contact), (factors, drifted)):
        electrodes = replace(truth, position=as_array(scale * np.asarray(truth.position)))
        model = ForwardModel(there, electrodes.with_contact_impedance(impedances), protocol)
        voltages = gain * np.asarray(solved_fields(on_host(model), conductivity * values).voltages)
        measured.append(recorded(rng, kind, voltages, noise))
    frames = [
        Measurement(one, np.ones(one.shape, bool), protocol, electrodes=described, domain=domain, name=name)
        for one, name in zip(measured, ("reference", "frame"), strict=True)
    ]
    axes = 2 if upright else 3
    bodies = tuple(
        Body(scale * ball.centre, scale * ball.radius, ball.factor - 1, scale**3 * ball.volume, axes) for ball in balls
    )
    return Tank(frames[1], frames[0], bodies, kind, f"solid, {form}", noise, size)


def _moved(electrodes: FacePatches, domain: Solid, degrees: np.ndarray) -> FacePatches:
    """The patches shifted by `degrees` (electrodes, 2) of the perimeter. On a cylinder, all patches of a column are
    shifted equally around it, and all patches of a ring equally upwards; on a box, all patches of a face are shifted
    equally along the two edges of the face, so that a mesh can follow the patches' edges. Upward shifts end before the
    rim."""
    shift = degrees / 360 * domain.outline.perimeter
    place = np.asarray(electrodes.position).copy()
    group = _rings(place) if isinstance(domain.outline, Disk) else _faces(place, domain)
    first = np.unique(group, return_index=True)[1]
    room = np.minimum(place[:, 2], domain.thickness - place[:, 2]) - np.asarray(electrodes.height) / 2
    room = _ROOM * np.array([room[group == one].min() for one in group])
    upwards = np.clip(shift[first[group], 1], -room, room)
    if isinstance(domain.outline, Disk):
        radius = np.linalg.norm(place[:, :2], axis=1)
        angle = np.arctan2(place[:, 1], place[:, 0])
        column, number = np.unique(np.round(angle, 6), return_index=True, return_inverse=True)[1:]
        angle = angle + shift[column[number], 0] / radius
        place = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), place[:, 2] + upwards])
    else:
        along = shift[first[group], 0]
        lid = group >= 4
        place[:, 0] += np.where(group < 2, 0, along)
        place[:, 1] += np.where(group < 2, along, np.where(lid, shift[first[group], 1], 0))
        place[:, 2] += np.where(lid, 0, upwards)
    return replace(electrodes, position=as_array(place))


def _rings(place: np.ndarray) -> np.ndarray:
    """The index of the ring of each patch, counted from below."""
    return np.unique(place[:, 2], return_inverse=True)[1]


def _faces(place: np.ndarray, domain: Solid) -> np.ndarray:
    """The index of the face of each patch: the two faces across x, the two across y, the lower face, the upper face."""
    x_min, x_max, y_min, y_max = domain.extent[:4]
    walls = [(0, x_min), (0, x_max), (1, y_min), (1, y_max), (2, 0.0), (2, domain.thickness)]
    return np.argmax([np.isclose(place[:, axis], at) for axis, at in walls], axis=0)
