"""Recordings that begin with the undisturbed body: the reference from their own frames."""

import json
import re

import numpy as np
import pytest

from jeit.cli.options import read_pair


@pytest.fixture
def recording(tank):
    """Two frames at rest, slightly different, and a third with a touch, with a description beside the file."""
    return tank.write("frames", [0.999 * tank.rest, 1.001 * tank.rest, tank.touched])


def test_reference_is_the_mean_of_frames_of_the_data_or_of_the_given_file(tank, recording):
    voltages = np.loadtxt(recording, delimiter=",")
    measurement, base = read_pair(recording, None, "0-1", None, None)
    assert measurement.num_frames == 3
    assert base is not None
    np.testing.assert_allclose(base.voltages, voltages[:2])
    with pytest.raises(ValueError, match=r"--reference: it is the file of DATA itself.*--reference-frames 0-9"):
        read_pair(recording, recording.parent / "." / recording.name, None, None, None)
    _, base = read_pair(tank.folder / "touched.csv", recording, "1", None, None)
    assert base is not None
    np.testing.assert_allclose(base.voltages, voltages[1:2])
    _, base = read_pair(tank.folder / "touched.csv", recording, None, None, None)
    assert base is not None
    assert base.num_frames == 3


def test_the_smallest_detectable_body_is_printed_and_reported(tank, run, tmp_path):
    noise = np.random.default_rng(0).normal(size=(2, tank.rest.size))
    for name, voltages, draw in (("rest", tank.rest, noise[0]), ("touched", tank.touched, noise[1])):
        tank.write(name, voltages + 1e-3 * np.abs(voltages) * draw)
    status, printed, _ = run("info", tank.folder / "touched.csv")
    assert status == 0
    (words,) = re.findall(r"smallest body +an insulating body ([0-9.]+) mm across is", " ".join(printed.split()))
    status, printed, error = run(
        "reconstruct", tank.folder / "touched.csv", "--reference", tank.folder / "rest.csv",
        "--output", tmp_path / "out", "--method", "one-step", "--hyperparameter", 1,
        "--num-points", 250, "--contact", "fixed",
    )  # fmt: skip
    assert (status, error) == (0, "")
    report = json.loads((tmp_path / "out" / "report.json").read_text("utf-8"))["smallest_detectable_body"]
    median, almost_everywhere = report["diameter_in_half_of_the_domain"], report["diameter_almost_everywhere"]
    assert 0 < median < almost_everywhere
    assert f"an insulating body {1e3 * median:.2g} mm across is detected" in " ".join(printed.split())
    # Both are those of noise, which is estimated from each file alone or from the difference.
    assert 1e-3 * float(words) == pytest.approx(median, rel=0.5)


@pytest.mark.parametrize("frames", ["1-0", "0-3", "3", "-1", "0:2", "a", ""])
def test_frames_that_do_not_exist_are_refused(recording, frames):
    with pytest.raises(ValueError, match=r"--reference-frames: give FIRST-LAST, .* frames 0 to 2 of 'frames'; it is '"):
        read_pair(recording, None, frames, None, None)


@pytest.mark.slow
def test_own_frames_and_a_file_of_them_give_the_same_image(tank, recording, run, tmp_path):
    found = []
    for name, given in (("own", ("--reference-frames", "0-1")), ("file", ("--reference", tank.folder / "rest.csv"))):
        folder = tmp_path / name
        asked = ("--frame", 2, "--num-points", 250, "--method", "one-step", "--hyperparameter", 1.0, "--output", folder)
        status, _, error = run("reconstruct", recording, *given, *asked)
        assert (status, error) == (0, "")
        found.append(json.loads((folder / "report.json").read_text())["inclusions"])
    own, file = ([one["peak"] for one in inclusions] for inclusions in found)
    np.testing.assert_allclose(own, file, rtol=1e-6)


@pytest.mark.parametrize("command", ["choose", "series", "reconstruct", "stream"])
def test_other_commands_accept_frames_too(recording, run, tmp_path, command):
    status, _, error = run(command, recording, "--reference-frames", "5", "--output", tmp_path / "out")
    assert status != 0
    assert "--reference-frames: give FIRST-LAST" in error
    own = {
        "series": ("--rate", 10),
        "choose": ("--rule", "gcv", "--quiet"),
        "reconstruct": ("--method", "one-step"),
        "stream": ("--method", "one-step", "--film", "none"),
    }
    asked = ("--num-points", 250, "--output", tmp_path / "images", *own[command])
    status, _, error = run(command, recording, "--reference-frames", "0-1", *asked)
    assert (status, error) == (0, "")


def test_a_stream_needs_a_reference_or_frames_of_it(tank, recording, run, tmp_path):
    for data, hint in ((recording, "or --reference-frames"), ("-", "--reference is missing")):
        status, _, error = run("stream", data, "--output", tmp_path)
        assert status == 1
        assert hint in error


@pytest.mark.parametrize("as_is", [False, True])
def test_a_stream_states_from_which_frame_on_electrodes_have_moved(tank, run, tmp_path, as_is):
    data = tank.write("frames", [tank.rest, tank.moved, tank.touched, tank.moved])
    given = ("--reference", tank.folder / "rest.csv", "--output", tmp_path / "out", "--film", "none")
    asked = ("--method", "one-step", "--num-points", 250, *(("--as-is",) if as_is else ()))
    status, output, error = run("stream", data, *given, *asked)
    assert (status, error) == (0, "")
    assert output.count("doubt: from frame 1 on, the voltages have changed as if electrodes had moved") == (not as_is)
    assert "4 frames: 3 imaged, 1 unchanged" in output
