"""Rasters: orientation, extent, and which pixel lies in which cell."""

import numpy as np
import pytest

from jeit.image import Raster
from jeit.mesh import box, centroids, cylinder, disk, measures, rectangle


def test_row_zero_is_at_the_top_and_column_zero_at_the_left():
    mesh = rectangle(0.2, 0.1, num_points=400)
    centre = np.asarray(centroids(mesh))
    raster = Raster.create(mesh, shape=(40, 80))
    x, y = np.asarray(raster.sample(centre[:, 0])), np.asarray(raster.sample(centre[:, 1]))
    inside = np.isfinite(x)
    pixel = raster.pixel_centres()
    largest = np.sqrt(np.asarray(measures(mesh)).max())
    assert np.abs(x - pixel[..., 0])[inside].max() < largest
    assert np.abs(y - pixel[..., 1])[inside].max() < largest
    assert pixel[0, 0, 1] > pixel[-1, 0, 1]
    assert pixel[0, 0, 0] < pixel[0, -1, 0]


def test_pixels_outside_are_nan_and_the_area_inside_is_correct():
    mesh = disk(0.1, num_points=800)
    raster = Raster.create(mesh)
    assert raster.extent == pytest.approx((-0.1, 0.1, -0.1, 0.1))
    values = np.asarray(raster.sample(np.ones(mesh.num_cells)))
    assert values.shape == (256, 256)
    assert np.isnan(values[0, 0])
    # A pixel is 0.6 % of the diameter, and the staircase at the edge averages out.
    assert np.isfinite(values).sum() * raster.pixel_area == pytest.approx(float(measures(mesh).sum()), rel=2e-3)


def test_every_pixel_lies_in_its_cell():
    mesh = disk(0.1, num_points=300)
    raster = Raster.create(mesh, shape=(64, 64))
    cell = np.asarray(raster.cell).ravel()
    inside = cell >= 0
    corners = np.asarray(mesh.points)[np.asarray(mesh.cells)[cell[inside]]]
    local = np.linalg.solve(
        np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2),
        (raster.pixel_centres().reshape(-1, 2)[inside] - corners[:, 0])[..., None],
    )[..., 0]
    assert local.min() > -1e-8
    assert local.sum(axis=1).max() < 1 + 1e-8


def test_every_pixel_of_a_slice_lies_in_its_cell():
    """And every pixel within the mesh has a cell, also in an extent that the mesh fills in part."""
    mesh = cylinder(0.1, 0.05, cell_size=0.03)
    raster = Raster.create(mesh, shape=(30, 40), extent=(-0.2, 0.1, 0.0, 0.2), height=0.02)
    cell, pixel = np.asarray(raster.cell).ravel(), raster.pixel_centres().reshape(-1, 2)
    distance, inside = np.hypot(*pixel.T), cell >= 0
    assert inside[distance < 0.09].all()
    assert not inside[distance > 0.1].any()
    corners = np.asarray(mesh.points)[np.asarray(mesh.cells)[cell[inside]]]
    places = np.column_stack([pixel[inside], np.full(inside.sum(), 0.02)])
    local = np.linalg.solve(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2), (places - corners[:, 0])[..., None])[
        ..., 0
    ]
    assert local.min() > -1e-8
    assert local.sum(axis=1).max() < 1 + 1e-8


def test_slice_through_a_box():
    mesh = box(0.2, 0.2, 0.1, num_points=500)
    raster = Raster.create(mesh, shape=(16, 16))
    assert (np.asarray(raster.cell) >= 0).all()
    batch = raster.sample(np.ones((3, mesh.num_cells)))
    assert batch.shape == (3, 16, 16)
