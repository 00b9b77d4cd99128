"""Frames of a stream with large noise: a noisy electrode is left out and named, and a frame whose noise hides every
change is refused. Voltages are those of random symmetric impedances, which obey reciprocity exactly."""

import numpy as np
import pytest

from jeit.inverse.streaming.stream import FrameCheck, FrameStatus
from jeit.protocol import adjacent

PROTOCOL, COUNT = adjacent(16), 16
DRIVE, MEASUREMENT = np.asarray(PROTOCOL.channel_drive), np.asarray(PROTOCOL.channel_measurement)
TOUCHING = np.array([PROTOCOL.channels_touching(electrode) for electrode in range(COUNT)])


def voltages(seed: int) -> np.ndarray:
    impedance = np.random.default_rng(seed).uniform(1, 2, (COUNT, COUNT))
    return np.einsum("ci,ij,cj->c", MEASUREMENT, impedance + impedance.T, DRIVE)


EXPECTED = voltages(0)
CHANGED = EXPECTED + 0.05 * voltages(1)


def noisy(frame: np.ndarray, noise: float, channels=slice(None)) -> np.ndarray:
    random, result = np.random.default_rng(2).normal(size=frame.shape), frame.copy()
    result[channels] += noise * (np.sqrt(np.mean(frame**2)) * random)[channels]
    return result


@pytest.fixture(scope="module")
def check():
    pairs, ratio = PROTOCOL.reciprocal_pairs()
    tied = np.asarray(pairs), np.asarray(ratio)
    return FrameCheck(np.ones(EXPECTED.shape, bool), EXPECTED, TOUCHING, tied, np.ones(EXPECTED.shape))


def test_a_noisy_electrode_is_named_and_left_out(check):
    _, usable, status, reason = check(noisy(CHANGED, 0.3, TOUCHING[4]))
    assert status == FrameStatus.PARTIAL
    assert "Electrode 5 breaks reciprocity" in reason
    np.testing.assert_array_equal(usable, ~TOUCHING[4])


def test_a_frame_whose_noise_hides_every_change_is_refused(check):
    _, _, status, reason = check(noisy(CHANGED, 0.3))
    assert status == FrameStatus.REFUSED
    assert "% of the voltages, by reciprocity, and hides every change" in reason


@pytest.mark.parametrize(("noise", "status"), [(0.001, FrameStatus.IMAGED), (0.02, FrameStatus.IMAGED)])
def test_a_change_that_exceeds_the_noise_is_imaged(check, noise, status):
    assert check(noisy(CHANGED, noise))[1:] == (pytest.approx(np.ones(EXPECTED.shape)), status, "")


def test_a_small_noise_without_a_change_is_no_fault(check):
    _, usable, status, _ = check(noisy(EXPECTED, 0.02))
    assert (status, usable.all()) == (FrameStatus.UNCHANGED, True)
