"""`jeit series`: a recording of a tank with oscillations, and the inputs that are refused."""

import json

import numpy as np
import pytest

from jeit.cli import main
from jeit.cli.console import Steps, format_with_unit
from jeit.data import load_description

DESCRIBED = """
[geometry]
shape = "disk"
radius = 0.1
[electrodes]
layout = "ring"
number = 8
width = 0.02
contact_impedance = 0.01
[protocol]
kind = "adjacent"
current = 1e-3
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tank")
    (folder / "description.toml").write_text(DESCRIBED + "[data]\nframe_rate = 5\n")
    (folder / "untimed.toml").write_text(DESCRIBED)
    model = load_description(folder / "description.toml").model("a.csv", num_points=250)
    rest, away = np.asarray(model.voltages(0.1)), np.ones(model.mesh.num_cells)
    away[:40] = 1.5
    change = np.asarray(model.voltages(0.1 * away)) - rest
    beat = 0.5 * np.cos(2 * np.pi * 1.3 * np.arange(20) / 5 + 0.4)
    frames = rest + beat[:, None] * change
    frames += 1e-5 * np.abs(rest) * np.random.default_rng(0).normal(size=frames.shape)
    np.savetxt(folder / "frames.csv", frames, delimiter=",")
    return folder


def test_results_are_written(recording, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jeit.plot.imaging.series.SERIES_FRAMES", 6)  # one row of frames instead of two
    monkeypatch.setattr("jeit.report.series.FILM_FRAMES", 4)
    given = ["series", str(recording / "frames.csv"), "-o", str(tmp_path), "--num-points", "250"]
    asked = ["--frequency", "0.5-2", "--region", "half:1,0", "--region", "box:-0.09,-0.09,0,0.09", "--film", "a.gif"]
    assert main([*given, *asked]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["frame_rate"] == pytest.approx(5)
    found = report["oscillations"][0]
    assert found["frequency"] == pytest.approx(1.3, abs=0.01)
    parts = found["regions"].values()
    assert min(abs((one["phase_degrees"] - np.degrees(0.4) + 90) % 180 - 90) for one in parts) < 5
    with np.load(tmp_path / "series.npz") as kept:
        assert kept["changes"].shape == (20, kept["cells"].shape[0])
        assert kept["amplitude"].shape == kept["phase"].shape == (1, kept["cells"].shape[0])
    table = (tmp_path / "regions.csv").read_text().splitlines()
    assert table[0] == 'time_s,"half:1,0","box:-0.09,-0.09,0,0.09"'
    assert len(table) == 21
    np.testing.assert_allclose([float(line.split(",")[0]) for line in table[1:]], np.arange(20) / 5)
    assert (report["unit"], report["frame_rate_unit"], found["unit"]) == ("S", "Hz", "Hz")
    assert (report["frames"], report["refused"], report["refused_frames"]) == (20, 0, [])
    curves = np.genfromtxt(tmp_path / "regions.csv", delimiter=",", skip_header=1)[:, 1:]
    for curve, one in zip(curves.T, parts, strict=True):
        assert one["amplitude"] == pytest.approx(np.sqrt(2) * np.std(curve), rel=0.1)
    assert (tmp_path / "series.png").stat().st_size > 20_000
    assert (tmp_path / "a.gif").stat().st_size > 10_000
    printed = " ".join(capsys.readouterr().out.split())
    assert "20 frames, 5 a second, 0 refused 1.3 Hz (resolution 0.53 Hz): " in printed
    for name, one in found["regions"].items():
        sizes = f"{format_with_unit(one['amplitude'], 'S')} ± {format_with_unit(one['noise'], 'S')}"
        assert f"{name}: amplitude {sizes}, phase {one['phase_degrees']:.0f}°" in printed


@pytest.mark.slow
def test_frames_without_times_are_numbered(recording, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(recording)
    given = ["--description", "untimed.toml", "--num-points", "250", "-o", str(tmp_path)]
    assert main(["series", "frames.csv", *given]) == 0
    assert "20 frames, 0 refused; no times are known (--rate gives them)" in capsys.readouterr().out
    assert (tmp_path / "regions.csv").read_text().startswith("frame,whole body\n0,")
    assert json.loads((tmp_path / "report.json").read_text())["frame_rate"] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frequency", "fast"], "--frequency: give hertz"),
        (["--frequency", "7"], "--frequency: 7 Hz is not below half the frame rate of 5 Hz"),
        (["--region", "ball:1,2"], "--region: 'ball:1,2' is none"),
        (["--region", "ball:1,2,0.1"], "--region 'ball:1,2,0.1': the region is empty"),
        (["--region", "ball:-50,0,25"], "The body spans [-0.1, -0.1] to [0.1, 0.1], metres."),
        (["--region", "left"], "--region: 'left' is no shape and numbers"),
        (["--description", "untimed.toml", "--frequency", "1"], "--frequency: 'frames' says no times; give --rate"),
        (["--rate", "-1"], "--rate must be positive"),
        (["--film", "film.txt"], "--film must be"),
    ],
)
def test_invalid_input_is_refused(recording, tmp_path, capsys, monkeypatch, options, message):
    monkeypatch.chdir(recording)
    assert main(["series", "frames.csv", "-o", str(tmp_path / "out"), "--num-points", "250", *options]) == 1
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [["--frequency", "7"], ["--frequency", "2-1"], ["--region", "left"]])
def test_options_that_need_no_mesh_are_checked_before_it_is_made(recording, tmp_path, capsys, monkeypatch, options):
    monkeypatch.chdir(recording)
    assert main(["series", "frames.csv", "-o", str(tmp_path / "out"), *options]) == 1
    printed = capsys.readouterr()
    assert "mesh" not in printed.out + printed.err


@pytest.mark.parametrize("region", ["ball:1,2,0.1", "ball:0,0,0,0.1"])
def test_a_region_outside_of_the_mesh_is_refused_before_any_image(recording, tmp_path, capsys, monkeypatch, region):
    begun, original = [], Steps.__call__
    monkeypatch.setattr(Steps, "__call__", lambda self, name: (begun.append(name), original(self, name)))
    monkeypatch.chdir(recording)
    output = ["-o", str(tmp_path / "out"), "--num-points", "250"]
    assert main(["series", "frames.csv", *output, "--region", "half:1,0", "--region", region]) == 1
    assert "--region" in capsys.readouterr().err
    assert "mesh" in begun
    assert "image" not in begun
