"""Drives or measurements exchanged in one frame alone: reported, but not for noise."""

import numpy as np
import pytest

from jeit.data import Measurement
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.imaging import prepare_difference
from jeit.imaging.wiring import exchanges_message
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent, haar

DISK = Disk(0.05)
ELECTRODES = BoundaryElectrodes(ring(0.05, 16), 0.01, 0.05)
MODEL = ForwardModel(DISK.mesh(num_points=700), ELECTRODES, haar(16))
NEAR = np.linalg.norm(np.asarray(centroids(MODEL.mesh)) - [0.02, 0.01], axis=1) < 0.012


def measured(conductivity, swap=None, name="frame", noise=1e-3, seed=0):
    """A frame (drives, measurements) with noise, some of it exchanged by `swap`."""
    frame = np.array(MODEL.voltages(conductivity)).reshape(15, 16)
    frame += noise * np.abs(frame).max() * np.random.default_rng(seed).normal(size=frame.shape)
    frame = frame if swap is None else swap(frame)
    return Measurement(frame.ravel(), np.ones(240, bool), MODEL.protocol, electrodes=ELECTRODES, domain=DISK, name=name)


EMPTY = measured(0.02, name="empty", seed=1)
OBJECT = np.where(NEAR, 0.04, 0.02)


def exchanged(*pairs, axis=0):
    def swap(frame):
        frame = np.moveaxis(frame.copy(), axis, 0)
        for one, other in pairs:
            frame[[one, other]] = frame[[other, one]]
        return np.moveaxis(frame, 0, axis)

    return swap


@pytest.mark.parametrize(
    ("pairs", "axis", "beginning"),
    [
        ([(2, 6)], 0, "drives 3 and 7 look exchanged in it"),
        ([(4, 12)], 1, "measurements of every drive 5 and 13 look exchanged in it"),
        ([(1, 2), (8, 13)], 0, "drives "),
    ],
)
def test_exchanged_rows_of_a_frame_are_reported(pairs, axis, beginning):
    message = exchanges_message(measured(OBJECT, exchanged(*pairs, axis=axis)), EMPTY)
    assert message.startswith(beginning)
    assert all(f"{one + 1} and {other + 1}" in message for one, other in pairs)


def test_the_frame_is_refused_with_that_message():
    with pytest.raises(
        ValueError, match=r"'frame' does not fit its reference: measurements of every drive 5 and 13 look exchang"
    ):
        prepare_difference(measured(OBJECT, exchanged((4, 12), axis=1)), EMPTY, num_points=500)


def test_objects_and_noise_are_not_reported_as_exchange():
    for change in (OBJECT, np.where(NEAR, 2.0, 0.02), np.where(NEAR, 2e-4, 0.02)):
        assert exchanges_message(measured(change), EMPTY) == ""
    noisy = measured(OBJECT, noise=0.5)
    assert exchanges_message(noisy, EMPTY) == ""
    with pytest.raises(ValueError, match="noisy"):
        prepare_difference(noisy, EMPTY, num_points=500)


def test_protocols_with_different_readings_for_each_drive_are_not_checked():
    model = MODEL.with_protocol(adjacent(16))
    frame = Measurement(np.array(model.voltages(0.02))[::-1], np.ones(208, bool), model.protocol)
    assert exchanges_message(frame, frame) == ""
