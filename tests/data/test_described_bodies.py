"""Descriptions of solids and of the user's own meshes, from TOML to the electrodes on them."""

import numpy as np
import pytest

from jeit.data import Measurement, read, screen, write_table
from jeit.data.description import parse_description
from jeit.electrodes import BoundaryElectrodes, FaceDiscs, FacePatches, FacetElectrodes, PointElectrodes
from jeit.inverse import Uncertainty
from jeit.layout import perimeter, ring
from jeit.mesh import Disk, Mesh, OwnMesh, Polygon, Rectangle, Solid, cylinder, write
from jeit.protocol import adjacent

RING = {"kind": "disc", "layout": "ring", "number": 8, "levels": [0.02], "radius": 0.005, "contact_impedance": 1e-3}
CYLINDER = {"shape": "cylinder", "radius": 0.05, "height": 0.04}
SQUARE = [[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]]


def described(geometry, electrodes=RING, folder="."):
    electrodes = {} if electrodes is None else {"electrodes": electrodes}
    return parse_description({"geometry": geometry, **electrodes}, "d.toml", folder)


def test_a_cylinder_with_a_ring_of_discs():
    found = described(CYLINDER)
    assert found.domain.describe() == {"shape": "disk", "radius": 0.05, "centre": [0.0, 0.0], "thickness": 0.04}
    mesh = found.domain.mesh(num_points=2000)
    assert mesh.num_points == pytest.approx(2000, rel=0.1)
    np.testing.assert_allclose(np.ptp(np.asarray(mesh.points), axis=0), [0.1, 0.1, 0.04], rtol=1e-3)
    assert isinstance(found.electrodes, FaceDiscs)
    np.testing.assert_allclose(found.electrodes.position, ring(0.05, 8, height=0.02), atol=1e-12)
    found.electrodes.check(mesh)


def test_one_level_may_be_a_number_or_a_list_of_one():
    as_number, as_list = described(CYLINDER, RING | {"levels": 0.03}), described(CYLINDER, RING | {"levels": [0.03]})
    np.testing.assert_array_equal(as_number.electrodes.position, as_list.electrodes.position)
    assert np.asarray(as_number.electrodes.position)[:, 2].tolist() == [0.03] * 8
    with pytest.raises(ValueError, match=r"electrodes\.levels must be a number or a list, 1 to 1024, from 0"):
        described(CYLINDER, RING | {"levels": "middle"})


def test_a_box_with_patches_in_two_levels():
    patches = {"kind": "patch", "layout": "perimeter", "number": 6, "start": 0.02, "levels": [0.01, 0.03]}
    patches |= {"width": 0.01, "height": 0.008, "contact_impedance": 1e-3}
    found = described({"shape": "box", "width": 0.1, "depth": 0.08, "height": 0.04}, patches)
    assert isinstance(found.electrodes, FacePatches)
    around = perimeter(Rectangle(0.1, 0.08), 6, start=0.02)
    np.testing.assert_allclose(found.electrodes.position[:6], np.column_stack([around, np.full(6, 0.01)]))
    np.testing.assert_allclose(found.electrodes.position[6:], np.column_stack([around, np.full(6, 0.03)]))
    found.electrodes.check(found.domain.mesh(num_points=4000))


def test_electrodes_along_an_edge_may_be_numbered_clockwise():
    plates = {"layout": "perimeter", "number": 6, "width": 0.01, "contact_impedance": 1e-2, "start": 0.02}
    sheet = {"shape": "rectangle", "width": 0.1, "height": 0.08}
    ahead, back = (described(sheet, plates | {"clockwise": way}).electrodes for way in (False, True))
    np.testing.assert_array_equal(back.position, np.asarray(ahead.position)[[0, 5, 4, 3, 2, 1]])


STRIP = {"kind": "patch", "layout": "ring", "number": 8, "width": 0.01, "contact_impedance": 1e-3, "levels": [0.02]}


def test_a_strip_may_be_as_tall_as_its_wall_but_not_taller():
    assert described(CYLINDER, STRIP | {"height": 0.04}).electrodes.num_electrodes == 8
    with pytest.raises(ValueError, match=r"electrode 1 reaches from -0.005 to 0.045 m, and its wall from 0 to 0.04 m"):
        described(CYLINDER, STRIP | {"height": 0.05})


