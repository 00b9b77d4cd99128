"""Curved skins from TOML files, described and swept: equal to those from Python, with errors raised before anything
runs.
"""

import importlib.util
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest

from jeit.design import Skin, read_described_skin, touch_grid
from jeit.design.reports.study import draw_maps
from jeit.design.study import open_results, read_study, run_study
from jeit.design.study.batch import check_points
from jeit.layout import SurfaceLayout, read_surface_layout, write_layout
from jeit.mesh import forearm, measures, sphere, tube, write
from jeit.mesh.checks import size_checked
from jeit.mesh.geodesic import Triangles

TUBE = 'kind = "tube"\nradius_mm = 30\nheight_mm = 80'
SKIN = f'[surface]\n{TUBE}\n[electrodes]\nlayout = "inner-8"\ndiameter_mm = 10\n[mesh]\ncell_mm = 8\n'
STUDY = f"""
[skin]
thickness_mm = [5, 8]
[surface]
{TUBE}
[electrodes]
layouts = "inner-8"
diameter_mm = 10
[measurement]
protocol = "adjacent"
[touch]
columns = 4
rows = 4
[mesh]
cell_mm = 8
"""
SURFACES = {
    "tube": TUBE,
    "forearm": 'kind = "forearm"\nlength_mm = 120\nwrist_mm = [30, 20]\nelbow_mm = 45',
    "sphere": 'kind = "sphere"\nradius_mm = 40',
    "cap": 'kind = "cap"\nradius_mm = 50\nangle_degrees = 70',
    "bent sheet": 'kind = "bent sheet"\nwidth_mm = 120\nheight_mm = 80\nradius_mm = 40',
    "inward": f"{TUBE}\noutward = false",
}


@pytest.fixture
def described(tmp_path):
    def call(text, read=read_described_skin):
        (tmp_path / "skin.toml").write_text(text, "utf-8")
        return read(tmp_path / "skin.toml")

    return call


def test_a_described_tube_equals_that_from_python(described):
    skin = described(SKIN + '[skin]\nmodel = "layer"\nthickness_mm = 6\n')
    surface = tube(0.03, 0.08, cell_size=8e-3)
    layout = SurfaceLayout.spread(surface, 8, np.full(8, 0.01))
    own = Skin.create(layout, thickness=6e-3, num_layers=5)
    np.testing.assert_allclose(skin.layout.centres, layout.centres, atol=1e-12)
    np.testing.assert_allclose(skin.model.mesh.points, own.model.mesh.points, atol=1e-12)
    np.testing.assert_array_equal(skin.model.protocol.drive, own.model.protocol.drive)


@pytest.mark.parametrize("name", SURFACES)
def test_every_kind_of_surface_is_constructed(described, name):
    skin = described(SKIN.replace(TUBE, SURFACES[name]))
    assert isinstance(skin.layout, SurfaceLayout)
    assert skin.layout.outward == (name != "inward")
    assert skin.model.mesh.is_surface
    surface = Triangles.of(skin.layout.surface)
    sizes = {"sphere": 4 * np.pi * 0.04**2, "cap": 2 * np.pi * 0.05**2 * (1 - np.cos(np.deg2rad(70)))}
    area = {"forearm": None, "bent sheet": 0.12 * 0.08, **sizes}.get(name, 2 * np.pi * 0.03 * 0.08)
    if area is not None:
        assert surface.areas.sum() == pytest.approx(area, rel=0.03)


def test_a_scan_is_read_in_its_unit_with_its_own_cells(described, tmp_path):
    arm = forearm(0.12, (0.03, 0.02), 0.045, num_points=400)
    write(arm, tmp_path / "arm.stl")
    text = SKIN.replace(TUBE, 'file = "arm.stl"\nunit = "m"').replace("[mesh]\ncell_mm = 8\n", "")
    assert described(text).model.mesh.num_points == arm.num_points
    tenth = text.replace('unit = "m"', 'unit = "cm"')
    with pytest.raises(ValueError, match=r"skin.toml: .*large|small|metres|mm"):
        described(tenth)
    study = described(text.replace("layout =", "layouts ="), read_study)
    (cell,) = {point.cell_size for point in study.points}
    edges = np.asarray(arm.points)[np.asarray(arm.cells)[:, :2]]
    assert cell == pytest.approx(np.linalg.norm(np.diff(edges, axis=1), axis=-1).mean(), rel=0.2)
    write(forearm(0.12, (0.03, 0.02), 0.046, num_points=400), tmp_path / "arm.stl")
    assert described(text.replace("layout =", "layouts ="), read_study) != study


