"""Measured frames imaged by a network on the command line."""

import io
import json

import numpy as np
import pytest
from small_networks import SHAPE, SKIN

from jeit.cli import main
from jeit.data import Measurement, screen
from jeit.data.exchange import write_table
from jeit.protocol import adjacent
from jeit.touch.networks import read_network
from jeit.touch.simulate import DiscIndenter, Indent, relative_changes

PLACES = ((0.01, -0.02), (-0.025, 0.01))


@pytest.fixture(scope="module")
def recorded(small_skin, resting, tmp_path_factory):
    """A folder with a file of the untouched skin, and one of two touches and a frame that lacks one channel."""
    folder = tmp_path_factory.mktemp("recorded")
    model = small_skin.model
    rest = np.asarray(model.voltages(small_skin.model_conductivity))
    touches = [[Indent(DiscIndenter(0.02), 5e-3, one)] for one in PLACES]
    touched = rest * (1 + relative_changes(small_skin, touches, resting))
    for name, frames in (("rest", rest[None]), ("touched", np.concatenate([touched, touched[:1]]))):
        mask = np.ones(frames.shape, bool)
        if name == "touched":
            mask[2, 7] = False
        known = {"electrodes": model.electrodes, "domain": small_skin.outline, "name": name}
        write_table(Measurement(frames, mask, model.protocol, **known), folder / f"{name}.npz")
    return folder