@pytest.mark.parametrize("size", [{"kind": "disc", "radius": 0.01}, {"kind": "patch", "width": 0.02, "height": 0.02}])
def test_electrodes_lie_on_the_surface(size):
    tank = {"shape": "box", "width": 0.1, "depth": 0.08, "height": 0.04}
    places = [[0.05, 0.0, 0.02], [0.0, 0.0, 0.04]]
    described(tank, size | {"positions": places, "contact_impedance": 1e-3})
    with pytest.raises(ValueError, match=r"electrode 2 at \[0.0, 0.0, 0.045\] m lies 5 mm off the body's surface"):
        described(tank, size | {"positions": [places[0], [0.0, 0.0, 0.045]], "contact_impedance": 1e-3})


@pytest.mark.parametrize(
    ("place", "off"),
    [
        ([0.0, 15.0, 0.02], "14.9 m"),  # farther from the wall than from either lid
        ([0.0, 0.15, 0.02], "100 mm"),
        ([0.0, 0.15, 0.04], "100 mm"),  # at the height of the lid, but off it
        ([0.0, 0.08, 0.08], "50 mm"),  # outside of wall and lid, by 30 and 40 mm
        ([0.0, 0.0, 0.055], "15 mm"),
        ([0.0, 0.04, 0.025], "10 mm"),  # inside
    ],
)
def test_distance_from_the_surface_is_exact(place, off):
    disc = {"kind": "disc", "radius": 0.004, "contact_impedance": 1e-3, "positions": [[0.05, 0.0, 0.02], place]}
    with pytest.raises(ValueError, match=rf"electrode 2 at .* m lies {off} off the body's surface"):
        described(CYLINDER, disc)


def test_any_outline_with_a_thickness_is_a_solid():
    corner = {"kind": "point", "positions": [[0.01, 0.01, 0.0], [0.09, 0.01, 0.0]]}
    found = described({"shape": "polygon", "vertices": SQUARE, "thickness": 0.01}, corner)
    assert isinstance(found.domain, Solid)
    assert isinstance(found.domain.outline, Polygon)
    assert found.electrodes.refinement(found.domain)[0].points.shape == (2, 2)  # in the plane mesh, seen from above
    assert found.domain.mesh(num_points=500, refine=found.electrodes.refinement(found.domain)).dimension == 3


@pytest.fixture
def folder(tmp_path):
    """A folder of two meshes in centimetres: a disk, and a cylinder with two named plates."""
    solid = cylinder(5.0, 4.0, num_points=400)
    facets, middle = np.asarray(solid.facets), np.asarray(solid.points)[np.asarray(solid.facets)].mean(axis=1)
    plates = {"east": facets[middle[:, 0] > 4], "west": facets[middle[:, 0] < -4]}
    write(Disk(5.0).mesh(num_points=200), tmp_path / "disk.vtu")
    write(Mesh.create(solid.points, solid.cells, tags=plates), tmp_path / "plates.msh")
    return tmp_path


def test_a_mesh_beside_the_description(folder):
    arcs = {"kind": "boundary", "positions": ring(0.05, 8).tolist(), "width": 0.01, "contact_impedance": 0.1}
    (folder / "frames.csv").write_text(",".join(["1"] * 39 + ["2"]))
    (folder / "frames.toml").write_text(
        f'[geometry]\nmesh = "disk.vtu"\nscale = 1e-2\n[electrodes]\npositions = {arcs["positions"]}\nwidth = 0.01\n'
        'contact_impedance = 0.1\n[protocol]\nkind = "adjacent"\ncurrent = 1e-3\n'
    )
    body = read(folder / "frames.csv").domain
    assert isinstance(body, OwnMesh)
    assert body.mesh(num_points=5000) is body.given
    assert body.given.dimension == 2
    assert body.extent == pytest.approx((-0.05, 0.05, -0.05, 0.05), rel=1e-2)
    (edge,) = body.loops()
    np.testing.assert_allclose(np.linalg.norm(edge, axis=1), 0.05, rtol=1e-6)


def test_named_facets_of_a_mesh(folder):
    facets = {"kind": "facets", "tags": ["east", "west"], "contact_impedance": [1e-3, 2e-3]}
    found = described({"mesh": "plates.msh", "scale": 1e-2}, facets, folder)
    assert isinstance(found.electrodes, FacetElectrodes)
    assert found.domain.loops() == ()
    found.electrodes.check(found.domain.mesh())