@pytest.mark.parametrize("kind", ["layout", "layouts"])
@pytest.mark.parametrize(("of_file", "given", "across"), [("mm", "m", "120 m"), ("m", "mm", "0.12 mm")])
def test_a_scan_in_another_unit_is_read_by_its_key(described, tmp_path, kind, of_file, given, across):
    length = {"mm": 120.0, "m": 0.12}[of_file]
    with size_checked():
        write(forearm(length, (length / 4, length / 6), length / 3, num_points=400), tmp_path / "arm.stl")
    text = SKIN.replace(TUBE, f'file = "arm.stl"\nunit = "{given}"').replace("[mesh]\ncell_mm = 8\n", "")
    message = rf'^skin\.toml: surface\.unit: in "{given}" the skin would be {across} across; give "{of_file}", in which'
    with pytest.raises(ValueError, match=message):
        described(text.replace("layout =", f"{kind} ="), read_described_skin if kind == "layout" else read_study)


STEP = 'file = "part.STEP"\nunit = "mm"'


@pytest.mark.skipif(importlib.util.find_spec("gmsh") is None, reason='needs the extra "mesh" (the gmsh package)')
def test_a_cad_file_is_meshed_with_the_cell_size_of_the_table(described, tmp_path):
    import gmsh

    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.model.add("part")
    gmsh.model.occ.addCylinder(0, 0, 0, 0, 0, 80, 30)
    gmsh.model.occ.synchronize()
    gmsh.write(str(tmp_path / "part.step"))
    gmsh.finalize()
    (tmp_path / "part.step").rename(tmp_path / "part.STEP")
    text = SKIN.replace(TUBE, STEP)
    coarse, fine = (described(text.replace("cell_mm = 8", f"cell_mm = {size}")).model.mesh for size in (10, 6))
    assert coarse.is_surface
    assert fine.num_cells > 2 * coarse.num_cells
    assert float(np.sum(measures(fine))) == pytest.approx(2 * np.pi * 0.03 * (0.08 + 0.03), rel=0.02)
    study = described(text.replace("layout =", "layouts =").replace("cell_mm = 8", "cell_mm = [6, 10]"), read_study)
    assert {point.cell_size for point in study.points} == {6e-3, 10e-3}


@pytest.mark.parametrize("kind", ["layout", "layouts"])
def test_a_cad_file_without_gmsh_names_the_package_to_install(described, tmp_path, monkeypatch, kind):
    (tmp_path / "part.STEP").write_text("ISO-10303-21;")
    monkeypatch.setitem(sys.modules, "gmsh", None)
    read = read_described_skin if kind == "layout" else read_study
    with pytest.raises(ImportError, match=r"pip install 'jeit\[mesh\]'"):
        described(SKIN.replace(TUBE, STEP).replace("layout =", f"{kind} ="), read)


def test_electrodes_by_position(described, tmp_path):
    given = SurfaceLayout.spread(tube(0.03, 0.08, cell_size=8e-3), 6, 9e-3, contact_impedance=2e-4, name="mine")
    write_layout(given, tmp_path / "mine.csv")
    again = read_surface_layout(tmp_path / "mine.csv", given.surface)
    np.testing.assert_allclose(again.centres, given.centres, atol=1e-11)
    skin = described(SKIN.replace("inner-8", "mine.csv").replace("diameter_mm = 10\n", ""))
    np.testing.assert_allclose(skin.layout.centres, given.centres, atol=1e-11)
    np.testing.assert_allclose(skin.layout.diameters, 9e-3)
    np.testing.assert_allclose(skin.model.electrodes.contact_impedance, 2e-4)
    with pytest.raises(ValueError, match=r"drawings are flat, and 'mine' is of a curved skin"):
        write_layout(given, tmp_path / "mine.svg")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('"tube"', '"torus"', r"surface\.kind must be one of tube, forearm, sphere, cap, bent sheet; it is 'torus'"),
        ('kind = "tube"\n', "", r"surface\.kind is missing; give it, one of tube, .*, or file"),
        ("radius_mm = 30", "radius_mm = 0.03", r"surface\.radius_mm is 0\.03, and must be .* metres\? Then write 30"),
        ("radius_mm = 30\n", "", r"surface\.radius_mm is missing"),
        ("radius_mm = 30", "radius_mm = 30\nwrist_mm = 20", r"surface\.wrist_mm is no key of a tube"),
        (f"[surface]\n{TUBE}", "surface = 3", "surface must be a table"),
        (
            "[surface]",
            "[skin]\nwidth_mm = 100\nheight_mm = 80\n[surface]",
            r"skin\.height_mm has no effect: the table surface says",
        ),
        ("[surface]", "[skin]\nwidth_mm = 100\n[surface]", r"skin\.width_mm has no effect: the table surface says"),
        (TUBE, 'file = "arm.stl"\nunit = "mm"', r"mesh\.cell_mm has no effect"),
        (TUBE, 'file = "arm.stl"', r"surface\.unit is missing"),
        (f"{TUBE}\n", 'file = "no.stl"\nunit = "mm"\n', "surface: .*no file"),
        (
            TUBE,
            'kind = "bent sheet"\nwidth_mm = 120\nheight_mm = 80\nradius_mm = 15',
            "surface: .*would overlap itself",
        ),
        ("inner-8", "grid-4x2", r"electrodes\.layouts: 'grid-4x2': a curved skin has inner-N.*or a \.csv file"),
        ("inner-8", "no.csv", r"electrodes\.layouts: 'no\.csv': .*no file"),
        ("inner-8", "flat.csv", r"electrodes\.layouts: 'flat\.csv': .*there is no column z_mm"),
        (
            'inner-8"\ndiameter_mm = 10',
            'inner-20"\ndiameter_mm = 40',
            r"electrodes\.layouts: 'inner-20': .*overlap|no room",
        ),
    ],
)
@pytest.mark.parametrize("kind", ["layout", "layouts"])
def test_errors_name_their_key(described, tmp_path, kind, old, new, match):
    (tmp_path / "flat.csv").write_text("x_mm,y_mm,diameter_mm\n0,0,6\n", "utf-8")
    text = SKIN.replace("layout =", f"{kind} =")
    assert old in text
    text = text.replace(old, new)
    if "no.stl" in text:
        text = text.replace("[mesh]\ncell_mm = 8\n", "")
    with pytest.raises(ValueError, match=match) as message:
        described(text, read_described_skin if kind == "layout" else read_study)
    assert len(str(message.value)) <= 400
    assert str(message.value).startswith("skin.toml: ")


