"""Meshes written and read back, and meshes made by Gmsh."""

import importlib.util

import meshio
import numpy as np
import pytest

from jeit.mesh import Disk, Polygon, Rectangle, box, disk, from_gmsh, quality, read, rectangle, write

PLANE = rectangle(0.2, 0.1, num_points=60)
SOLID = box(0.2, 0.1, 0.05, cell_size=0.05)


@pytest.mark.parametrize("mesh", [PLANE, SOLID], ids=["2-D", "3-D"])
@pytest.mark.parametrize("ending", [".msh", ".vtu", ".vtk", ".inp"])
def test_round_trip(mesh, ending, tmp_path):
    write(mesh, tmp_path / f"mesh{ending}")
    back = read(tmp_path / f"mesh{ending}")
    np.testing.assert_allclose(back.points, mesh.points, rtol=1e-15, atol=1e-17)
    np.testing.assert_array_equal(back.cells, mesh.cells)
    np.testing.assert_array_equal(back.facets, mesh.facets)
    if ending == ".msh":
        assert back.tags.keys() == mesh.tags.keys()
        for name, index in mesh.tags.items():
            np.testing.assert_array_equal(back.tags[name], index)


def test_values_are_written(tmp_path):
    per_cell, per_node = np.arange(SOLID.num_cells, dtype=float), np.arange(3.0 * SOLID.num_points).reshape(-1, 3)
    write(SOLID, tmp_path / "mesh.vtu", cell_data={"conductivity": per_cell}, point_data={"field": per_node})
    content = meshio.read(tmp_path / "mesh.vtu")
    np.testing.assert_array_equal(content.cell_data["conductivity"][0], per_cell)
    np.testing.assert_array_equal(content.point_data["field"], per_node)
    write(PLANE, tmp_path / "mesh.msh", point_data={"potential": np.arange(PLANE.num_points)})
    np.testing.assert_array_equal(read(tmp_path / "mesh.msh").points, PLANE.points)


def test_units_unused_nodes_and_inner_groups_of_imported_meshes(tmp_path):
    points = np.array([[0.0, 0, 5], [100, 0, 5], [100, 100, 5], [0, 100, 5], [777, 0, 5]])
    lines = np.array([[0, 1], [1, 2], [0, 2]])
    content = meshio.Mesh(
        points,
        [("line", lines), ("triangle", [[0, 2, 1], [0, 2, 3]])],
        cell_data={
            "gmsh:physical": [np.array([7, 8, 9]), np.array([1, 1])],
            "gmsh:geometrical": [np.ones(3), np.ones(2)],
        },
        field_data={"electrode": np.array([7, 1]), "crack": np.array([9, 1])},
    )
    content.write(tmp_path / "plate.msh", file_format="gmsh22")
    mesh = read(tmp_path / "plate.msh", scale=1e-3)
    assert mesh.dimension == 2
    np.testing.assert_allclose(mesh.points, points[:4, :2] * 1e-3)
    assert set(mesh.tags) == {"electrode", "physical_8"}
    assert set(np.asarray(mesh.facets)[np.asarray(mesh.tags["electrode"])[0]].tolist()) == {0, 1}


def test_unreadable_files(tmp_path, capfd):
    with pytest.raises(FileNotFoundError, match="no file"):
        read(tmp_path / "absent.vtu")
    for name in ("mesh.vtu", "mesh.msh", "mesh.unknown"):
        (tmp_path / name).write_text("this is not a mesh")
        with pytest.raises(ValueError, match=r"does not work as a mesh file.*\.vtu"):
            read(tmp_path / name)
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5], [0, -1, 0]])
    for cells, message in (
        ([("quad", [[0, 1, 2, 3]])], "linear triangles or tetrahedra"),
        ([("triangle", [[0, 1, 2], [0, 1, 3], [0, 1, 4]])], "not manifold"),
        ([("triangle", [[0, 1, 2]]), ("quad", [[0, 1, 2, 3]])], "mixes in"),
    ):
        meshio.Mesh(points, cells).write(tmp_path / "other.vtk")
        with pytest.raises(ValueError, match=message):
            read(tmp_path / "other.vtk")
    write(PLANE, tmp_path / "good.vtu")
    with pytest.raises(ValueError, match="scale"):
        read(tmp_path / "good.vtu", scale=0.0)
    assert capfd.readouterr() == ("", "")


def test_unwritable_requests(tmp_path):
    with pytest.raises(ValueError, match="one value per cell"):
        write(PLANE, tmp_path / "mesh.vtu", cell_data={"conductivity": np.ones(3)})
    with pytest.raises(ValueError, match="complex"):
        write(PLANE, tmp_path / "mesh.vtu", point_data={"potential": 1j * np.ones(PLANE.num_points)})
    with pytest.raises(ValueError, match=r"\.vtu"):
        write(PLANE, tmp_path / "mesh.msh", cell_data={"conductivity": np.ones(PLANE.num_cells)})
    with pytest.raises(ValueError, match="does not work"):
        write(PLANE, tmp_path / "mesh.unknown")
    with pytest.raises(ValueError, match="folder"):
        write(PLANE, tmp_path / "absent" / "mesh.vtu")


@pytest.mark.skipif(importlib.util.find_spec("gmsh") is not None, reason="gmsh is installed")
def test_error_without_gmsh_says_what_to_install():
    with pytest.raises(ImportError, match=r"pip install 'jeit\[mesh\]'"):
        from_gmsh(Disk(0.1))


@pytest.mark.skipif(importlib.util.find_spec("gmsh") is None, reason='needs the extra "mesh" (the gmsh package)')
def test_gmsh_meshes_outlines_and_files(tmp_path):
    for domain in (
        Disk(0.1),
        Rectangle(0.2, 0.1),
        Polygon([[0, 0], [0.2, 0], [0.1, 0.2]], [[[0.09, 0.05], [0.11, 0.05], [0.1, 0.07]]]),
    ):
        mesh = from_gmsh(domain, cell_size=0.01)
        corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
        area = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 2
        assert area == pytest.approx(float(domain.area), rel=5e-3)
    path = tmp_path / "tank.geo"
    lines = [
        'SetFactory("OpenCASCADE");',
        "Cylinder(1) = {0, 0, 0, 0, 0, 50, 100};",
        'Physical Surface("lid") = {2};',
    ]
    path.write_text("\n".join(lines))
    tank = from_gmsh(path, cell_size=25, scale=1e-3, scripts=True)
    assert tank.dimension == 3
    assert set(tank.tags) == {"lid"}
    assert quality(tank).longest_edge.max() < 0.06
    path.write_text("nonsense {")
    with pytest.raises(ValueError, match="Gmsh could not"):
        from_gmsh(path, scripts=True)
    with pytest.raises(ValueError, match="no current model"):
        from_gmsh()


def test_writing_does_not_change_the_mesh(tmp_path):
    mesh = disk(0.1, num_points=50)
    write(mesh, tmp_path / "a.vtu", cell_data={"one": np.ones(mesh.num_cells)})
    assert not mesh.tags
