"""Plot that compares measured and modelled voltages."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from jeit.plot.axes import INK, SOFT, axes_or_new, with_si_prefix
from jeit.protocol import Protocol

MEASURED = "#1f6fb4"
MODELLED = "#d1495b"


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
    factor, unit = with_si_prefix(float(np.abs(measured[is_drawn]).max()), "V")
    misfit = np.linalg.norm((modelled - measured)[is_drawn]) / np.linalg.norm(measured[is_drawn])
    ax = axes_or_new(ax, (8.4, 5.0))
    ax.set_axis_off()
    voltage_axes = ax.inset_axes((0, 0.42, 1, 0.58))
    difference_axes = ax.inset_axes((0, 0, 1, 0.36), sharex=voltage_axes)
    marker_size = float(np.clip(500 / channel.size, 0.8, 3))
    voltage_axes.plot(
        channel, factor * measured[is_drawn], "o", color=MEASURED, markersize=2 * marker_size, label="measured"
    )
    voltage_axes.plot(
        channel, factor * modelled[is_drawn], "o", color=MODELLED, markersize=marker_size, label="modelled"
    )
    voltage_axes.set_ylabel(f"Voltage ({unit})")
    voltage_axes.legend(
        frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.1, markerscale=2
    )
    voltage_axes.set_title(title or f"Relative misfit {100 * misfit:.2g} %", loc="left", fontsize=11)
    voltage_axes.tick_params(labelbottom=False)
    residual = 100 * (modelled - measured)[is_drawn] / rms_voltage
    difference_axes.axhline(0, color=SOFT, linewidth=0.8)
    difference_axes.vlines(channel, 0, residual, color=INK, linewidth=0.6)
    difference_axes.plot(channel, residual, "o", color=INK, markersize=marker_size)
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
