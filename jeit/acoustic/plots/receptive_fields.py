"""Receptive fields: the intensity of taps at each microphone against their distance."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import ArrayLike

from jeit.acoustic.calibration.calibrate import CalibrationFit
from jeit.acoustic.plots.surface_view import FOUND, HALO
from jeit.arguments import check_kind
from jeit.plot.axes import INK, SOFT, axes_or_new, soften_axes
from jeit_solvers.engines import on_host

_TAP = "#8fb4d9"


def plot_receptive_fields(
    fit: CalibrationFit, *, microphones: ArrayLike | None = None, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Plot the intensity at each microphone, relative to the strength of the tap, against distance, with the fitted
    curve.

    `microphones`: indices of those to draw, all unless given; they are numbered from 0, as in the calibration's
    messages. Red circles are taps excluded from the fit; the panel of an unusable microphone states the reason. The
    dashed line is the noise, one standard deviation, relative to a tap of median strength; the number beside the index
    is the distance at which a microphone receives half the intensity of a tap directly above it. The panels are insets
    of the returned axes. Raises `ValueError` for microphones that do not exist, and for what is no `CalibrationFit`.
    """
    check_kind("fit", fit, CalibrationFit, "a CalibrationFit, as of calibrate_microphones")
    number = fit.power.shape[1]
    chosen = np.arange(number) if microphones is None else np.atleast_1d(np.asarray(microphones))
    if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or not chosen.size:
        raise ValueError(f"microphones: give indices of microphones, whole numbers; got shape {chosen.shape}.")
    if chosen.min() < 0 or chosen.max() >= number:
        raise ValueError(f"microphones must be from 0 to {number - 1}; they are {chosen.min()} to {chosen.max()}.")
    columns = chosen.size if chosen.size <= 3 else int(np.ceil(np.sqrt(chosen.size)))
    rows = -(-chosen.size // columns)
    ax = axes_or_new(ax, (max(4.8, min(11.0, 2.2 * columns)), max(3.6, min(9.0, 1.75 * rows))))
    ax.set_axis_off()
    # The height is fixed: matplotlib would search all panels for it.
    ax.set_title(title or "", loc="left", y=1.0, pad=26)
    distance = np.linspace(0, float(fit.distance.max()), 200)
    decay = on_host(fit.calibration.microphone_array.decay)
    curve = np.asarray(decay.response(np.broadcast_to(distance**2, (number, distance.size))))
    relative = fit.power / _strengths(fit)[:, None]
    noise = np.asarray(fit.calibration.microphone_array.noise.deviation) / np.nanmedian(fit.strength)
    seen = relative[:, chosen][np.isfinite(relative[:, chosen]) & (relative[:, chosen] > 0)]
    usable = fit.calibration.usable[chosen]
    curves = curve[chosen][usable] if usable.any() else curve[chosen]
    low = min(curves.min(), np.quantile(seen, 0.02) if seen.size else np.inf) / 1.5
    high = max(curves.max(), np.quantile(seen, 0.999) if seen.size else 0.0) * 1.8
    wide, tall = 1 / columns, 1 / rows
    for place, index in enumerate(chosen):
        row, column = divmod(place, columns)
        panel = ax.inset_axes((column * wide, 1 - (row + 1) * tall, 0.93 * wide, 0.9 * tall))
        panel.set_in_layout(False)  # their labels extend beyond the axes
        _draw_field(panel, fit, int(index), relative[:, index], (distance, curve[index], noise[index]), columns)
        panel.set_xlim(0, 1e3 * distance[-1])
        panel.set_ylim(low, high)
        panel.tick_params(labelleft=column == 0, labelbottom=place + columns >= chosen.size)
    _label(ax, fit, noise_shown=bool(noise[chosen].max() > low))
    return ax


def _label(ax: Axes, fit: CalibrationFit, *, noise_shown: bool) -> None:
    """Draw the axis labels shared by all panels, and the legend above them."""
    label: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "color": INK}
    label["annotation_clip"] = False
    ax.annotate("Distance (mm)", (0.5, 0), (0, -22), ha="center", va="top", **label)
    ax.annotate("Intensity / strength of the tap", (0, 0.5), (-34, 0), ha="right", va="center", rotation=90, **label)
    handles = [
        Line2D([], [], marker="o", linestyle="none", color=_TAP, markersize=4, label="tap"),
        Line2D([], [], color=INK, linewidth=1.6, label=f"fit, {type(fit.calibration.microphone_array.decay).name}"),
    ]
    if noise_shown:
        handles.append(Line2D([], [], color=SOFT, linewidth=1.0, linestyle=(0, (4, 3)), label="noise, 1 σ"))
    if fit.outlier.any():
        ring: dict[str, Any] = {"marker": "o", "linestyle": "none", "fillstyle": "none", "markersize": 4}
        handles.append(Line2D([], [], color=FOUND, label="left out", **ring))
    place: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": 4}
    ax.legend(handles=handles, frameon=False, fontsize=9.5, borderpad=0, **place)


