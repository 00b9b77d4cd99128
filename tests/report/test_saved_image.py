"""Saved images are read back unchanged, and other files are refused with the reason. Pictures of them are checked by
the drawn artists, without writing them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from jeit.electrodes import BoundaryElectrodes, FacePatches
from jeit.image import Inclusion, Plane, SolidForm
from jeit.layout import ring
from jeit.mesh import box, disk
from jeit.plot import Camera
from jeit.report import read_image, write_views
from jeit.report.saved_image import drawn_values, saved_extras

TANK = box(0.1, 0.08, 0.06, num_points=300)
SHEET = disk(0.05, num_points=200)
PATCHES = FacePatches([[0.05, 0.0, 0.03], [-0.05, 0.0, 0.03]], 0.03, 0.03, 1e-3)
ARCS = BoundaryElectrodes(ring(0.05, 4), 0.01, 0.1)
FOUND = (Inclusion(-1, (0.01, 0.0, 0.03), 1e-6, -2e-3), Inclusion(1, (0.0, 0.01, 0.02), 2e-6, 1e-3))


def content(mesh=TANK, electrodes=PATCHES, inclusions=FOUND, **changed):
    arrays = {
        "conductivity": np.linspace(-1e-3, 1e-3, mesh.num_cells),
        "background": np.array(0.03),
        "points": np.asarray(mesh.points),
        "cells": np.asarray(mesh.cells),
        **saved_extras(mesh, electrodes, inclusions),
        **changed,
    }
    return {name: value for name, value in arrays.items() if value is not None}


def test_round_trip_of_a_solid(tmp_path):
    np.savez(tmp_path / "image.npz", **content())
    image = read_image(tmp_path / "image.npz")
    np.testing.assert_array_equal(image.mesh.points, TANK.points)
    np.testing.assert_array_equal(image.change, np.linspace(-1e-3, 1e-3, TANK.num_cells))
    assert (image.background, image.unit, image.departure) == (0.03, "S/m", None)
    assert image.inclusions == FOUND
    assert image.electrodes is not None
    np.testing.assert_allclose(image.electrodes.middles(), PATCHES.position, atol=1e-12)


def test_round_trip_of_fitted_bodies(tmp_path):
    axes = ((0.01, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.03))
    forms = [SolidForm((0.0, 0.01, 0.03), axes, column) for column in (True, False)]
    found = tuple(Inclusion(1, (0.0, 0.01, 0.03), 1e-6, 2e-3, form=form) for form in forms)
    arrays = content(inclusions=found)
    np.savez(tmp_path / "image.npz", **arrays)
    assert read_image(tmp_path / "image.npz").inclusions == found
    bad = {"inclusion_axes": np.full((2, 3, 3), np.nan)}, {"inclusion_columns": np.array([True])}
    for changed, message in zip(bad, ("not finite", "not of every inclusion"), strict=True):
        np.savez(tmp_path / "image.npz", **arrays | changed)
        with pytest.raises(ValueError, match=message):
            read_image(tmp_path / "image.npz")


def test_round_trip_of_a_sheet_and_of_a_complex_image(tmp_path):
    values = np.linspace(0, 1, SHEET.num_cells) * (1 + 0.5j)
    arrays = content(SHEET, ARCS, (), conductivity=values, background=np.array(0.1 + 0.01j))
    np.savez(tmp_path / "image.npz", **arrays)
    image = read_image(tmp_path / "image.npz")
    np.testing.assert_array_equal(image.change, values)
    assert (image.unit, image.inclusions) == ("S", ())
    assert image.electrodes is not None
    assert image.electrodes.number == 4


def test_files_of_earlier_versions_have_neither_electrodes_nor_inclusions(tmp_path):
    arrays = {name: value for name, value in content().items() if not name.startswith(("electrode", "inclusion"))}
    np.savez(tmp_path / "image.npz", raster=np.zeros((4, 4)), extent=np.zeros(4), **arrays)
    image = read_image(tmp_path / "image.npz")
    assert (image.electrodes, image.inclusions) == (None, ())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"conductivity": None}, "no array 'conductivity'"),
        ({"conductivity": np.zeros(3)}, "there are .* cells"),
        ({"conductivity": np.full(TANK.num_cells, np.nan)}, "not finite"),
        ({"conductivity": np.full(TANK.num_cells, "a")}, "'conductivity' is an array"),
        ({"background": np.zeros(2)}, "one number"),
        ({"points": np.asarray(TANK.points)[:-1]}, "cells"),
        ({"electrode_sizes": np.array([32, 1])}, "whose corners"),
        ({"electrode_sizes": None}, "no array 'electrode_sizes'"),
        ({"electrode_sizes": np.array([65, -1])}, "whose corners"),
        ({"electrode_numbers": np.array([0, 7])}, "leave electrodes out"),
        ({"electrode_corners": np.full((64, 3), np.inf)}, "no places"),
        ({"inclusion_peaks": np.zeros(1)}, "do not belong together"),
        ({"inclusion_centroids": np.array(1.0)}, "do not belong together"),
        ({"points": np.asarray(TANK.points) + 0j}, "'points' is an array of complex128"),
        ({"inclusion_centroids": np.full((2, 3), np.nan)}, "not finite"),
        ({"departure": np.zeros(2)}, "'departure' is an array"),
        ({"images": np.zeros(2), "conductivity": None}, "many frames"),
    ],
)
def test_inconsistent_content_is_reported(changed, message, tmp_path):
    np.savez(tmp_path / "image.npz", **content(**changed))
    with pytest.raises(ValueError, match=rf"^image\.npz: .*{message}"):
        read_image(tmp_path / "image.npz")


def test_other_files_are_refused(tmp_path):
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(ValueError, match="not an image that jeit wrote"):
        read_image(tmp_path / "report.json")
    with pytest.raises(ValueError, match=r"is a folder; give the image\.npz"):
        read_image(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_image(tmp_path / "none.npz")


@pytest.fixture
def pictures(monkeypatch):
    """The figures that are written, by the names of their files, which stay empty."""
    written = {}

    def save(figure, path, **_):
        written[Path(path).name] = figure
        Path(path).touch()

    monkeypatch.setattr(Figure, "savefig", save)
    return written


def saved(folder, *given, **changed):
    np.savez(folder / "image.npz", **content(*given, **changed))
    return read_image(folder / "image.npz")


def extents(ax):
    """Width and height of the drawn body."""
    (drawn,) = [one for one in ax.collections if isinstance(one, PolyCollection)]
    return np.ptp(np.concatenate([path.vertices for path in drawn.get_paths()]), axis=0)


def place_of(ax, text):
    (found,) = [one.get_position() for one in ax.texts if one.get_text() == text]
    return found


def test_a_solid_is_drawn_from_four_sides(pictures, tmp_path):
    """Of a body of 100 × 80 × 60 mm the front shows width and height, and from above width and depth are seen. From the
    other side, left and right are exchanged."""
    image = replace(saved(tmp_path), electrodes=None)
    names = write_views(image, tmp_path / "out", camera=Camera(30, -20), slices=3, axis="y")
    assert names == tuple(pictures) == ("overview.png", "isosurfaces.png", "slices.png")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(names)
    views = {ax.get_title(): ax for ax in pictures["isosurfaces.png"].axes if ax.get_title()}
    angles, back, front, above = views
    assert angles == "azimuth 30°, elevation −20°"
    assert (back, front, above) == ("from the other side", "from the front", "from above")
    np.testing.assert_allclose(extents(views[front]), [0.1, 0.06], atol=1e-9)
    np.testing.assert_allclose(extents(views[above]), [0.1, 0.08], atol=1e-9)
    camera = Camera(30, -20)
    corners = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.04, 0.04) for z in (0.0, 0.06)])
    np.testing.assert_allclose(extents(views[angles]), np.ptp(camera.on_page(corners), axis=0), atol=1e-9)
    slices = [ax.get_title() for ax in pictures["slices.png"].axes if ax.get_title()]
    assert len(slices) == 3
    assert all(title.startswith("y = ") for title in slices)


def test_from_the_other_side_electrodes_change_places(pictures, tmp_path):
    """The numbers are at half the height of the body, and are seen from 25° above."""
    write_views(saved(tmp_path), tmp_path / "out", camera=Camera(-60, 25))
    first, back = pictures["isosurfaces.png"].axes[:2]
    for number in "12":
        (x, y), (other_x, other_y) = place_of(first, number), place_of(back, number)
        assert other_x == pytest.approx(-x)
        assert (y + other_y) / 2 == pytest.approx(0.03 * np.cos(np.radians(25)))
    assert place_of(first, "1")[0] > 0.02


def test_sections_of_a_solid_have_a_picture_of_their_own(pictures, tmp_path):
    planes = [Plane.at("x", 0.01), Plane.at("y", 0.02), Plane.at("z", 0.03)]
    names = write_views(saved(tmp_path), tmp_path / "out", planes=planes)
    assert names[-1] == "planes.png"
    panels = pictures["planes.png"].axes[:4]
    assert [ax.get_title() for ax in panels] == ["x = 10 mm", "y = 20 mm", "z = 30 mm", ""]
    assert not panels[3].axison
    with pytest.raises(ValueError, match="planes cut solids; this image is of a sheet"):
        write_views(saved(tmp_path, SHEET, ARCS, ()), tmp_path / "sheet", planes=planes)


def test_a_sheet_is_one_picture_with_its_electrodes(pictures, tmp_path):
    image = saved(tmp_path, SHEET, ARCS, ())
    assert write_views(image, tmp_path / "out") == ("image.png",)
    assert {"1", "2", "3", "4", "20 mm"} <= {text.get_text() for text in pictures["image.png"].axes[0].texts}
    write_views(replace(image, electrodes=None), tmp_path / "bare")
    assert "1" not in {text.get_text() for text in pictures["image.png"].axes[0].texts}


def test_iterative_images_are_drawn_as_factors_and_complex_ones_by_their_real_part(tmp_path):
    log = np.linspace(-1, 1, TANK.num_cells)
    for changed, expected, quantity in (
        ({}, np.linspace(-1e-3, 1e-3, TANK.num_cells), "Change of conductivity"),
        ({"departure": log}, log, "Conductivity over background"),
        ({"conductivity": log * (1 + 2j)}, log, "Change of conductivity σ"),
    ):
        values, scale = drawn_values(saved(tmp_path, **changed))
        np.testing.assert_array_equal(values, expected)
        assert scale.of(values, "S/m").label.startswith(quantity)
