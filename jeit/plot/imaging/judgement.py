"""Plots to assess an image and its model: the choice of a hyperparameter, with the curves of the rules; figures of
merit; and measured and modelled voltages."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.image.rasters import FiguresOfMerit
from jeit.inverse.hyperparameter.choice import Choice
from jeit.plot.axes import draw_horizontal_grid, get_or_create_axes, style_graph_axes
from jeit.plot.colours import DARK_GREY, LIGHT_GREY, SERIES_COLOURS, SERIES_MARKERS, choose_si_prefix
from jeit.protocol import Protocol

# Colour of each rule for λ; other rules, and values of λ specified as numbers, are drawn in the colour `DARK_GREY`.
RULE_COLOURS = {
    "gcv": "#d1495b",
    "l-curve": "#1f6fb4",
    "discrepancy": "#c9820a",
    "noise-figure": "#157f3b",
    "best-resolution": "#7b4fa3",
}
# Minimum distance of labelled points on the L-curve, relative to its width and height.
_MIN_LABEL_DISTANCE = 0.06
# For each rule: name of its criterion, scale of the axis, and the value of the criterion that the rule seeks.
_CRITERION_LABELS = {
    "gcv": ("prediction error (σ²)", "log", "least"),
    "l-curve": ("curvature of the L-curve", "linear", "greatest"),
    "discrepancy": ("residual (σ)", "log", "equal to the noise"),
    "noise-figure": ("noise figure", "log", "at its target"),
    "best-resolution": ("blur radius / body", "linear", "least"),
}
# Colours of measured and modelled voltages.
MEASURED_COLOUR = "#1f6fb4"
MODELLED_COLOUR = "#d1495b"


def plot_choice(choices: Choice | Mapping[str, Choice], *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the curves used in choosing a hyperparameter λ, and the chosen λ on them.

    For one choice by the rule "l-curve", the L-curve is drawn: ‖residual‖ against ‖image‖ with the corner marked. For
    other rules, the criterion is drawn against λ. For several choices, the criterion of each choice is drawn, and, if λ
    was chosen from data, the L-curve with all choices; these plots are insets of the returned axes. A choice at the
    edge of its grid of λ is drawn as a hollow marker.

    **Arguments:**

    - `choices`: a `jeit.inverse.Choice`, or a dictionary of choices by name, as from `jeit.inverse.compare_rules`.
    - `title`: title of the plot.
    - `ax`: axes to draw in; default: new axes.

    Raises `ValueError` for hyperparameters that were specified as numbers, which have no curve, and for objects that
    are not choices.

    **Example:**

    ```python
    from jeit.inverse import compare_rules
    plot_choice(compare_rules(model, 1.0, difference=change, noise=1e-6))
    ```
    """
    choices_of_all_rules = list(choices.values()) if isinstance(choices, Mapping) else [choices]
    for choice_of_rule in choices_of_all_rules:
        check_kind("choices", choice_of_rule, Choice, "a Choice, or several, {name: choice}, as of compare_rules")
    if isinstance(choices, Choice):
        if choices.criterion.size == 0:
            raise ValueError("choices: a hyperparameter that was given has no curve; draw one that a rule chose.")
        ax = get_or_create_axes(ax, (5.6, 4.2))
        if choices.rule == "l-curve":
            _draw_l_curve(ax, choices, [choices])
            ax.set_title(title or "", loc="left")
        else:
            _draw_criterion(ax, choices)
            ax.set_title(title or _choice_title(choices), color=_rule_colour(choices), fontsize=11, loc="left")
            ax.set_xlabel("Hyperparameter λ")
        return ax
    choices_with_criterion = [rule_choice for rule_choice in choices_of_all_rules if rule_choice.criterion.size]
    if not choices_with_criterion:
        raise ValueError("choices: there is no choice of a rule among them, so there is no curve to draw.")
    ax = get_or_create_axes(ax, (9.6, 5.4))
    ax.set_axis_off()
    ax.set_title(title or "", loc="left")
    rules_with_data = [rule_choice for rule_choice in choices_with_criterion if rule_choice.residual.size]
    left_edge_of_panel = 0.0
    if rules_with_data:
        left_edge_of_panel = 0.54
        # Every choice contains the whole L-curve; the choice with the most candidates has the finest L-curve.
        choice_with_most_candidates = max(rules_with_data, key=lambda rule_choice: rule_choice.candidates.size)
        _draw_l_curve(ax.inset_axes((0, 0, 0.46, 1)), choice_with_most_candidates, choices_of_all_rules)
    panel_height = 1 / len(choices_with_criterion)
    rule_panel = None
    for panel_row, rule_choice in enumerate(choices_with_criterion):
        panel_bounds = (
            left_edge_of_panel,
            1 - (panel_row + 1) * panel_height,
            1 - left_edge_of_panel,
            (0.62 if len(choices_with_criterion) > 1 else 0.95) * panel_height,
        )
        rule_panel = ax.inset_axes(panel_bounds, sharex=rule_panel)
        for choice_of_other_rule in choices_of_all_rules:
            rule_panel.axvline(
                float(choice_of_other_rule.hyperparameter),
                color=_rule_colour(choice_of_other_rule),
                linewidth=0.6,
                alpha=0.45,
                zorder=0,
            )
        _draw_criterion(rule_panel, rule_choice, is_small_panel=len(choices_with_criterion) > 1)
        rule_panel.tick_params(labelbottom=panel_row == len(choices_with_criterion) - 1)
    if rule_panel is not None:
        rule_panel.set_xlabel("Hyperparameter λ")
    return ax