def _strengths(fit: CalibrationFit) -> Float[np.ndarray, " T"]:
    """Strength of every tap. Taps excluded from the fit get the median of the strengths estimated from the
    microphones."""
    response = np.asarray(on_host(fit.calibration.microphone_array.decay).response(fit.distance.T**2)).T
    strength = np.where((fit.power > 0) & fit.calibration.usable, fit.power / response, np.nan)
    received = np.isfinite(strength).any(axis=1)
    median = np.full(len(strength), np.nan)
    median[received] = np.nanmedian(strength[received], axis=1)
    return np.where(np.isfinite(fit.strength), fit.strength, median)


def _draw_field(panel: Axes, fit: CalibrationFit, index: int, relative, lines, columns: int) -> None:
    """Draw one panel: taps, curve and noise of a microphone; `lines`: distances (m), the curve there, and the noise."""
    distance, curve, noise = lines
    reason = fit.calibration.reasons[index]
    shown = np.isfinite(relative) & (relative > 0)
    panel.set_yscale("log")
    for which, style in (
        (shown & ~fit.outlier, {"color": SOFT if reason else _TAP, "alpha": 0.6, "linewidths": 0}),
        (shown & fit.outlier, {"facecolors": "none", "edgecolors": FOUND, "linewidths": 0.7, "zorder": 2.5}),
    ):
        size = 9 if columns <= 2 else 5
        panel.scatter(1e3 * fit.distance[which, index], relative[which], s=size, rasterized=True, **style)
    style = {"color": SOFT, "linewidth": 1.2, "linestyle": (0, (1, 1))} if reason else {"color": INK, "linewidth": 1.6}
    # No curve is drawn for a microphone without readings.
    near = (distance <= fit.distance[:, index].max()) & shown.any()
    panel.plot(1e3 * distance[near], curve[near], zorder=3, **style)
    if noise > 0:
        panel.axhline(noise, color=SOFT, linewidth=1.0, linestyle=(0, (4, 3)), zorder=1)
    fontsize = 8.5 if columns <= 5 else 7
    text: dict[str, Any] = {"transform": panel.transAxes, "va": "top", "path_effects": HALO, "zorder": 4}
    panel.text(0.05, 0.97, str(index), ha="left", fontsize=fontsize, fontweight="bold", color=INK, **text)
    if reason:
        short = textwrap.shorten(reason.split(" (")[0], 60, placeholder=" …")
        wrapped = textwrap.fill(short, 24 if columns <= 5 else 18)
        panel.text(0.97, 0.97, wrapped, ha="right", fontsize=fontsize - 1, color=FOUND, **text)
    elif columns <= 6:
        half = distance[np.argmin(np.abs(curve / curve[0] - 0.5))]
        panel.text(0.97, 0.97, f"½ at {1e3 * half:.0f} mm", ha="right", fontsize=fontsize - 1, color=INK, **text)
    soften_axes(panel)
    panel.tick_params(length=2.5, labelsize=fontsize - 0.5, which="both")
    panel.xaxis.set_major_locator(MaxNLocator(4 if columns <= 5 else 3, steps=[1, 2, 5, 10], prune="upper"))
    panel.yaxis.set_major_locator(LogLocator(numticks=4))
    panel.yaxis.set_minor_locator(NullLocator())
    panel.yaxis.set_minor_formatter(NullFormatter())
