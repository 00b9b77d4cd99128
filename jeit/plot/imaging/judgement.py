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
_CRITERIA = {
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
    rules = [choice for choice in choices_of_all_rules if choice.criterion.size]
    if not rules:
        raise ValueError("choices: there is no choice of a rule among them, so there is no curve to draw.")
    ax = get_or_create_axes(ax, (9.6, 5.4))
    ax.set_axis_off()
    ax.set_title(title or "", loc="left")
    rules_with_data = [choice for choice in rules if choice.residual.size]
    left_edge = 0.0
    if rules_with_data:
        left_edge = 0.54
        # Every choice contains the whole L-curve; the choice with the most candidates has the finest L-curve.
        most_detailed_choice = max(rules_with_data, key=lambda choice: choice.candidates.size)
        _draw_l_curve(ax.inset_axes((0, 0, 0.46, 1)), most_detailed_choice, choices_of_all_rules)
    height = 1 / len(rules)
    panel = None
    for row, choice in enumerate(rules):
        panel_bounds = (left_edge, 1 - (row + 1) * height, 1 - left_edge, (0.62 if len(rules) > 1 else 0.95) * height)
        panel = ax.inset_axes(panel_bounds, sharex=panel)
        for other_choice in choices_of_all_rules:
            panel.axvline(
                float(other_choice.hyperparameter),
                color=_rule_colour(other_choice),
                linewidth=0.6,
                alpha=0.45,
                zorder=0,
            )
        _draw_criterion(panel, choice, is_small_panel=len(rules) > 1)
        panel.tick_params(labelbottom=row == len(rules) - 1)
    if panel is not None:
        panel.set_xlabel("Hyperparameter λ")
    return ax


def _draw_l_curve(ax: Axes, curve: Choice, choices: list[Choice]) -> None:
    """Draw the L-curve, its points at powers of ten of λ, and all choices, with labels in the free corner of the L."""
    values, residual, penalty = (np.asarray(array) for array in (curve.candidates, curve.residual, curve.penalty))
    ax.loglog(residual, penalty, color=LIGHT_GREY, linewidth=1.8, zorder=1)
    exponents = np.arange(np.ceil(np.log10(values[0])), np.floor(np.log10(values[-1])) + 1, dtype=int)
    log_ranges = np.log10([residual.max() / residual.min(), penalty.max() / penalty.min()])
    labelled_positions = np.full((1, 2), np.inf)
    for exponent in exponents[::-1]:
        point = curve.read(residual, 10.0**exponent), curve.read(penalty, 10.0**exponent)
        relative_position = np.log10(point) / log_ranges
        if np.linalg.norm(labelled_positions - relative_position, axis=1).min() < _MIN_LABEL_DISTANCE:
            continue
        labelled_positions = np.vstack([labelled_positions, relative_position])
        name = "λ = " if exponent == exponents[-1] else ""
        label = {"textcoords": "offset points", "ha": "right", "va": "top", "color": LIGHT_GREY, "fontsize": 7.5}
        ax.plot(*point, "o", color=LIGHT_GREY, markersize=3, zorder=1)
        ax.annotate(f"{name}$10^{{{exponent}}}$", point, (-4, -3), **label)
    sorted_choices = sorted(choices, key=lambda choice: float(choice.hyperparameter))
    for rank, choice in enumerate(sorted_choices):
        point = curve.read(residual, choice.hyperparameter), curve.read(penalty, choice.hyperparameter)
        ax.annotate(
            _choice_title(choice),
            point,
            (0.36, 0.97 - 0.065 * rank),
            textcoords="axes fraction",
            color=_rule_colour(choice),
            va="center",
            fontsize=9,
            arrowprops={"arrowstyle": "-", "color": _rule_colour(choice), "linewidth": 0.7, "relpos": (0, 0.5)},
        )
        ax.plot(*point, zorder=3, **_marker_style(choice, 8))
    ax.margins(0.09, 0.05)
    ax.set_xlabel("Residual ‖w (v − Jx)‖ (standard deviations)")
    ax.set_ylabel("Penalty √(xᵀQx)")
    _style_axes(ax)


def _draw_criterion(ax: Axes, choice: Choice, *, is_small_panel: bool = False) -> None:
    label, scale, aim_text = _CRITERIA.get(choice.rule, ("criterion", "linear", ""))
    value = float(choice.hyperparameter)
    ax.set_xscale("log")
    ax.set_yscale(scale)
    ax.plot(np.asarray(choice.candidates), np.asarray(choice.criterion), color=_rule_colour(choice), linewidth=1.6)
    if choice.target is not None:
        ax.axhline(choice.target, color=DARK_GREY, linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
    ax.plot(
        value,
        choice.read(choice.criterion),
        clip_on=False,
        zorder=3,
        **_marker_style(choice, 6 if is_small_panel else 8),
    )
    text = f"{label}, {aim_text}" if aim_text else label
    if is_small_panel:
        ax.set_title(f"{choice.rule}: {text}", fontsize=8.5, loc="left", pad=3, color=_rule_colour(choice))
        ax.tick_params(labelsize=7.5)
    else:
        ax.axvline(value, color=_rule_colour(choice), linewidth=0.6, alpha=0.45, zorder=0)
        ax.set_ylabel(text[0].upper() + text[1:])
    _style_axes(ax, ticks=3 if is_small_panel else 6)


def _marker_style(choice: Choice, size: float) -> dict:
    face = "white" if choice.edge else _rule_colour(choice)
    edge = _rule_colour(choice) if choice.edge else "white"
    style = {"marker": "o", "markersize": size, "linestyle": "none"}
    return {**style, "markerfacecolor": face, "markeredgecolor": edge, "markeredgewidth": 1.6 if choice.edge else 0.8}


def _choice_title(choice: Choice) -> str:
    edge = " (edge of the grid)" if choice.edge else ""
    return f"{choice.rule}: λ = {float(choice.hyperparameter):.3g}{edge}"


def _rule_colour(choice: Choice) -> str:
    return RULE_COLOURS.get(choice.rule, DARK_GREY)


def _style_axes(ax: Axes, ticks: int = 6) -> None:
    style_graph_axes(ax)
    for axis, max_ticks in ((ax.xaxis, 8), (ax.yaxis, ticks)):
        if axis.get_scale() == "log":
            axis.set_major_locator(LogLocator(numticks=max_ticks))
            axis.set_minor_formatter(NullFormatter())
            if max_ticks < 6:
                axis.set_minor_locator(NullLocator())
        else:
            axis.set_major_locator(MaxNLocator(max_ticks))


# For each figure of merit: field, title, unit on the axis, factor that converts to this unit, and value for a perfect
# image, or None.
_PANELS = (
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
    for name, merit in figures.items():
        if not isinstance(merit, FiguresOfMerit) or np.ndim(merit.distance) != 1:
            raise ValueError(f"figures['{name}'] must be what figures_of_merit gives for many targets (T,).")
    ax = get_or_create_axes(ax, (10.6, 5.6))
    ax.set_axis_off()
    ax.set_title(title or "")
    max_radius = max(1e3 * float(np.max(merit.body_radius)) for merit in figures.values())
    for panel_index, (field, heading, unit, factor, perfect_value) in enumerate(_PANELS):
        column, row = panel_index % 3, panel_index // 3
        panel = ax.inset_axes((0.36 * column, 0.55 * (1 - row), 0.28, 0.43))
        if perfect_value is not None:
            panel.axhline(factor * perfect_value, color=LIGHT_GREY, linewidth=1.0, linestyle=(0, (4, 3)), zorder=1)
        for merit, colour, marker in zip(figures.values(), SERIES_COLOURS, SERIES_MARKERS, strict=False):
            distance, value = 1e3 * np.asarray(merit.distance), factor * np.asarray(getattr(merit, field))
            is_finite = np.isfinite(value)
            mean_distances, mean_values = _binned_means(distance[is_finite], value[is_finite], 1e-3 * max_radius)
            panel.plot(mean_distances, mean_values, color=colour, linewidth=1.6, zorder=3)
            panel.plot(distance[is_finite], value[is_finite], marker, color=colour, markersize=3.2, zorder=3)
        _style_panel(panel, heading, unit, max_radius)
        if panel_index >= 2:  # the lowest plot of its column
            panel.set_xlabel("Target's distance from the centre (mm)", fontsize=9, color=DARK_GREY)
    styles = zip(figures, SERIES_COLOURS, SERIES_MARKERS, strict=False)
    lines = [Line2D([], [], color=colour, marker=marker, markersize=5, label=name) for name, colour, marker in styles]
    lines.append(Line2D([], [], color=LIGHT_GREY, linewidth=1.0, linestyle=(0, (4, 3)), label="perfect image"))
    ax.legend(handles=lines, frameon=False, loc="center", bbox_to_anchor=(0.72, 0, 0.28, 0.43), fontsize=11)
    return ax


def _binned_means(distance: np.ndarray, value: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Sorted distances, rounded to multiples of `tolerance`, and the mean of the values at each distance."""
    ring, inverse = np.unique(np.round(distance / tolerance), return_inverse=True)
    return ring * tolerance, np.bincount(inverse, value) / np.bincount(inverse)


def _style_panel(panel: Axes, heading: str, unit: str, max_distance: float) -> None:
    panel.set_title(heading, loc="left", fontsize=11, color=DARK_GREY)
    panel.set_ylabel(unit, fontsize=9, color=DARK_GREY)
    panel.set_xlim(0, max_distance)
    lower_limit, upper_limit = panel.get_ylim()
    panel.set_ylim(min(lower_limit, 0), upper_limit)  # from zero, so that small variations look small
    style_graph_axes(panel)
    panel.tick_params(length=3, labelsize=9)
    draw_horizontal_grid(panel)


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
    channel = np.flatnonzero(is_drawn)
    rms_voltage = np.sqrt(np.mean(measured[is_drawn] ** 2))
    factor, unit = choose_si_prefix(float(np.abs(measured[is_drawn]).max()), "V")
    misfit = np.linalg.norm((modelled - measured)[is_drawn]) / np.linalg.norm(measured[is_drawn])
    ax = get_or_create_axes(ax, (8.4, 5.0))
    ax.set_axis_off()
    voltage_axes = ax.inset_axes((0, 0.42, 1, 0.58))
    difference_axes = ax.inset_axes((0, 0, 1, 0.36), sharex=voltage_axes)
    marker_size = float(np.clip(500 / channel.size, 0.8, 3))
    voltage_axes.plot(
        channel, factor * measured[is_drawn], "o", color=MEASURED_COLOUR, markersize=2 * marker_size, label="measured"
    )
    voltage_axes.plot(
        channel, factor * modelled[is_drawn], "o", color=MODELLED_COLOUR, markersize=marker_size, label="modelled"
    )
    voltage_axes.set_ylabel(f"Voltage ({unit})")
    voltage_axes.legend(
        frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.1, markerscale=2
    )
    voltage_axes.set_title(title or f"Relative misfit {100 * misfit:.2g} %", loc="left", fontsize=11)
    voltage_axes.tick_params(labelbottom=False)
    residual = 100 * (modelled - measured)[is_drawn] / rms_voltage
    difference_axes.axhline(0, color=LIGHT_GREY, linewidth=0.8)
    difference_axes.vlines(channel, 0, residual, color=DARK_GREY, linewidth=0.6)
    difference_axes.plot(channel, residual, "o", color=DARK_GREY, markersize=marker_size)
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