FACETS = {"kind": "facets", "tags": ["a"], "contact_impedance": 1e-3}
PATCH = {"kind": "patch", "width": 0.01, "height": 0.01}
WRONG = {
    "no height": ({"shape": "cylinder", "radius": 0.05}, RING, r"geometry\.height is missing; give it"),
    "two shapes": (CYLINDER | {"mesh": "a.msh"}, RING, r"geometry\.(height|radius|shape) is no key of a mesh"),
    "two heights": (CYLINDER | {"thickness": 0.1}, RING, r"geometry\.thickness is no key of a cylinder"),
    "another's size": ({"shape": "disk", "radius": 0.1, "width": 0.1}, RING, r"geometry\.width is no key of a disk"),
    "no thickness": (
        {"shape": "disk", "radius": 0.1, "thickness": -1.0},
        RING,
        r"geometry\.thickness is -1, and must be from 1e-09 to 1000 m\.$",
    ),
    "millimetres": (
        {"shape": "disk", "radius": 1500},
        RING,
        r"geometry\.radius is 1500, and must be .* m\. 1500 mm are 1\.5 m\. Were millimetres given for metres\?$",
    ),
    "all at once": (
        {"shape": "disk", "radius": "0.1", "centre": [0, True]},
        RING | {"number": 5000, "kind": "dics"},
        r"geometry\.radius must be a number, .*; it is '0\.1'\. geometry\.centre must be 2 numbers, .*; it has True in"
        r" it.* electrodes\.kind must be one of .*; it is 'dics' \(did you mean 'disc'\?\)\.$",
    ),
    "many electrodes": (
        CYLINDER,
        RING | {"number": 5000},
        r"number is 5000, .* to 1024\. Channels grow with its square",
    ),
    "many in levels": (
        CYLINDER,
        RING | {"number": 800, "levels": [0.01, 0.02]},
        r"electrodes.* describes 1600 electrodes",
    ),
    "two places": (CYLINDER, RING | {"positions": [[0, 0, 0]]}, r"electrodes\.layout has no effect beside positions"),
    "levels of a sheet": ({"shape": "disk", "radius": 0.1}, RING, r"electrodes: levels are heights on a solid"),
    "many vertices": (
        {"shape": "polygon", "vertices": SQUARE * 1000, "holes": [SQUARE * 100]},
        RING,
        r"geometry\.vertices and holes are 4400 points, .* give 4096 at most",
    ),
    "no mesh": ({"mesh": "none.msh"}, RING, r"geometry\.mesh: there is no file none\.msh; put it beside d\.toml"),
    "a mesh elsewhere": ({"mesh": "../none.msh"}, RING, r"geometry\.mesh: must be the name of a file beside d\.toml"),
    "a mesh on the web": ({"mesh": "https://a.org"}, RING, r"geometry\.mesh: must be the name of a file beside"),
    "no levels": (CYLINDER, {k: v for k, v in RING.items() if k != "levels"}, "on a solid it needs 'levels'"),
    "above": (CYLINDER, RING | {"levels": [0.05]}, r"levels must be heights from 0 to 0\.04 m"),
    "arcs": (
        CYLINDER,
        {k: v for k, v in RING.items() if k != "radius"} | {"kind": "boundary", "width": 0.01},
        "3 coordinates are not those of kind = 'boundary'",
    ),
    "flat patch": (
        {"shape": "disk", "radius": 0.1},
        {k: v for k, v in RING.items() if k not in ("radius", "levels")} | PATCH,
        "give x, y and z",
    ),
    "strips": (CYLINDER, RING | {"kind": "strip"}, r"'strip' \(did you mean 'patch', with width and height\?\)\.$"),
    "circles": (CYLINDER, RING | {"kind": "Circles"}, r"'Circles' \(did you mean 'disc', with radius\?\)\.$"),
    "a tank": (CYLINDER | {"shape": "tank"}, RING, r"'tank' \(did you mean 'cylinder', with radius and height\?\)\.$"),
    "misspelt twice": (
        {"shape": "cylinder", "raduis": 0.05, "height": 0.04},
        {**{key: value for key, value in STRIP.items() if key != "contact_impedance"}, "height": 0.04, "impedance": 1},
        r"geometry\.radius is missing; .* geometry\.raduis is no key of a cylinder .*'radius'\?\).*"
        r" electrodes\.contact_impedance is missing; give it; if it is not known, write 1e-3 .*\."
        r" (Wrong too: )?electrodes\.impedance",
    ),
    "wide": (
        CYLINDER,
        STRIP | {"width": 12, "height": 0.02},
        r"electrodes\.width: electrode 1's is 12 m, larger than the body, 100 mm; were millimetres given for metres\?$",
    ),
    "tall": (CYLINDER, STRIP | {"height": 0.08}, r"electrodes\.height: electrode 1 reaches from -0\.02 to 0\.06 m"),
    "one place": (
        CYLINDER,
        PATCH | {"positions": [[0.05, 0, 0.02]] * 16, "contact_impedance": 1e-3},
        r"electrodes\.positions: electrodes 1 and 2 are at the same place, \[0\.05, 0\.0, 0\.02\] m; give each its own",
    ),
    "places in millimetres": (
        CYLINDER,
        PATCH | {"positions": [[50, 0, 20], [0, 50, 20]], "contact_impedance": 1e-3},
        r"electrodes\.positions: electrode 1 .* lies 53\.8 m off .*; were millimetres given for metres\?$",
    ),
    "a place near the wall": (
        CYLINDER,
        PATCH | {"positions": [[0.055, 0, 0.02], [0, 0.05, 0.02]], "contact_impedance": 1e-3},
        r"electrode 1 .* lies 5 mm off the body's surface; give a place on it\.$",
    ),
    "facets": (CYLINDER, FACETS, r"facets that a mesh has names for: give \[geometry\] mesh"),
}


