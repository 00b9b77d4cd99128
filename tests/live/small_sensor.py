"""A sensor of eight electrodes for tests that need frames but no image, and a view that draws nothing."""

import numpy as np

from jeit.data import screen
from jeit.electrodes import BoundaryElectrodes
from jeit.layout import ring
from jeit.live.pictures import AbstractView, Picture, Scene
from jeit.mesh import Disk
from jeit.protocol import adjacent

PROTOCOL = adjacent(8, current=1e-3)
CHANNELS = PROTOCOL.num_measurements  # 40
NOISE = 1e-4


def rest():
    """Voltages (M,) of the undisturbed sensor: reciprocal, of a disk with point electrodes."""
    angle = np.pi / 2 - 2 * np.pi * np.arange(8) / 8
    places = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    transfer = np.where(apart > 0, -np.log(np.where(apart > 0, apart, 1.0)), 0.0)
    return np.einsum("ml,lk,mk->m", PROTOCOL.channel_measurement, transfer, PROTOCOL.channel_drive) / np.pi


def noisy(number, seed=0):
    """Frames (number, M) of the undisturbed sensor."""
    random = np.random.default_rng(seed)
    size = np.sqrt(np.mean(rest() ** 2))
    return rest() + NOISE * size * random.standard_normal((number, CHANNELS))


def measured(number=20, seed=0):
    """The same as a measurement."""
    position = ring(0.1, 8, clockwise=True)
    electrodes = BoundaryElectrodes(position, 0.01, 1e-3)
    return screen(noisy(number, seed), PROTOCOL, electrodes=electrodes, domain=Disk(0.1), name="small", source="made")


def description(path, data=""):
    """Write a description of the sensor, with lines of its section [data]."""
    path.write_text(
        '[geometry]\nshape = "disk"\nradius = 0.1\n[electrodes]\nlayout = "ring"\nnumber = 8\nclockwise = true\n'
        'width = 0.01\ncontact_impedance = 1e-3\n[protocol]\nkind = "adjacent"\ncurrent = 1e-3\n[data]\n' + data
    )
    return path


class Blank(AbstractView):
    """A view without images, which stores the frames and references that it received."""

    def __init__(self, make=None):
        self.scene = Scene("blank", "nothing", "", True, (-0.1, 0.1, -0.1, 0.1), ())
        self.seen, self.references, self.make = [], [], make

    def picture(self, frame):
        self.seen.append(frame.number)
        return Picture(None) if self.make is None else self.make(frame)

    def set_reference(self, frames):
        self.references.append(frames)
