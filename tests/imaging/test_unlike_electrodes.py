"""Outlying electrodes, identified by the residual of a calibrated model of the empty body."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.problems.cut_tanks import draw, without
from jeit import image_difference
from jeit.data import Measurement, read
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.image.rasters import challenge_score
from jeit.imaging import ImagingSettings, prepare_difference
from jeit.inverse.channels import electrode_misfits
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent
from jeit.report.image import report_image

RADIUS, FAULTY = 0.05, 6
TRUTH = ForwardModel(Disk(RADIUS).mesh(num_points=2000), BoundaryElectrodes(ring(RADIUS, 16), 0.01, 0.05), adjacent(16))
FEW: dict[str, Any] = {"num_points": 450}


def frame(factor: float = 1.0, gain: float = 1.0, seed: int = 0) -> Measurement:
    """A disk whose conductivity is `factor` times that of the rest, with one electrode's potential read `gain` times
    too large.
    """
    inside = np.linalg.norm(np.asarray(centroids(TRUTH.mesh)) - [0.02, 0.01], axis=1) < RADIUS / 3
    impedance = np.array(TRUTH.transfer_impedance(np.where(inside, 0.02 * factor, 0.02)))
    impedance[FAULTY] *= gain
    plan = TRUTH.protocol
    voltages = (np.asarray(plan.channel_measurement) @ impedance * np.asarray(plan.channel_drive)).sum(axis=1)
    voltages = voltages * (1 + 1e-3 * np.random.default_rng(seed).normal(size=voltages.shape))
    mask = np.ones(voltages.shape, bool)
    return Measurement(voltages, mask, plan, electrodes=TRUTH.electrodes, domain=Disk(RADIUS), name="frame")


def test_a_misread_electrode_is_named_and_has_less_weight():
    prepared = prepare_difference(frame(20.0, 1.1, 1), frame(1.0, 1.1), as_is=True, **FEW)
    assert FAULTY in prepared.unlike_electrodes
    assert prepared.unlike_electrodes[FAULTY] > 3
    reads = np.asarray(TRUTH.protocol.channel_measurement)[:, FAULTY] != 0
    sound = prepare_difference(frame(20.0, 1.0, 1), frame(), **FEW)
    ratio = np.asarray(prepared.relative_noise) / np.asarray(sound.relative_noise)
    assert ratio[reads].min() > 2.5
    alone = np.asarray(TRUTH.protocol.channel_measurement)[:, list(prepared.unlike_electrodes)] == 0
    np.testing.assert_allclose(ratio[alone.all(axis=1)], 1, rtol=0.1)


def test_sound_electrodes_have_equal_weights():
    prepared = prepare_difference(frame(20.0, 1.0, 1), frame(), **FEW)
    assert prepared.unlike_electrodes == {}


def test_the_image_is_valid_and_the_report_names_the_electrode():
    result = image_difference(
        frame(20.0, 1.1, 1), frame(1.0, 1.1), ImagingSettings(as_is=True, raster_shape=(128, 128), **FEW)
    )
    assert FAULTY in result.unlike_electrodes
    assert [one.sign for one in result.inclusions] == [1]
    assert np.linalg.norm(np.array(result.inclusions[0].centroid) - [0.02, 0.01]) < 0.04 * RADIUS
    assert report_image(result)["unlike_electrodes"][FAULTY + 1] == pytest.approx(result.unlike_electrodes[FAULTY])


def test_masked_channels_and_unread_electrodes_count_as_ordinary():
    plan = TRUTH.protocol
    mask = np.asarray(plan.mask_without([0, 1]))
    residual = np.where(mask, 1.0, np.nan)
    misfits = electrode_misfits(plan, residual, np.ones(len(mask)), mask)
    np.testing.assert_array_equal(misfits, 1.0)
    residual[np.asarray(plan.channel_measurement)[:, FAULTY] != 0] *= 10
    misfits = electrode_misfits(plan, residual, np.ones(len(mask)), mask)
    assert np.argmax(misfits) == FAULTY
    assert misfits[FAULTY] == pytest.approx(10)
    np.testing.assert_array_equal(electrode_misfits(plan, np.zeros(len(mask)), np.ones(len(mask)), mask), 1.0)


@pytest.mark.slow
def test_the_challenges_tank_has_one_between_its_last_electrodes(data_folder):
    folder = data_folder / "ktc2023"
    reference = read(folder / "ref.mat")
    for gone in ((), range(6)):
        frames = (without(one, gone) for one in (read(folder / "data1.mat"), reference))
        assert set(prepare_difference(*frames, num_points=600).unlike_electrodes) == {29, 30, 31}


@pytest.mark.slow
def test_a_body_is_segmented_although_an_electrode_is_missing():
    """By the challenge's score, which equals that of the truth except for the outline."""
    used = np.asarray(TRUTH.protocol.mask_without([0]))
    frames = (replace(one, mask=used) for one in (frame(20.0, seed=1), frame()))
    result = image_difference(*frames, ImagingSettings(segment=True, **FEW))
    assert result.shapes is not None
    assert result.labels is not None
    left, right, low, high = result.extent
    x, y = (first + (np.arange(256) + 0.5) / 256 * (last - first) for first, last in ((left, right), (high, low)))
    truth = np.where(np.hypot(x - 0.02, y[:, None] - 0.01) < RADIUS / 3, 2, 0)
    assert challenge_score(result.labels, truth) > 0.9
    assert challenge_score(truth, truth) == 1
    assert challenge_score(np.zeros_like(truth), truth) < 0.7


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1000, 1009])
def test_bodies_are_segmented_although_electrodes_are_missing(seed):
    tank = draw(seed).without(6)
    result = image_difference(tank.frame, tank.reference, ImagingSettings(segment=True, num_points=700))
    assert result.shapes is not None
    assert result.labels is not None
    assert challenge_score(result.labels, tank.truth) > 0.7
