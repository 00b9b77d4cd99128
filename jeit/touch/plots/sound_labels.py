"""Plot the classification of sounds over time: the probability of each name, and the name that is chosen."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from jeit.plot.axes import INK, SERIES_COLOURS, axes_or_new, draw_colour_bar, soften_axes
from jeit.touch.listening import SoundLabels
from jeit.touch.listening.feature_images import EVERY


def plot_sound_labels(labels: SoundLabels, *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the probabilities of all names over time, a row each, with a bar under the chosen name; quiet is blank."""
    ax = axes_or_new(ax, (8.0, 3.2))
    names, times = labels.names, labels.times
    shown = np.where((labels.named != "")[:, None], labels.probabilities, np.nan).T
    extent = (float(times[0]) - EVERY / 2, float(times[-1]) + EVERY / 2, -0.5, len(names) - 0.5)
    drawn = ax.imshow(
        100 * shown,
        aspect="auto",
        origin="lower",
        extent=extent,
        cmap="Blues",
        vmin=0,
        vmax=100,
        interpolation="nearest",
    )
    draw_colour_bar(ax, drawn, "Probability (%)")
    for event in labels.events:
        if event.name:
            row, span = names.index(event.name) - 0.42, [event.start, event.end]
            ax.plot(span, [row, row], color=SERIES_COLOURS[1], linewidth=2.5, solid_capstyle="butt")
    ax.set_yticks(range(len(names)), names)
    ax.set_xlim(0, extent[1])
    ax.set_xlabel("Time (s)", color=INK)
    quiet = int((labels.named == "").sum())
    said = f"{labels.name}: sounds in red" + (f"; blank, {quiet} of {len(labels)} windows quiet" if quiet else "")
    ax.set_title(said if title is None else title)
    soften_axes(ax)
    return ax
