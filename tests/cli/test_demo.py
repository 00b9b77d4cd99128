"""The demo, and what new users call first: help, version and import."""

import json
import re

import numpy as np
import pytest

import jeit
from jeit.imaging.calibration import DEFAULT_SHEET_NUM_POINTS, DEFAULT_SOLID_NUM_POINTS
from jeit.inverse.prior.matern import PRIORS


@pytest.mark.slow
def test_demo_locates_the_press(run, tmp_path):
    status, output, error = run("demo", "--x", "0.01", "--y", "-0.02", "--output", tmp_path)
    assert (status, error) == (0, "")
    assert "error" in output
    found = json.loads((tmp_path / "report.json").read_text("utf-8"))["inclusions"]
    assert len(found) == 1
    assert found[0]["kind"] == "conductive"
    # 3 % of the diameter; Chen et al. report up to 11 mm on the real skin.
    assert np.hypot(found[0]["centroid"][0] - 0.01, found[0]["centroid"][1] + 0.02) < 0.003
    assert (tmp_path / "image.png").stat().st_size > 10_000


def test_the_same_seed_gives_the_same_press():
    import jax

    from jeit.data.round_skin import RoundSkin, simulate_press

    skin = RoundSkin(num_points=300)
    frames = [simulate_press(skin, jax.random.key(seed), (0.01, 0.0))[0].voltages for seed in (3, 3, 4)]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])
    # The requested noise, relative to the root mean square: 208 draws give it to about 5 %.
    spread = np.std(frames[0] - frames[2]) / np.sqrt(2) / np.sqrt(np.mean(frames[0] ** 2))
    assert spread == pytest.approx(1e-4, rel=0.2)


def test_help_and_version(run):
    status, output, _ = run("--help")
    assert status == 0
    for command in ("demo", "reconstruct", "info"):
        assert command in output
    status, output, _ = run("--version")
    assert (status, output) == (0, f"jeit {jeit.__version__}\n")
    assert run()[0] == 0


def test_help_states_the_defaults(run):
    _, output, _ = run("reconstruct", "--help")
    text = " ".join(output.replace("│", " ").split())
    settings = jeit.imaging.ImagingSettings()
    rule = jeit.imaging.ImagingSettings(method="one-step").hyperparameter
    for value in (settings.method, settings.prior, rule):
        assert f"{value} (default)" in text
    assert settings.num_points is None
    assert f"(default {DEFAULT_SHEET_NUM_POINTS}; of a solid body {DEFAULT_SOLID_NUM_POINTS})" in text


@pytest.mark.parametrize("command", ["reconstruct", "choose"])
def test_help_names_all_priors(run, command):
    text = " ".join(run(command, "--help")[1].replace("│", " ").split())
    for name in PRIORS:
        assert re.search(rf"\b{name}\b", text.partition("--prior")[2].partition("--contact")[0])


def test_contents_page():
    for name in dir(jeit):
        assert getattr(jeit, name) is not None
    assert jeit.Disk is jeit.mesh.Disk
    with pytest.raises(AttributeError, match="attribute disc"):
        _ = jeit.disc
