"""`jeit choose`: the table, picture and report of the hyperparameters that the rules choose."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from jeit.cli.commands.choose import print_comparison_of_rules
from jeit.data import read
from jeit.image import Inclusion
from jeit.imaging import ImagingSettings, compare_on_data, image_difference
from jeit.inverse import RULES
from jeit.mesh import disk
from jeit.report import draw_choice, report_choice
from jeit.report.hyperparameter_rules import _draw_rule_image

SMALL = ("--num-points", 250, "--contact", "fixed")


def choose(run, folder, *options):
    status, output, error = run("choose", *options, "--output", folder)
    assert (status, error) == (0, "")
    return output, json.loads((folder / "choice.json").read_text("utf-8"), parse_constant=pytest.fail)


def test_every_rule_is_in_table_picture_and_report(tank, run, tmp_path):
    files = (tank.folder / "touched.csv", "--reference", tank.folder / "rest.csv")
    folder = tmp_path / "out"
    output, written = choose(run, folder, *files, *SMALL, "--prior", "noser")
    assert sorted(file.name for file in folder.iterdir()) == ["choice.json", "choice.png"]
    assert (folder / "choice.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    rows = {line.split()[0]: line for line in output.splitlines() if line.split()}
    assert [entry["rule"] for entry in written["rules"]] == list(RULES)
    assert written["prior"] == "noser"
    assert written["doubts"] == []
    assert (written["conductivity_unit"], written["centroid_unit"]) == ("S", "m")
    for entry in written["rules"]:
        row = rows[entry["rule"]]
        assert f"{entry['hyperparameter']:.3g}" in row
        assert f"{entry['noise_figure']:.3g}" in row
        assert row.split()[-1] == str(len(entry["inclusions"]))
        assert all(
            (one["kind"] == "conductive") == (one["sign"] > 0) == (one["peak"] > 0) for one in entry["inclusions"]
        )
        assert 0 < entry["relative_residual"] < 1
        lengths = {len(entry[curve]) for curve in ("candidates", "criterion", "residual", "penalty")}
        assert len(lengths) == 1
    # Without noise in the data, the noise estimated from reciprocity is zero, and no residual is as small.
    (edge,) = [entry for entry in written["rules"] if entry["rule"] == "discrepancy"]
    assert edge["edge_of_grid"] == "smallest"
    assert edge["note"] in output
    assert rows["discrepancy"].split()[1] == "*"
    # The same λ as the one-step image.
    settings = ImagingSettings(num_points=250, contact="fixed", method="one-step", prior="noser")
    imaged = image_difference(read(files[0]), read(files[2]), settings)
    (figure,) = [entry for entry in written["rules"] if entry["rule"] == "noise-figure"]
    assert float(imaged.reconstruction.hyperparameter) == pytest.approx(figure["hyperparameter"])
    assert imaged.reconstruction.choice is not None
    assert imaged.reconstruction.choice.note == ""


@pytest.mark.parametrize(("number", "title", "marks"), [(1, "gcv\n1 inclusion", 1), (9, "gcv\n9 inclusions", 0)])
def test_the_image_of_a_rule_has_its_own_scale_and_few_marks(number, title, marks):
    mesh = disk(0.05, num_points=60)
    change, found = np.linspace(-2e-3, 1e-3, mesh.num_cells), (Inclusion(1, (0.01, 0.0), 1e-4, 1e-3),)
    outcome: Any = SimpleNamespace(change=change, inclusions=number * found)
    figure = Figure()
    ax = figure.subplots()
    _draw_rule_image(ax, "gcv", outcome, mesh)
    bar = figure.axes[1]
    assert [label.get_text() for label in bar.get_xticklabels()] == ["−2", "0", "+2 mS"]
    np.testing.assert_allclose(bar.get_xticks(), [-2, 0, 2])
    assert (ax.get_title(), len(ax.patches)) == (title, marks)


def test_noise_in_the_difference_is_doubted(tank, run, tmp_path):
    touched, rest = (np.asarray(read(tank.folder / f"{name}.csv").voltages)[0] for name in ("touched", "rest"))
    deviation = np.linalg.norm(touched - rest) / np.linalg.norm(rest) * np.abs(rest)
    noisy = tank.write("noisy", touched + deviation * np.random.default_rng(0).normal(size=touched.shape))
    files = (noisy, "--reference", tank.folder / "rest.csv")
    output, written = choose(run, tmp_path / "out", *files, *SMALL, "--rule", "best-resolution")
    assert "of the difference from the reference" in written["doubts"][0]
    assert f"doubt: {written['doubts'][0]}" in output


@pytest.mark.slow
def test_every_image_has_a_colour_bar_with_few_ticks(tank):
    """A colour bar for each image over the range of its own values, in a readable unit, without overlapping tick
    labels."""
    settings = ImagingSettings(num_points=250, contact="fixed")
    result = compare_on_data(
        read(tank.folder / "touched.csv"), read(tank.folder / "rest.csv"), settings, rules=list(RULES)[:3]
    )
    figure = draw_choice(result)
    figure.draw_without_rendering()
    outcomes = list(result.outcomes.values())
    bars = [ax for ax in figure.axes if ax.get_label() == "<colorbar>"]
    assert len(bars) == len(outcomes)
    for bar, outcome in zip(bars, outcomes, strict=True):
        low, middle, high = (label.get_text() for label in bar.get_xticklabels())
        value, unit = high.split()
        assert (low[1:], middle, unit[-1]) == (value[1:], "0", "S")
        factor = {"S": 1, "mS": 1e3, "µS": 1e6}[unit]
        assert float(value) == pytest.approx(factor * float(np.abs(outcome.change).max()), rel=0.01)
    images = [ax for ax in figure.axes if "inclusion" in ax.get_title()]
    for ax, outcome in zip(images, outcomes, strict=True):
        number = len(outcome.inclusions)
        assert ax.get_title().endswith(f"{number} inclusion{'s' * (number != 1)}")
        assert len(ax.patches) == (number if number <= 8 else 0)


@pytest.mark.slow
def test_one_rule_quietly(tank, run, tmp_path):
    options = ("--rule", "l-curve", "--rule", "gcv", "--quiet", *SMALL)
    output, written = choose(
        run, tmp_path / "out", tank.folder / "touched.csv", "--reference", tank.folder / "rest.csv", *options
    )
    assert output == ""
    assert [entry["rule"] for entry in written["rules"]] == ["l-curve", "gcv"]


@pytest.mark.slow
def test_reconstruct_reports_a_choice_at_the_edge_of_the_range(tank, run, tmp_path):
    files = (tank.folder / "touched.csv", "--reference", tank.folder / "rest.csv")
    status, output, error = run(
        "reconstruct", *files, *SMALL, "--hyperparameter", "discrepancy", "--output", tmp_path / "out"
    )
    assert (status, error) == (0, "")
    imaged = json.loads((tmp_path / "out" / "report.json").read_text("utf-8"))
    assert "ran to the smallest" in imaged["hyperparameter"]["note"]
    assert "not to be" in " ".join(output.split())


@pytest.mark.slow
def test_a_rule_that_cannot_choose_is_refused_alone(tank, capsys):
    """With only one of every two reciprocal channels, the data contain no estimate of the noise."""
    pairs, _ = read(tank.folder / "rest.csv").protocol.reciprocal_pairs()
    usable = np.ones(40, bool)
    usable[np.asarray(pairs)[:, 1]] = False
    touched, rest = (read(tank.folder / f"{name}.csv").masked(usable, "half") for name in ("touched", "rest"))
    settings = ImagingSettings(num_points=250, contact="fixed")
    result = compare_on_data(touched, rest, settings, rules=["discrepancy", "gcv"])
    assert list(result.outcomes) == ["gcv"]
    assert "needs to know the noise" in result.refused["discrepancy"]
    assert report_choice(result)["refused"] == result.refused
    print_comparison_of_rules(Console(width=200), result)
    assert "needs to know the noise" in capsys.readouterr().out
    with pytest.raises(ValueError, match="needs to know the noise"):
        compare_on_data(touched, rest, settings, rules=["discrepancy"])
    with pytest.raises(ValueError, match="none is named"):
        compare_on_data(touched, rest, settings, rules=[])


BAD = {
    "unknown rule": (lambda t: good(t, "--rule", "luck"), "--rule must be one of gcv, l-curve"),
    "unknown prior": (lambda t: good(t, "--prior", "flat"), "tikhonov, laplace, noser, gaussian"),
    "no reference": (lambda t: [t.folder / "touched.csv"], "reference"),
    "no such file": (lambda t: ["absent.csv", "--reference", t.folder / "rest.csv"], "DATA: there is no file"),
    "mesh of three nodes": (lambda t: good(t, "--num-points", "3"), "50 to 100,000"),
    "equal frames": (lambda t: [t.folder / "rest.csv", "--reference", t.folder / "rest.csv"], "no difference to image"),
}


def good(tank, *options):
    return [tank.folder / "touched.csv", "--reference", tank.folder / "rest.csv", *options]


@pytest.mark.parametrize(("arguments", "words"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_refused_in_one_line(arguments, words, tank, run, tmp_path):
    status, _, error = run("choose", *arguments(tank), "--output", tmp_path / "out")
    assert status == 1
    assert words in error
    assert error.count("\n") == 1


def test_output_that_is_a_file_is_refused_before_any_computation(tank, run):
    status, output, error = run("choose", *good(tank), "--output", tank.folder / "rest.csv")
    assert (status, output) == (1, "")
    assert "is a file" in error


@pytest.mark.slow
def test_measured_tank(data_folder, run, tmp_path):
    """Three metal rods. The rules based on the system or on the corner of the L-curve find them. GCV and discrepancy do
    not, because of model errors."""
    folder = data_folder / "kit4"
    files = (folder / "datamat_3_4.mat", "--reference", folder / "datamat_1_0.mat")
    _, written = choose(run, tmp_path / "out", *files, "--num-points", 600)
    found = {entry["rule"]: [i["sign"] for i in entry["inclusions"]] for entry in written["rules"]}
    for rule in ("noise-figure", "best-resolution", "l-curve"):
        assert found[rule] == [1, 1, 1]
    assert len(found["gcv"]) > 3 < len(found["discrepancy"])
    assert not any(entry["edge_of_grid"] for entry in written["rules"])
