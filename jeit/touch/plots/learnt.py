"""Plots of learnt skins and networks: predicted touches, errors on held-out presses (places, forces, labels and keys),
maps of indentation depth, and losses during training."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from jeit.arguments import check_kind, counted, real_array
from jeit.plot.axes import draw_legend_above, draw_scale_bar, extent_of, get_or_create_axes, hide_axes, style_graph_axes
from jeit.plot.colours import DARK_GREY, LIGHT_GREY, SEQUENTIAL_COLOUR_MAP, SERIES_COLOURS, draw_colour_bar
from jeit.touch import Standing, Touches
from jeit.touch.training import TrainingResult

# Maximum number of ellipses that are drawn, so that they do not hide each other.
_MAX_ELLIPSES = 400
# Maximum number of labels for which a confusion matrix has tick labels.
_MAX_TICK_LABELS = 24


def plot_places(touches: Touches, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the touched places that a learnt skin estimates from frames, with ellipses of one standard deviation.

    Places in later frames are brighter. Raises `ValueError` if the skin did not learn places.
    """
    if touches.position is None:
        raise ValueError("touches have no places: the skin did not learn any.")
    ax = get_or_create_axes(ax)
    touched_frames = np.flatnonzero(np.isfinite(touches.position).all(axis=1))
    if not touched_frames.size:
        ax.set_axis_off()
        default_title = "All frames unlike any learnt from" if touches.unlike.all() else "No touch"
        ax.set_title(default_title if title is None else title)
        return ax
    touched_places = touches.position[touched_frames, :2]
    place_deviations = touches.position_std[touched_frames, :2]  # pyright: ignore[reportOptionalSubscript]
    extent = extent_of(np.vstack([touched_places - place_deviations, touched_places + place_deviations]))
    hide_axes(ax, extent, numbered=False)
    drawn_indices = np.linspace(0, len(touched_frames) - 1, min(len(touched_frames), _MAX_ELLIPSES)).astype(int)
    ellipse_diameters = 2 * place_deviations[drawn_indices]
    ax.add_collection(
        EllipseCollection(
            ellipse_diameters[:, 0],
            ellipse_diameters[:, 1],
            np.zeros(len(drawn_indices)),
            units="xy",
            offsets=touched_places[drawn_indices],
            transOffset=ax.transData,
            facecolors="none",
            edgecolors=SERIES_COLOURS[0],
            linewidths=0.5,
            alpha=0.35,
        )
    )
    place_markers = ax.scatter(
        *touched_places.T, c=touched_frames, s=12, cmap=SEQUENTIAL_COLOUR_MAP, linewidths=0, zorder=3
    )
    draw_scale_bar(ax, extent)
    draw_colour_bar(ax, place_markers, "Frame")
    ax.set_title(f"{len(touched_frames)} touches, ellipses of one standard deviation" if title is None else title)
    return ax