@pytest.mark.parametrize("name", WRONG)
def test_faults_are_named(name):
    geometry, electrodes, message = WRONG[name]
    with pytest.raises(ValueError, match=rf"^d\.toml.*{message}"):
        described(geometry, electrodes)


def test_a_file_that_is_no_mesh_is_named_with_its_key(tmp_path):
    (tmp_path / "junk.msh").write_text("hello")
    with pytest.raises(
        ValueError, match=r"^d\.toml: geometry\.mesh: junk\.msh does not work .* its content does not fit"
    ):
        described({"mesh": "junk.msh"}, FACETS, tmp_path)


def test_patches_on_a_mesh_in_another_unit(folder):
    """With the wrong unit, no facet of the mesh is near a patch."""
    patches = PATCH | {"positions": [[0.05, 0, 0.02], [0, 0.05, 0.02]], "contact_impedance": 1e-3}
    described({"mesh": "plates.msh", "scale": 1e-2}, patches | {"width": 0.03, "height": 0.03}, folder)
    expected = r"lies 20 mm off the body's surface; is the mesh in millimetres\? Read it with scale = 1e-3\.$"
    with pytest.warns(UserWarning, match="is large"), pytest.raises(ValueError, match=expected):
        described({"mesh": "plates.msh", "scale": 10}, patches, folder)
    placed = FacePatches([[50, 0, 20], [0, 50, 20]], 0.01, 0.01, 1e-3)
    body = described({"mesh": "plates.msh", "scale": 1e-2}, None, folder).domain
    with pytest.raises(ValueError, match=r"^position: electrode 1 .* were millimetres given for metres\?$"):
        placed.check(body.given)
    with pytest.raises(ValueError, match=r"^d\.toml: electrodes\.width: .* 12 m, larger than the body, 14\d mm"):
        described({"mesh": "plates.msh", "scale": 1e-2}, patches | {"width": 12}, folder)


def test_a_surface_is_refused_as_a_volume(folder):
    corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    write(Mesh.create(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]), folder / "shell.vtu")
    with pytest.raises(ValueError, match=r"tagged 'a'.* It is a surface, without tetrahedra: mesh the volume"):
        described({"mesh": "shell.vtu"}, FACETS, folder)


def test_a_layout_on_a_mesh_is_refused(folder):
    with pytest.raises(ValueError, match="needs a shape to lie on; on a mesh of your own give 'positions'"):
        described({"mesh": "plates.msh", "scale": 1e-2}, RING, folder)


@pytest.mark.parametrize("kind", [FaceDiscs, PointElectrodes])
def test_solids_are_written_and_read_again(tmp_path, kind):
    places = ring(0.05, 8, height=0.02)
    electrodes = FaceDiscs(places, 0.005, 1e-3) if kind is FaceDiscs else PointElectrodes(places)
    body = Solid(Disk(0.05), 0.04)
    write_table(screen(np.arange(40.0) + 1, adjacent(8), electrodes=electrodes, domain=body), tmp_path / "a.npz")
    again = read(tmp_path / "a.npz")
    assert again.domain == body
    assert type(again.electrodes) is kind
    np.testing.assert_array_equal(again.electrodes.position, places)


