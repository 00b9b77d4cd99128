"""`jeit layout compare`: two layouts compared in a table, a report and a picture."""

import json

import numpy as np
import pytest

from jeit.design import Skin
from jeit.layout import Layout, grid, named_layout, write_layout
from jeit.mesh import Rectangle

SKIN = Rectangle(0.06, 0.05)
OPTIONS = ["--places", 6, "--margin-mm", 5, "--taxels", 8, "--cell-mm", 6, "--pairs", 6]


@pytest.fixture
def layouts(tmp_path):
    write_layout(Layout(grid(0.04, 0.03, 3, 2), 8e-3, outline=SKIN), tmp_path / "inside.svg")
    left = grid(0.02, 0.03, 3, 2) - np.array([0.016, 0.0])
    write_layout(Layout(left, 8e-3, outline=SKIN), tmp_path / "left.csv")
    return tmp_path / "inside.svg", tmp_path / "left.csv"


def test_two_files_are_compared(layouts, run, tmp_path):
    folder = tmp_path / "out"
    size = ["--width-mm", 60, "--height-mm", 50]
    status, output, error = run("layout", "compare", *layouts, "--output", folder, *OPTIONS, "--contrast", 5, *size)
    assert (status, error) == (0, "")
    assert "blind spot / % of the area" in output
    assert (folder / "comparison.png").read_bytes().startswith(b"\x89PNG")
    report = json.loads((folder / "report.json").read_text("utf-8"), parse_constant=pytest.fail)
    inside, left = report["layouts"]
    assert [one["layout"] for one in report["layouts"]] == ["inside", "left"]
    assert inside["measurements"] == 6
    # The right side of this layout is far from all electrodes.
    assert left["sensitivity_min_V"] < 0.5 * inside["sensitivity_min_V"]
    assert left["blind_spot_fraction"] > 0.1
    assert inside["blind_spot_fraction"] == 0
    assert 0 < inside["taxel_count"] <= 8
    assert inside["taxel_area_cm2"]["mean"] <= inside["taxel_area_cm2"]["max"] < 30
    assert report["options"]["margin_mm"] == 5
    assert report["options"]["pairs"] == 6
    assert report["options"]["contrast"] == 5


def test_a_layout_and_its_file_give_the_same_result(run, tmp_path):
    """Files hold millimetres with nine digits; this rounding causes no blind spot."""
    write_layout(named_layout("grid-3x2", Rectangle(0.06, 0.05)), tmp_path / "file.csv")
    options = ["--width-mm", 60, "--height-mm", 50, "--output", tmp_path / "out", *OPTIONS]
    status, output, _ = run("layout", "compare", "grid-3x2", tmp_path / "file.csv", *options)
    assert status == 0
    assert "a layer 10 mm thick; two-terminal measurements: 6 and 6" in output
    assert "touched at 6 × 6 places, 5 mm or more from the edge" in output
    report = json.loads((tmp_path / "out" / "report.json").read_text("utf-8"))
    assert [one["blind_spot_fraction"] for one in report["layouts"]] == [0, 0]
    lengths = [report["options"][name] for name in ("thickness_mm", "margin_mm", "cell_mm")]
    assert lengths == pytest.approx([10, 5, 6])


def test_the_second_layout_is_checked_before_the_first_is_simulated(layouts, run, tmp_path, monkeypatch):
    touched = []
    monkeypatch.setattr(Skin, "voltage_changes", lambda skin, cells: touched.append(skin.layout.name))
    write_layout(Layout(grid(0.04, 0.03, 3, 2), 3e-3, outline=SKIN), tmp_path / "small.svg")
    write_layout(Layout(grid(0.04, 0.0, 3, 1), 8e-3, outline=SKIN), tmp_path / "three.svg")
    for second, message in (
        ("none.svg", "none.svg"),
        ("small.svg", "--cell-mm is 6 mm; give no more than 4.5 mm, as electrodes of 'small' are 3 mm across"),
        ("three.svg", "--pairs is 6; 'three' has 3 electrodes, and they make 3 pairs"),
    ):
        command = ["layout", "compare", layouts[0], tmp_path / second, "--output", tmp_path / "out", *OPTIONS]
        status, _, error = run(*command)
        assert status == 1
        assert message in error
        assert "metres" not in error
    assert touched == []


