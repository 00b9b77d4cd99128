"""Pictures of what a learnt skin predicts, and of its errors on held-out presses, from predictions that are made up."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest

from jeit.touch.learnt.learn_from_presses import Standing
from jeit.touch.learnt.recorded_presses import Touches
from jeit.touch.plots.learnt import (
    plot_answers,
    plot_confusion,
    plot_force_errors,
    plot_key_errors,
    plot_place_errors,
    plot_places,
)
from jeit.touch.reports import listener
from jeit.touch.reports.learnt_skin import summary


def touches(**fields) -> Touches:
    names = ("position", "position_std", "force", "force_std", "label", "probability", "touched", "key_probability")
    unlike, others = fields.pop("unlike", np.zeros(4, bool)), {"novelty": np.zeros(4), "alive": np.ones((4, 1), bool)}
    return Touches(**{name: fields.get(name) for name in names}, unlike=unlike, **others)


def test_places_are_drawn_with_their_deviations_and_frames_without_a_touch_are_left_out():
    position = np.array([[0.01, 0.02], [np.nan, np.nan], [0.03, 0.01], [0.02, 0.02]])
    ax = plot_places(touches(position=position, position_std=np.full((4, 2), 1e-3)))
    ellipses, points = ax.collections[:2]
    np.testing.assert_allclose(np.asarray(points.get_offsets()), position[[0, 2, 3]])
    assert len(np.asarray(ellipses.get_offsets())) == 3
    assert ax.get_title().startswith("3 touches")
    nothing = np.full((4, 2), np.nan)
    empty = plot_places(touches(position=nothing, position_std=nothing))
    unlike = plot_places(touches(position=nothing, position_std=nothing, unlike=np.ones(4, bool)))
    assert (empty.get_title(), unlike.get_title()) == ("No touch", "All frames unlike any learnt from")
    with pytest.raises(ValueError, match="did not learn any"):
        plot_places(touches())
    plt.close("all")


def test_keys_labels_and_forces_are_drawn_over_the_frames():
    keys = plot_answers(touches(touched=np.eye(4, 3, dtype=bool)))
    assert (keys.get_ylabel(), len(keys.get_yticks())) == ("Key", 3)
    labels = plot_answers(touches(label=np.array(["tap", "", "stroke", "tap"])))
    assert [text.get_text() for text in labels.get_yticklabels()] == ["stroke", "tap"]
    np.testing.assert_array_equal(labels.lines[0].get_xydata(), [[0, 1], [2, 0], [3, 1]])
    force = np.array([0.0, 1.0, 2.0, 1.0])
    unlike = np.array([False, False, True, False])
    forces = plot_answers(touches(force=force, force_std=np.full(4, 0.1), unlike=unlike))
    assert forces.get_ylabel() == "Force (N)"
    np.testing.assert_array_equal(forces.lines[0].get_ydata(), force)
    assert forces.get_title() == "red: 1 frame unlike any learnt from"
    plt.close("all")


def test_errors_of_keys_are_shares_of_presses():
    right = np.array([[True, False], [True, True], [False, True], [False, False]])
    held_out = right ^ np.array([[True, False], [False, False], [False, False], [False, False]])
    ax = plot_key_errors(Standing("som", [("som", 0.1)], held_out, right, None))
    assert [bar.get_height() for bar in ax.patches] == [25.0, 0.0]  # pyright: ignore
    assert ax.get_title() == "Keys: 87.5 % right, whole patterns 75.0 %"
    plt.close(ax.figure)


def test_errors_of_places_are_in_millimetres_at_the_true_places():
    """The largest errors are drawn last, over the others."""
    right = np.array([[0.01, 0.02], [0.03, 0.04], [0.05, 0.0], [0.0, 0.0]])
    error = np.array([[3e-3, 4e-3], [0.0, 1e-3], [-2e-3, 0.0], [0.0, 0.0]])
    ax = plot_place_errors(Standing("som", [], right + error, right))
    (points,) = ax.collections
    np.testing.assert_allclose(points.get_offsets(), right[[3, 1, 2, 0]])  # pyright: ignore
    np.testing.assert_allclose(points.get_array(), [0, 1, 2, 5], atol=1e-12)  # pyright: ignore
    assert points.get_clim() == (0, pytest.approx(5 - 0.06 * 3))
    assert ax.get_title() == "Places: 2 mm on average, median 1.5 mm"
    assert ax.figure.axes[1].get_ylabel() == "Error of presses held out (mm)"
    plt.close(ax.figure)


def test_errors_of_forces_and_labels():
    right, held_out = np.array([[1.0], [2.0], [4.0]]), np.array([[1.5], [2.0], [3.0]])
    ax = plot_force_errors(Standing("som", [], held_out, right))
    line, points = ax.lines
    np.testing.assert_array_equal(line.get_xydata(), [[1, 1], [4, 4]])
    np.testing.assert_array_equal(points.get_xydata(), [[1, 1.5], [2, 2], [4, 3]])
    assert (ax.get_xlabel(), ax.get_title()) == ("Force (N)", "Forces: 0.5 N off on average")
    plt.close(ax.figure)
    names = np.array(["a", "a", "a", "a", "b", "b"])
    ax = plot_confusion(Standing("som", [], np.array(["a", "a", "b", "a", "b", "b"]), names))
    np.testing.assert_array_equal(ax.images[0].get_array(), [[75, 25], [0, 100]])  # rows are true labels
    assert [text.get_text() for text in ax.texts] == ["75", "25", "100"]
    assert ax.get_title() == "Labels: 83.3 % right of presses held out"
    plt.close(ax.figure)


def test_summaries_of_what_was_learnt_are_in_per_cent():
    right = np.array([[True, False], [True, True], [False, True], [False, False]])
    held_out = right ^ np.array([[True, False], [False, False], [False, False], [False, False]])
    assert summary("keys", Standing("som", [], held_out, right)) == "87.5 % of the keys right, 75.0 % of whole patterns"
    sounds = Standing("trees", [("trees", 0.25), ("linear", 0.4)], np.array(["a", "b", "b", "b"]), np.array([*"aabb"]))
    words = "75.0 % of 4 clips right; tried: trees 75.0 %, linear 60.0 %"
    assert listener.summary(SimpleNamespace(standing=sounds)) == words
    title = "trees: 75.0 % of 4 clips held out classified correctly"
    assert listener.draw_listener(SimpleNamespace(standing=sounds, method="trees")).axes[0].get_title() == title