def test_a_mesh_is_accepted_as_a_domain_but_a_path_is_not():
    mesh = Disk(0.05).mesh(num_points=200)
    body = Measurement(np.ones((1, 40)), np.ones((1, 40), bool), adjacent(8), domain=mesh).domain
    assert isinstance(body, OwnMesh)
    electrodes = BoundaryElectrodes(ring(0.05, 8), 0.005, 0.1)
    with pytest.raises(ValueError, match=r"domain must be an outline such as Disk\(0.05\), a Solid, or a Mesh"):
        screen(np.arange(40.0) + 1, adjacent(8), electrodes=electrodes, domain="tank.msh")


def test_a_radius_in_millimetres_is_reported_in_metres():
    expected = r"^d\.toml: geometry\.radius: 150 m is large .* If the lengths are millimetres, give 0\.15, "
    with pytest.warns(UserWarning, match=expected):
        described({"shape": "disk", "radius": 150}, {"kind": "point", "positions": [[0, 150]]})


SHEET = {
    "geometry": {"shape": "disk", "radius": 0.1},
    "electrodes": {"layout": "ring", "number": 8, "width": 0.01, "contact_impedance": 0.01},
    "protocol": {"kind": "adjacent", "current": 1e-3},
}


def test_an_uncertainty_in_degrees_and_percent_is_kept_by_measurements(tmp_path):
    known = parse_description(
        {**SHEET, "uncertainty": {"position_degrees": 1, "size_percent": 3}}, "d.toml"
    ).uncertainty
    assert known.position == pytest.approx(np.deg2rad(1) * 0.1)
    assert known == Uncertainty(position=known.position, size=0.03)
    np.savetxt(tmp_path / "frames.csv", np.random.default_rng(0).normal(size=(3, 40)), delimiter=",")
    (tmp_path / "frames.toml").write_text(
        '[geometry]\nshape = "disk"\nradius = 0.1\n[electrodes]\nlayout = "ring"\nnumber = 8\nwidth = 0.01\n'
        'contact_impedance = 0.01\n[protocol]\nkind = "adjacent"\ncurrent = 1e-3\n'
        "[uncertainty]\nposition_degrees = 1\nsize_percent = 3\n"
    )
    measurement = read(tmp_path / "frames.csv")
    one = measurement.frame(0).masked(np.arange(40) != 3, "for a test.").mean_frame()
    assert measurement.uncertainty == one.uncertainty == known
    write_table(measurement, tmp_path / "again.npz")
    assert read(tmp_path / "again.npz").uncertainty == known
    assert parse_description(SHEET, "d.toml").uncertainty is None


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"position": 1e-3, "position_degrees": 1}, "the same"),
        ({"position": -1}, "from 0"),
        ({"positions": 1}, "did you mean 'position'"),
        ({"other_percent": 101}, r"101, and must be from 0 to 100 %\.$"),
    ],
)
def test_a_faulty_uncertainty_is_named(given, expected):
    with pytest.raises(ValueError, match=expected):
        parse_description({**SHEET, "uncertainty": given}, "d.toml")


@pytest.mark.parametrize(
    "given", [{"position": -1e-3}, {"position": "1 mm"}, {"drift": np.nan}, {"size": 3}, {"other": -1}, {"drift": None}]
)
def test_an_uncertainty_with_invalid_values_is_refused(given):
    with pytest.raises(ValueError, match=f"{next(iter(given))} must be a number"):
        Uncertainty(**given)


def test_an_uncertainty_of_another_type_is_refused():
    with pytest.raises(ValueError, match=r"jeit\.inverse\.Uncertainty"):
        Measurement(np.ones(40), np.ones(40, bool), adjacent(8), uncertainty={"position": 1e-3})  # pyright: ignore


def test_degrees_need_a_circular_body():
    square = {"geometry": {"shape": "rectangle", "width": 0.1, "height": 0.1}}
    electrodes = {"electrodes": {**SHEET["electrodes"], "layout": "perimeter"}}
    with pytest.raises(ValueError, match="position_degrees is of a disk"):
        parse_description({**SHEET, **square, **electrodes, "uncertainty": {"position_degrees": 1}}, "d.toml")
