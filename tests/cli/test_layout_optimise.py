"""`jeit layout optimise`: an improved layout, its drawing and its report."""

import io
import json
import re

import numpy as np
import pytest
from rich.console import Console

from jeit.cli.app import run_as_command
from jeit.cli.console import Steps
from jeit.design.commands.layout import _OPTIMISATION_FILES, _parse_region
from jeit.layout import Layout, read_layout, write_layout
from jeit.mesh import Disk, Rectangle


def run(*arguments):
    run_as_command().main(args=["layout", "optimise", *map(str, arguments)], standalone_mode=False)


@pytest.mark.slow
def test_the_optimised_layout_is_written_and_scores_higher(tmp_path):
    start = tmp_path / "low.svg"
    centres = [(x, y) for y in (-0.04, -0.015) for x in (-0.03, 0.0, 0.03)]
    write_layout(Layout(centres, 8e-3, outline=Rectangle(0.1, 0.1)), start)
    options = ["--steps", 6, "--num-points", 200, "--minimum-spacing-mm", 15, "--keep-out", "-30,0,8", "--quiet"]
    run(start, "--output", tmp_path / "out", *options)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(_OPTIMISATION_FILES)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    before, after = report["start"], report["optimised"]
    assert after["worst_sensitivity_V"] > 1.5 * before["worst_sensitivity_V"]
    assert after["mean_variance"] < before["mean_variance"]
    assert report["options"]["keep_out_mm"] == ["-30,0,8"]
    found = read_layout(tmp_path / "out" / "layout.svg")
    assert found.num_electrodes == 6
    assert (np.linalg.norm(found.centres - np.array([-0.03, 0]), axis=1) > 0.012 - 1e-6).all()


def test_progress_shows_the_step_and_the_best_score(monkeypatch):
    messages = []
    step = Steps(Console(file=io.StringIO(), force_terminal=True), quiet=False)
    with step:
        step.report("nothing is under way yet")
        step("optimise")
        monkeypatch.setattr(step._spinner, "update", messages.append)
        step.report("step 3 of at most 60, best score 1.234")
        monkeypatch.setattr(step, "_step_start_time", step._step_start_time - 7.2)
        step.report("step 40 of at most 60")
    assert [str(one.__rich__()) for one in messages] == [
        "optimise … step 3 of at most 60, best score 1.234",
        "optimise … step 40 of at most 60  7 s",
    ]


@pytest.mark.parametrize(
    ("text", "region"),
    [
        ("10,-20,5", Disk(5e-3, (0.01, -0.02))),
        ("-10, 20, 30, -5", Rectangle(0.04, 0.025, (0.01, 0.0075))),
    ],
)
def test_excluded_regions(text, region):
    found = _parse_region(text, Rectangle(0.2, 0.2))
    assert type(found) is type(region)
    np.testing.assert_allclose(found.extent, region.extent, atol=1e-15)


def test_bad_input_is_refused(tmp_path):
    path = tmp_path / "bare.csv"
    path.write_text("x_mm,y_mm,diameter_mm\n0,0,6\n200,0,6\n")
    with pytest.raises(ValueError, match="beyond the outline"):
        run(path, "--output", tmp_path)
    with pytest.raises(ValueError, match="--noise must be positive"):
        run("park-inner", "--output", tmp_path, "--noise", 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--thickness-mm", 0.01], "--thickness-mm must be more than the 2.5 mm"),
        (["--thickness-mm", 500], "--thickness-mm is 500 mm, more than the skin is wide, "),
        (["--conductivity", "nan"], "--conductivity must be from"),
        (["--contact-impedance", -1], "--contact-impedance must be positive"),
        (["--minimum-spacing-mm", -3], "--minimum-spacing-mm must not be negative; it is -3"),
        (
            ["--minimum-spacing-mm", 300],
            "--minimum-spacing-mm: 32 electrodes 300 mm apart do not fit the outline, 200 × 200 mm;",
        ),
        (["--steps", 0], "--steps must be at least 1"),
        (["--starts", 0], "--starts must be at least 1"),
        (["--num-points", 0], "--num-points must be from 4 to 250000"),
        (["--num-points", 300_000], "--num-points must be from 4 to 250000"),
        (["--num-points", 20], "--num-points 20 makes cells too coarse for electrodes 6 mm across"),
        (["--keep-out", "1,2"], "give a disc x,y,radius or a rectangle"),
        (["--keep-out", "a,b,c"], "give a disc x,y,radius or a rectangle"),
        (["--keep-out", "0,0,nan"], "give a disc x,y,radius or a rectangle"),
        (["--keep-out", "0,0,-3"], "0,0,-3 has no size"),
        (["--keep-out", "5,0,5,9"], "5,0,5,9 has no size"),
        (
            ["--keep-out", "0,0,5", "--keep-out", "500,0,10"],
            "500,0,10 lies off the skin, which spans -100 to 100 mm by -100 to 100 mm.",
        ),
    ],
)
def test_error_messages_name_the_options(options, message, tmp_path):
    with pytest.raises(ValueError, match=re.escape(message)):
        run("park-inner", "--output", tmp_path, *options)
