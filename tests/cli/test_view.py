"""`jeit view`: from a saved image to pictures from several sides."""

import sys

import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, FacePatches
from jeit.image import Inclusion
from jeit.layout import ring
from jeit.mesh import Mesh, box, centroids, disk, rectangle
from jeit.plot.solid import interactive
from jeit.report.saved_image import saved_extras

TANK = box(0.1, 0.08, 0.06, num_points=200)
PATCHES = FacePatches([[0.05, 0.0, 0.03], [-0.05, 0.0, 0.03]], 0.04, 0.04, 1e-3)
BALL = Inclusion(1, (0.02, 0.0, 0.03), 1e-5, 1e-3)


def save(path, mesh, values, extras=None, **others):
    arrays = {"conductivity": values, "background": 0.03, "points": np.asarray(mesh.points), "cells": mesh.cells}
    np.savez(path, **arrays, **(extras or {}), **others)
    return path


@pytest.fixture
def solid(tmp_path):
    place = np.asarray(centroids(TANK)) - BALL.centroid
    values = 1e-3 * np.exp(-np.sum(place**2, axis=1) / 0.02**2)
    return save(tmp_path / "image.npz", TANK, values, saved_extras(TANK, PATCHES, (BALL,)))


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")


@pytest.mark.slow
def test_a_solid_is_shown_from_several_sides(run, solid, tmp_path):
    status, output, error = run(
        "view", solid, "--output", tmp_path / "out", "--plane-mm", "x=20", "--plane-mm", "0,0,30/1,1,0",
        "--level", 0.3, "--level", 0.6, "--axis", "x", "--slices", 4, "--azimuth", 30,
    )  # fmt: skip
    assert (status, error) == (0, "")
    names = {"overview.png", "isosurfaces.png", "slices.png", "planes.png"}
    assert {one.name for one in (tmp_path / "out").iterdir()} == names
    assert all((tmp_path / "out" / name).stat().st_size > 20_000 for name in names)
    assert all(name in output for name in names)


def test_without_a_display_pictures_are_written_with_the_reason(run, solid, tmp_path):
    status, output, error = run("view", solid, "--slices", 1)
    assert (status, error) == (0, "")
    assert "pictures, not a window: " in output
    assert (tmp_path / "view" / "overview.png").is_file()
    assert not (tmp_path / "view" / "planes.png").exists()


def test_with_a_display_a_window_opens(run, solid, tmp_path, monkeypatch):
    shown = []

    class Window:
        def show(self):
            shown.append(True)

    monkeypatch.setattr(interactive, "can_view", lambda: "")
    monkeypatch.setattr(interactive, "view_solid", lambda mesh, values, electrodes, **marked: Window())
    assert run("view", solid) == (0, "", "")
    assert shown == [True]
    assert not (tmp_path / "view").exists()


@pytest.mark.slow
def test_a_sheet_an_iterative_and_a_complex_image(run, tmp_path):
    sheet = disk(0.05, num_points=200)
    values = np.where(np.asarray(centroids(sheet))[:, 0] > 0, 1e-3, -1e-3)
    arcs = saved_extras(sheet, BoundaryElectrodes(ring(0.05, 8), 0.01, 0.1), ())
    save(tmp_path / "image.npz", sheet, values, arcs)
    assert run("view", tmp_path / "image.npz", "-o", tmp_path / "sheet")[0] == 0
    assert [one.name for one in (tmp_path / "sheet").iterdir()] == ["image.png"]
    log = np.linspace(-1, 1, TANK.num_cells)
    for name, changed, extra in (("log", log, {"departure": log}), ("complex", log * (1 + 1j), {})):
        save(tmp_path / f"{name}.npz", TANK, changed, **extra)
        assert run("view", tmp_path / f"{name}.npz", "-o", tmp_path / name, "--slices", 1)[0] == 0
        assert (tmp_path / name / "overview.png").stat().st_size > 20_000


def test_a_skin_in_space(run, tmp_path):
    flat = rectangle(0.1, 0.06, num_points=200)
    x, y = np.asarray(flat.points).T
    skin = Mesh.create(np.stack([0.05 * np.sin(x / 0.05), y, 0.05 * np.cos(x / 0.05)], axis=1), flat.cells)
    save(tmp_path / "image.npz", skin, np.linspace(-1e-3, 1e-3, skin.num_cells))
    assert run("view", tmp_path / "image.npz", "-o", tmp_path / "out")[0] == 0
    assert [one.name for one in (tmp_path / "out").iterdir()] == ["surface.png"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--plane-mm", "w=3"), "--plane-mm must be such as z=20"),
        (("--plane-mm", "1,2/3"), "--plane-mm must be such as z=20"),
        (("--plane-mm", "z=900"), "jeit: --plane-mm z = 900 mm misses the body, which lies 840 mm behind it.\n"),
        (
            ("--level", "0.5", "--level", "2"),
            "--level must be shares of the strongest change, from 0 to 1; given were 0.5, 2",
        ),
        (("--elevation", "100"), "--elevation must lie between"),
        (("--slices", "0"), "--slices must be a number of slices from 1 to 64"),
        (("--axis", "w"), "--axis must be"),
    ],
)
def test_invalid_options(run, solid, tmp_path, arguments, message):
    status, _, error = run("view", solid, "-o", tmp_path / "out", *arguments)
    assert status == 1
    assert message in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_invalid_files(run, tmp_path):
    (tmp_path / "image.png").write_bytes(b"\x89PNG")
    for name, message in (("image.png", "not an image that jeit wrote"), ("none.npz", "No such file"), (".", "folder")):
        status, _, error = run("view", tmp_path / name)
        assert status == 1
        assert message in error
    others = {
        "frames.csv": "a table of data, which is to be imaged first",
        "image.vtu": "a file for ParaView",
        "image.PNG": "a picture, which any viewer shows",
        "tank.toml": "a description",
    }
    for name, kind in others.items():
        (tmp_path / name).write_text("1, 2, 3")
        message = (
            f"{name}: not an image that jeit wrote, but {kind}; give the image.npz that jeit reconstruct writes.\n"
        )
        assert run("view", tmp_path / name)[2].endswith(message)
    np.savez(tmp_path / "frames.npz", voltages=np.ones((3, 4)))
    assert "it holds voltages, and no image" in run("view", tmp_path / "frames.npz")[2]
    np.savez(tmp_path / "series.npz", changes=np.ones((3, 4)), functional=np.ones(4), points=1, cells=1)
    assert "it holds many frames; give the image.npz of one" in run("view", tmp_path / "series.npz")[2]
    flat = save(tmp_path / "flat.npz", disk(0.05, num_points=60), np.zeros(disk(0.05, num_points=60).num_cells))
    assert "planes cut solids" in run("view", flat, "-o", tmp_path / "out", "--plane-mm", "z=1")[2]
