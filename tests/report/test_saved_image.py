"""Saved images are read back unchanged, and other files are refused with the reason."""

import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, FacePatches
from jeit.image import Inclusion, SolidForm
from jeit.layout import ring
from jeit.mesh import box, disk
from jeit.report import read_image
from jeit.report.saved_image import saved_extras

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
