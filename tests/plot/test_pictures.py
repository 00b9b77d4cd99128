"""Pictures of images and electrodes, checked by the drawn artists: colours, limits, labels, positions."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure

from jeit.electrodes import (
    BoundaryElectrodes,
    CombinedElectrodes,
    FaceDiscs,
    FacePatches,
    PointElectrodes,
    SheetDiscs,
    plates,
)
from jeit.forward import ForwardModel
from jeit.image import ImageSeries, Inclusion
from jeit.inverse.shapes import Quantities, Star
from jeit.layout import perimeter, ring
from jeit.mesh import Disk, Polygon, Rectangle, Solid, centroids, disk, layer, measures, rectangle
from jeit.plot import ColourScale, plot_image, plot_mesh
from jeit.plot.axes import extent_of, hide_axes
from jeit.plot.colours import FACTOR_SCALE
from jeit.plot.imaging.electrodes import draw_electrodes, draw_inclusions, draw_outlines
from jeit.plot.imaging.image import plot_admittivity, plot_raster, plot_sensitivity
from jeit.plot.imaging.judgement import plot_voltages
from jeit.plot.imaging.series import plot_series
from jeit.protocol import adjacent

RADIUS = 0.05


@pytest.fixture(scope="module")
def mesh():
    return disk(RADIUS, num_points=300)


@pytest.fixture(scope="module")
def electrodes():
    return BoundaryElectrodes(ring(RADIUS, 8, clockwise=True), 0.012, 0.1)


@pytest.fixture
def ax():
    return Figure(layout="constrained").subplots()


def texts(ax):
    return {text.get_text(): np.array(text.get_position()) for text in ax.texts}


def colour_bar_label(ax):
    return ax.figure.axes[-1].get_ylabel()


def test_differences_are_centred_at_zero(mesh, electrodes, ax):
    values = jnp.where(centroids(mesh)[:, 0] > 0, 2e-3, -1e-3)
    assert plot_image(mesh, values, electrodes, ax=ax) is ax
    (cells,) = [c for c in ax.collections if c.get_array() is not None]
    assert cells.get_clim() == pytest.approx((-2, 2))
    np.testing.assert_allclose(cells.get_array(), 1e3 * values)
    assert colour_bar_label(ax) == "Change of sheet conductivity (mS)"
    red, _, blue, _ = cells.to_rgba(2.0)
    assert red > blue  # conductive is red
    assert np.allclose(cells.to_rgba(0.0)[:3], 1, atol=0.05)  # no change is white


def test_conductivity_is_sequential_and_spans_its_range(mesh, ax):
    values = np.linspace(1.0, 3.0, mesh.num_points)
    plot_image(mesh, values, scale=ColourScale(difference=False, unit="S/m"), ax=ax)
    drawn = [c for c in ax.collections if c.get_array() is not None]
    assert drawn[0].get_clim() == pytest.approx((1, 3))
    assert colour_bar_label(ax) == "Conductivity (S/m)"


@pytest.mark.parametrize(
    ("limit", "labels"),
    [
        (1.0, ["÷10", "÷5", "÷2", "1", "×2", "×5", "×10"]),
        (0.05, ["÷1.1", "÷1.05", "1", "×1.05", "×1.1"]),
        (4.0, ["÷10000", "÷1000", "÷100", "÷10", "1", "×10", "×100", "×1000", "×10000"]),
    ],
)
def test_ticks_of_logarithms_are_factors(mesh, ax, limit, labels):
    values = np.linspace(-limit / 2, limit, mesh.num_cells)
    plot_image(mesh, values, scale=FACTOR_SCALE, ax=ax)
    ticks = ax.figure.axes[-1].yaxis.get_ticklabels()
    assert [tick.get_text() for tick in sorted(ticks, key=lambda tick: tick.get_position()[1])] == labels
    factors = [float(label.replace("÷", "1/").split("/")[-1].strip("×")) for label in labels]
    expected = [np.log10(factor) * (-1 if "÷" in label else 1) for factor, label in zip(factors, labels, strict=True)]
    np.testing.assert_allclose(sorted(tick.get_position()[1] for tick in ticks), expected, atol=1e-9)
    assert colour_bar_label(ax) == "Conductivity over background"


def test_electrodes_are_drawn_at_their_position_and_width(mesh, electrodes, ax):
    draw_electrodes(mesh, electrodes, ax=ax)
    (arcs,) = [c for c in ax.collections if isinstance(c, LineCollection)]
    for arc, position in zip(arcs.get_segments(), np.asarray(electrodes.position), strict=True):
        # On a polygon inscribed in the circle, within the sagitta of an edge.
        length = np.linalg.norm(np.diff(arc, axis=0), axis=1).sum()
        assert length == pytest.approx(0.012, rel=1e-6)
        assert np.linalg.norm(arc.mean(axis=0) - position) < 0.03 * RADIUS
    numbers = texts(ax)
    assert set(numbers) == {str(k) for k in range(1, 9)}
    for k, position in enumerate(np.asarray(electrodes.position), start=1):
        assert np.linalg.norm(numbers[str(k)]) > RADIUS
        assert np.dot(numbers[str(k)], position) > 0.99 * np.linalg.norm(numbers[str(k)]) * RADIUS


OUTLINES = {
    "flat": Rectangle(0.3, 0.1),
    "notched": Polygon(0.2 * np.array([[0, 0], [1, 0], [1, 1], [0.7, 1], [0.7, 0.3], [0.3, 0.3], [0.3, 1], [0, 1]])),
}


@pytest.mark.parametrize("name", OUTLINES)
def test_numbers_are_outside_opposite_their_electrodes(name, ax):
    """Along the normal of any outline: 0.058 of its size from the electrode, and no nearer to the rest."""
    outline = OUTLINES[name]
    places = perimeter(outline, 12, start=0.02)
    size = np.ptp(np.asarray(outline.mesh(num_points=200).points), axis=0).max()
    draw_electrodes(outline.mesh(num_points=200), BoundaryElectrodes(places, 0.01, 0.1), ax=ax)
    for number, place in texts(ax).items():
        own = places[int(number) - 1]
        assert np.linalg.norm(place - own) == pytest.approx(0.058 * size, rel=1e-3)
        assert -outline.signed_distance(place[None])[0] == pytest.approx(0.058 * size, rel=1e-3)


def test_numbers_in_a_narrow_notch_are_inside(ax):
    slit = Polygon([[0, 0], [0.2, 0], [0.2, 0.1], [0.102, 0.1], [0.102, 0.02], [0.098, 0.02], [0.098, 0.1], [0, 0.1]])
    electrodes = BoundaryElectrodes([[0.102, 0.06], [0.05, 0.0]], 0.01, 0.1)
    draw_electrodes(slit.mesh(num_points=300), electrodes, ax=ax)
    inside, outside = ax.texts
    assert slit.signed_distance(np.array([inside.get_position()]))[0] > 0
    assert inside.get_position()[0] > 0.102  # on its own side
    assert np.linalg.norm(np.array(inside.get_position()) - (0.102, 0.06)) < 0.015
    assert inside.get_path_effects()
    assert not outside.get_path_effects()


def test_circles_of_inclusions_have_their_area_or_volume(ax):
    flat, round_ = Inclusion(1, (0.0, 0.0), np.pi * 0.02**2, 1.0), Inclusion(-1, (0.0, 0.0, 0.1), 4e-6 * np.pi / 3, 1.0)
    draw_inclusions([flat, round_], ax=ax)
    assert [patch.radius for patch in ax.patches] == pytest.approx([0.02, 0.01])


def test_intervals_are_placed_inward_without_overlap(ax):
    """Below a body in the upper half, above one in the lower half, and on the other side if a label is there
    already."""
    known = Quantities(2.0, (1.5, 2.5), 1e-4, (0.5e-4, 2e-4), 0.5e-4, (0.4e-4, 0.6e-4))
    angle = 2 * np.pi * np.arange(32) / 32
    round_body = 0.01 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    places = np.array([[0.0, 0.06], [0.0, -0.06], [0.02, -0.06]])
    ax.set_aspect("equal")
    ax.plot([-0.1, 0.1], [-0.1, 0.1])
    draw_outlines([Star(1, place, place + round_body, 1.1, True, 2.0, known) for place in places], ax=ax)
    (upper, lower, beside) = ax.texts
    assert [one.get_text() for one in ax.texts] == ["+150 % to +250 %"] * 3
    np.testing.assert_allclose([one.xy[1] for one in ax.texts], [0.05, -0.05, -0.07])
    assert [one.get_va() for one in (upper, lower, beside)] == ["top", "bottom", "top"]


def test_an_electrode_across_the_start_of_the_outline_is_one_line(mesh, ax):
    across = BoundaryElectrodes(jnp.array([[RADIUS, 0.0], [-RADIUS, 0.0]]), 0.02, 0.1)
    draw_electrodes(mesh, across, ax=ax)
    (arcs,) = [c for c in ax.collections if isinstance(c, LineCollection)]
    arc = arcs.get_segments()[0]
    assert np.linalg.norm(np.diff(arc, axis=0), axis=1).max() < 0.02
    assert arc[:, 1].min() == pytest.approx(-arc[:, 1].max(), rel=1e-6)


def test_numbers_of_rings_round_a_tank_are_combined(ax):
    tank = Solid(Disk(RADIUS), 0.04).mesh(num_points=1200)
    rings = np.concatenate([ring(RADIUS, 4, height=height) for height in (0.01, 0.03)])
    draw_electrodes(tank, FaceDiscs(rings, 0.008, 0.1), ax=ax)
    assert [text.get_text() for text in ax.texts] == ["1, 5", "2, 6", "3, 7", "4, 8"]
    assert not [c for c in ax.collections if isinstance(c, PatchCollection)]  # a disc on the wall is seen from its side
    draw_electrodes(tank, FacePatches(rings[:4], 0.01, 0.01, 0.1), ax=ax)
    assert not [c for c in ax.collections if isinstance(c, PatchCollection)]


@pytest.mark.parametrize(
    ("outline", "inches"),
    [
        pytest.param(Disk(RADIUS), (5.0, 4.4), id="disk", marks=pytest.mark.slow),
        pytest.param(Rectangle(0.15, 0.2), (4.0, 3.6), id="rectangle"),
    ],
)
def test_numbers_of_rings_are_beside_their_electrodes(outline, inches, ax):
    tank = Solid(outline, 0.04).mesh(num_points=600)
    level = ring(RADIUS, 16)
    if isinstance(outline, Rectangle):
        quarter = [[0.075, 0.025], [0.075, 0.075], [0.055, 0.1], [0.018, 0.1]]
        level = np.concatenate([np.array(quarter) * side for side in ([1, 1], [-1, 1], [-1, -1], [1, -1])])
    places = np.concatenate([np.column_stack([level, np.full(16, height)]) for height in (0.01, 0.03)])
    hide_axes(draw_electrodes(tank, FaceDiscs(places, 0.004, 0.1), ax=ax), extent_of(tank.points))
    ax.figure.set_size_inches(inches)
    ax.figure.canvas.draw()
    dots, radius = ax.transData.transform(level), np.sqrt(28 / np.pi) * ax.figure.dpi / 72
    assert len(ax.texts) == 16
    for text in ax.texts:
        box = text.get_window_extent()
        away = np.maximum([box.x0, box.y0] - dots, dots - [box.x1, box.y1]).clip(0)
        assert np.linalg.norm(away, axis=1).min() > radius, text.get_text()
        assert ax.bbox.x0 <= box.x0 < box.x1 <= ax.bbox.x1  # not under the colour bar


def test_a_section_of_a_solid_has_its_outline(ax):
    tank = Solid(Disk(RADIUS), 0.04).mesh(num_points=1200)
    plot_image(tank, np.zeros(tank.num_cells), ax=ax)
    (outline,) = [c for c in ax.collections if isinstance(c, ContourSet)]
    np.testing.assert_allclose(np.linalg.norm(outline.get_paths()[0].vertices, axis=1), RADIUS, rtol=0.02)


def test_other_kinds_of_electrodes(ax):
    sheet = rectangle(0.2, 0.1, num_points=200)
    combined = CombinedElectrodes(
        BoundaryElectrodes(jnp.array([[-0.1, 0.0]]), 0.02, 0.1), SheetDiscs([[0.0, 0.0]], 0.01, 0.1)
    )
    draw_electrodes(sheet, combined, ax=ax)
    assert set(texts(ax)) == {"1", "2"}
    assert any(isinstance(c, PatchCollection) for c in ax.collections)
    draw_electrodes(sheet, plates(sheet, ["left", "right"], 0.1), ax=ax, first=3)
    assert set(texts(ax)) == {"1", "2", "3", "4"}
    draw_electrodes(sheet, PointElectrodes([[0.05, 0.0], [-0.05, 0.0]]), ax=ax, numbers=False)
    assert len(texts(ax)) == 4


def test_electrodes_of_an_outline_with_a_hole(ax):
    square = np.array([[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]])
    mesh = Polygon(square, [0.03 + 0.4 * square]).mesh(num_points=200)
    draw_electrodes(mesh, BoundaryElectrodes([[0.1, 0.05], [0.03, 0.05]], 0.01, 0.1), ax=ax)
    (arcs,) = [c for c in ax.collections if isinstance(c, LineCollection)]
    for arc, x in zip(arcs.get_segments(), (0.1, 0.03), strict=True):
        np.testing.assert_allclose(arc[:, 0], x, atol=1e-12)


def test_length_of_the_scale_bar(mesh, ax):
    plot_image(mesh, np.ones(mesh.num_cells), ax=ax)
    (bar,) = ax.lines
    assert np.ptp(bar.get_xdata()) == pytest.approx(0.02)
    assert "20 mm" in texts(ax)


def test_inclusions_are_marked(mesh, ax):
    plot_image(mesh, np.ones(mesh.num_cells), inclusions=[Inclusion(1, (0.01, -0.02), np.pi * 1e-4, 1.0)], ax=ax)
    (circle,) = ax.patches
    assert circle.get_center() == (0.01, -0.02)
    assert circle.get_radius() == pytest.approx(0.01)


def test_extent_of_rasters(ax):
    raster = np.full((4, 8), np.nan)
    raster[0, 0] = -5.0
    plot_raster(raster, (0.0, 0.08, 0.0, 0.04), ax=ax)
    (drawn,) = ax.images
    assert list(drawn.get_extent()) == [0.0, 0.08, 0.0, 0.04]
    assert drawn.get_clim() == pytest.approx((-5, 5))
    assert drawn.origin == "upper"


def test_slice_of_a_solid(ax):
    solid = layer(rectangle(0.1, 0.1, num_points=60), 0.02, 2)
    lower = jnp.where(centroids(solid)[:, 2] < 0.01, 1.0, 3.0)
    electrodes = FaceDiscs([[0.03, 0.03, 0.02], [-0.03, -0.03, 0.02]], 0.01, 0.1)
    plot_image(solid, lower, electrodes, height=0.005, ax=ax)
    np.testing.assert_allclose(np.asarray(ax.images[0].get_array()), 1.0)
    assert colour_bar_label(ax) == "Change of conductivity (S/m)"
    with pytest.raises(ValueError, match="no mesh at z = 1"):
        plot_image(solid, lower, height=1.0)


@pytest.mark.parametrize(("number", "further"), [(4, 2), (5, 2), (6, 3)])
def test_too_few_frames_have_no_spectrum(mesh, number, further):
    """Five frames have a single frequency, which is no line."""
    swing = np.cos(np.arange(number))[:, None] * np.ones(mesh.num_cells)
    drawn = plot_series(ImageSeries(mesh, swing, 0.1 * np.arange(number)), {"all": np.ones(mesh.num_cells, bool)})
    titles = [ax.get_title() for ax in drawn.axes if ax.get_title()]
    assert titles[:number] == [f"{one:.2f} s" for one in 0.1 * np.arange(number)]
    assert titles[number:] == ["functional image", "regions over time", "their spectra"][:further]
    assert all(len(ax.lines[0].get_xdata()) > 1 for ax in drawn.axes if ax.get_title() in titles[number + 1 :])


def test_a_series_of_a_solid_is_cut_in_the_stated_plane():
    """Of three layers, the middle one by default."""
    tank = layer(rectangle(0.1, 0.1, num_points=60), 0.03, 3)
    number = np.floor(np.asarray(centroids(tank))[:, 2] / 0.01) + 1.0
    series = ImageSeries(tank, np.stack([number, number]), np.arange(2.0))
    for height, place, expected in ((None, "15.0", 2.0), (0.025, "25.0", 3.0)):
        axes = {ax.get_title(): ax for ax in plot_series(series, {}, height=height).axes}
        assert f"functional image, slice at z = {place} mm" in axes
        np.testing.assert_allclose(axes["1.00 s"].images[1].get_array(), expected)


def test_sensitivity_is_lowest_in_the_middle(mesh, electrodes, ax):
    model = ForwardModel(mesh, electrodes, adjacent(8))
    plot_sensitivity(model, 1e-3, ax=ax)
    (cells,) = [c for c in ax.collections if c.get_array() is not None]
    middle = np.argmin(np.linalg.norm(np.asarray(centroids(mesh)), axis=1))
    assert cells.get_array()[middle] < -20  # decibels relative to the edge: adjacent drives hardly reach the middle
    assert cells.get_array().max() == 0
    sensitivity = np.linalg.norm(model.jacobian(1e-3), axis=0) / measures(mesh)
    below = cells.get_array() < 0
    expected = 20 * np.log10(sensitivity / sensitivity[middle])
    np.testing.assert_allclose((cells.get_array() - cells.get_array()[middle])[below], expected[below], atol=1e-9)
    assert below.mean() == pytest.approx(0.99, abs=0.005)
    assert colour_bar_label(ax) == "Sensitivity per area (dB)"


def test_both_parts_of_an_admittivity_have_their_own_scale(mesh):
    values = np.where(np.asarray(centroids(mesh))[:, 0] > 0, 2e-3 - 3e-6j, -1e-3 + 1e-6j)
    axes = plot_admittivity(mesh, values, titles=("first", "second"))
    drawn = [next(c for c in ax.collections if c.get_array() is not None) for ax in axes]
    np.testing.assert_allclose(drawn[0].get_array(), 1e3 * values.real)
    np.testing.assert_allclose(drawn[1].get_array(), 1e6 * values.imag)
    assert [ax.get_title() for ax in axes] == ["first", "second"]
    bars = [ax.get_ylabel() for ax in axes[0].figure.axes[2:]]
    assert bars == ["Change of conductivity σ (mS)", "Change of susceptivity ωε (µS)"]
    (figure,) = {ax.figure for ax in plot_admittivity(mesh, -values * np.sign(values.imag), difference=False)}
    assert [ax.get_ylabel() for ax in figure.axes[2:]] == ["Conductivity σ (mS)", "Susceptivity ωε (µS)"]
    with pytest.raises(ValueError, match="real; draw them with plot_image"):
        plot_admittivity(mesh, values.real)


def test_voltages_and_their_difference(ax):
    protocol = adjacent(8)
    measured = np.linspace(1e-3, 2e-3, 40)
    plot_voltages(measured, 1.02 * measured, protocol, ax=ax)
    upper, lower = ax.child_axes
    assert upper.get_title(loc="left") == "Relative misfit 2 %"
    assert upper.get_ylabel() == "Voltage (mV)"
    np.testing.assert_allclose(upper.lines[0].get_ydata(), 1e3 * measured)
    np.testing.assert_allclose(upper.lines[1].get_ydata(), 1.02e3 * measured)
    assert [line.get_label() for line in upper.lines] == ["measured", "modelled"]
    (starts,) = upper.collections  # of each drive, with five channels
    np.testing.assert_allclose([line[0, 0] for line in starts.get_segments()], np.arange(4.5, 35, 5))
    assert lower.lines[-1].get_ydata().max() == pytest.approx(2 * 2e-3 / np.sqrt(np.mean(measured**2)), rel=1e-9)


def test_masked_channels_are_left_out(ax):
    measured = np.array([1.0, np.nan, 2.0])
    plot_voltages(measured, np.ones(3), mask=[True, False, True], ax=ax)
    np.testing.assert_array_equal(ax.child_axes[0].lines[0].get_xdata(), [0, 2])


def test_a_figure_is_made_without_axes(mesh, electrodes):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    ax = plot_mesh(mesh, electrodes)
    assert "nodes" in ax.get_title()
    ax.figure.canvas.draw()
    pyplot.close(ax.figure)