def _draw_l_curve(ax: Axes, curve: Choice, rule_choices: list[Choice]) -> None:
    """Draw the L-curve, its points at powers of ten of λ, and all choices, with labels in the free corner of the L."""
    hyperparameters, residual_norms, penalty_norms = (
        np.asarray(curve_array) for curve_array in (curve.candidates, curve.residual, curve.penalty)
    )
    ax.loglog(residual_norms, penalty_norms, color=LIGHT_GREY, linewidth=1.8, zorder=1)
    label_exponents = np.arange(
        np.ceil(np.log10(hyperparameters[0])), np.floor(np.log10(hyperparameters[-1])) + 1, dtype=int
    )
    log_ranges = np.log10([residual_norms.max() / residual_norms.min(), penalty_norms.max() / penalty_norms.min()])
    labelled_positions = np.full((1, 2), np.inf)
    for label_exponent in label_exponents[::-1]:
        curve_point = curve.read(residual_norms, 10.0**label_exponent), curve.read(penalty_norms, 10.0**label_exponent)
        relative_position = np.log10(curve_point) / log_ranges
        if np.linalg.norm(labelled_positions - relative_position, axis=1).min() < _MIN_LABEL_DISTANCE:
            continue
        labelled_positions = np.vstack([labelled_positions, relative_position])
        name = "λ = " if label_exponent == label_exponents[-1] else ""
        label_style = {"textcoords": "offset points", "ha": "right", "va": "top", "color": LIGHT_GREY, "fontsize": 7.5}
        ax.plot(*curve_point, "o", color=LIGHT_GREY, markersize=3, zorder=1)
        ax.annotate(f"{name}$10^{{{label_exponent}}}$", curve_point, (-4, -3), **label_style)
    sorted_choices = sorted(rule_choices, key=lambda rule_choice: float(rule_choice.hyperparameter))
    for choice_rank, rule_choice in enumerate(sorted_choices):
        curve_point = (
            curve.read(residual_norms, rule_choice.hyperparameter),
            curve.read(penalty_norms, rule_choice.hyperparameter),
        )
        ax.annotate(
            _choice_title(rule_choice),
            curve_point,
            (0.36, 0.97 - 0.065 * choice_rank),
            textcoords="axes fraction",
            color=_rule_colour(rule_choice),
            va="center",
            fontsize=9,
            arrowprops={"arrowstyle": "-", "color": _rule_colour(rule_choice), "linewidth": 0.7, "relpos": (0, 0.5)},
        )
        ax.plot(*curve_point, zorder=3, **_marker_style(rule_choice, 8))
    ax.margins(0.09, 0.05)
    ax.set_xlabel("Residual ‖w (v − Jx)‖ (standard deviations)")
    ax.set_ylabel("Penalty √(xᵀQx)")
    _style_axes(ax)


