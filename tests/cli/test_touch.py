"""`jeit touch`: presses to a learnt skin, frames to touches, and the errors for invalid files."""

import csv
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from made_skins import record

from jeit.cli.console import plain_console
from jeit.data import load_description
from jeit.mesh import centroids
from jeit.touch.commands.touch import _print_touches


@pytest.fixture(scope="module", autouse=True)
def small_ensembles():
    """Ensembles of a few members, for which the command has no option."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jeit.touch.learnt.methods._NUM_ENSEMBLE_MEMBERS", 8)
        yield


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("touch")
    recorded = record(80)
    label = np.where(recorded["positions"][:, 0] > 0, "right", "left")
    np.savez(folder / "presses.npz", **recorded, label=label)
    np.savez(folder / "places.npz", **{key: recorded[key] for key in ("frames", "reference", "positions")})
    fresh = record(40, seed=1)
    frames = fresh["frames"].copy()
    frames[3] = 7.0
    np.savez(folder / "frames.npz", frames=frames, reference=fresh["reference"])
    np.savez(folder / "bare.npz", frames=frames)
    np.savez(folder / "fewer.npz", frames=frames[:, :9], reference=fresh["reference"][:, :9])
    np.savez(folder / "millimetres.npz", frames=recorded["frames"], positions=1e3 * recorded["positions"])
    return folder, fresh


def test_from_presses_to_touches(files, run):
    folder, fresh = files
    status, output, error = run(
        "touch", "fit", folder / "presses.npz", "--output", folder / "skin", "--method", "neighbours"
    )
    assert (status, error) == (0, "")
    assert (folder / "skin" / "learning.png").read_bytes().startswith(b"\x89PNG")
    report = json.loads((folder / "skin" / "report.json").read_text("utf-8"), parse_constant=pytest.fail)
    assert set(report["held_out"]) == {"place", "force", "label"}
    assert report["held_out"]["place"]["method"].startswith("neighbours")
    assert report["held_out"]["place"]["mean_error_m"] < 0.02
    assert abs(report["held_out"]["place"]["share_within_one_standard_deviation"] - 0.68) < 0.15
    place, label = report["held_out"]["place"], report["held_out"]["label"]
    keys = ("mean_error_m", "median_error_m", "error_of_95_percent_m", "mean_error_of_a_guess_m")
    mean, median, high, guess = (f"{1e3 * place[key]:.3g} mm" for key in keys)
    printed = " ".join(output.split())
    assert f"{mean} off on average, median {median}, 95 % within {high}; guessing the middle: {guess}" in printed
    assert f"{100 * label['right']:.1f} % right; the commonest label alone: " in printed
    assert f"alone: {100 * label['right_by_the_commonest']:.1f} %" in printed
    status, output, error = run("touch", "predict", folder / "skin", folder / "frames.npz", "--output", folder / "out")
    assert (status, error) == (0, "")
    assert "40 frames; 1 unlike any learnt from; 39 with a place, standard deviation " in output
    rows = list(csv.DictReader((folder / "out" / "touches.csv").read_text("utf-8").splitlines()))
    assert list(rows[0]) == [
        *("frame", "x_m", "y_m", "std_x_m", "std_y_m", "force_N", "std_force_N", "label", "probability", "unlike")
    ]
    assert len(rows) == 40
    assert (rows[3]["x_m"], rows[3]["label"], rows[3]["unlike"]) == ("", "", "1")
    std = np.median([float(row[key]) for row in rows if row["x_m"] for key in ("std_x_m", "std_y_m")])
    (printed_std,) = re.findall(r"deviation (\S+) mm \(median\)", " ".join(output.split()))
    assert float(printed_std) == pytest.approx(1e3 * std, rel=0.01)
    places = np.array([[float(row["x_m"]), float(row["y_m"])] for row in rows if row["x_m"]])
    right = np.delete(fresh["positions"], 3, axis=0)
    assert np.linalg.norm(places - right, axis=1).mean() < 0.015
    assert (folder / "out" / "touches.png").read_bytes().startswith(b"\x89PNG")
    report = json.loads((folder / "out" / "report.json").read_text("utf-8"), parse_constant=pytest.fail)
    assert report["unlike"] == [3]


def test_printed_touches_have_seconds_millimetres_and_per_cent(capsys):
    """The strongest change is the largest of any sign, relative to the background."""
    position, peak = np.array([[0.0123, -0.004], [0.0, 0.0], [0.05, 0.001]]), np.array([1e-4, -5e-4, 2e-4])
    touch = SimpleNamespace(number=7, onset=1.25, offset=2.5, position=position, peak=peak)
    _print_touches(plain_console(), 32 * [touch], 1e-3)
    names, *rows, more = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines() if line]
    assert names == "touch from / s to / s first place / mm last place / mm strongest change"
    assert rows == 30 * ["7 1.25 2.50 (+12.3, -4.0) (+50.0, +1.0) -50 %"]
    assert more == "2 more in report.json"


DISK = """
[geometry]
shape = "disk"
radius = 0.05

