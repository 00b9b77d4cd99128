"""Surface meshes from files, such as scans and CAD, and faulty files."""

import importlib.util
import struct

import meshio
import numpy as np
import pytest

from jeit.mesh import bend, cap, from_gmsh, measures, normals, read, rectangle, sphere, surface_of, tube, write

SLEEVE = tube(0.04, 0.1, num_points=120)
BALL = sphere(0.05, num_points=100)


def binary_stl(path, mesh, scale):
    corners = scale * np.asarray(mesh.points)[np.asarray(mesh.cells)]
    with path.open("wb") as file:
        file.write(b"solid, as many binary files begin".ljust(80) + struct.pack("<I", len(corners)))
        for normal, triangle in zip(np.asarray(normals(mesh)), corners, strict=True):
            file.write(np.concatenate([normal, triangle.ravel()]).astype("<f4").tobytes() + b"\0\0")


def ascii_stl(path, mesh, scale):
    lines = ["solid arm"]
    for triangle in scale * np.asarray(mesh.points)[np.asarray(mesh.cells)]:
        lines += ["facet normal 0 0 0", "outer loop", *(f"vertex {x:.6e} {y:.6e} {z:.6e}" for x, y, z in triangle)]
        lines += ["endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid arm"]))


def unconnected_obj(path, mesh, scale):
    """Write every triangle with corners of its own, with colours, texture and normals."""
    lines = ["# a scan", "o arm", "vt 0 0", "vn 0 0 1"]
    corners = scale * np.asarray(mesh.points)[np.asarray(mesh.cells)]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g} 0.5 0.5 0.5" for x, y, z in corners.reshape(-1, 3)]
    lines += [f"f {3 * k + 1}/1/1 {3 * k + 2}/1/1 {3 * k + 3}/1/1" for k in range(len(corners))]
    path.write_text("\n".join(lines))


@pytest.mark.parametrize("mesh", [SLEEVE, BALL], ids=["open", "closed"])
@pytest.mark.parametrize(
    ("name", "writer"),
    [("a.stl", binary_stl), ("a.STL", ascii_stl), ("a.obj", unconnected_obj)],
    ids=["binary", "text", "obj"],
)
def test_unconnected_triangles_become_a_surface(mesh, name, writer, tmp_path):
    writer(tmp_path / name, mesh, 1000)
    back = read(tmp_path / name, scale=1e-3)
    assert (back.num_points, back.num_cells, back.num_facets) == (mesh.num_points, mesh.num_cells, mesh.num_facets)
    assert back.is_surface
    np.testing.assert_allclose(measures(back).sum(), measures(mesh).sum(), rtol=1e-5)
    # Both are oriented outward, the open one by its file.
    np.testing.assert_allclose(np.asarray(normals(back)), np.asarray(normals(mesh)), atol=1e-4)


@pytest.mark.parametrize("ending", [".msh", ".vtu", ".vtk", ".inp"])
def test_round_trip(ending, tmp_path):
    write(SLEEVE, tmp_path / f"arm{ending}", point_data={"height": np.asarray(SLEEVE.points)[:, 2]})
    back = read(tmp_path / f"arm{ending}")
    np.testing.assert_allclose(back.points, SLEEVE.points, rtol=1e-15, atol=1e-17)
    np.testing.assert_array_equal(back.cells, SLEEVE.cells)
    np.testing.assert_array_equal(back.facets, SLEEVE.facets)
    if ending == ".msh":
        for name, index in SLEEVE.tags.items():
            np.testing.assert_array_equal(back.tags[name], index)


def test_a_flat_sheet_becomes_two_dimensional_only_at_constant_z(tmp_path):
    flat = bend(rectangle(0.2, 0.1, num_points=60), np.inf, axis="x")
    write(flat, tmp_path / "flat.vtu")
    assert not read(tmp_path / "flat.vtu").is_surface
    upright = meshio.Mesh(np.asarray(flat.points)[:, [2, 0, 1]], [("triangle", np.asarray(flat.cells))])
    upright.write(tmp_path / "upright.vtu")
    assert read(tmp_path / "upright.vtu").is_surface


