"""Files for other visualisation programs: read back unchanged, and written completely or not at all."""

import xml.etree.ElementTree as Tree

import meshio
import numpy as np
import pytest

from jeit.electrodes import CombinedElectrodes, FaceDiscs, FacePatches, PointElectrodes, SheetDiscs, plates
from jeit.mesh import box, disk
from jeit.report import write_vtk_series, write_vtu, write_xdmf
from jeit.report.volume_files import electrode_of_nodes

TIMES = [0.0, 0.1, 0.25]


@pytest.fixture(scope="module")
def tank():
    return box(0.1, 0.08, 0.06, num_points=400)


@pytest.fixture(scope="module")
def frames(tank):
    return np.random.default_rng(3).normal(size=(len(TIMES), tank.num_cells))


def test_one_file_holds_the_image_and_the_electrode_positions(tank, frames, tmp_path):
    electrodes = plates(tank, ["left", "top"], 1e-3)
    heat = np.arange(tank.num_points) * 0.5
    write_vtu(
        tmp_path / "image.vtu",
        tank,
        {"change": frames[0], "admittivity": frames[1] + 1j * frames[2]},
        point_data={"heat": heat},
        electrodes=electrodes,
    )
    assert [one.name for one in tmp_path.iterdir()] == ["image.vtu"]
    read = meshio.read(tmp_path / "image.vtu")
    np.testing.assert_array_equal(read.points, tank.points)
    np.testing.assert_array_equal(read.cells_dict["tetra"], tank.cells)
    np.testing.assert_array_equal(read.cell_data["change"][0], frames[0])
    np.testing.assert_array_equal(read.cell_data["admittivity, real"][0], frames[1])
    np.testing.assert_array_equal(read.cell_data["admittivity, imaginary"][0], frames[2])
    np.testing.assert_array_equal(read.point_data["heat"], heat)
    under = read.point_data["electrode"]
    assert set(under) == {0, 1, 2}
    left = np.asarray(tank.points)[:, 0] < -0.05 + 1e-9
    inner = left & (np.asarray(tank.points)[:, 2] < 0.06 - 1e-9)
    np.testing.assert_array_equal(under[inner], 1)
    np.testing.assert_array_equal(under[~left & (np.asarray(tank.points)[:, 2] > 0.06 - 1e-9)], 2)


@pytest.mark.parametrize("kind", ["discs", "patches", "points", "combined"])
def test_nodes_under_electrodes_are_near_them(tank, kind):
    places = np.array([[0.05, 0.0, 0.03], [-0.05, 0.01, 0.03]])
    electrodes = {
        "discs": FaceDiscs(places, 0.02, 1e-3),
        "patches": FacePatches(places, 0.04, 0.04, 1e-3),
        "points": PointElectrodes(places),
        "combined": CombinedElectrodes(FaceDiscs(places[:1], 0.02, 10), FacePatches(places[1:], 0.04, 0.04, 1e-3)),
    }[kind]
    under = electrode_of_nodes(tank, electrodes)
    for number, place in enumerate(places, start=1):
        nodes = np.asarray(tank.points)[under == number]
        assert len(nodes)
        assert np.linalg.norm(nodes - place, axis=1).max() < 0.035
        np.testing.assert_allclose(nodes[:, 0], place[0])


def test_nodes_under_discs_on_a_sheet_are_those_within_their_radius():
    sheet = disk(0.05, num_points=400)
    places = np.array([[0.02, 0.0], [-0.01, 0.02]])
    under = electrode_of_nodes(sheet, SheetDiscs(places, 0.012, [1e-3, 10.0]))
    for number, place in enumerate(places, start=1):
        distance = np.linalg.norm(np.asarray(sheet.points) - place, axis=1)
        assert (under[distance < 0.011] == number).all()
        assert (under[distance > 0.016] != number).all()


def test_a_series_has_one_file_per_frame_and_an_index(tank, frames, tmp_path):
    write_vtk_series(tmp_path / "breath.pvd", tank, TIMES, {"change": frames})
    sets = list(Tree.parse(tmp_path / "breath.pvd").iter("DataSet"))
    assert [float(one.attrib["timestep"]) for one in sets] == TIMES
    for one, values in zip(sets, frames, strict=True):
        read = meshio.read(tmp_path / one.attrib["file"])
        np.testing.assert_array_equal(read.cell_data["change"][0], values)
    assert len(list(tmp_path.iterdir())) == 1 + len(TIMES)


@pytest.mark.parametrize("body", ["solid", "sheet"])
def test_xdmf_is_one_file_with_all_frames(tank, body, tmp_path):
    mesh = tank if body == "solid" else disk(0.05, num_points=100)
    values = np.random.default_rng(1).normal(size=(len(TIMES), mesh.num_cells))
    write_xdmf(tmp_path / "breath.xdmf", mesh, TIMES, {"change": values})
    assert [one.name for one in tmp_path.iterdir()] == ["breath.xdmf"]
    with meshio.xdmf.TimeSeriesReader(tmp_path / "breath.xdmf") as read:
        points, cells = read.read_points_cells()
        np.testing.assert_array_equal(points[:, : mesh.points.shape[1]], mesh.points)
        np.testing.assert_array_equal(cells[0].data, mesh.cells)
        assert read.num_steps == len(TIMES)
        for k, time in enumerate(TIMES):
            stored, _, data = read.read_data(k)
            assert stored == time
            np.testing.assert_array_equal(data["change"][0], values[k])


def test_inconsistent_input_is_reported_and_leaves_no_file(tank, frames, tmp_path):
    wrong = {
        "must end in .vtu": lambda: write_vtu(tmp_path / "a.vtk", tank, {"change": frames[0]}),
        "one value per cell": lambda: write_vtu(tmp_path / "a.vtu", tank, {"change": frames[0][1:]}),
        "must end in .pvd": lambda: write_vtk_series(tmp_path / "a.vtu", tank, TIMES, {"change": frames}),
        "times must be": lambda: write_vtk_series(tmp_path / "a.pvd", tank, ["now"], {"change": frames}),
        "times must rise": lambda: write_vtk_series(tmp_path / "a.pvd", tank, [0, 0, 1], {"change": frames}),
        "has shape": lambda: write_xdmf(tmp_path / "a.xdmf", tank, TIMES, {"change": frames[:2]}),
        "cell_data is empty": lambda: write_xdmf(tmp_path / "a.xdmf", tank, TIMES, {}),
        "must end in .xdmf": lambda: write_xdmf(tmp_path / "a.h5", tank, TIMES, {"change": frames}),
    }
    for message, write in wrong.items():
        with pytest.raises(ValueError, match=message):
            write()
    assert list(tmp_path.iterdir()) == []