[electrodes]
layout = "ring"
number = 8
width = 0.01
contact_impedance = 0.001

[protocol]
kind = "adjacent"
current = 1e-3
"""


@pytest.mark.slow
def test_a_described_skin_is_imaged(tmp_path, run):
    """The description is of the kind that measured tables have."""
    skin = tmp_path / "skin.toml"
    skin.write_text(DISK)
    model = load_description(skin).model(skin, num_points=200)
    places = np.random.default_rng(0).uniform(-0.03, 0.03, (30, 2))
    spots = np.exp(-((np.linalg.norm(places[:, None] - np.asarray(centroids(model.mesh)), axis=2) / 0.01) ** 2))
    rest = np.asarray(model.voltages(1.0))
    frames = rest + 0.3 * spots @ np.asarray(model.jacobian(1.0)).T
    np.savez(tmp_path / "presses.npz", frames=frames, reference=rest, positions=places)
    fit = ("touch", "fit", tmp_path / "presses.npz", "-o", tmp_path / "out", "--method", "ridge", "--description")
    status, output, error = run(*fit, skin)
    assert (status, error) == (0, "")
    assert "ridge on contacts" in output
    for wrong, message in (
        (DISK.replace("number = 8", "number = 16"), "--description: its protocol has 208 channels, and frames have 40"),
        (DISK[DISK.index("[protocol]") :] + "number = 8", "a model needs [geometry], [electrodes] too"),
    ):
        skin.write_text(wrong)
        status, _, error = run(*fit, skin)
        assert status == 1
        assert message in error


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fit", "millimetres.npz"), "are these metres"),
        (("fit", "none.npz"), "there is no such file"),
        (("fit", "frames.npz"), "nothing to learn from"),
        (("fit", "places.npz", "--method", "magic"), "--method"),
        (("fit", "places.npz", "--channels", "99"), "--channels must be from 2 to 40"),
        (("fit", "places.npz", "--per-session"), "--per-session: presses have no group"),
        (("predict", "frames.npz", "frames.npz"), "not a learnt skin that can be read"),
        (("predict", "nowhere", "frames.npz"), "there is no such file"),
        (("predict", "skin", "bare.npz"), "reference is missing"),
        (("predict", "skin", "fewer.npz"), "frames have 9 channels, and the skin that was learnt has 40"),
    ],
)
def test_invalid_input_is_reported(files, run, tmp_path, words, message):
    folder, _ = files
    if words[1] == "skin" and not (folder / "skin").exists():
        run("touch", "fit", folder / "places.npz", "--output", folder / "skin", "--method", "ridge", "--quiet")
    words = [folder / word if word.endswith(".npz") or word in ("skin", "nowhere") else word for word in words]
    status, _, error = run("touch", *words, "--output", tmp_path / "out")
    assert status == 1
    assert message in error
    assert error.count("\n") == 1