def test_a_study_of_a_layer_reports_where_it_is_too_thick(described):
    study = described(STUDY.replace("[skin]\nthickness_mm = [5, 8]", '[skin]\nmodel = "layer"\nthickness_mm = 45')
                      .replace(TUBE, f"{TUBE}\noutward = false"), read_study)  # fmt: skip
    with pytest.raises(ValueError, match=r"skin\.thickness_mm = 45.*radius of curvature"):
        check_points(study)


def test_gaps_are_along_the_surface(described):
    narrow = STUDY.replace("diameter_mm = 10", "diameter_mm = 10\nminimum_gap_mm = 60")
    with pytest.raises(ValueError, match=r"minimum_gap_mm is 60.*an impossible spacing"):
        described(narrow, read_study)


@pytest.mark.slow
@pytest.mark.parametrize("exact", [True, False], ids=["exact", "linear"])
def test_a_study_is_run_and_drawn_unrolled(described, tmp_path, exact):
    pytest.importorskip("xarray")
    coarse = STUDY.replace("inner-8", "inner-4").replace("diameter_mm = 10", "diameter_mm = 24")
    coarse = coarse.replace("cell_mm = 8", "cell_mm = 12").replace(
        "rows = 4", f"rows = 4\nexact = {str(exact).lower()}"
    )
    study = described(coarse, read_study)
    with run_study(study, tmp_path / "study.zarr") as data:
        assert data.sensitivity.shape == (2, 16)
        radius = np.hypot(data.x_mm, data.y_mm)
        assert ((radius > 27) & (radius < 30.1)).all()
        assert float(data.z_mm.min()) > 0
    layout = study.points[0].layout
    skin = Skin.create(
        layout, thickness=5e-3, num_layers=0, protocol=study.points[0].measurement_protocol(study.current)
    )
    changes = skin.voltage_changes(skin.touched_cells(touch_grid(skin.outline, 4, 4).places), linear=not exact)
    with open_results(study, tmp_path / "study.zarr") as data:
        np.testing.assert_allclose(data.sensitivity[0], np.linalg.norm(changes, axis=1), rtol=1e-9)
        figure = draw_maps(study, data)
    axes = figure.axes[0]
    assert axes.dataLim.width == pytest.approx(2 * np.pi * 30, rel=0.02)
    assert axes.dataLim.height == pytest.approx(80, rel=0.02)
    plt.close(figure)


def test_places_on_a_layer_are_above_those_on_its_core(described):
    study = described(STUDY, read_study)
    grid = touch_grid(study.outline, 4, 4)
    inner = Triangles.of(tube(0.03, 0.08, num_around=24))
    outer = Triangles(inner.points * [1.2, 1.2, 1], inner.cells)
    raised = grid.on(inner, outer)
    np.testing.assert_allclose(raised.places[:, :2], 1.2 * grid.places[:, :2], rtol=1e-2, atol=1e-6)
    assert raised.areas.sum() == pytest.approx(1.2 * grid.areas.sum(), rel=0.02)


def test_a_sphere_has_places_everywhere(described):
    text = STUDY.replace(TUBE, SURFACES["sphere"])
    study = described(text, read_study)
    assert isinstance(study.outline, Triangles)
    assert study.outline.areas.sum() == pytest.approx(Triangles.of(sphere(0.04, cell_size=8e-3)).areas.sum())