@pytest.mark.slow
def test_touches_that_increase_the_conductivity(layouts, run, tmp_path):
    for contrast in (0, 5):
        options = ["--output", tmp_path / f"out-{contrast}", *OPTIONS, "--contrast", contrast, "--quiet"]
        assert run("layout", "compare", layouts[0], layouts[0], *options)[0] == 0
    reports = [json.loads((tmp_path / f"out-{contrast}" / "report.json").read_text("utf-8")) for contrast in (0, 5)]
    assert [report["options"]["contrast"] for report in reports] == [0, 5]
    insulating, conducting = (report["layouts"][0]["sensitivity_mean_V"] for report in reports)
    assert conducting != pytest.approx(insulating, rel=0.1)


@pytest.mark.parametrize(("option", "value"), [("--width-mm", 0), ("--height-mm", 1e6)])
def test_the_side_of_a_skin_must_be_a_length(option, value, layouts, run, tmp_path):
    status, _, error = run("layout", "compare", *layouts, "--output", tmp_path / "out", *OPTIONS, option, value)
    assert status == 1
    assert f"{option} must be from 1 to 5000 mm" in error


def test_layouts_on_different_skins_are_not_compared(layouts, run, tmp_path):
    """A CSV file is assumed to describe the default skin unless the sides are given."""
    status, _, error = run("layout", "compare", *layouts, "--output", tmp_path / "out", *OPTIONS)
    assert status == 1
    assert "different skins, 'inside' 60 × 50 mm and 'left' 200 × 200 mm" in error
    assert "--width-mm" in error


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["park-iner"], "park-inner"),
        (["missing.svg"], "missing.svg"),
        ([None, "--margin-mm", 40], "so far from its edge"),
        ([None, "--thickness-mm", 2], "--thickness-mm must be more than the 2.5 mm that a touch is deep"),
        ([None, "--thickness-mm", 55], "--thickness-mm is 55 mm; give more than the 2.5 mm"),
        ([None, "--thickness-mm", 500], "--thickness-mm is 500 mm, more than the skin is wide, 60 mm.\n"),
        ([None, "--conductivity", -1], "--conductivity must be from 1e-09 to 1e+09 S/m"),
        (
            [None, "--cell-mm", 500],
            "--cell-mm is 500 mm; give no more than 12 mm, as electrodes of 'inside' are 8 mm across.\n",
        ),
        ([None, "--cell-mm", 0.001], "--cell-mm is 0.001 mm, which makes about 2.2e+10 nodes; give 0.15 mm or more"),
        ([None, "--contrast", 1], "--contrast must be a factor for the conductivity"),
        ([None, "--contrast", 1e7], "up to 1e+06, where the limit is reached long before"),
        ([None, "--places", 100_000], "--places must be from 2 to 256"),
        ([None, "--taxels", 0], "--taxels must be at least 1"),
        ([None, "--taxels", 101], "--taxels is 101; it must be from 1 to"),
        ([None, "--pairs", 16], "--pairs is 16; 'inside' has 6 electrodes, and they make 15 pairs"),
        ([None, "--seed", -1], "--seed must be at least 0"),
        (["grid-2x1"], "'grid-2x1' has 2 electrodes; give a layout of three or more"),
    ],
)
def test_bad_input_is_explained(change, message, layouts, run, tmp_path):
    first = change[0] or layouts[0]
    status, _, error = run("layout", "compare", first, layouts[0], "--output", tmp_path / "out", *OPTIONS, *change[1:])
    assert status == 1
    assert message in error
    assert len(error.strip().splitlines()) == 1
