"""Iterative methods, segmentation and streams on the command line."""

import csv
import io
import json

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, label

from jeit.arguments import counted
from jeit.cli.console import format_in_one_unit
from jeit.cli.options import NETWORK_METHOD
from jeit.data import read, write_table
from jeit.imaging import METHODS, StreamSettings
from jeit.imaging.method import AUTO
from jeit.imaging.stream_preparation import DEFAULT_STREAM_NUM_POINTS
from jeit.inverse.streaming.imager import MAX_STEPS_PER_FRAME

FEW = ("--num-points", 250)


def arrays_of(path):
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


@pytest.mark.parametrize(
    "method",
    [
        pytest.param("gauss-newton", marks=pytest.mark.slow),
        pytest.param("levenberg-marquardt", marks=pytest.mark.slow),
        # Segmentation is tested with the quick methods.
        pytest.param("total-variation", marks=pytest.mark.slow),
    ],
)
def test_iterative_images(method, tank, run, tmp_path):
    output = tmp_path / "out"
    status, text, error = run(
        "reconstruct", tank.folder / "touched.csv", "--reference", tank.folder / "rest.csv", "--output", output,
        "--method", method, *FEW,
    )  # fmt: skip
    assert (status, error) == (0, "")
    assert "converged" in text
    report = json.loads((output / "report.json").read_text())["reconstruction"]
    assert report["method"] == method
    assert report["status"] == "converged"
    objective = report["objective_per_iteration"]
    assert len(objective) == report["iterations"] + 1
    assert (np.diff(objective) < 0).all()
    content = arrays_of(output / "image.npz")
    assert (content["conductivity"] > -content["background"]).all()
    assert "labels" not in content


@pytest.mark.slow
def test_segmentation(tank, run, tmp_path):
    status, printed, error = run(
        "reconstruct", tank.folder / "touched.csv", "--reference", tank.folder / "rest.csv",
        "--output", tmp_path / "out", "--segment", "--method", "total-variation", *FEW,
    )  # fmt: skip
    assert (status, error) == (0, "")
    assert "hyperparameter 300 (default)" in printed
    content = arrays_of(tmp_path / "out" / "image.npz")
    assert content["labels"].shape == (256, 256)
    assert content["labels"].dtype == np.uint8
    assert set(np.unique(content["labels"])) <= {0, 1, 2}
    assert content["labels"].any()
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["hyperparameter"]["chosen_by"] == "default"
    # The listed bodies are those of the labels; inclusions that share a corner of the mesh touch in a pixel.
    islands = sum(label(binary_erosion(content["labels"] == kind, iterations=3))[1] for kind in (1, 2))
    listed = sum(printed.count(f"  {kind}") for kind in ("conductive", "resistive"))
    assert len(report["inclusions"]) == islands == listed
    pixel = (0.2 / 256) ** 2
    assert sum(one["area"] for one in report["inclusions"]) == pytest.approx(
        (content["labels"] > 0).sum() * pixel, rel=0.01
    )
    report = report["reconstruction"]
    assert report["method"] == "total-variation"
    assert report["prior"] == "total variation"
    assert "converged" in printed
    assert report["status"] == "converged"
    assert len(report["objective_per_iteration"]) == report["iterations"] + 1
    assert (np.diff(report["objective_per_iteration"]) < 0).all()
    assert (content["conductivity"] > -content["background"]).all()


