"""`jeit layout optimise`: a better layout, its drawing, its report."""

import json

import pytest
import typer

from jeit.cli.layout_optimise import RESULTS, optimise
from jeit.electrodes import Layout, read_layout, write_layout
from jeit.mesh import Rectangle

APP = typer.Typer()
APP.command()(optimise)


def run(*arguments):
    command = typer.main.get_command(APP)
    command.main(args=[str(one) for one in arguments], standalone_mode=False)


@pytest.mark.slow
def test_optimised_layout_is_written_and_better(tmp_path):
    start = tmp_path / "low.svg"
    centres = [(x, y) for y in (-0.04, -0.015) for x in (-0.03, 0.0, 0.03)]
    write_layout(Layout(centres, 8e-3, outline=Rectangle(0.1, 0.1)), start)
    run(start, "--output", tmp_path / "out", "--steps", 6, "--num-points", 200, "--minimum-spacing", 15, "--quiet")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(RESULTS)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    before, after = report["start"], report["optimised"]
    assert after["worst_sensitivity_V"] > 1.5 * before["worst_sensitivity_V"]
    assert after["mean_variance"] < before["mean_variance"]
    assert read_layout(tmp_path / "out" / "layout.svg").num_electrodes == 6


def test_bad_input_is_refused(tmp_path):
    path = tmp_path / "bare.csv"
    path.write_text("x_mm,y_mm,diameter_mm\n0,0,6\n200,0,6\n")
    with pytest.raises(ValueError, match="beyond the outline"):
        run(path, "--output", tmp_path)
    with pytest.raises(ValueError, match="--noise must be positive"):
        run("park-inner", "--output", tmp_path, "--noise", 0)