def test_faults_of_files(tmp_path):
    binary_stl(tmp_path / "arm.stl", SLEEVE, 1000)
    with pytest.warns(UserWarning, match=r"millimetres.*inches.*scale="):
        read(tmp_path / "arm.stl")
    inside_out = np.asarray(BALL.points)[np.asarray(BALL.cells)[:, ::-1]]
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in inside_out.reshape(-1, 3)]
    lines += [f"f {3 * k + 1} {3 * k + 2} {3 * k + 3}" for k in range(len(inside_out))]
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    with pytest.warns(UserWarning, match="inside out"):
        read(tmp_path / "ball.obj")
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 1\nv 0 1 1\n"
    for text, match in {
        "f 1 2 9": "names vertex 9, and there are 4",
        "f 0 1 2": "names vertex 0",
        "f -5 -2 -1": "names vertex -5, and 4 came before",
        "f 1 2 x": "does not work as a mesh file: invalid literal",
        "v 1 2": "a vertex has not three",
        "v 1 2 nan\nf 1 2 5": "no finite number",
        "l 1 2": "no triangles",
    }.items():
        (tmp_path / "bad.obj").write_text(corners + text)
        with pytest.raises(ValueError, match=match):
            read(tmp_path / "bad.obj")
    (tmp_path / "bad.obj").write_text("v 0 0 0\n" * 6 + "f 1 2 3\nf 4 5 6\n")
    with pytest.raises(
        ValueError, match=r"no triangle in it has an area. All .* within 0 of \[0.0, 0.0, 0.0\].*scale="
    ):
        read(tmp_path / "bad.obj")
    for text, match in {
        "solid nothing\nendsolid nothing\n": "no triangles",
        "something else": "neither a text",
        "solid\nvertex 1 2 3\nvertex 1 2 4": "not three vertices",
        "solid\nvertex 1 2 3\nvertex 1 2 4\nvertex 1 2 ?": "could not convert",
    }.items():
        (tmp_path / "bad.stl").write_text(text)
        with pytest.raises(ValueError, match=match):
            read(tmp_path / "bad.stl")


def test_polygons_and_negative_indices(tmp_path):
    (tmp_path / "quad.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 1\nv 0 1 1\nf -4// -3// -2// \\\n -1//\n")
    mesh = read(tmp_path / "quad.obj")
    assert float(measures(mesh).sum()) == pytest.approx(np.sqrt(2))


@pytest.mark.skipif(importlib.util.find_spec("gmsh") is None, reason='needs the extra "mesh" (the gmsh package)')
def test_cad_files_through_gmsh(tmp_path):
    import gmsh

    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.model.add("part")
    gmsh.model.occ.addCylinder(0, 0, 0, 0, 0, 100, 40)
    gmsh.model.occ.synchronize()
    gmsh.write(str(tmp_path / "part.step"))
    gmsh.finalize()
    surface = from_gmsh(tmp_path / "part.step", cell_size=10, dimension=2, scale=1e-3)
    assert surface.is_surface
    assert surface.num_facets == 0
    whole = 2 * np.pi * 0.04 * (0.1 + 0.04)
    assert float(measures(surface).sum()) == pytest.approx(whole, rel=0.02)
    solid = from_gmsh(tmp_path / "part.step", cell_size=10, scale=1e-3)
    assert solid.dimension == 3
    assert float(measures(surface_of(solid)).sum()) == pytest.approx(whole, rel=0.02)
    (tmp_path / "broken.step").write_text("ISO-10303-21;")
    with pytest.raises(ValueError, match=r"could not mesh the geometry: Could not read file 'broken\.step'"):
        from_gmsh(tmp_path / "broken.step", dimension=2)
    write(cap(0.05, 1.0, num_points=200), tmp_path / "cap.stl")
    assert from_gmsh(tmp_path / "cap.stl").is_surface