def rows_of(folder):
    with open(folder / "frames.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["one-step", "gauss-newton"])
def test_a_stream_from_a_file(method, tank, run, tmp_path):
    bad = tank.touched.copy()
    bad[3] = np.nan
    data = tank.write("many", np.stack([tank.touched, 5 * tank.touched, bad, tank.touched]))
    output = tmp_path / "out"
    status, text, error = run(
        "stream", data, "--reference", tank.folder / "rest.csv", "--output", output, "--method", method, *FEW
    )
    assert (status, error) == (0, "")
    assert "4 frames" in text
    rows = rows_of(output)
    assert [row["status"] for row in rows][1:3] == ["refused", "partial"]
    assert "another sensor" in rows[1]["reason"]
    images = arrays_of(output / "images.npz")["conductivity"]
    assert np.isnan(images[1]).all()
    assert np.isfinite(images[[0, 2, 3]]).all()
    np.testing.assert_allclose(images[0], images[3], rtol=0.02)
    assert (output / "frames.png").stat().st_size > 10_000
    assert (output / "film.gif").stat().st_size > 10_000
    assert "frames.png, film.gif" in text
    assert text.index("4 frames") > text.index("  draw ")


def test_a_stream_from_standard_input(tank, run, tmp_path, monkeypatch):
    good = " ".join(map(repr, map(float, tank.touched)))
    first, *others = good.split()
    gap = ",".join([first, "", *others[1:]])
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{good}\n\nrubbish\n{good.replace(' ', ',')}\n1 2 3\n{gap}\n"))
    status, _, error = run(
        "stream", "-", "--reference", tank.folder / "rest.csv", "--output", tmp_path / "out", "--method", "one-step",
        "--quiet", "--film", "none", *FEW,
    )  # fmt: skip
    assert (status, error) == (0, "")
    assert [row["status"] for row in rows_of(tmp_path / "out")] == [
        "imaged", "refused", "imaged", "refused", "partial",
    ]  # fmt: skip
    # Frames of several lines after a separator, in the unit that the description states.
    cells = [repr(1e3 * value) for value in map(float, tank.touched)]
    wrapped = "".join(f"{' '.join(cells[k : k + 5])}\n" for k in range(0, 40, 5))
    monkeypatch.setattr("sys.stdin", io.StringIO(f"frame 1\n{wrapped}frame 2\n{wrapped}"))
    reference = tank.write("millivolts", 1e3 * tank.rest, tank.description.replace('"V"', '"mV"'))
    status, _, error = run(
        "stream", "-", "--reference", reference, "--output", tmp_path / "wrapped", "--method", "one-step", "--quiet",
        "--film", "none", *FEW,
    )  # fmt: skip
    assert (status, error) == (0, "")
    assert [row["status"] for row in rows_of(tmp_path / "wrapped")] == ["refused", "imaged", "imaged"]
    # A stream of which all frames are refused fails with the reason, and its table holds the reasons.
    monkeypatch.setattr("sys.stdin", io.StringIO("1 2 3\nrubbish\n"))
    status, _, error = run(
        "stream", "-", "--reference", tank.folder / "rest.csv", "--output", tmp_path / "out", "--method", "one-step",
        "--quiet", "--film", "none", *FEW,
    )  # fmt: skip
    assert (status, error.count("\n")) == (1, 1)
    assert "2 frames, and none could be imaged" in error
    assert "not 40 real voltages" in error
    assert [row["status"] for row in rows_of(tmp_path / "out")] == ["refused", "refused"]
    # A stream that fails leaves no images of an earlier run behind.
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    assert (tmp_path / "out" / "images.npz").exists()
    status, _, error = run(
        "stream", "-", "--reference", tank.folder / "rest.csv", "--output", tmp_path / "out", "--method", "one-step",
        "--quiet", "--film", "none", *FEW,
    )  # fmt: skip
    assert (status, "no frame" in error) == (1, True)
    assert not (tmp_path / "out" / "images.npz").exists()


@pytest.mark.slow
def test_a_stream_uses_the_description_of_its_reference(tank, run, tmp_path):
    """The reference is an NPZ file of jeit with its description beside it; the frames lie elsewhere without one."""
    write_table(read(tank.folder / "rest.csv"), tmp_path / "empty.npz")
    (tmp_path / "live").mkdir()
    np.savetxt(tmp_path / "live" / "frames.csv", tank.touched[None], delimiter=",")
    options = ("--reference", tmp_path / "empty.npz", "--output", tmp_path / "out", "--method", "one-step", *FEW)
    status, text, error = run("stream", tmp_path / "live" / "frames.csv", *options)
    assert (status, error) == (0, "")
    assert "1 frame: 1 imaged" in text
    assert "frames.png, film.gif" in text
    assert text.index("1 frame: ") > text.index("  draw ")
    assert np.isfinite(arrays_of(tmp_path / "out" / "images.npz")["conductivity"]).all()
    assert (tmp_path / "out" / "frames.png").stat().st_size > 10_000
    assert (tmp_path / "out" / "film.gif").stat().st_size > 10_000
    (tmp_path / "out" / "film.gif").unlink()
    assert run("stream", tmp_path / "live" / "frames.csv", *options, "--film", "none", "--quiet")[0] == 0
    assert not (tmp_path / "out" / "film.gif").exists()
    status, _, error = run("stream", tmp_path / "live" / "frames.csv", *options, "--film", "a.avi")
    assert (status, "--film must be a name that ends in .gif or .mp4" in error) == (1, True)
    status, _, error = run("stream", tmp_path / "live" / "frames.csv", *options, "--rate", "-1")
    assert (status, "--rate must be positive" in error) == (1, True)


def test_help_of_a_stream_states_the_defaults(run):
    settings = StreamSettings()
    printed = " ".join(run("stream", "--help")[1].replace("│", " ").split())
    assert f"{settings.solver.name} (default)" in printed
    assert f"(default {DEFAULT_STREAM_NUM_POINTS})" in printed
    assert f"{settings.memory:g} (default)" in printed
    assert f"(default {MAX_STEPS_PER_FRAME})" in printed


def test_help_lists_the_accepted_methods(run):
    printed = " ".join(run("reconstruct", "--help")[1].replace("│", " ").split())
    assert [name for name in (AUTO, *METHODS, NETWORK_METHOD) if name not in printed] == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("reconstruct", "--method", "newton"), "gauss-newton"),
        (
            ("reconstruct", "--method", "shape"),
            "total-variation, shapes, network; it is 'shape' (did you mean 'shapes'?",
        ),
        (("reconstruct", "--method", "networks"), "--method must be one of auto, one-step, "),
        (("reconstruct", "--method", "total-variation", "--prior", "noser"), "--prior"),
        (("reconstruct", "--method", "total-variation", "--hyperparameter", "gcv"), "takes a number"),
        (
            ("stream", "--method", "magic"),
            "--method must be one of one-step, gauss-newton, levenberg-marquardt, network; it is 'magic'",
        ),
        (("stream", "--method", "l-bfgs-b"), "--method: l-bfgs-b does not image frames in a bounded time"),
        (("stream", "--steps", "0"), "--steps must be"),
        (("stream", "--memory", "-1"), "--memory must be"),
        (("stream", "--hyperparameter", "magic"), "or a number; it is 'magic'"),
        (("stream", "--contact", "firm"), "--contact must be one of each, common, fixed"),
    ],
)
def test_bad_input_is_refused_in_one_line(arguments, words, tank, run, tmp_path):
    command, *options = arguments
    status, _, error = run(
        command, tank.folder / "touched.csv", "--reference", tank.folder / "rest.csv", "--output", tmp_path / "out",
        *options, *FEW,
    )  # fmt: skip
    assert status == 1
    assert words in error
    assert error.count("\n") == 1


def test_columns_have_one_unit():
    assert format_in_one_unit([2.7e-3, -1.85e-4], "S") == ("mS", ["2.7", "-0.185"])
    assert format_in_one_unit([12.0], "S/m") == ("S/m", ["12"])
    assert format_in_one_unit([], "S") == ("S", [])


def test_singular_and_plural():
    assert [counted(number, "frame") for number in (0, 1, 1000)] == ["0 frames", "1 frame", "1,000 frames"]
