"""The main command on measured tanks: from a file to a picture, arrays and a report."""

import csv
import json

import numpy as np
import pytest

RADIUS = 0.14  # radius of the KIT4 tank, metres


def reconstruct(run, folder, *options):
    status, output, error = run("reconstruct", *options, "--output", folder)
    assert (status, error) == (0, "")
    return output, json.loads((folder / "report.json").read_text("utf-8"), parse_constant=pytest.fail)


@pytest.fixture
def kit4(data_folder):
    return data_folder / "kit4"


@pytest.mark.slow
def test_kit4_three_conductive_inclusions(kit4, run, tmp_path):
    """`jeit reconstruct datamat_3_4.mat --reference datamat_1_0.mat --output out`, and every file that it writes."""
    folder = tmp_path / "out"
    output, report = reconstruct(run, folder, kit4 / "datamat_3_4.mat", "--reference", kit4 / "datamat_1_0.mat")
    assert sorted(file.name for file in folder.iterdir()) == ["image.npz", "image.png", "report.json"]
    assert (folder / "image.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    for words in ("calibrate", "misfit", "conductive", "image.png"):
        assert words in output

    with np.load(folder / "image.npz") as arrays:
        raster, extent = arrays["raster"], arrays["extent"]
        conductivity, points, cells = arrays["conductivity"], arrays["points"], arrays["cells"]
    assert raster.shape == (256, 256)
    np.testing.assert_allclose(extent, [-RADIUS, RADIUS, -RADIUS, RADIUS], rtol=1e-3)
    assert conductivity.shape == (len(cells),)
    # The disk fills π/4 of its square; outside there is NaN.
    assert np.isfinite(raster).mean() == pytest.approx(np.pi / 4, rel=0.01)
    assert np.isnan(raster[[0, 0, -1, -1], [0, -1, 0, -1]]).all()
    # Row 0 is at the top, column 0 at the left: a cell's value is at the pixel of its centre.
    centre = points[cells].mean(axis=1)
    column = ((centre[:, 0] - extent[0]) / (extent[1] - extent[0]) * 256).astype(int)
    row = ((extent[3] - centre[:, 1]) / (extent[3] - extent[2]) * 256).astype(int)
    # Cells are larger than pixels, but a pixel's centre may lie just outside its cell.
    assert np.mean(raster[row, column] == conductivity) > 0.95

    # The reference frame is fitted to 1.4 %; the independent model in the data's README gave 1.318 mS.
    assert report["calibration"]["relative_misfit"] < 0.02
    assert report["calibration"]["status"] == "converged"
    assert report["calibration"]["conductivity"] == pytest.approx(1.318e-3, rel=0.02)
    assert report["calibration"]["contact"] == "each, with the electrode positions"
    assert report["uncertainty"]["contact_drift"] == 0.1
    assert report["uncertainty"]["position"] == pytest.approx(2 * RADIUS * 0.0175, rel=1e-3)
    assert report["quality"]["rounding_relative_to_difference"] == 0
    assert report["protocol"]["measurements"] == 79 * 16
    assert report["geometry"]["radius"] == RADIUS
    assert report["geometry"]["electrodes"]["number"] == 16
    assert report["noise"]["relative_to_difference"] < 0.03
    assert report["hyperparameter"]["value"] > 0
    assert report["reconstruction"]["method"] == "gauss-newton"
    assert report["hyperparameter"]["chosen_by"] == "default"
    assert {"check", "mesh", "calibrate", "image"} <= set(report["timings"])
    assert set(report["versions"]) >= {"jeit", "jax"}

    with (kit4 / "truth_centroids.csv").open(encoding="utf-8") as file:
        truth = [row for row in csv.DictReader(file) if row["case"] == "3_4"]
    expected = [(float(row["x_over_R"]), float(row["y_over_R"])) for row in truth]
    kinds = {row["kind"] for row in truth}
    found = report["inclusions"]
    assert len(found) == len(expected)
    assert {inclusion["kind"] for inclusion in found} == kinds
    for place in expected:
        distances = [np.hypot(*(np.array(i["centroid"]) / RADIUS - place)) for i in found]
        assert min(distances) < 0.10
    strongest = found[0]["centroid"]
    pixel = raster[
        int((extent[3] - strongest[1]) / 2 / RADIUS * 256), int((strongest[0] - extent[0]) / 2 / RADIUS * 256)
    ]
    assert pixel == pytest.approx(np.nanmax(raster), rel=0.2)


@pytest.mark.slow
def test_quiet_prints_nothing(kit4, run, tmp_path):
    files = (kit4 / "datamat_2_2.mat", "--reference", kit4 / "datamat_1_0.mat")
    output, _ = reconstruct(run, tmp_path, *files, "--quiet", "--num-points", 300)
    assert output == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("one-step", ()),
        ("back-projection", ()),
        ("filtered-back-projection", ("--hyperparameter", 0.1)),
    ],
)
def test_every_method_finds_the_rod(method, options, data_folder, run, tmp_path):
    """The metal rod beside electrode 1 (12 o'clock) of the small tank, for which --reference is not needed."""
    (file,) = (data_folder / "tank6cm" / "electrode01_metal").glob("*.csv")
    _, report = reconstruct(run, tmp_path, file, "--method", method, "--num-points", 500, *options)
    assert report["reconstruction"]["method"] == method
    x, y = report["inclusions"][0]["centroid"]
    assert report["inclusions"][0]["sign"] == 1
    assert abs(np.degrees(np.arctan2(x, y))) < 12


@pytest.mark.slow
@pytest.mark.parametrize("prior", ["tikhonov", "laplace", "noser", "gaussian"])
def test_every_prior_finds_the_rod(prior, data_folder, run, tmp_path):
    (file,) = (data_folder / "tank6cm" / "electrode01_metal").glob("*.csv")
    _, report = reconstruct(run, tmp_path, file, "--prior", prior, "--num-points", 500)
    assert report["reconstruction"]["prior"] == prior
    x, y = report["inclusions"][0]["centroid"]
    assert report["inclusions"][0]["sign"] == 1
    assert abs(np.degrees(np.arctan2(x, y))) < 12


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["gcv", "l-curve", "discrepancy"])
def test_rules_are_accepted_and_reported(rule, data_folder, run, tmp_path):
    """Where the model error is a quarter of the voltages, as here, these rules regularise too little."""
    (file,) = (data_folder / "tank6cm" / "electrode01_metal").glob("*.csv")
    _, report = reconstruct(run, tmp_path, file, "--hyperparameter", rule, "--num-points", 500)
    assert report["hyperparameter"]["chosen_by"] == rule
    assert report["hyperparameter"]["value"] > 0


def test_info(kit4, run):
    status, output, error = run("info", kit4 / "datamat_1_0.mat")
    assert (status, error) == (0, "")
    for words in ("1264", "79 drives", "radius 140 mm", "reciprocity", "milliamperes"):
        assert words in output
