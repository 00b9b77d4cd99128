"""Figures of touches located by sound: the drawn places, colours, names and units."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from jeit.acoustic import Calibration, MicrophoneArray
from jeit.acoustic.calibration.calibrate import CalibrationFit
from jeit.acoustic.decay import InverseSquare
from jeit.acoustic.localisation.locations import Locations
from jeit.acoustic.microphones import IntensityNoise
from jeit.acoustic.plots import (
    MapMarks,
    plot_error_curve,
    plot_loss_map,
    plot_position_errors,
    plot_receptive_fields,
    plot_track,
)
from jeit.acoustic.plots.surface_view import ESTIMATE_COLOUR
from jeit.acoustic.surface import make_surface
from jeit.acoustic.touch_tracks import Touch, Track
from jeit.layout import grid

OUTLINE = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
DEAD = "dead: every sample is 0"


def calibration(number=9, reasons=(), outline=OUTLINE, points=None, microphones=None):
    """Calibration of equal microphones on a square grid, some of them unusable, {index: reason}."""
    side = int(np.ceil(np.sqrt(number)))
    places = grid(0.15, 0.15, side, side)[:number] if microphones is None else microphones
    why = tuple(dict(reasons).get(k, "") for k in range(number))
    decay = InverseSquare(jnp.full(number, 1e-4), jnp.full(number, 1e-4))
    noise = IntensityNoise.create(number, floor=1e-2, freedom=100.0)
    microphone_array = MicrophoneArray(jnp.asarray(places), make_surface(outline, points), decay, noise)
    return Calibration(
        microphone_array, np.array([not reason for reason in why]), why, np.full((2, number), 0.1), None, "made"
    )


def dome(points):
    """Points (n, 3) above points (n, 2)."""
    return np.column_stack([points, 0.3 - 1.5 * np.sum(np.asarray(points) ** 2, axis=1)])


def fitted(number=9, reasons=(), outliers=()):
    """A fit to 30 taps without errors, of strengths from 1 to 2. The left-out taps are ten times as loud."""
    known = calibration(number, reasons)
    rng = np.random.default_rng(0)
    places = rng.uniform(-0.1, 0.1, (30, 2))
    distance = np.linalg.norm(places[:, None] - np.asarray(known.microphone_array.microphones), axis=2)
    strength, outlier = np.linspace(1, 2, 30), np.isin(np.arange(30), outliers)
    power = strength[:, None] * 1e-4 / (distance**2 + 1e-4) * np.where(outlier, 10, 1)[:, None]
    usable = np.ones_like(power, bool)
    for index, reason in dict(reasons).items():
        if reason == DEAD:
            power[:, index], usable[:, index] = np.nan, False
    strengths = np.where(outlier, np.nan, strength)
    still = np.zeros(known.microphone_array.microphones.shape)
    return CalibrationFit(known, distance, power, usable, strengths, outlier, np.ones(number), ~known.usable, still)


def recorded(position, statuses=None, *, spread=1e-6, rejected=(), touches=None, used=None, number=9, second=None):
    """A track and its locations: frames 0.1 s apart, NaN where there is no touch."""
    position = np.asarray(position, float)
    frames, d = position.shape
    located = np.isfinite(position).all(axis=1)
    status = np.where(located, "touch", "no touch") if statuses is None else np.asarray(statuses)
    covariance = np.where(located[:, None, None], np.eye(d) * spread if np.ndim(spread) == 0 else spread, np.nan)
    times, nothing = 0.1 * np.arange(frames), np.full(frames, np.nan)
    locations = Locations(
        times=times,
        position=position,
        covariance=covariance,
        strength=np.where(located, 1.0, np.nan),
        status=status.astype(str),
        misfit=nothing,
        freedom=np.full(frames, number - 3),
        used=np.ones((frames, number), bool) if used is None else used,
        second=np.full((frames, d), np.nan) if second is None else second,
        second_strength=nothing,
        overlap=1.0,
        faults=("",) * number,
        notes=(),
        name="made",
    )
    if touches is None:
        index = np.flatnonzero(located)
        touches = [(index[0], index[-1])] if index.size else []
    made = tuple(Touch(float(times[a]), float(times[b]), int(a), int(b), 0.1) for a, b in touches)
    doubted = np.isin(np.arange(frames), rejected)
    return Track(times, position, covariance, np.zeros_like(position), made, doubted), locations


def stroke(frames=20):
    return np.column_stack([np.linspace(-0.06, 0.06, frames), np.linspace(-0.03, 0.05, frames)])


@pytest.fixture
def ax():
    return Figure(layout="constrained").subplots()


def named(ax):
    legend = ax.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]


def texts(ax):
    return [text.get_text() for text in ax.texts]


def dots(ax, label):
    """Places (n, 2) of the markers of this label."""
    (line,) = [line for line in ax.lines if line.get_label() == label]
    return np.column_stack(line.get_data())


def test_a_receptive_field_is_intensity_over_strength_against_distance(ax):
    fit = fitted()
    assert plot_receptive_fields(fit, ax=ax) is ax
    assert len(ax.child_axes) == 9
    for index, panel in enumerate(ax.child_axes):
        taps = panel.collections[0].get_offsets()
        np.testing.assert_allclose(taps[:, 0], 1e3 * fit.distance[:, index])
        np.testing.assert_allclose(taps[:, 1], fit.power[:, index] / fit.strength)
        # The taps are without errors: they lie on the curve.
        x, y = panel.lines[0].get_data()
        np.testing.assert_allclose(np.interp(taps[:, 0], x, y), taps[:, 1], rtol=0.02)
        assert panel.get_yscale() == "log"
        assert panel.texts[0].get_text() == str(index)
        assert panel.texts[1].get_text() == "½ at 10 mm"
    assert texts(ax) == ["Distance (mm)", "Intensity / strength of the tap"]
    assert named(ax)[:2] == ["tap", "fit, inverse-square"]
    assert "left out" not in named(ax)


def test_left_out_taps_are_red_and_unusable_microphones_have_a_reason(ax):
    fit = fitted(reasons={2: "its intensity does not fall with distance", 4: DEAD}, outliers=[3, 7])
    plot_receptive_fields(fit, ax=ax)
    panel = ax.child_axes[0]
    taps, out = panel.collections
    assert len(taps.get_offsets()) == 28
    assert len(out.get_offsets()) == 2
    assert to_hex(out.get_edgecolor()[0]) == ESTIMATE_COLOUR
    assert "left out" in named(ax)
    assert ax.child_axes[2].texts[1].get_text().replace("\n", " ") == "its intensity does not fall with distance"
    dead = ax.child_axes[4]
    assert dead.texts[1].get_text() == DEAD
    assert not dead.collections[0].get_offsets().size
    assert not dead.lines[0].get_xdata().size


@pytest.mark.parametrize(("number", "columns"), [(3, 3), (7, 3), (25, 5), pytest.param(64, 8, marks=pytest.mark.slow)])
def test_axis_labels_are_at_the_border_only(number, columns, ax):
    plot_receptive_fields(fitted(number), ax=ax)
    ax.figure.canvas.draw()
    left = [panel.yaxis.get_tick_params()["labelleft"] for panel in ax.child_axes]
    bottom = [panel.xaxis.get_tick_params()["labelbottom"] for panel in ax.child_axes]
    assert left == [k % columns == 0 for k in range(number)]
    assert bottom == [k + columns >= number for k in range(number)]


def test_a_selection_of_microphones(ax):
    plot_receptive_fields(fitted(), microphones=[5, 1], ax=ax)
    assert [panel.texts[0].get_text() for panel in ax.child_axes] == ["5", "1"]
    for wrong in ([9], [-1], [0.5], []):
        with pytest.raises(ValueError, match="microphones"):
            plot_receptive_fields(fitted(), microphones=wrong, ax=ax)


def test_a_loss_map_has_its_bottom_row_first_and_is_lowest_at_the_source(ax):
    known = calibration()
    values = np.full((20, 40), 50.0)
    values[0, 0], values[5, 30] = np.nan, 2.0
    place, spread = np.array([0.05, -0.04]), np.diag([4e-6, 1e-6])
    marks = MapMarks([0.052, -0.041], estimate=place, covariance=spread)
    assert plot_loss_map(values, known.microphone_array, received=np.linspace(0, 1, 9), marks=marks, ax=ax) is ax
    (drawn,) = ax.images
    assert list(drawn.get_extent()) == pytest.approx([-0.1, 0.1, -0.1, 0.1])
    assert drawn.origin == "lower"
    shown = np.asarray(drawn.get_array().filled(np.nan))
    assert shown[5, 30] == 0
    assert shown[10, 10] == pytest.approx(np.sqrt(2 * 48))
    # The source is in the bright region.
    assert sum(drawn.to_rgba(0.0)[:3]) > sum(drawn.to_rgba(shown[10, 10])[:3])
    (ellipse,) = [patch for patch in ax.patches if isinstance(patch, Ellipse)]
    # √χ²(0.95, 2) = 2.4477 standard deviations of 2 and 1 mm.
    assert (ellipse.width, ellipse.height) == pytest.approx((2 * 2.4477 * 2e-3, 2 * 2.4477 * 1e-3), rel=1e-4)
    assert np.cos(np.radians(ellipse.angle)) ** 2 == pytest.approx(1)
    assert ellipse.center == pytest.approx(tuple(place))
    np.testing.assert_allclose(dots(ax, "truth"), [[0.052, -0.041]])
    np.testing.assert_allclose(dots(ax, "estimate, 95 %"), [place])
    (circles,) = ax.collections
    assert np.all(np.diff(circles.get_sizes()) >= 0)
    assert named(ax) == ["microphone, by level", "truth", "estimate, 95 %"]
    assert "standard deviations" in ax.figure.axes[-1].get_ylabel().lower()
    assert "50 mm" in texts(ax)


def test_the_papers_loss_is_in_decibels(ax):
    values = np.array([[1e-3, 1e-2], [1e-1, 1e6]])
    plot_loss_map(values, OUTLINE, microphones=[[0.0, 0.0]], method="consistency", colour_bar=False, ax=ax)
    np.testing.assert_allclose(ax.images[0].get_array(), [[0, 10], [20, 90]])
    assert ax.images[0].get_clim() == (0, 40)
    assert ax.images[0].get_cmap().colorbar_extend == "max"
    assert named(ax) == ["microphone"]
    assert len(ax.figure.axes) == 1


@pytest.mark.parametrize(
    ("match", "change"),
    [
        ("values has shape", {"values": np.zeros(4)}),
        ("values has shape", {"values": np.full((2, 2), np.nan)}),
        ("method must be", {"method": "loudest"}),
        ("received has shape", {"received": np.ones(8)}),
        ("microphones has shape", {"microphones": np.ones((9, 3))}),
        ("truth has shape", {"marks": MapMarks(truth=[0.0, 0.0, 0.0])}),
        ("estimate has shape", {"marks": MapMarks(estimate=0.0)}),
        ("give estimate too", {"marks": MapMarks(covariance=np.eye(2))}),
        ("covariance has shape", {"marks": MapMarks(estimate=[0.0, 0.0], covariance=np.eye(3))}),
    ],
)
def test_loss_maps_refuse_bad_input(match, change, ax):
    arguments = {"values": np.ones((3, 3)), "surface": calibration().microphone_array, "ax": ax} | change
    with pytest.raises(ValueError, match=match):
        plot_loss_map(**arguments)


def test_pairs_are_connected_and_their_error_is_the_title(ax):
    true, found = grid(0.1, 0.1, 2, 2), grid(0.1, 0.1, 2, 2)
    found[0] += [3e-3, 4e-3]
    found[1] += [0.0, 1e-3]
    found[3] = np.nan
    assert plot_position_errors(true, found, [[0.0, 0.0]], OUTLINE, ax=ax) is ax
    assert ax.get_title() == "2.0 ± 2.2 mm"  # of 5, 1 and 0 mm: √(14 / 3)
    (lines,) = [c for c in ax.collections if isinstance(c, LineCollection)]
    np.testing.assert_allclose(lines.get_segments(), np.stack([true, found], axis=1)[:3])
    assert named(ax) == ["microphone", "true", "not found", "estimated"]
    np.testing.assert_allclose(dots(ax, "not found"), true[3:])
    np.testing.assert_allclose(dots(ax, "estimated"), found[:3])
    assert "50 mm" in texts(ax)


def test_pairs_refuse_unequal_numbers(ax):
    place = np.zeros((4, 2))
    with pytest.raises(ValueError, match="found 3"):
        plot_position_errors(place, place[:3], place, OUTLINE, ax=ax)
    with pytest.raises(ValueError, match="true has shape"):
        plot_position_errors(place.T[:, :3], place, place, OUTLINE, ax=ax)


def test_a_path_is_coloured_by_time_from_onset_to_offset(ax):
    position = np.full((26, 2), np.nan)
    position[3:23] = stroke()
    overlay = np.zeros((10, 10))
    overlay[0, 9] = 1.0
    track, locations = recorded(position)
    assert plot_track(track, locations, calibration(), overlay=overlay, title="Stroke", ax=ax) is ax
    halo, path = [c for c in ax.collections if isinstance(c, LineCollection)]
    np.testing.assert_allclose(path.get_segments(), np.stack([position[3:22], position[4:23]], axis=1))
    colours = path.get_colors()
    assert len(colours) == 19
    assert np.all(np.diff(colours[:, 0] + colours[:, 1]) > 0)  # from dark to bright
    np.testing.assert_allclose(dots(ax, "onset"), position[3:4])
    np.testing.assert_allclose(dots(ax, "offset"), position[22:23])
    bar = ax.figure.axes[-1]
    assert bar.get_ylabel() == "Time (s)"
    assert bar.get_ylim() == pytest.approx((0.3, 2.2))
    assert list(ax.images[0].get_extent()) == pytest.approx([-0.1, 0.1, -0.1, 0.1])
    assert ax.images[0].origin == "lower"
    assert named(ax) == ["microphone", "onset", "offset"]
    assert ax.get_title() == "Stroke"
    assert halo.get_linewidth()[0] > path.get_linewidth()[0]


def test_a_tap_is_a_dot_in_an_ellipse(ax):
    position = np.full((9, 2), np.nan)
    position[4] = [0.02, 0.03]
    plot_track(*recorded(position, spread=9e-6), calibration(), ax=ax)
    (ellipse,) = [patch for patch in ax.patches if isinstance(patch, Ellipse)]
    assert ellipse.center == pytest.approx((0.02, 0.03))
    assert ellipse.width == pytest.approx(2 * 2.4477 * 3e-3, rel=1e-4)
    assert named(ax) == ["microphone", "touch, 95 %"]
    assert all(low < -0.1 and high > 0.1 for low, high in (ax.get_xlim(), ax.get_ylim()))  # the whole skin
    assert not ax.images
    assert len(ax.figure.axes) == 1  # a single time needs no colour bar


def test_a_recording_without_a_touch_says_so(ax):
    track, locations = recorded(np.full((5, 2), np.nan))
    plot_track(track, locations, calibration(), ax=ax)
    assert "no touch" in texts(ax)
    assert len(ax.figure.axes) == 1
    track, locations = recorded(np.full((5, 2), np.nan), ["unusable"] * 5)
    plot_track(track, locations, calibration(), overlay=np.zeros((3, 3)), ax=(other := Figure().subplots()))
    assert "no usable frame" in texts(other)


def test_unusable_microphones_are_crossed_out(ax):
    used = np.ones((20, 9), bool)
    used[:, 5] = False
    used[3, 7] = False
    known = calibration(reasons={1: DEAD})
    plot_track(*recorded(stroke(), used=used), known, ax=ax)
    np.testing.assert_allclose(dots(ax, "not usable"), np.asarray(known.microphone_array.microphones)[[1, 5]])
    assert len(dots(ax, "microphone")) == 7
    assert named(ax)[:2] == ["microphone", "not usable"]


def test_frames_with_another_status_are_labelled(ax):
    statuses = np.full(20, "touch", dtype="<U12")
    statuses[[2, 3]], statuses[5], statuses[8] = "outside", "misfit", "two touches"
    second = np.full((20, 2), np.nan)
    second[8] = [-0.05, 0.06]
    track, locations = recorded(stroke(), statuses, rejected=[3, 12], second=second)
    plot_track(track, locations, calibration(), truth=stroke(3), ax=ax)
    known = ["not believed (2)", "two touches (1)", "outside (2)", "misfit (1)"]
    assert named(ax) == ["microphone", "truth", "onset", "offset", *known]
    marked = [np.asarray(c.get_offsets()) for c in ax.collections if not isinstance(c, LineCollection)]
    plain, doubted, other, first, outside, misfit = marked
    assert len(plain) == 15
    np.testing.assert_allclose(doubted, stroke()[[3, 12]])
    np.testing.assert_allclose(other, second[[8]])
    np.testing.assert_allclose(first, stroke()[[8]])
    pair = [c for c in ax.collections if isinstance(c, LineCollection)][-1]
    np.testing.assert_allclose(pair.get_segments(), [[stroke()[8], second[8]]])
    np.testing.assert_allclose(outside, stroke()[[2, 3]])
    np.testing.assert_allclose(misfit, stroke()[[5]])


def test_a_curved_skin_is_drawn_in_its_chart(ax):
    over = {"points": dome(grid(0.18, 0.18, 5, 5)), "microphones": dome(grid(0.15, 0.15, 3, 3))}
    known = calibration(outline=dome(OUTLINE), **over)
    plot_track(*recorded(dome(stroke())), known, overlay=np.ones((4, 4)), ax=ax)
    surface = known.microphone_array.surface
    places = np.asarray(surface.project(jnp.asarray(dome(stroke()).T))).T
    np.testing.assert_allclose(dots(ax, "onset"), places[:1])
    np.testing.assert_allclose(
        dots(ax, "microphone"), np.asarray(surface.project(known.microphone_array.microphones.T)).T
    )


def test_the_ellipse_lies_in_the_plane_of_the_skin(ax):
    turn = np.array([[np.cos(0.7), 0, -np.sin(0.7)], [0, 1, 0], [np.sin(0.7), 0, np.cos(0.7)]])

    def tilted(points):
        return np.column_stack([points, np.zeros(len(points))]) @ turn.T

    known = calibration(outline=tilted(OUTLINE), microphones=tilted(grid(0.15, 0.15, 3, 3)))
    spread = turn @ np.diag([4e-6, 1e-6, 0.0]) @ turn.T
    plot_track(*recorded(tilted(np.full((4, 2), 0.02)), spread=spread), known, ax=ax)
    (ellipse,) = [patch for patch in ax.patches if isinstance(patch, Ellipse)]
    assert (ellipse.width, ellipse.height) == pytest.approx((2 * 2.4477 * 2e-3, 2 * 2.4477 * 1e-3), rel=1e-4)


@pytest.mark.parametrize(
    ("match", "change"),
    [
        ("overlay has shape", {"overlay": np.zeros((3, 4, 4))}),
        ("truth has shape", {"truth": np.zeros((4, 3))}),
        ("locations: 20 frames of 9 microphones", {"array": calibration(16)}),
        ("locations", {"locations": recorded(stroke(19))[1]}),
    ],
)
def test_tracks_refuse_bad_input(match, change, ax):
    track, locations = recorded(stroke())
    arguments = {"track": track, "locations": locations, "array": calibration(), "ax": ax} | change
    with pytest.raises(ValueError, match=match):
        plot_track(**arguments)


def test_error_curves_are_in_millimetres_beside_the_bound(ax):
    ratio = np.array([20.0, 0.0, 10.0])
    errors = np.array([[1.0, 2.0, 9.0], [10.0, 20.0, np.nan], [3.0, 4.0, 5.0]]) * 1e-3
    assert plot_error_curve(ratio, {"likelihood": errors, "other": errors[:, 0]}, bound=1e-3 * np.ones(3), ax=ax) is ax
    many, one, bound = ax.lines
    np.testing.assert_allclose(many.get_data(), [[0, 10, 20], [15, 4, 2]])
    np.testing.assert_allclose(one.get_ydata(), [10, 3, 1])
    np.testing.assert_allclose(bound.get_ydata(), 1.0)
    assert len(ax.collections) == 1  # a band for many, none for one
    assert named(ax) == ["likelihood", "other", "Cramér-Rao bound"]
    assert ax.get_xlabel() == "Signal-to-noise ratio (dB)"
    assert ax.get_ylabel() == "Median error (mm)"
    assert (ax.get_xscale(), ax.get_yscale()) == ("linear", "log")


@pytest.mark.parametrize(("statistic", "label", "value"), [("mean", "Mean", 4.0), ("rms", "RMS", np.sqrt(86 / 3))])
def test_error_curves_of_other_statistics(statistic, label, value, ax):
    errors = {"likelihood": np.array([[1.0, 2.0, 9.0]] * 3) * 1e-3}
    plot_error_curve([4, 9, 25], errors, quantity="Microphones", statistic=statistic, logarithmic=True, ax=ax)
    np.testing.assert_allclose(ax.lines[0].get_ydata(), value)
    assert ax.get_ylabel() == f"{label} error (mm)"
    ax.figure.canvas.draw()
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["4", "9", "25"]


@pytest.mark.parametrize(
    ("match", "change"),
    [
        ("values has shape", {"values": np.zeros((2, 2))}),
        ("values has shape", {"values": [0.0, 1.0], "logarithmic": True}),
        ("errors has 0", {"errors": {}}),
        (r"errors\['a'\] has shape", {"errors": {"a": np.ones(3)}}),
        (r"errors\['a'\]: errors are distances", {"errors": {"a": [-1.0, 1.0]}}),
        ("bound has shape", {"bound": np.ones(3)}),
        ("statistic must be", {"statistic": "worst"}),
    ],
)
def test_error_curves_refuse_bad_input(match, change, ax):
    arguments = {"values": [1.0, 2.0], "errors": {"a": np.ones((2, 4))}, "ax": ax} | change
    with pytest.raises(ValueError, match=match):
        plot_error_curve(**arguments)


def test_figures_are_created_where_no_axes_are_given():
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    drawn = [
        plot_receptive_fields(fitted()),
        plot_loss_map(np.eye(3), calibration()),
        plot_position_errors(stroke(4), stroke(4), [[0.0, 0.0]], OUTLINE),
        plot_track(*recorded(stroke()), calibration()),
        plot_error_curve([0.0, 1.0], {"likelihood": [1e-3, 2e-3]}),
    ]
    for ax in drawn:
        ax.figure.canvas.draw()
        pyplot.close(ax.figure)