def plot_answers(touches: Touches, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw what a learnt skin predicts for consecutive frames: pressed keys, labels, or forces in newtons."""
    ax = get_or_create_axes(ax)
    frame_numbers = np.arange(len(touches))
    if touches.touched is not None:
        ax.imshow(
            touches.touched.T, aspect="auto", cmap="Blues", vmin=0, vmax=1.2, interpolation="nearest", origin="lower"
        )
        ax.set_yticks(range(touches.touched.shape[1]))
        ax.set_ylabel("Key", color=DARK_GREY)
    elif touches.label is not None:
        label_names = [str(label_text) for label_text in np.unique(touches.label) if label_text]
        has_label = touches.label != ""
        label_indices = np.searchsorted(label_names, touches.label[has_label])
        ax.plot(
            frame_numbers[has_label],
            label_indices,
            linestyle="none",
            marker="o",
            markersize=3.5,
            color=SERIES_COLOURS[0],
            markeredgewidth=0,
        )
        ax.set_yticks(range(len(label_names)), label_names)
    elif touches.force is not None and touches.force_std is not None:
        lower_limits, upper_limits = touches.force - touches.force_std, touches.force + touches.force_std
        ax.fill_between(frame_numbers, lower_limits, upper_limits, color=SERIES_COLOURS[0], alpha=0.2, linewidth=0)
        ax.plot(frame_numbers, touches.force, color=SERIES_COLOURS[0], linewidth=1.2)
        ax.set_ylabel("Force (N)", color=DARK_GREY)
    for unlike_frame in frame_numbers[touches.unlike]:
        ax.axvline(unlike_frame, color=SERIES_COLOURS[1], linewidth=0.6, alpha=0.5, zorder=0)
    ax.set_xlabel("Frame", color=DARK_GREY)
    num_unlike_touches = int(touches.unlike.sum())
    unlike_text = f"red: {counted(num_unlike_touches, 'frame')} unlike any learnt from" if num_unlike_touches else ""
    ax.set_title(unlike_text if title is None else title)
    style_graph_axes(ax)
    return ax


def plot_depth_map(
    depth: Float[np.ndarray, "rows columns"],
    extent: tuple[float, float, float, float],
    *,
    most: float | None = None,
    colour_bar: bool = True,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a map of indentation depth, such as the result of `ImageNetwork.depth`.

    **Arguments:**

    - `depth`: the map (rows, columns), metres, row 0 at the minimum y.
    - `extent`: (x_min, x_max, y_min, y_max) of the map, metres.
    - `most`: depth at the end of the colour scale, metres; by default the maximum of the map.
    - `colour_bar`: whether to draw a colour bar.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` if `depth` is not a map (rows, columns).

    **Example:**

    ```python
    network = read_network("network")
    ax = plot_depth_map(network.depth(rest, rest), network.extent)
    ```
    """
    depth = real_array("depth", depth, "a map (rows, columns) of depths in metres")
    if depth.ndim != 2:
        raise ValueError(f"depth must be a map (rows, columns); it has shape {depth.shape}.")
    ax = get_or_create_axes(ax)
    hide_axes(ax, extent, numbered=False)
    colour_limit = 1e3 * (float(depth.max()) if most is None else most) or 1.0
    mesh_image = ax.imshow(
        1e3 * depth,
        origin="lower",
        extent=extent,
        cmap=SEQUENTIAL_COLOUR_MAP,
        vmin=0.0,
        vmax=colour_limit,
        interpolation="nearest",
    )
    draw_scale_bar(ax, extent)
    if colour_bar:
        draw_colour_bar(ax, mesh_image, "Depth (mm)")
    if title is not None:
        ax.set_title(title)
    return ax


def plot_losses(courses: Mapping[str, TrainingResult], *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw a network's loss on held-out touches during each training, relative to its first value, and mark its
    minimum.

    `courses`: results of `jeit.touch.fit_network`, by the names of the trainings. Raises `ValueError` for
    anything but such results.
    """
    check_kind("courses", courses, Mapping, "trainings by name, such as learnt.courses")
    ax = get_or_create_axes(ax)
    for (training_name, training_result), line_colour in zip(
        courses.items(), SERIES_COLOURS * len(courses), strict=False
    ):
        check_kind(f"courses[{training_name!r}]", training_result, TrainingResult, "a TrainingResult, as of fit")
        training_course = training_result.course
        relative_losses = np.array(training_course.validation) / training_course.validation[0]
        ax.plot(training_course.steps, relative_losses, color=line_colour, linewidth=1.6, label=training_name)
        ax.plot(
            training_course.steps[training_course.best],
            relative_losses[training_course.best],
            marker="o",
            color=line_colour,
            markersize=5,
        )
    ax.set_xlabel("Batches", color=DARK_GREY)
    ax.set_ylabel("Loss of touches held out, of that at first", color=DARK_GREY)
    style_graph_axes(ax)
    draw_legend_above(ax)
    if title is not None:
        ax.set_title(title)
    return ax


def plot_place_errors(place: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the errors of the places estimated for held-out presses, at the true places, in millimetres.

    `place`: accuracy of the places learnt by a `LearntSkin`, its `standing["place"]`.
    """
    ax = get_or_create_axes(ax)
    errors_mm = 1e3 * np.linalg.norm(place.held_out - place.right, axis=1)
    extent = extent_of(place.right)
    hide_axes(ax, extent, numbered=False)
    colour_limit = float(np.quantile(errors_mm, 0.98)) or 1.0
    sort_order = np.argsort(errors_mm)
    place_markers = ax.scatter(
        *place.right[sort_order, :2].T,
        c=errors_mm[sort_order],
        s=22,
        cmap=SEQUENTIAL_COLOUR_MAP,
        vmin=0,
        vmax=colour_limit,
        linewidths=0,
    )
    draw_scale_bar(ax, extent)
    draw_colour_bar(ax, place_markers, "Error of presses held out (mm)")
    ax.set_title(
        f"Places: {errors_mm.mean():.3g} mm on average, median {np.median(errors_mm):.3g} mm"
        if title is None
        else title
    )
    return ax


def plot_force_errors(force: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the forces that a learnt skin estimates for held-out presses against the true forces, in newtons."""
    ax = get_or_create_axes(ax)
    true_forces, estimated_forces = force.right[:, 0], force.held_out[:, 0]
    force_limits = [min(true_forces.min(), estimated_forces.min()), max(true_forces.max(), estimated_forces.max())]
    ax.plot(force_limits, force_limits, color=LIGHT_GREY, linewidth=1, zorder=1)
    ax.plot(
        true_forces,
        estimated_forces,
        linestyle="none",
        marker="o",
        markersize=3.5,
        alpha=0.6,
        color=SERIES_COLOURS[0],
        markeredgewidth=0,
    )
    ax.set_xlabel("Force (N)", color=DARK_GREY)
    ax.set_ylabel("Estimated force of presses held out (N)", color=DARK_GREY)
    ax.set_title(
        f"Forces: {np.abs(estimated_forces - true_forces).mean():.3g} N off on average" if title is None else title
    )
    style_graph_axes(ax)
    return ax


def plot_confusion(label: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the confusion matrix of a classifier on held-out presses, in per cent of the presses of each label.

    **Arguments:**

    - `label`: true labels of held-out presses, and the labels that the classifier predicts for them.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    **Example:**

    ```python
    ax = plot_confusion(gestures.standing)
    ax.figure.savefig("confusion.png")
    ```
    """
    ax = get_or_create_axes(ax)
    label_names = np.unique(label.right)
    press_counts = np.array(
        [
            [
                np.sum((label.right == true_label) & (label.held_out == predicted_label))
                for predicted_label in label_names
            ]
            for true_label in label_names
        ]
    )
    percentages = 100 * press_counts / np.maximum(press_counts.sum(axis=1, keepdims=True), 1)
    matrix_image = ax.imshow(percentages, cmap="Blues", vmin=0, vmax=100)
    draw_colour_bar(ax, matrix_image, "Share of the kind (%)")
    if len(label_names) <= _MAX_TICK_LABELS:
        label_rotation = 90 if max(len(label_name) for label_name in label_names) > 3 else 0
        ax.set_xticks(range(len(label_names)), label_names, rotation=label_rotation)
        ax.set_yticks(range(len(label_names)), label_names)
    if len(label_names) <= 10:
        for true_index, predicted_index in np.argwhere(percentages >= 0.5):
            text_colour = "white" if percentages[true_index, predicted_index] > 50 else DARK_GREY
            ax.text(
                predicted_index,
                true_index,
                f"{percentages[true_index, predicted_index]:.0f}",
                ha="center",
                va="center",
                color=text_colour,
                fontsize=8,
            )
    ax.set_xlabel("Predicted label", color=DARK_GREY)
    ax.set_ylabel("True label", color=DARK_GREY)
    percentage_right = 100 * np.mean(label.right == label.held_out)
    ax.set_title(f"Labels: {percentage_right:.1f} % right of presses held out" if title is None else title)
    return ax


def plot_key_errors(keys: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw, for each key of a learnt skin, the share of held-out presses in which it was classified wrongly."""
    ax = get_or_create_axes(ax)
    error_rates = 100 * np.mean(keys.held_out != keys.right, axis=0)
    ax.bar(range(len(error_rates)), error_rates, color=SERIES_COLOURS[0], width=0.7)
    ax.set_xticks(range(len(error_rates)))
    ax.set_xlabel("Key", color=DARK_GREY)
    ax.set_ylabel("Classified wrongly (%)", color=DARK_GREY)
    ax.set_ylim(0, max(1.0, 1.1 * error_rates.max()))
    percentage_of_patterns = 100 * np.mean((keys.held_out == keys.right).all(axis=1))
    default_title = f"Keys: {100 - error_rates.mean():.1f} % right, whole patterns {percentage_of_patterns:.1f} %"
    ax.set_title(default_title if title is None else title)
    style_graph_axes(ax)
    return ax


def plot_tried(label: Standing, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the accuracy, in per cent, of each tried classifier on held-out presses, the best at the top."""
    ax = get_or_create_axes(ax)
    method_names, percentages = (
        [method_name for method_name, _ in label.tried],
        [100 * (1 - error_rate) for _, error_rate in label.tried],
    )
    bar_colours = [SERIES_COLOURS[0] if method_name == label.method else "#c9d3de" for method_name in method_names]
    ax.barh(range(len(method_names)), percentages, color=bar_colours, height=0.7)
    for method_index, percentage in enumerate(percentages):
        ax.text(percentage, method_index, f" {percentage:.0f}", va="center", color=DARK_GREY, fontsize=8)
    ax.set_yticks(range(len(method_names)), method_names, fontsize=8)
    ax.invert_yaxis()
    ax.set_xlim(0, 105)
    ax.set_xlabel("Right of what was held out (%)", color=DARK_GREY)
    ax.set_title("What was tried" if title is None else title)
    style_graph_axes(ax)
    return ax
