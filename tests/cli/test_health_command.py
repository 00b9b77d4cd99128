"""`jeit touch health`: damage detected in recordings, from frames alone and with a described skin."""

import csv
import json

import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent
from jeit.touch.simulate.damage import Cut

TOML = """
[geometry]
shape = "disk"
radius = 0.05
[electrodes]
kind = "boundary"
layout = "ring"
number = 8
width = 0.008
contact_impedance = 300.0
[protocol]
kind = "adjacent"
current = 1e-3
"""
SECONDS = np.arange(0, 30, 0.2)


def touched(rng, number, rest, noise=1e-3):
    """Frames of a synthetic skin with a touch of eight frames in every thirty."""
    frames = rest + noise * rng.normal(size=(number, len(rest)))
    for start in range(10, number - 20, 30):
        frames[start : start + 8] += 0.1 * np.exp(-((np.arange(len(rest)) - rng.uniform(0, len(rest))) ** 2) / 20)
    return frames


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("health"), np.random.default_rng(0)
    rest = rng.uniform(0.5, 1.5, 40)
    healthy = touched(rng, 800, rest)
    np.savetxt(folder / "healthy.csv", healthy, delimiter=",")
    np.save(folder / "healthy.npy", healthy)  # which takes less time to read
    np.save(folder / "again.npy", touched(rng, 600, rest))
    hurt = touched(rng, 600, rest)
    hurt[300:] += 0.03 * rng.normal(size=40)
    np.savetxt(folder / "hurt.csv", hurt, delimiter=",")
    np.save(folder / "hurt.npy", hurt)
    np.savez(folder / "timed.npz", frames=hurt, seconds=np.arange(600) / 10)
    np.save(folder / "fewer.npy", hurt[:, :30])
    np.save(folder / "short.npy", hurt[:5])
    np.save(folder / "constant.npy", np.ones((100, 40)))
    (folder / "empty.csv").write_text("", "utf-8")
    return folder


def events(folder):
    return list(csv.DictReader((folder / "events.csv").read_text("utf-8").splitlines()))


def test_damage_is_detected_from_frames_alone(files, run, tmp_path):
    status, output, error = run(
        "touch", "health", files / "hurt.csv", "--healthy", files / "healthy.csv", "--output", tmp_path
    )
    assert (status, error) == (0, "")
    assert "600 frames: 1 event" in output
    (event,) = events(tmp_path)
    assert abs(int(event["frame"]) - 300) < 8
    assert (event["electrode"], event["path_m"]) == ("", "")
    assert f"\n  frame {event['frame']}: {event['kind']}, {event['status']}. " in output
    report = json.loads((tmp_path / "report.json").read_text("utf-8"), parse_constant=pytest.fail)
    assert report["units"]["time"] == "frames"
    assert (tmp_path / "health.png").read_bytes().startswith(b"\x89PNG")