@pytest.fixture
def run(capsys):
    def call(*arguments):
        status = main([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return call


def table_of(folder):
    return np.genfromtxt(folder / "frames.csv", delimiter=",", skip_header=1)


def test_reconstruct(imaging, recorded, run, tmp_path):
    status, out, error = run(
        "reconstruct", recorded / "touched.npz", "--reference", recorded / "rest.npz", "--frame", 1,
        "--method", "network", "--model", imaging[0], "--output", tmp_path,
    )  # fmt: skip
    assert (status, error) == (0, "")
    assert "1 frame imaged" in out
    x, y, depth = 1e3 * table_of(tmp_path)[1:]
    assert f"deepest: {depth:.2f} mm at ({x:.1f}, {y:.1f}) mm, in frame 1" in " ".join(out.split())

    assert np.linalg.norm(table_of(tmp_path)[1:3] - PLACES[1]) < 0.015
    with np.load(tmp_path / "depth.npz") as written:
        assert written["depth"].shape == (1, *SHAPE)
    assert json.loads((tmp_path / "report.json").read_text())["design"] == "unrolled"
    assert (tmp_path / "depth.png").stat().st_size > 5000


@pytest.mark.slow
def test_stream(imaging, recorded, run, tmp_path):
    """A frame that lacks one channel is imaged. One with reversed signs is not."""
    with np.load(recorded / "touched.npz") as one:
        arrays = dict(one)
    with np.load(recorded / "rest.npz") as one:
        arrays["voltages"][2] = 2 * one["voltages"][0] - arrays["voltages"][2]
    np.savez(tmp_path / "touched.npz", frames=np.where(arrays["mask"], arrays["voltages"], np.nan))
    given = "--reference", recorded / "rest.npz", "--method", "network", "--model", imaging[0], "--output", tmp_path
    status, out, error = run("stream", recorded / "touched.npz", *given)
    assert (status, error) == (0, "")
    assert "3 frames imaged" in out
    assert (np.linalg.norm(table_of(tmp_path)[:, 1:3] - [*PLACES, PLACES[0]], axis=1) < 0.015).all()
    status, out, error = run("stream", tmp_path / "touched.npz", *given)
    assert (status, error) == (0, "")
    assert "frame 2: refused." in " ".join(out.split())
    assert np.isnan(table_of(tmp_path)[2, 1:]).all()
    assert json.loads((tmp_path / "report.json").read_text())["refused"] == [2]


@pytest.mark.slow
def test_a_table_without_a_description(imaging, recorded, run, tmp_path):
    """The network has the protocol, and a file of the skin also serves as a description."""
    for name in ("rest", "touched"):
        with np.load(recorded / f"{name}.npz") as one:
            np.savez(tmp_path / f"{name}.npz", frames=one["voltages"])
    (tmp_path / "skin.toml").write_text(SKIN)
    given = "--reference", tmp_path / "rest.npz", "--method", "network", "--model", imaging[0], "--output", tmp_path
    for more in ((), ("--description", tmp_path / "skin.toml")):
        status, out, error = run("reconstruct", tmp_path / "touched.npz", *given, "--frame", -2, *more)
        assert (status, error) == (0, "")
        assert "in frame 1" in out
        line = table_of(tmp_path)
        assert line[0] == 1
        assert np.linalg.norm(line[1:3] - PLACES[1]) < 0.015
    (tmp_path / "skin.toml").write_text(SKIN.replace("grid-4x4", "grid-3x3"))
    status, _, error = run("reconstruct", tmp_path / "touched.npz", *given, "--description", tmp_path / "skin.toml")
    assert status == 1
    assert "was trained for another skin or protocol" in error
    np.savez(tmp_path / "few.npz", frames=np.ones((2, 5)))
    status, _, error = run("reconstruct", tmp_path / "few.npz", *given)
    assert status == 1
    assert "has 5 channels, and the network was trained for 94" in error


def test_an_untouched_skin(imaging, recorded, run, tmp_path):
    """No touch is reported."""
    given = "--reference", recorded / "rest.npz", "--method", "network", "--model", imaging[0], "--output", tmp_path
    status, out, _ = run("stream", recorded / "rest.npz", *given)
    assert status == 0
    floor = 1e3 * read_network(imaging[0]).floor
    assert f"untouched: nothing is deeper than noise makes it, {floor:.2g} mm" in out
    assert np.isnan(table_of(tmp_path)[1:3]).all()


def test_a_failed_command_leaves_no_files(imaging, recorded, run, tmp_path):
    """No empty folder, and none of those above it that did not exist."""
    given = "--method", "network", "--model", imaging[0], "--output", tmp_path / "new" / "out"
    status, _, error = run("reconstruct", recorded / "touched.npz", *given)
    assert status == 1
    assert "--reference" in error
    assert not (tmp_path / "new").exists()


def test_stream_from_standard_input(imaging, recorded, run, tmp_path, monkeypatch):
    with np.load(recorded / "touched.npz") as one:
        text = " ".join(map(repr, one["voltages"][0].tolist())) + "\n1 2 3\n"
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    given = "--reference", recorded / "rest.npz", "--method", "network", "--model", imaging[0], "--output", tmp_path
    status, out, _ = run("stream", "-", *given)
    assert status == 0
    assert "1 frame imaged" in out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--method", "network"), "--method network needs --model"),
        (("--model", "MODEL"), "--model is for --method network"),
        (("--method", "network", "--model", "MODEL", "--prior", "laplace"), "--prior has no use"),
        (("--method", "network", "--model", "nowhere"), "there is no such file"),
    ],
)
def test_incompatible_options(imaging, recorded, run, tmp_path, options, message):
    options = [imaging[0] if one == "MODEL" else one for one in options]
    given = recorded / "touched.npz", "--reference", recorded / "rest.npz", "--output", tmp_path, *options
    status, _, error = run("reconstruct", *given)
    assert status == 1
    assert message in error


def test_another_protocol_is_refused(small_skin, imaging, recorded, run, tmp_path):
    other = screen(
        np.linspace(1, 2, 208)[None], adjacent(16), electrodes=small_skin.model.electrodes, domain=small_skin.outline
    )
    write_table(other, tmp_path / "other.npz")
    given = "--method", "network", "--model", imaging[0], "--output", tmp_path
    status, _, error = run("reconstruct", tmp_path / "other.npz", "--reference", tmp_path / "other.npz", *given)
    assert status == 1
    assert "its channels is 94, and here it is 208" in error
