"""What is stated about an image: the rows that `jeit reconstruct` prints, the durations of the steps, and the labels of
the pixels. Rows are compared with the properties of the image, durations with a clock that the test sets."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_chosen_frame import EMPTY, FULL, MODEL, SETTINGS, tank

from jeit.cli.commands.reconstruct import print_imaging_result
from jeit.cli.console import plain_console
from jeit.image import Inclusion, Raster
from jeit.imaging import ImagingSettings, calibration, image_difference
from jeit.imaging.difference import _label_region_pixels
from jeit.imaging.wiring import Wiring
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.shapes import Ellipsoid, Star
from jeit.mesh import centroids
from jeit.report.image import _image_arrays, draw_image, report_image
from jeit_solvers import Status


@pytest.fixture(scope="module")
def imaged():
    return image_difference(tank(FULL), tank(EMPTY), SETTINGS)


@pytest.fixture
def printed(imaged, capsys):
    """Print the image with some of its properties replaced; return the text, and the names of the rows."""

    def call(**changed):
        print_imaging_result(plain_console(), replace(imaged, **changed))
        lines = capsys.readouterr().out.splitlines()
        table = lines[2 : lines.index("", 2)]
        return " ".join(" ".join(lines).split()), [name for line in table if (name := line[:15].strip())]

    return call


USUAL = ["background", "difference", "noise in it", "smallest body", "method", "mesh"]


def test_a_sound_image_has_no_rows_of_faults(printed):
    text, rows = printed()
    assert rows == USUAL
    assert "conductive" in text
    assert "peaks of the image, which blurs" in text


def test_a_hyperparameter_is_called_default_where_it_is_the_methods_number(imaged):
    def chosen_by(method, hyperparameter, rule):
        settings = ImagingSettings(method, hyperparameter=hyperparameter)
        return replace(imaged, settings=settings, reconstruction=SimpleNamespace(rule=rule)).chosen_by

    default = ImagingSettings("gauss-newton").hyperparameter
    assert chosen_by("gauss-newton", None, "given") == chosen_by("gauss-newton", default, "given") == "default"
    assert chosen_by("gauss-newton", 2 * default, "given") == chosen_by("one-step", default, "given") == "given"
    assert chosen_by("one-step", None, "gcv") == "gcv"


def test_faults_have_rows_of_their_own(imaged, printed):
    turned = Wiring((0, 1, 6, 3, 4, 5, 2, 7), described=0.4)
    text, rows = printed(wiring=turned, unlike_electrodes={2: 2.54})
    assert rows == [*USUAL, "note", "wiring"]
    assert "electrodes 3 and 7 look exchanged" in text
    assert "at 3 (2.5 times): what reads them counts less" in text
    text, rows = printed(quality=replace(imaged.quality, rounding=0.012, difference_noise=None, noise_share=None))
    assert rows == [*USUAL[:3], "rounding", *USUAL[3:]]
    (stated,) = re.findall(r"noise in it not measured; ([0-9.]+) % is assumed, model error included", text)
    difference = np.asarray(imaged.measurement.voltages - imaged.reference.voltages)
    assumed = np.linalg.norm(imaged.noise) / np.linalg.norm(difference)
    assert float(stated) == pytest.approx(100 * assumed, rel=0.06)  # two digits
    assert "1.2 % of the difference: voltages have few digits" in text


def test_the_report_states_numbers_in_their_units(imaged):
    background = float(imaged.calibration.conductivity)
    body = Inclusion(-1, (0.02, -0.01), 3e-4, -0.5 * background, contrast_interval=(-0.7, None), strength=2e-4)
    ball = Inclusion(1, (0.02, -0.01, 0.03), 4e-6, 0.25 * background)
    report = report_image(replace(imaged, unlike_electrodes={0: 2.5, 7: 3.0}, inclusions=(body, ball)))
    currents = {name: report["protocol"][name] for name in ("electrodes", "drives", "measurements", "largest_current")}
    assert currents == {"electrodes": 8, "drives": 8, "measurements": 40, "largest_current": pytest.approx(1e-3)}
    fit = report["calibration"]
    assert fit["conductivity"] == pytest.approx(background)
    assert (fit["conductivity_unit"], fit["contact_impedance_unit"]) == ("S", "ohm·m")
    assert report["unlike_electrodes"] in ({1: 2.5, 8: 3.0}, {"1": 2.5, "8": 3.0})
    first, second = report["inclusions"]
    assert (first["kind"], second["kind"]) == ("resistive", "conductive")
    assert (first["area"], first["area_unit"]) == (3e-4, "m²")
    assert (second["volume"], second["volume_unit"]) == (4e-6, "m³")
    assert (first["peak_relative_to_background"], second["peak_relative_to_background"]) == pytest.approx((-0.5, 0.25))
    assert (first["contrast_interval"], first["strength"], first["strength_unit"]) == ([-0.7, None], 2e-4, "m²")
    assert "strength" not in second


def test_fitted_bodies_are_reported_with_their_conductivity_relative_to_the_background(imaged):
    outline = np.array([[0.02, 0.0], [0.02, 0.01], [0.01, 0.01], [0.01, 0.0]])
    weak, strong = (Star(sign, outline[0], outline, np.log(4), sign < 0, 3.0) for sign in (-1, 1))
    axes, centre = np.diag([0.03, 0.02, 0.01]), np.array([0.0, 0.01, 0.02])
    ball, column = (
        Ellipsoid(sign, centre, axes, 3e-5, centre, np.log(2), column=sign < 0, alike=sign > 0, rise=2.0)
        for sign in (1, -1)
    )
    shapes = SimpleNamespace(
        bodies=(weak, ball), doubtful=(strong,), alternatives=(None, column), alternative_deviations=(np.nan, 0.3),
        misfit=1.5, drift=0.01,
    )  # fmt: skip
    report = report_image(replace(imaged, shapes=shapes))["shapes"]
    sheet_body, solid_body, (left_out,) = *report["bodies"], report["left_out"]
    assert sheet_body["conductivity_over_background"] == pytest.approx(0.25)
    assert (sheet_body["sign"], sheet_body["area"], sheet_body["rise"]) == (-1, pytest.approx(1e-4), 3.0)
    assert (sheet_body["conductivity_is"], "or" in sheet_body) == ("estimated from the data", False)
    assert left_out["conductivity_over_background"] == pytest.approx(4)
    assert left_out["conductivity_is"] == "assumed, as of what is strong"
    assert (solid_body["form"], solid_body["volume"]) == ("ellipsoid", 3e-5)
    assert solid_body["conductivity_over_background"] == pytest.approx(2)
    assert "of one material with all others of its sign" in solid_body["conductivity_is"]
    assert (solid_body["or"]["form"], solid_body["or"]["deviation_of_logarithm"]) == ("column", 0.3)
    assert solid_body["or"]["conductivity_over_background"] == pytest.approx(0.5)


def test_the_arrays_of_an_iterative_image_contain_the_logarithm_of_its_conductivity(imaged):
    change, background = np.asarray(imaged.change), float(imaged.calibration.conductivity)
    iterative = replace(imaged, reconstruction=object.__new__(Reconstruction))
    arrays = _image_arrays(iterative)
    np.testing.assert_allclose(arrays["departure"], np.log10((background + change) / background), rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(arrays["conductivity"], change)
    assert arrays["background"] == background
    assert "departure" not in {*_image_arrays(imaged), *_image_arrays(replace(iterative, change=change * (1 + 0.1j)))}
    assert "labels" not in arrays
    np.testing.assert_array_equal(_image_arrays(replace(imaged, labels=np.eye(3)))["labels"], np.eye(3))


def test_a_calibration_that_failed_is_explained(imaged, printed):
    fit = imaged.calibration
    known = {"model": fit.model, "conductivity": fit.conductivity, "misfit": fit.misfit}
    failed = SimpleNamespace(**known, note="contacts are those described", status=Status.STALLED, reason="No step fits")
    text, rows = printed(calibration=failed)
    assert rows == [USUAL[0], "calibration", "note", *USUAL[1:]]
    assert "stalled. No step fits" in text
    assert "contacts are those described" in text


def test_a_linear_image_of_negative_conductivity_is_doubted(imaged, printed):
    background = float(imaged.calibration.conductivity)
    change = np.asarray(imaged.change).copy()
    change[0] = -1.3 * background
    text, rows = printed(change=change, inclusions=())
    assert rows == [*USUAL, "doubt"]
    assert "falls to -130 % of the background" in text
    assert "no inclusion found" in text
    assert "peaks of the image" not in text
    change[0] = -0.9 * background
    assert printed(change=change)[1] == USUAL


def test_noise_and_a_common_change_are_no_inclusions_and_a_body_beside_them_is():
    settings, rng = ImagingSettings(method="one-step", num_points=300), np.random.default_rng(0)
    signal = np.linalg.norm(FULL - EMPTY) / np.linalg.norm(EMPTY)
    noise = EMPTY * (1 + signal * rng.normal(size=EMPTY.shape))
    found = image_difference(tank(1.05 * noise), tank(EMPTY), replace(settings, as_is=True))
    assert not found.inclusions
    assert found.quality.noise_share > 0.9
    warmer = EMPTY / 1.05 * (1 + 0.1 * signal * rng.normal(size=EMPTY.shape))
    found = image_difference(tank(warmer), tank(EMPTY), settings)
    assert not found.inclusions
    assert "all voltages have changed by -4.6 % alike" in found.doubts[0]
    body = image_difference(tank(FULL / 1.1), tank(EMPTY), settings).inclusions[0]
    assert np.hypot(body.centroid[0] - 0.02, body.centroid[1] - 0.01) < 0.005
    (body,) = image_difference(tank(0.98 * FULL), tank(EMPTY), settings).inclusions
    assert np.hypot(body.centroid[0] - 0.02, body.centroid[1] - 0.01) < 0.005


def test_noise_that_reciprocity_does_not_show_is_what_a_linear_image_leaves_unexplained():
    """One channel of each reciprocal pair: noise alone is doubted; a body is found."""
    settings, rng = ImagingSettings(method="one-step", num_points=300), np.random.default_rng(0)
    one_of_each = np.ones(EMPTY.size, bool)
    one_of_each[np.asarray(MODEL.protocol.reciprocal_pairs()[0])[:, 1]] = False
    noisy, body, rest = (
        tank(row).masked(one_of_each, "one of each pair")
        for row in (EMPTY * (1 + 1e-3 * rng.normal(size=EMPTY.size)), FULL, EMPTY)
    )
    found = image_difference(noisy, rest, settings)
    assert found.quality.noise_share > 0.5
    assert "by what the image leaves unexplained" in found.doubts[-1]
    assert [one.sign for one in image_difference(body, rest, settings).inclusions] == [1]


def test_the_first_doubt_is_written_in_the_picture(imaged):
    assert draw_image(imaged).get_supxlabel() == ""
    doubted = replace(imaged, quality=replace(imaged.quality, noise_share=0.8))
    assert draw_image(doubted).get_supxlabel().startswith("Doubt: by reciprocity, noise is 80 %")


def test_a_step_takes_the_time_from_its_beginning_to_its_end(monkeypatch):
    now, begun = [100.0], []
    monkeypatch.setattr(calibration.time, "perf_counter", lambda: now[0])
    clock = calibration.StepTimer(begun.append)
    for step, seconds in (("mesh", 2.5), ("image", 0.25)):
        with clock(step):
            assert begun[-1] == step
            now[0] += seconds
    assert clock.seconds == {"mesh": 2.5, "image": 0.25}


def test_every_pixel_of_a_region_is_labelled_by_its_sign():
    """A region of all cells contains all pixels inside of the outline; a later region replaces its label."""
    grid, cells = Raster.create(MODEL.mesh, shape=(32, 32)), np.asarray(centroids(MODEL.mesh))
    whole, left = np.ones(len(cells), bool), cells[:, 0] < 0
    conductive, resistive = (Inclusion(sign, (0.0, 0.0), 1e-4, sign * 1e-3) for sign in (1, -1))
    labels = _label_region_pixels([(conductive, whole), (resistive, left)], grid)
    x, y = np.moveaxis(grid.pixel_centres(), -1, 0)
    inside, size = np.hypot(x, y) < 0.0495, 0.004
    np.testing.assert_array_equal(labels[inside & (x > size)], 2)
    np.testing.assert_array_equal(labels[inside & (x < -size)], 1)
    np.testing.assert_array_equal(labels[np.hypot(x, y) > 0.0501], 0)
    assert set(labels[inside].tolist()) == {1, 2}


@pytest.mark.parametrize("truth", [(0.02, -0.01), (0.02, -0.01, 0.005)])
def test_the_true_contact_is_drawn_at_its_place_with_its_radius(truth, imaged):
    (ax, *_) = draw_image(imaged, truth=truth).axes
    (line,) = [line for line in ax.lines if line.get_label() == "pressed here"]
    distances = np.hypot(*(np.array(line.get_data()).reshape(2, -1) - np.array([[0.02], [-0.01]])))
    np.testing.assert_allclose(distances, truth[2] if len(truth) > 2 else 0, atol=1e-12)