def test_a_healthy_skin_has_no_events(files, run, tmp_path):
    status, _, error = run(
        *("touch", "health", files / "again.npy", "--healthy", files / "healthy.npy", "--output", tmp_path),
        *("--rate", 10, "--quiet"),
    )
    assert (status, error) == (0, "")
    assert events(tmp_path) == []


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    """A disk of film that is cut after twelve seconds, as files."""
    folder, cut = tmp_path_factory.mktemp("cut"), Cut([(-0.005, 0.014), (0.02, 0.024)])
    electrodes = BoundaryElectrodes(ring(0.05, 8), 0.008, 300.0)
    mesh = Disk(0.05).mesh(num_points=300, refine=cut.refine(4e-3))
    model, rng = ForwardModel(mesh, electrodes, adjacent(8)), np.random.default_rng(1)
    whole = np.full(mesh.num_cells, 3e-5)
    torn, centres = np.asarray(cut.conductivity(mesh, whole)), np.asarray(centroids(mesh))

    def seen(conductivity):
        """Voltages at rest and under touches at eight places; each touch lasts from second 1 to 2 of every four
        seconds."""
        angle = 2.0 * np.arange(8)
        places = 0.03 * np.array([np.cos(angle), np.sin(angle)]).T
        spots = 1 + 0.5 * np.exp(-np.sum((centres - places[:, None]) ** 2, axis=-1) / 0.012**2)
        scales = [np.ones(len(centres)), *spots]
        return np.stack([model.voltages((one * conductivity.T).T) for one in scales])

    number = np.where((SECONDS % 4 > 1) & (SECONDS % 4 < 2), 1 + SECONDS // 4, 0).astype(int)
    intact, damaged = seen(whole), seen(torn)

    def recorded(at):
        frames = np.where((at > SECONDS)[:, None], intact[number], damaged[number])
        return frames + 1e-4 * np.abs(frames).mean() * rng.normal(size=frames.shape)

    np.savez(folder / "healthy.npz", frames=recorded(np.inf), seconds=SECONDS)
    np.savez(folder / "cut.npz", frames=recorded(12.0), seconds=SECONDS)
    (folder / "skin.toml").write_text(TOML, "utf-8")
    return folder


def test_a_cut_is_located_on_a_described_skin(cut, run, tmp_path, monkeypatch):
    """On a mesh with edges twice as long as usual, from fewer starting paths: the cut is located to a centimetre."""
    for name, value in (("_RELATIVE_EDGE_LENGTH", 0.025), ("_NUM_OPTIMISED_CUTS", 1), ("_NUM_CUT_DIRECTIONS", 4)):
        monkeypatch.setattr(f"jeit.touch.health.cut_path.{name}", value)
    status, output, error = run(
        *("touch", "health", cut / "cut.npz", "--healthy", cut / "healthy.npz", "--skin", cut / "skin.toml"),
        *("--patience", 9, "--output", tmp_path),
    )
    assert (status, error) == (0, "")
    (event,) = events(tmp_path)
    assert (event["kind"], event["status"]) == ("cut", "lasting")
    assert abs(float(event["time"]) - 12.0) < 1.0
    path = np.array([[float(one) for one in place.split()] for place in event["path_m"].split("; ")])
    assert np.linalg.norm(path.mean(axis=0) - [0.0075, 0.019]) < 0.01
    length = 1e3 * np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert f"\n  {float(event['time']):.2f} s: cut, {length:.0f} ± " in output
    assert " mm long, lasting. " in output
    report = json.loads((tmp_path / "report.json").read_text("utf-8"), parse_constant=pytest.fail)
    assert report["with_a_model"]


@pytest.mark.slow
def test_limitations_of_the_recordings_are_noted(files, run, tmp_path):
    hurt, healthy = (np.load(files / name) for name in ("hurt.npy", "healthy.npy"))
    still = hurt.copy()
    still[:, 3], still[:, 5] = still[0, 3], np.nan
    made = {
        "brief": (hurt[:30], ["30 frames are fewer than two windows of"]),
        "still": (still, ["constant throughout: channels 3", "without any reading: channels 5"]),
        "larger": (1e3 * hurt, ["are both in the same unit?"]),
    }
    for name, (frames, notes) in made.items():
        np.save(tmp_path / f"{name}.npy", frames)
        status, output, _ = run(
            *("touch", "health", tmp_path / f"{name}.npy", "--healthy", files / "healthy.npy"),
            *("--output", tmp_path / name),
        )
        assert status == 0, name
        report = json.loads((tmp_path / name / "report.json").read_text("utf-8"), parse_constant=pytest.fail)
        for message in notes:
            assert message in " ".join(output.split())
            assert any(message in one for one in report["notes"])
    np.save(tmp_path / "few.npy", healthy[:60])
    _, output, _ = run("touch", "health", files / "hurt.npy", "--healthy", tmp_path / "few.npy", "-o", tmp_path / "few")
    assert "few beside the length of touches" in " ".join(output.split())
    np.save(tmp_path / "nothing.npy", np.full_like(hurt, np.nan))
    status, _, error = run(
        *("touch", "health", tmp_path / "nothing.npy", "--healthy", files / "healthy.npy", "-o", tmp_path / "nothing")
    )
    assert (status, "none of them has a reading" in error) == (1, True)


@pytest.mark.parametrize(
    ("recording", "healthy", "options", "message"),
    [
        ("hurt.npy", "fewer.npy", (), "has 40 channels, and"),
        ("hurt.npy", "short.npy", (), "5 frames are too few"),
        ("hurt.npy", "constant.npy", (), "every channel lacks readings or is constant"),
        ("empty.csv", "healthy.npy", (), "holds no numbers"),
        ("nothing.csv", "healthy.npy", (), "there is no such file"),
        ("timed.npz", "healthy.npy", (), "--rate: only one of the recordings says"),
        ("hurt.npy", "healthy.npy", ("--rate", -1), "--rate must be positive"),
        ("hurt.npy", "healthy.npy", ("--patience", 0), "--patience must be positive"),
        ("hurt.npy", "healthy.npy", ("--skin", "nowhere.toml"), "there is no such file"),
    ],
)
def test_invalid_input_is_reported(files, run, tmp_path, recording, healthy, options, message):
    status, _, error = run(
        *("touch", "health", files / recording, "--healthy", files / healthy, "--output", tmp_path / "out", *options)
    )
    assert status == 1
    assert message in error
    assert not (tmp_path / "out" / "events.csv").exists()
