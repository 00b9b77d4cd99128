"""Surfaces and solids in space, checked by the drawn artists: order, colours, positions."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from jeit.electrodes import (
    BoundaryElectrodes,
    CombinedElectrodes,
    FaceDiscs,
    FacePatches,
    PointElectrodes,
    plates,
)
from jeit.electrodes.electrode_shapes import shapes_of
from jeit.image import Inclusion, Plane, SolidForm
from jeit.layout import SurfaceLayout, ring
from jeit.mesh import box, centroids, cylinder, disk, tube
from jeit.plot import (
    Camera,
    ColourScale,
    plot_curved_skin,
    plot_isosurfaces,
    plot_slice,
    plot_slices,
    plot_solid,
    plot_surface,
)
from jeit.plot.solid.isosurfaces import level_surfaces
from jeit.plot.solid.scene import Scene


@pytest.fixture
def ax():
    return Figure(layout="constrained").subplots()


def pieces(ax) -> PolyCollection:
    (drawn,) = [one for one in ax.collections if isinstance(one, PolyCollection)]
    return drawn


@pytest.mark.parametrize(
    ("angles", "toward", "right", "up"),
    [
        ((-90, 0), (0, -1, 0), (1, 0, 0), (0, 0, 1)),
        ((0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((-90, 90), (0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ],
)
def test_camera_directions(angles, toward, right, up):
    camera = Camera(*angles)
    for seen, wanted in ((camera.toward, toward), (camera.right, right), (camera.up, up)):
        np.testing.assert_allclose(seen, wanted, atol=1e-15)


def test_nearer_pieces_are_drawn_later(ax):
    points = np.array([[0, 0, z] for z in (0.3, 0.1, 0.2)])[:, None] + [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    scene = Scene(Camera(0, 90))
    for k, colour in enumerate(np.eye(3)):
        scene.add_triangles(points[k], np.array([[0, 1, 2]]), np.array([[*colour, 1.0]]), is_lit=False)
    scene.draw(ax)
    np.testing.assert_allclose(pieces(ax).get_facecolor()[:, :3], np.eye(3)[[1, 2, 0]])


def test_lengths_across_the_view_are_to_scale(ax):
    camera = Camera(33, 47)
    ends = np.stack([np.zeros(3), 0.05 * camera.up])
    np.testing.assert_allclose(camera.on_page(ends)[1], [0, 0.05], atol=1e-15)


def test_shading_does_not_change_the_sign_of_colours(ax):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.2]])
    plot_surface(points, [[0, 1, 2], [1, 3, 2]], [2e-3, -2e-3], ax=ax)
    red, blue = sorted(pieces(ax).get_facecolor(), key=lambda colour: colour[2])
    assert red[0] > 2 * red[2]
    assert blue[2] > 2 * blue[0]
    assert ax.figure.axes[-1].get_ylabel() == "Change of sheet conductivity (mS)"


def test_both_sides_are_lit_alike():
    camera = Camera()
    normals = np.random.default_rng(1).normal(size=(50, 3))
    np.testing.assert_allclose(camera.light(normals), camera.light(-3 * normals))
    assert camera.light(normals).max() <= 1


def test_a_surface_without_values_has_no_colour_bar(ax):
    plot_surface(np.eye(3), [[0, 1, 2]], title="shell", ax=ax)
    assert len(ax.figure.axes) == 1
    assert ax.get_title() == "shell"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((3, 2)), [[0, 1, 2]]), "points has shape"),
        ((np.full((3, 3), np.nan), [[0, 1, 2]]), "points must be finite"),
        ((np.eye(3), [[0, 1, 3]]), "names point 3"),
        ((np.eye(3), np.zeros((0, 3), int)), "triangles has shape"),
        ((np.eye(3), [[0, 1, 2]], [1.0, 2.0]), "values has shape"),
        ((np.eye(3), [[0, 1, 2]], [1j]), "complex"),
        ((np.eye(3), [[0, 1, 2]], [np.inf]), "finite"),
    ],
)
def test_invalid_surfaces(arguments, message):
    with pytest.raises(ValueError, match=message):
        plot_surface(*arguments)


@pytest.mark.parametrize("angles", [(np.nan, 0), ("left", 0), (0, 91)])
def test_invalid_cameras(angles):
    with pytest.raises(ValueError, match=r"azimuth|elevation"):
        Camera(*angles)


def test_scales_and_cameras_of_another_type():
    with pytest.raises(ValueError, match="camera must be a Camera"):
        plot_surface(np.eye(3), [[0, 1, 2]], camera=30)
    with pytest.raises(ValueError, match="scale must be"):
        plot_surface(np.eye(3), [[0, 1, 2]], scale="viridis")


BOX = (0.17, 0.255, 0.17)
PLACES = np.array([[0.085, 0.03, 0.05], [0.085, -0.06, 0.12], [0.0, -0.1275, 0.085], [-0.085, 0.0, 0.085]])


@pytest.fixture(scope="module")
def tank():
    return box(*BOX, num_points=2500)


@pytest.fixture(scope="module")
def image(tank):
    """A conductive ball and a resistive one of half its strength."""
    place = np.asarray(centroids(tank))
    balls = [np.exp(-(np.linalg.norm(place - middle, axis=1) ** 2) / 0.03**2) for middle in MIDDLES]
    return 2e-3 * balls[0] - 1e-3 * balls[1]


@pytest.fixture(scope="module")
def patches():
    return FacePatches(PLACES, 0.04, 0.03, 1e-3)


MIDDLES = np.array([[0.03, -0.05, 0.1], [-0.03, 0.06, 0.06]])


def shown(ax) -> list[str]:
    return [text.get_text() for text in ax.texts]


def area(corners):
    """Area of a polygon in space."""
    return 0.5 * np.linalg.norm(sum(np.cross(a, b) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)))


def test_patches_and_discs_are_polygons_of_their_size_in_the_wall(tank, patches):
    shapes = shapes_of(tank, patches)
    assert shapes.number == 4
    np.testing.assert_allclose(shapes.middles(), PLACES, atol=1e-12)
    for corners, place in zip(shapes.polygons(), PLACES, strict=True):
        assert area(corners - place) == pytest.approx(0.04 * 0.03, rel=1e-12)
        across = int(np.abs(place[:2] / BOX[:2]).argmax())
        np.testing.assert_allclose(corners[:, across], place[across], atol=1e-12)
        assert np.ptp(corners[:, 2]) == pytest.approx(0.03)
    discs = shapes_of(tank, FaceDiscs(PLACES, 0.01, 1e-3))
    assert area(discs.polygons()[0] - PLACES[0]) == pytest.approx(np.pi * 1e-4, rel=0.01)


def test_strips_are_bent_round_a_cylinder():
    tank = cylinder(0.075, 0.1, num_points=4000)
    (corners,) = shapes_of(tank, FacePatches([[0.075, 0.0, 0.05]], 0.05, 0.08, 1e-3)).polygons()
    radius = np.hypot(corners[:, 0], corners[:, 1])
    assert np.abs(radius - 0.075).max() < 1e-3
    assert np.ptp(corners[:, 0]) > 0.003  # a flat one would be 4.3 mm off the wall


def test_facets_points_and_segments_are_drawn_by_their_kind(tank):
    faces = shapes_of(tank, plates(tank, ["left", "right"], 1e-3))
    total = [sum(area(one) for one, k in zip(faces.polygons(), faces.electrode, strict=True) if k == e) for e in (0, 1)]
    np.testing.assert_allclose(total, BOX[1] * BOX[2])
    dots = shapes_of(tank, PointElectrodes(PLACES))
    np.testing.assert_array_equal(dots.sizes, 1)
    both = shapes_of(tank, CombinedElectrodes(FaceDiscs(PLACES[:2], 0.01, 1), FacePatches(PLACES[2:], 0.02, 0.02, 1)))
    np.testing.assert_allclose(both.middles(), PLACES, atol=1e-12)


def test_arcs_of_a_sheet_are_lines_along_its_edge():
    sheet = disk(0.05, num_points=300)
    shapes = shapes_of(sheet, BoundaryElectrodes(ring(0.05, 8), 0.01, 0.1))
    assert shapes.number == 8
    assert shapes.corners.shape[1] == 2
    assert np.abs(np.hypot(*shapes.corners.T) - 0.05).max() < 1e-3


def nearness_of(ax, colour) -> np.ndarray:
    """Positions in the drawing order of the pieces whose face has about this colour."""
    faces = pieces(ax).get_facecolor()
    return np.flatnonzero(colour(faces))


def is_metal(faces):
    return (faces[:, 0] > 1.3 * faces[:, 1]) & (faces[:, 1] > 3 * faces[:, 2]) & (faces[:, 3] == 1)


def test_electrodes_in_front_are_drawn_after_the_interior_and_those_behind_before_it(tank, image, patches, ax):
    camera = Camera(azimuth=0, elevation=0)
    plot_isosurfaces(tank, image, patches, camera=camera, scale=ColourScale(bar=False), ax=ax)
    metal = nearness_of(ax, is_metal)
    inside = nearness_of(ax, lambda faces: (faces[:, 3] == 1) & ~is_metal(faces))
    drawn, seen = pieces(ax).get_paths(), []
    for k in metal:
        seen.append((drawn[k].vertices[:, 0].mean(), k > inside.max(), k < inside.min()))
    # Patches 1 and 2 are on the front wall and 4 on the back wall; 3 is seen from its edge.
    for place, wanted in ((0.04, (True, False)), (-0.01, (False, True))):
        on_it = {one[1:] for one in seen if abs(one[0] - place) < 0.006}
        assert on_it == {wanted}


def test_electrodes_that_hide_a_body_are_transparent(tank, image, ax):
    whole = plates(tank, ["left", "right", "front", "back", "bottom", "top"], 1e-3)
    plot_isosurfaces(tank, image, whole, camera=Camera(), scale=ColourScale(bar=False), ax=ax)
    brown = pieces(ax).get_facecolor()
    brown = brown[(brown[:, 0] > 1.3 * brown[:, 1]) & (brown[:, 1] > 3 * brown[:, 2])]
    # Three transparent faces in front, drawn last, and three behind.
    assert set(np.round(brown[-100:, 3], 2)) == {0.16}
    assert set(np.round(brown[:100, 3], 2)) == {1.0}
    assert np.mean(brown[:, 3] < 1) == pytest.approx(0.5, abs=0.1)


def test_each_sign_has_its_own_surface(tank, image):
    found = level_surfaces(tank, image, (0.5,), is_signed=True)
    assert [np.sign(value) for value, _, _ in found] == [1, -1]
    for (_, _, surface), middle in zip(found, MIDDLES, strict=True):
        # A Gaussian falls to half at 0.83 of its length.
        assert surface.enclosed == pytest.approx(4 / 3 * np.pi * (0.8326 * 0.03) ** 3, rel=0.3)
        assert np.linalg.norm(surface.points.mean(axis=0) - middle) < 0.008
    weak = np.where(image < 0, 0.1 * image, image)
    assert len(level_surfaces(tank, weak, (0.3, 0.6), is_signed=True)) == 2
    assert level_surfaces(tank, np.zeros(tank.num_cells), (0.5,), is_signed=True) == []
    ((value, _, _),) = level_surfaces(tank, image + 5e-3, (0.5,), is_signed=False)
    assert 5e-3 < value < 6.5e-3


def test_a_slice_has_the_colours_of_the_cells_that_it_cuts(tank, image, patches, ax):
    plot_slice(tank, image, Plane.at("x", 0.03), patches, ax=ax)
    (cells,) = [one for one in ax.collections if isinstance(one, PolyCollection)]
    values = np.asarray(cells.get_array())
    assert values.max() == pytest.approx(1e3 * image.max(), rel=0.1)
    assert cells.get_clim() == pytest.approx((-1e3 * image.max(), 1e3 * image.max()))
    assert ax.get_title() == "x = 30 mm"
    # Electrode 3 lies across x = 0, from -20 to 20 mm.
    assert "3" not in shown(ax)
    assert {"y", "z", "50 mm"} <= set(shown(ax))


def test_a_slice_shows_the_electrodes_and_balls_that_it_cuts(tank, image, patches, ax):
    inclusions = [Inclusion(1, (0.03, -0.05, 0.1), 4 / 3 * np.pi * 0.03**3, 1e-3)]
    plot_slice(tank, image, Plane.at("z", 0.1 + 0.018), patches, inclusions=inclusions, ax=ax)
    assert "2" in shown(ax)
    assert "1" not in shown(ax)
    (circle,) = [one for one in ax.patches if isinstance(one, Circle)]
    assert circle.radius == pytest.approx(0.024)  # 18 mm off the middle of a ball of 30 mm
    assert circle.center == pytest.approx((0.03, -0.05))
    other = Figure().subplots()
    plot_slice(tank, image, Plane.at("z", 0.14), inclusions=inclusions, ax=other)
    assert not other.patches


def test_fitted_bodies_are_outlined_by_their_shapes(tank, image, ax):
    form = SolidForm((0.02, -0.05, 0.085), ((0.03, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.085)), True)
    column = Inclusion(1, (0.02, -0.05, 0.085), 1e-4, 1e-3, form=form, contrast_interval=(1.5, None))
    plot_slice(tank, image, Plane.at("z", 0.02), inclusions=[column], ax=ax)
    plot_slice(tank, image, Plane.at("y", -0.05), inclusions=[column], ax=(side := Figure().subplots()))
    plot_slice(tank, image, Plane.at("y", -0.03), inclusions=[column], ax=(beside := Figure().subplots()))
    for panel, least, most in ((ax, (-0.01, -0.06), (0.05, -0.04)), (side, (-0.01, 0.0), (0.05, 0.17))):
        (outline,) = [one for one in panel.patches if isinstance(one, Polygon)]
        np.testing.assert_allclose(outline.get_xy().min(axis=0), least, atol=1e-5)
        np.testing.assert_allclose(outline.get_xy().max(axis=0), most, atol=1e-5)
    assert not beside.patches
    overview = plot_solid(tank, image, inclusions=[column], camera=Camera(azimuth=-90, elevation=0))
    (outline,) = [one for one in overview.axes[0].patches if isinstance(one, Polygon)]
    np.testing.assert_allclose(np.ptp(outline.get_xy(), axis=0), (0.06, 0.17), atol=1e-5)
    (words,) = [text.get_text() for one in overview.axes for text in one.texts if "found" in text.get_text()]
    assert "found, dashed:" in words
    assert "column of 100 cm³" in words
    assert "at least +150 %" in words


def test_grids_have_one_scale(tank, image, patches):
    figure = plot_slices(tank, image, patches, axis="y", at=5)
    panels = [one for one in figure.axes if one.get_title()]
    assert [panel.get_title()[:4] for panel in panels] == ["y = "] * 5
    limits = {tuple(c.get_clim()) for panel in panels for c in panel.collections if isinstance(c, PolyCollection)}
    assert len(limits) == 1
    assert len({panel.get_xlim() for panel in panels}) == 1
    assert figure.axes[-1].get_ylabel() == "Change of conductivity (mS/m)"
    figure = plot_slices(tank, image, axis="z", at=[0.02, 0.03])
    assert [one.get_title() for one in figure.axes if one.get_title()] == ["z = 20 mm", "z = 30 mm"]


def test_the_overview_cuts_through_the_strongest_change(tank, image, patches):
    figure = plot_solid(tank, image, patches)
    titles = {one.get_title() for one in figure.axes} - {""}
    strongest = np.asarray(centroids(tank))[np.abs(image).argmax()]
    assert titles == {Plane.at(axis, float(one)).name for axis, one in zip("xyz", strongest, strict=True)}
    # The view, three slices, the caption and the colour bar fill the grid, and none lies on another.
    places = [ax.get_subplotspec() for ax in figure.axes]
    cells = [(row, column) for place in places for row in place.rowspan for column in place.colspan]
    assert sorted(cells) == [(row, column) for row in range(2) for column in range(4)]
    inclusions = [Inclusion(-1, (-0.03, 0.06, 0.06), 1e-4, -1e-3, centroid_radius=2.34e-3)]
    figure = plot_solid(tank, image, patches, inclusions=inclusions)
    assert {one.get_title() for one in figure.axes} - {""} == {"x = −30 mm", "y = 60 mm", "z = 60 mm"}
    space = plot_isosurfaces(tank, image, inclusions=[*inclusions, Inclusion(1, (0.0, 0.0, 0.1), 1e-4, 1e-3)])
    assert [line.get_marker() for line in space.lines if line.get_marker() in ("+", "_")] == ["_", "+"]
    (words,) = [text.get_text() for one in figure.axes for text in one.texts if "found" in text.get_text()]
    assert "100 cm³ at (−30, 60, 60) ±2.3 mm" in words
    assert "surfaces at 50 % of the strongest change" in words


def test_a_constant_image_is_drawn(tank):
    plot_solid(tank, np.zeros(tank.num_cells)).canvas.draw()
    plot_solid(tank, np.full(tank.num_points, 0.3), scale=ColourScale(difference=False)).canvas.draw()


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda tank: plot_isosurfaces(tank, np.zeros(tank.num_cells), levels=(1.5,)), "levels must be shares"),
        (lambda tank: plot_isosurfaces(tank, np.zeros(tank.num_cells), levels=()), "levels must be shares"),
        (lambda tank: plot_isosurfaces(tank, np.zeros(3)), "values has shape"),
        (lambda tank: plot_isosurfaces(tank, np.zeros(tank.num_cells), camera=3), "camera must be"),
        (lambda tank: plot_slice(tank, np.zeros(tank.num_cells), Plane.at("z", 1.0)), "misses the body"),
        (lambda tank: plot_slice(tank, np.full(tank.num_cells, np.nan), Plane.at("z", 0.1)), "finite"),
        (lambda tank: plot_slices(tank, np.zeros(tank.num_cells), at=0), "at must be"),
        (lambda tank: plot_slices(tank, np.zeros(tank.num_cells), axis="w"), "axis must be"),
        (lambda tank: plot_slices(tank, np.zeros(tank.num_cells), electrodes=PLACES), "electrodes must be"),
        (lambda tank: plot_solid(tank, np.zeros(tank.num_cells), scale=1), "scale must be"),
        (lambda tank: plot_solid(disk(0.1, num_points=50), np.zeros(70)), "plane mesh"),
    ],
)
def test_invalid_solids(tank, draw, message):
    with pytest.raises(ValueError, match=message):
        draw(tank)


def test_electrodes_on_a_surface_are_numbered_and_those_behind_it_hidden():
    sleeve = cylinder(0.05, 0.2, num_points=3000)
    wall = np.asarray(sleeve.facets)[np.asarray(sleeve.tags["side"])]
    places = [[0.05, 0.0, 0.1], [-0.05, 0.0, 0.1]]
    shapes = shapes_of(sleeve, FaceDiscs(places, 0.012, 1e-3))
    ax = Figure().subplots()
    plot_surface(sleeve.points, wall, None, shapes, camera=Camera(0, 0), ax=ax)
    metal = np.flatnonzero(is_metal(pieces(ax).get_facecolor()))
    number = len(pieces(ax).get_facecolor())
    # Half of the pieces of electrodes come first, under the front wall, and half last.
    assert (metal < 0.45 * number).sum() == (metal > 0.55 * number).sum() == len(metal) / 2
    assert {"1"} <= set(shown(ax))
    assert "2" not in shown(ax)
    with pytest.raises(ValueError, match="electrodes must be ElectrodeShapes"):
        plot_surface(sleeve.points, wall, None, FaceDiscs(places, 0.012, 1e-3))


def test_electrodes_behind_each_other_share_a_label(ax):
    rings = np.concatenate([ring(0.05, 8, height=height) for height in (0.01, 0.03)])
    body = cylinder(0.05, 0.04, num_points=600)
    plot_isosurfaces(body, np.zeros(body.num_cells), FaceDiscs(rings, 0.006, 1e-3), camera=Camera(-90, 90), ax=ax)
    labels = {one for one in shown(ax) if one[:1].isdigit() and "mm" not in one}
    assert labels == {f"{k}, {k + 8}" for k in range(1, 9)}


def test_labels_of_electrodes_behind_each_other_are_beside_the_body(tank):
    """Seen from the front, walls appear from their edge: labels are outside of the body, as ranges from first to
    last."""
    low, high = np.asarray(tank.points).min(axis=0), np.asarray(tank.points).max(axis=0)
    sides = [[x, y, 0.5 * (low[2] + high[2])] for x in (low[0], high[0]) for y in np.linspace(low[1], high[1], 6)[1:-1]]
    ax = Figure().subplots()
    electrodes = FacePatches(sides, 0.004, 0.004, 1e-3)
    plot_isosurfaces(tank, np.zeros(tank.num_cells), electrodes, camera=Camera(-90, 0), ax=ax)
    found = {one.get_text(): (one.get_position()[0], one.get_ha()) for one in ax.texts}
    assert found["1–4"][0] < low[0]
    assert found["1–4"][1] == "right"
    assert found["5–8"][0] > high[0]
    assert found["5–8"][1] == "left"


def test_a_group_of_facets_has_one_outline(tank, ax):
    plot_isosurfaces(tank, np.zeros(tank.num_cells), plates(tank, ["top"], 1e-3), camera=Camera(0, 90), ax=ax)
    lines = np.abs(np.array(pieces(ax).get_linewidths()) - 0.5) < 1e-9
    edges = np.array([np.linalg.norm(np.ptp(one.vertices, axis=0)) for one in np.array(pieces(ax).get_paths())[lines]])
    assert edges.sum() == pytest.approx(2 * (BOX[0] + BOX[1]))
    faces = pieces(ax).get_facecolor()
    hull = np.flatnonzero((faces[:, 3] > 0) & (faces[:, 3] < 0.2))
    assert np.flatnonzero(is_metal(faces)).min() > hull.max()  # outside of its wall


def test_electrodes_on_the_far_side_are_under_their_wall(tank, ax):
    plot_isosurfaces(tank, np.zeros(tank.num_cells), plates(tank, ["bottom"], 1e-3), camera=Camera(0, 90), ax=ax)
    faces = pieces(ax).get_facecolor()
    hull = np.flatnonzero((faces[:, 3] > 0) & (faces[:, 3] < 0.2))
    assert np.flatnonzero(is_metal(faces)).max() < hull.min()


def test_the_legend_of_a_curved_skin_does_not_overlap_axis_labels(ax):
    layout = SurfaceLayout.spread(tube(0.03, 0.12, num_points=150), 6, 8e-3)
    marks = {"touched": [[0.03, 0.0, 0.06]], "found": [[0.0, -0.03, 0.06]]}
    for elevation in (25, 60):
        ax.clear()
        plot_curved_skin(layout, marks=marks, camera=Camera(130, elevation), ax=ax)
        FigureCanvasAgg(ax.figure).draw()
        legend = ax.get_legend().get_window_extent()
        letters = [one for one in ax.texts if one.get_text() in ("x", "y", "z")]
        assert len(letters) == 3
        assert not any(legend.overlaps(one.get_window_extent()) for one in letters)


def test_marks_above_a_curved_skin_are_drawn_on_it(ax):
    layout = SurfaceLayout.spread(tube(0.03, 0.12, num_points=400), 6, 8e-3)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    above = np.stack([0.04 * np.cos(angle), 0.04 * np.sin(angle), np.full(12, 0.06)], axis=1)
    plot_curved_skin(layout, marks={"touched": above}, camera=Camera(0, 0), ax=ax)
    (drawn,) = (one for one in ax.lines if one.get_label() == "touched")
    across = np.asarray(drawn.get_xdata())
    assert np.abs(across).max() <= 0.0301
    # Of the two on the silhouette, either side's edge may be seen; the five behind it are not.
    assert 5 <= len(across) <= 7
