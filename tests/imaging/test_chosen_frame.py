"""A file with several frames: the imaged frame is reported, and errors name it."""

import json

import numpy as np
import pytest

from jeit.cli.commands.reconstruct import print_imaging_result
from jeit.cli.console import plain_console
from jeit.data import screen
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.imaging import ImagingSettings, image_difference, prepare_difference
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent
from jeit.report import write_image

DISK = Disk(0.05)
ELECTRODES = BoundaryElectrodes(ring(0.05, 8), 0.01, 0.05)
MODEL = ForwardModel(DISK.mesh(num_points=400), ELECTRODES, adjacent(8))
NEAR = np.linalg.norm(np.asarray(centroids(MODEL.mesh)) - [0.02, 0.01], axis=1) < 0.012
EMPTY, FULL = (np.asarray(MODEL.voltages(np.where(NEAR, high, 0.02))) for high in (0.02, 0.03))
SETTINGS = ImagingSettings(method="one-step", hyperparameter=10.0, num_points=300, raster_shape=(32, 32))


def tank(*rows, names=(), name="tank"):
    return screen(
        np.stack(rows), MODEL.protocol, electrodes=ELECTRODES, domain=DISK, name=name, frame_names=tuple(names)
    )


MEAN = 'frames = "mean" in [data] of the description'
NAMES = ["reference", "a", "b"]
IMAGED = {
    "the first": (None, tank(FULL, EMPTY), 0, f"0 of 2, from 0; --frame takes another, or their mean: {MEAN}"),
    "one asked for": (-2, tank(EMPTY, FULL, EMPTY), 1, "1 of 3"),
    "one named": (None, tank(EMPTY, FULL, FULL, names=NAMES), 1, "'a', 1 of 3, from 0; --frame takes another"),
}


@pytest.mark.parametrize("name", IMAGED)
def test_the_frame_is_reported_and_written(name, tmp_path, capsys):
    frame, measured, number, label = IMAGED[name]
    base = None if measured.frame_names else tank(EMPTY)
    result = image_difference(measured, base, SETTINGS, frame=frame)
    np.testing.assert_array_equal(np.asarray(result.measurement.voltages)[0], FULL)
    assert (result.frame, result.num_frames) == (number, measured.num_frames)
    print_imaging_result(plain_console(), result, frame_given=frame is not None)
    assert f"frame {label} background " in " ".join(capsys.readouterr().out.split())
    write_image(result, tmp_path)
    data = json.loads((tmp_path / "report.json").read_text())["data"]
    assert data["frame"] == (measured.frame_names[number] if measured.frame_names else number)
    assert data["frames"] == measured.num_frames


def test_one_frame_is_not_numbered(capsys):
    print_imaging_result(plain_console(), image_difference(tank(FULL), tank(EMPTY), SETTINGS))
    assert "frame " not in capsys.readouterr().out


def test_a_frame_without_readings_is_named():
    nothing = tank(FULL, np.nan * FULL, FULL)
    with pytest.raises(ValueError, match=r"^'tank', frame 1 has no usable voltage: each is NaN"):
        prepare_difference(nothing, tank(EMPTY), frame=1, num_points=300)
    with pytest.raises(ValueError, match=r"^the reference 'empty' has no usable voltage"):
        prepare_difference(tank(FULL), tank(EMPTY, np.nan * EMPTY, name="empty").frame(1), num_points=300)
    with pytest.raises(ValueError, match=r"^the reference 'tank' has no usable voltage"):  # a frame of the same file
        prepare_difference(tank(FULL, FULL), tank(EMPTY, np.nan * EMPTY).frame(1), frame=1, num_points=300)


def test_a_frame_that_cannot_be_imaged_is_named_and_its_reference_is_not():
    noise = np.random.default_rng(0).normal(size=FULL.size) * np.abs(FULL)
    with pytest.raises(ValueError, match=r"^'tank', frame 2 cannot be imaged: "):
        prepare_difference(tank(FULL, FULL, noise), tank(EMPTY), frame=2, num_points=300)
    with pytest.raises(ValueError, match=r"^'tank', frame 0 cannot be imaged: it equals its reference"):
        prepare_difference(tank(EMPTY, FULL), tank(EMPTY), num_points=300)
    with pytest.raises(ValueError, match=r"^'tank' cannot be imaged: it equals its reference"):
        prepare_difference(tank(EMPTY), tank(EMPTY), num_points=300)


def test_a_difference_within_rounding_is_named():
    drifted = EMPTY * (1 + 5e-5 * np.random.default_rng(0).normal(size=EMPTY.size))
    empty, almost = (np.array([float(f"{one:.4g}") for one in frame]) for frame in (EMPTY, drifted))
    assert (empty != almost).any()
    with pytest.raises(ValueError, match=r"^'tank' cannot be imaged: its difference .* is mostly rounding of the volt"):
        prepare_difference(tank(almost), tank(empty), num_points=300)
