"""Figures of touches in time and on the skin, tested on the drawn lanes, bars, gaps and colours, and of a skin's change
in time.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from jeit.electrodes import PointElectrodes
from jeit.mesh import Rectangle
from jeit.plot.colours import SERIES_COLOURS
from jeit.touch import NamedTouch, SkinHealth, Standing
from jeit.touch.gestures import ChangeCourse, StreamTouch
from jeit.touch.health.event import EventKind, EventStatus, HealthEvent
from jeit.touch.listening import SoundLabels
from jeit.touch.plots import (
    plot_changes,
    plot_health,
    plot_health_course,
    plot_sound_labels,
    plot_timeline,
    plot_touch_paths,
    plot_tried,
)
from jeit.touch.reports import report_health

NAMES = ("pat", "tap")


def named(number, gesture, onset, length, *, unlike=False, cut_off=False, probability=0.9):
    seconds = onset + np.linspace(0, length, 5)
    place = np.linspace((0.0, 0.0), (0.02, 0.01), 5)
    place[2] = np.nan  # bridged
    ones = np.ones(5)
    course = ChangeCourse(seconds, ones, -ones, 0.1 * ones, ones, 1e-4 * ones, place)
    shares = np.array([probability, 1 - probability])
    touch = StreamTouch(course, 0, False, cut_off)
    return NamedTouch(number, touch, gesture, probability, shares, unlike, onset + length, 1e-3)


@pytest.fixture
def ax():
    return Figure().subplots()


def test_touches_are_bars_in_their_lanes(ax):
    touches = [
        named(1, "pat", 1.0, 0.5),
        named(2, "tap", 3.0, 0.25, cut_off=True),
        named(3, "tap", 5.0, 1.0, unlike=True),
    ]
    plot_timeline(touches, NAMES, ax=ax)
    assert [one.get_text() for one in ax.get_yticklabels()] == ["pat", "tap", "unlike any"]
    assert [(one.get_x(), one.get_width(), round(one.get_y() + 0.36)) for one in ax.patches] == [
        (1.0, 0.5, 0),
        (3.0, 0.25, 1),
        (5.0, 1.0, 2),
    ]
    assert {one.get_text() for one in ax.texts} == {"1", "2", "3"}
    (end,) = ax.lines
    assert end.get_xdata()[0] == 3.25  # cut off there


def test_a_curve_is_thinned_with_its_extremes_and_gaps(ax):
    seconds = np.arange(50_000) / 60
    peaks = np.zeros(50_000)
    peaks[31_415] = 2e-3
    peaks[100:200] = np.nan
    plot_changes(seconds, peaks, 1e-3, ax=ax)
    line = ax.lines[0]
    assert len(line.get_xdata()) <= 3000
    assert np.nanmax(line.get_ydata()) == pytest.approx(2.0)
    assert np.isnan(line.get_ydata()).any()
    assert ax.get_ylabel() == "Greatest change (mS)"
    with pytest.raises(ValueError, match="one of each for every frame"):
        plot_changes(seconds, peaks[:-1], 1e-3, ax=ax)


def test_paths_leave_out_touches_without_a_place(ax):
    plot_touch_paths(Rectangle(0.1, 0.05).mesh(num_points=60), [named(1, "pat", 0.0, 1.0)], NAMES, ax=ax)
    path = next(one for one in ax.lines if len(one.get_xdata()) == 4)
    assert path.get_xdata()[-1] == pytest.approx(0.02)


def test_a_figure_without_touches_says_so(ax):
    for draw in (lambda: plot_timeline([1], NAMES, ax=ax), lambda: plot_timeline(None, NAMES, ax=ax)):
        with pytest.raises(ValueError, match="touches"):
            draw()


def test_methods_are_shown_in_order(ax):
    standing = Standing("b on seven", [("b on seven", 0.1), ("a on seven", 0.3)], np.array(["x"]), np.array(["x"]))
    plot_tried(standing, ax=ax)
    assert [round(one.get_width()) for one in ax.patches] == [90, 70]
    assert ax.patches[0].get_facecolor() != ax.patches[1].get_facecolor()


def test_a_skin_over_time(ax):
    rng = np.random.default_rng(0)
    health = SkinHealth.fit(1 + 1e-3 * rng.normal(size=(200, 6)))
    frames = 1 + 1e-3 * rng.normal(size=(50, 6))
    frames[20:] += 1.0
    frames[5] = np.nan
    plot_health_course(health, np.arange(50), frames, ax=ax)
    size = ax.lines[0].get_ydata()
    assert size[:5].max() < 1 < size[20:].min()
    with pytest.raises(ValueError, match="frames have shape"):
        plot_health_course(health, np.arange(49), frames, ax=ax)


def event(kind, status=EventStatus.LASTING, **fields):
    return HealthEvent(0, kind, status, 20.0, 24.0, 18, np.arange(6) < 2, np.zeros(6), 3.0, **fields)


def with_events(*events, skin=None):
    """The state of a skin of six channels after some events."""
    health = SkinHealth.fit(1 + 1e-3 * np.random.default_rng(0).normal(size=(200, 6)))
    return replace(health, record=replace(health.record, events=events, skin=skin))


def test_events_of_a_skin_are_marked_at_their_time(ax):
    """Electrodes are numbered from 1."""
    health = with_events(event(EventKind.DEAD, electrode=2), event(EventKind.REPAIRED), event(EventKind.CHANGED))
    plot_health_course(health, np.arange(50), np.ones((50, 6)), ax=ax)
    assert [text.get_text() for text in ax.texts] == [" limit", "dead electrode 3", "repaired", "changed"]
    _, limit, *marks = ax.lines
    assert list(limit.get_ydata()) == [1, 1]
    assert [list(line.get_xdata()) for line in marks] == 3 * [[20, 20]]
    dead, repaired, changed = (line.get_color() for line in marks)
    assert (dead, repaired, changed) == (SERIES_COLOURS[1], SERIES_COLOURS[2], SERIES_COLOURS[1])


def test_a_report_of_damage_has_numbers_of_electrodes_and_metres():
    cut = event(EventKind.CUT, path=np.array([[0.0, 0.0], [0.03, 0.04]]), deviation=2e-3)
    report = report_health(with_events(event(EventKind.DEAD, electrode=2), cut), "skin", timed=True)
    dead, cut = report["events"]
    assert (dead["electrode"], dead["channels"], dead["length_m"], dead["path_m"]) == (3, [0, 1], None, None)
    assert (dead["time"], dead["noticed"], dead["frame"], report["units"]["time"]) == (20.0, 24.0, 18, "s")
    assert (cut["electrode"], cut["length_m"], cut["length_deviation_m"]) == (None, pytest.approx(0.05), 2e-3)
    assert cut["path_m"] == [[0.0, 0.0], [0.03, 0.04]]


def test_cuts_and_failed_electrodes_are_drawn_on_the_skin(ax):
    electrodes = PointElectrodes([(0.05, 0.0), (0.0, 0.025), (-0.05, 0.0)])
    model = SimpleNamespace(mesh=Rectangle(0.1, 0.05).mesh(num_points=60), electrodes=electrodes)
    path = np.array([[-0.02, 0.0], [0.01, 0.004]])
    cuts = [
        event(EventKind.CUT, path=path, deviation=2.6e-3),
        event(EventKind.CUT, EventStatus.MENDED, path=-path),
        event(EventKind.CUT, EventStatus.DENIED, path=2 * path),
    ]
    failed = event(EventKind.DEAD, electrode=2), event(EventKind.LOOSE, EventStatus.MENDED, electrode=0)
    plot_health(with_events(*cuts, *failed, skin=SimpleNamespace(model=model)), ax=ax)
    *_, cut, mended, cross = ax.lines
    np.testing.assert_array_equal(cut.get_xydata(), path)
    np.testing.assert_array_equal(mended.get_xydata(), -path)
    assert cut.get_linestyle() == "-" != mended.get_linestyle()
    np.testing.assert_allclose(cross.get_xydata(), [[-0.05, 0.0]])
    labels = [text.get_text() for text in ax.texts if text.get_text().endswith(" s")]
    assert labels == ["cut, 30 ± 3 mm, at 20 s", "mended, 30 mm, at 20 s"]


def test_sounds_are_probabilities_in_per_cent_over_time(ax):
    """The second window is quiet, so that its probabilities are left out."""
    quiet, yes = np.array([False, True, False]), np.ones(3, bool)
    probabilities = np.array([[0.9, 0.1], [0.5, 0.5], [0.2, 0.8]])
    labels = SoundLabels(np.array([1.0, 1.1, 1.2]), probabilities, ("low", "high"), quiet, yes, np.zeros(3, int), yes)
    plot_sound_labels(labels, ax=ax)
    drawn = np.ma.filled(ax.images[0].get_array().astype(float), np.nan)
    np.testing.assert_allclose(drawn, [[90, np.nan, 20], [10, np.nan, 80]])
    assert ax.images[0].get_clim() == (0, 100)
    left, right, *rows = ax.images[0].get_extent()
    assert (left < 1.0, right > 1.2, 1.0 - left) == (True, True, pytest.approx(right - 1.2))
    assert rows == [-0.5, 1.5]
    assert ax.get_title() == "recording: sounds in red; blank, 1 of 3 windows quiet"
    assert [round(line.get_ydata()[0] + 0.42) for line in ax.lines] == [0, 1]
    assert [one.get_text() for one in ax.get_yticklabels()] == ["low", "high"]
    assert "Probability (%)" in [one.get_ylabel() for one in ax.figure.axes] + [
        one.get_ylabel() for one in ax.child_axes
    ]
