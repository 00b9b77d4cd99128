"""Frames of a flat disc pressed on a round sheet, against the series for a disk with a disc of other conductivity.

An independent solution without meshes, presses or low-rank updates. An off-centre disc is moved there by a Möbius map
of the disk onto itself, which preserves currents and potentials at points of the boundary.
"""

import dataclasses

import jax
import numpy as np

from jeit.electrodes import BoundaryElectrodes, PointElectrodes
from jeit.forward import ForwardModel
from jeit.forward.exact import ConductingDisk, arc_transfer_impedance, point_inclusion_effect
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch.simulate.contact import DiscIndenter, Press, PressedSkin, material

KEY = jax.random.key(0)
RADIUS, SHEET, PUNCH, LOAD = 0.05, 2e-5, 0.012, 15.0
WIDTH, IMPEDANCE = 0.008, 200.0
ANGLES = 2 * np.pi * np.arange(16) / 16
VELOSTAT = dataclasses.replace(material("velostat"), creep=(), noise=0.0, gain_spread=0.0)
PROTOCOL = adjacent(16)
RIM = RADIUS * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)


def select(impedance):
    table = np.asarray(PROTOCOL.measurement) @ impedance @ np.asarray(PROTOCOL.drive).T
    return table[np.asarray(PROTOCOL.measurement_index), np.asarray(PROTOCOL.drive_index)]


def pressed_disk(ratio: float) -> ConductingDisk:
    """With the conductivity under the punch by the material's law at its pressure, load over area."""
    change = VELOSTAT.change(LOAD / (np.pi * PUNCH**2))
    return ConductingDisk(RADIUS, SHEET, ratio, SHEET * (1 + float(change)))


def errors(electrodes, place, exact, levels) -> list[float]:
    found = []
    for number in levels:
        model = ForwardModel(Disk(RADIUS).mesh(num_points=number), electrodes, PROTOCOL)
        skin = PressedSkin(KEY, model, VELOSTAT, conductivity=SHEET)
        touched, conductivity = skin.touched([Press(DiscIndenter(2 * PUNCH), LOAD, place)]), np.array(skin.conductivity)
        conductivity[touched.cells[0]] *= 1 + np.asarray(touched.change[0])  # frames are those of such a model
        change = np.asarray(model.voltages(conductivity)) - skin.rest()
        found.append(np.linalg.norm(change - exact) / np.linalg.norm(exact))
    return found


def test_a_punch_at_the_centre():
    widths, impedance = np.full(16, WIDTH), np.full(16, IMPEDANCE)
    pressed, rest = (
        arc_transfer_impedance(disk, ANGLES, widths, impedance, order=24)
        for disk in (pressed_disk(PUNCH / RADIUS), pressed_disk(0))
    )
    found = errors(BoundaryElectrodes(RIM, WIDTH, IMPEDANCE), (0, 0), select(pressed) - select(rest), (400, 1600, 6400))
    assert found[-1] < 7e-3
    assert np.log2(found[0] / found[-1]) / 2 > 1.0


def test_a_punch_off_the_centre():
    away, size = 0.4, PUNCH / RADIUS
    # w → (w − a) / (1 − a w) maps the circle of radius `size` about `away` to one about the centre.
    low, high = away - size, away + size
    half = (1 + low * high) / (low + high)
    shift = half - np.sqrt(half**2 - 1)
    ratio = (high - shift) / (1 - shift * high)
    rim = np.exp(1j * ANGLES)
    moved = np.angle((rim - shift) / (1 - shift * rim))
    exact = select(point_inclusion_effect(pressed_disk(ratio), moved))
    found = errors(PointElectrodes(RIM), (away * RADIUS, 0.0), exact, (400, 1600, 6400))
    assert found[-1] < 0.012
    assert np.log2(found[0] / found[-1]) / 2 > 1.0