def _draw_criterion(ax: Axes, rule_choice: Choice, *, is_small_panel: bool = False) -> None:
    criterion_label, axis_scale, text_of_aim = _CRITERION_LABELS.get(rule_choice.rule, ("criterion", "linear", ""))
    chosen_hyperparameter = float(rule_choice.hyperparameter)
    ax.set_xscale("log")
    ax.set_yscale(axis_scale)
    ax.plot(
        np.asarray(rule_choice.candidates),
        np.asarray(rule_choice.criterion),
        color=_rule_colour(rule_choice),
        linewidth=1.6,
    )
    if rule_choice.target is not None:
        ax.axhline(rule_choice.target, color=DARK_GREY, linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
    ax.plot(
        chosen_hyperparameter,
        rule_choice.read(rule_choice.criterion),
        clip_on=False,
        zorder=3,
        **_marker_style(rule_choice, 6 if is_small_panel else 8),
    )
    text = f"{criterion_label}, {text_of_aim}" if text_of_aim else criterion_label
    if is_small_panel:
        ax.set_title(f"{rule_choice.rule}: {text}", fontsize=8.5, loc="left", pad=3, color=_rule_colour(rule_choice))
        ax.tick_params(labelsize=7.5)
    else:
        ax.axvline(chosen_hyperparameter, color=_rule_colour(rule_choice), linewidth=0.6, alpha=0.45, zorder=0)
        ax.set_ylabel(text[0].upper() + text[1:])
    _style_axes(ax, num_y_ticks=3 if is_small_panel else 6)


def _marker_style(rule_choice: Choice, marker_size: float) -> dict:
    face_colour = "white" if rule_choice.edge else _rule_colour(rule_choice)
    edge_colour = _rule_colour(rule_choice) if rule_choice.edge else "white"
    marker_style = {"marker": "o", "markersize": marker_size, "linestyle": "none"}
    return {
        **marker_style,
        "markerfacecolor": face_colour,
        "markeredgecolor": edge_colour,
        "markeredgewidth": 1.6 if rule_choice.edge else 0.8,
    }


def _choice_title(rule_choice: Choice) -> str:
    edge_note = " (edge of the grid)" if rule_choice.edge else ""
    return f"{rule_choice.rule}: λ = {float(rule_choice.hyperparameter):.3g}{edge_note}"


def _rule_colour(rule_choice: Choice) -> str:
    return RULE_COLOURS.get(rule_choice.rule, DARK_GREY)


def _style_axes(ax: Axes, num_y_ticks: int = 6) -> None:
    style_graph_axes(ax)
    for axis, max_ticks in ((ax.xaxis, 8), (ax.yaxis, num_y_ticks)):
        if axis.get_scale() == "log":
            axis.set_major_locator(LogLocator(numticks=max_ticks))
            axis.set_minor_formatter(NullFormatter())
            if max_ticks < 6:
                axis.set_minor_locator(NullLocator())
        else:
            axis.set_major_locator(MaxNLocator(max_ticks))


# For each figure of merit: field, title, unit on the axis, factor that converts to this unit, and value for a perfect
# image, or None.
_MERIT_PANELS = (
    ("amplitude_response", "Amplitude response", "image / truth", 1.0, 1.0),
    ("position_error", "Position error", "mm (+ is towards the centre)", 1e3, 0.0),
    ("resolution", "Resolution", "% of the body's radius", 1e2, None),
    ("shape_deformation", "Shape deformation", "% of the image's area", 1e2, 0.0),
    ("ringing", "Ringing", "% of the target's image", 1e2, 0.0),
)


def plot_figures_of_merit(
    figures: Mapping[str, FiguresOfMerit], *, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the five GREIT figures of merit of one or several reconstructions against the distance of the targets from
    the centre.

    Lines connect the means of targets at the same distance; dashed grey lines show the values of a perfect image. The
    five plots are insets of the returned axes.

    **Arguments:**

    - `figures`: figures for T targets, from `jeit.image.figures_of_merit`, by name of the reconstruction for the
      legend.
    - `title`, `ax`: as for `plot_choice`.

    Raises `ValueError` without figures, for more than six reconstructions, and for figures of a single image.

    **Example:**

    ```python
    from jeit.image import Raster, figures_of_merit
    raster = Raster.create(mesh, shape=(64, 64))
    pixels = raster.sample(np.stack([image, image]))
    targets = figures_of_merit(pixels, raster.extent, [[0.04, 0], [0.05, 0]], area=1e-3)
    plot_figures_of_merit({"one step": targets})
    ```
    """
    check_kind("figures", figures, Mapping, "{name: figures}, as of jeit.image.figures_of_merit")
    if not 1 <= len(figures) <= len(SERIES_COLOURS):
        raise ValueError(
            f"figures has {len(figures)} reconstructions; give 1 to {len(SERIES_COLOURS)}, {{name: figures}}."
        )
    for name, merit_figures in figures.items():
        if not isinstance(merit_figures, FiguresOfMerit) or np.ndim(merit_figures.distance) != 1:
            raise ValueError(f"figures['{name}'] must be what figures_of_merit gives for many targets (T,).")
    ax = get_or_create_axes(ax, (10.6, 5.6))
    ax.set_axis_off()
    ax.set_title(title or "")
    max_radius = max(1e3 * float(np.max(merit_figures.body_radius)) for merit_figures in figures.values())
    for panel_index, (field_name, panel_heading, value_unit, unit_factor, perfect_value) in enumerate(_MERIT_PANELS):
        panel_column, panel_row = panel_index % 3, panel_index // 3
        merit_panel = ax.inset_axes((0.36 * panel_column, 0.55 * (1 - panel_row), 0.28, 0.43))
        if perfect_value is not None:
            merit_panel.axhline(
                unit_factor * perfect_value, color=LIGHT_GREY, linewidth=1.0, linestyle=(0, (4, 3)), zorder=1
            )
        for merit_figures, series_colour, series_marker in zip(
            figures.values(), SERIES_COLOURS, SERIES_MARKERS, strict=False
        ):
            centre_distances, merit_values = (
                1e3 * np.asarray(merit_figures.distance),
                unit_factor * np.asarray(getattr(merit_figures, field_name)),
            )
            is_finite = np.isfinite(merit_values)
            mean_distances, mean_values = _binned_means(
                centre_distances[is_finite], merit_values[is_finite], 1e-3 * max_radius
            )
            merit_panel.plot(mean_distances, mean_values, color=series_colour, linewidth=1.6, zorder=3)
            merit_panel.plot(
                centre_distances[is_finite],
                merit_values[is_finite],
                series_marker,
                color=series_colour,
                markersize=3.2,
                zorder=3,
            )
        _style_panel(merit_panel, panel_heading, value_unit, max_radius)
        if panel_index >= 2:  # the lowest plot of its column
            merit_panel.set_xlabel("Target's distance from the centre (mm)", fontsize=9, color=DARK_GREY)
    series_styles = zip(figures, SERIES_COLOURS, SERIES_MARKERS, strict=False)
    legend_lines = [
        Line2D([], [], color=series_colour, marker=series_marker, markersize=5, label=name)
        for name, series_colour, series_marker in series_styles
    ]
    legend_lines.append(Line2D([], [], color=LIGHT_GREY, linewidth=1.0, linestyle=(0, (4, 3)), label="perfect image"))
    ax.legend(handles=legend_lines, frameon=False, loc="center", bbox_to_anchor=(0.72, 0, 0.28, 0.43), fontsize=11)
    return ax


def _binned_means(
    centre_distances: np.ndarray, merit_values: np.ndarray, ring_width: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sorted distances, rounded to multiples of `ring_width`, and the mean of the values at each distance."""
    ring_numbers, ring_indices = np.unique(np.round(centre_distances / ring_width), return_inverse=True)
    return ring_numbers * ring_width, np.bincount(ring_indices, merit_values) / np.bincount(ring_indices)


def _style_panel(merit_panel: Axes, panel_heading: str, value_unit: str, max_distance: float) -> None:
    merit_panel.set_title(panel_heading, loc="left", fontsize=11, color=DARK_GREY)
    merit_panel.set_ylabel(value_unit, fontsize=9, color=DARK_GREY)
    merit_panel.set_xlim(0, max_distance)
    lower_limit, upper_limit = merit_panel.get_ylim()
    merit_panel.set_ylim(min(lower_limit, 0), upper_limit)  # from zero, so that small variations look small
    style_graph_axes(merit_panel)
    merit_panel.tick_params(length=3, labelsize=9)
    draw_horizontal_grid(merit_panel)


def plot_voltages(
    measured: ArrayLike,
    modelled: ArrayLike,
    protocol: Protocol | None = None,
    *,
    mask: ArrayLike | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw measured and modelled voltages (M,), in volts, channel by channel, and their difference below.

    `protocol`: if given, the first channel of each drive is marked. `mask`: True for the channels to draw. The
    difference is in per cent of the root mean square voltage; the title gives the relative misfit
    ‖modelled - measured‖ / ‖measured‖. The two plots are insets of the returned axes. Raises `ValueError` for arguments
    of different lengths, and for drawn voltages that are not finite.
    """
    measured, modelled = np.asarray(measured), np.asarray(modelled)
    is_drawn = np.ones(measured.shape, bool) if mask is None else np.asarray(mask, bool)
    if measured.ndim != 1 or modelled.shape != measured.shape or is_drawn.shape != measured.shape:
        raise ValueError(
            f"measured {measured.shape}, modelled {modelled.shape} and mask {is_drawn.shape} must be one frame (M,) "
            "each."
        )
    if protocol is not None and protocol.num_measurements != measured.size:
        raise ValueError(f"measured has {measured.size} channels, and '{protocol.name}' {protocol.num_measurements}.")
    if not is_drawn.any() or not np.isfinite(measured[is_drawn]).all() or not np.isfinite(modelled[is_drawn]).all():
        raise ValueError("there must be channels to draw, and their voltages finite; mask those that are not.")
    drawn_channels = np.flatnonzero(is_drawn)
    rms_voltage = np.sqrt(np.mean(measured[is_drawn] ** 2))
    unit_factor, voltage_unit = choose_si_prefix(float(np.abs(measured[is_drawn]).max()), "V")
    relative_misfit = np.linalg.norm((modelled - measured)[is_drawn]) / np.linalg.norm(measured[is_drawn])
    ax = get_or_create_axes(ax, (8.4, 5.0))
    ax.set_axis_off()
    voltage_axes = ax.inset_axes((0, 0.42, 1, 0.58))
    difference_axes = ax.inset_axes((0, 0, 1, 0.36), sharex=voltage_axes)
    marker_size = float(np.clip(500 / drawn_channels.size, 0.8, 3))
    voltage_axes.plot(
        drawn_channels,
        unit_factor * measured[is_drawn],
        "o",
        color=MEASURED_COLOUR,
        markersize=2 * marker_size,
        label="measured",
    )
    voltage_axes.plot(
        drawn_channels,
        unit_factor * modelled[is_drawn],
        "o",
        color=MODELLED_COLOUR,
        markersize=marker_size,
        label="modelled",
    )
    voltage_axes.set_ylabel(f"Voltage ({voltage_unit})")
    voltage_axes.legend(
        frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.1, markerscale=2
    )
    voltage_axes.set_title(title or f"Relative misfit {100 * relative_misfit:.2g} %", loc="left", fontsize=11)
    voltage_axes.tick_params(labelbottom=False)
    residual_percent = 100 * (modelled - measured)[is_drawn] / rms_voltage
    difference_axes.axhline(0, color=LIGHT_GREY, linewidth=0.8)
    difference_axes.vlines(drawn_channels, 0, residual_percent, color=DARK_GREY, linewidth=0.6)
    difference_axes.plot(drawn_channels, residual_percent, "o", color=DARK_GREY, markersize=marker_size)
    difference_axes.set_ylabel("Difference\n(% of rms)")
    difference_axes.set_xlabel("Channel")
    if protocol is not None:
        drive_starts = np.flatnonzero(np.diff(np.asarray(protocol.drive_index)) != 0) + 1
        for axes in (voltage_axes, difference_axes):
            axes.vlines(
                drive_starts - 0.5, 0, 1, transform=axes.get_xaxis_transform(), color="#e6e8eb", linewidth=0.6, zorder=0
            )
    for axes in (voltage_axes, difference_axes):
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlim(-1, measured.size)
    return ax
