"""Plots of series of frames: images side by side on a contact sheet, single frames of a film, and curves over time.

All images of a stream have one colour scale. A refused frame has no image; its body is drawn grey, with the text
"refused".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from jeit.electrodes import AbstractElectrodes
from jeit.image import ImageSeries, Oscillation, Raster, amplitude_spectrum
from jeit.mesh import Mesh
from jeit.plot.axes import (
    CHANGE,
    INK,
    SOFT,
    ColourScale,
    FittedScale,
    check_scale,
    draw_colour_bar,
    draw_scale_bar,
    hide_axes,
    with_si_prefix,
)
from jeit.plot.imaging.electrodes import draw_electrodes
from jeit.plot.imaging.image import check_body, draw_outline, draw_slice_outline, slice_text
from jeit_solvers.engines import as_array

# Number of pixels along a side of an image, and colour of a body without an image.
_PIXELS, _GREY = 160, "#dfe2e6"
SHEET_FRAMES = 12
"""Default of the maximum number of frames of a contact sheet."""
SERIES_FRAMES, _FRAMES_PER_ROW = 12, 6
"""Number of frames at the beginning of the picture of a series."""
# Maximum number of refused frames named below a contact sheet.
_MAX_NAMED = 6


class FrameCount(NamedTuple):
    """Counts of the frames of a stream. **Fields**: `number`: number of frames; `refused`: number of refused frames;
    `names`: names of the first refused frames."""

    number: int
    refused: int
    names: Sequence[str]


def chosen_frames(num_frames: int, max_frames: int) -> list[int]:
    """Numbers of at most `max_frames` evenly spaced frames out of `num_frames`, including the first and the last."""
    return [int(one) for one in np.unique(np.linspace(0, num_frames - 1, min(num_frames, max_frames)).round())]


class FramePicture:
    """Picture of one frame at a time on `ax`; `show` replaces the image by the next one.

    `fitted`: colour scale of all frames; `number`: whether electrodes are numbered; `bar`: whether a scale bar is
    drawn. Images are sampled on a raster, in a solid at the `height` z in metres, half its own by default.
    """

    def __init__(
        self,
        ax: Axes,
        mesh: Mesh,
        electrodes: AbstractElectrodes | None,
        fitted: FittedScale,
        *,
        number: bool = True,
        bar: bool = True,
        height: float | None = None,
    ):
        self.ax, self.fitted = ax, fitted
        self.raster = Raster.create(mesh, shape=(_PIXELS, _PIXELS), height=height)
        extent, inside = self.raster.extent, np.asarray(self.raster.cell) >= 0
        body = np.where(inside, 0.0, np.nan)
        ax.imshow(body, extent=extent, cmap=ListedColormap([_GREY]), interpolation="nearest", zorder=0)
        self.drawn = ax.imshow(body, extent=extent, interpolation="nearest", zorder=1, **fitted.keywords)
        if mesh.dimension == 2:
            draw_outline(mesh, ax)
        else:
            draw_slice_outline(body, extent, ax)
        if electrodes is not None:
            draw_electrodes(mesh, electrodes, numbers=number, ax=ax)
        hide_axes(ax, extent, numbered=number and electrodes is not None)
        if bar:
            draw_scale_bar(ax, extent)
        middle = (extent[0] + extent[1]) / 2, (extent[2] + extent[3]) / 2
        style = {"ha": "center", "va": "center", "color": INK, "fontsize": 10, "zorder": 5}
        self.refused = ax.text(*middle, "refused", **style)  # pyright: ignore[reportArgumentType]

    def show(self, change: Float[np.ndarray, " m"], title: str) -> None:
        """Show a frame. `change`: change of conductivity per cell (m,), NaN for a refused frame."""
        imaged = bool(np.isfinite(change).all())
        if imaged:
            self.drawn.set_data(self.fitted.factor * np.asarray(self.raster.sample(as_array(change))))
        self.drawn.set_visible(imaged)
        self.refused.set_visible(not imaged)
        self.ax.set_title(title, fontsize=10)


def fit_scale(changes: Float[np.ndarray, "F m"], mesh: Mesh, scale: ColourScale = CHANGE) -> FittedScale:
    """Fit one colour scale to all imaged frames. Raises `ValueError` if all frames were refused."""
    check_scale(scale)
    finite = changes[np.isfinite(changes)]
    if not finite.size:
        raise ValueError("changes: every frame was refused; there is nothing to draw.")
    return scale.of(finite, "S" if mesh.dimension == 2 else "S/m")


def plot_frames(
    mesh: Mesh,
    changes: Float[np.ndarray, "F m"],
    electrodes: AbstractElectrodes | None = None,
    *,
    titles: Sequence[str] | None = None,
    scale: ColourScale = CHANGE,
    most: int = SHEET_FRAMES,
    count: FrameCount | None = None,
) -> Figure:
    """Draw a contact sheet of a stream: evenly spaced frames with titles and one colour scale.

    **Arguments:**

    - `mesh`, `electrodes`: as for `plot_image`.
    - `changes` (F, m): changes of conductivity, S (3-D: S/m, drawn at half the height); rows of NaN are refused frames.
    - `titles`: one per frame; default: the numbers of the frames from 0.
    - `scale`: colour scale; default: for changes of conductivity.
    - `most`: maximum number of frames on the sheet.
    - `count`: counts of all frames, if `changes` has only some of them.

    The colour scale is fitted to all frames, not only those drawn. Raises `ValueError` for changes of another shape,
    another number of titles, and if every frame was refused.

    **Example:**

    ```python
    plot_frames(mesh, np.outer(np.linspace(0, 1, 5), image), electrodes)
    ```
    """
    check_body(mesh, electrodes)
    values = np.asarray(changes)
    if values.ndim != 2 or values.shape[1] != mesh.num_cells or not len(values):
        raise ValueError(f"changes has shape {values.shape}; give (frames, {mesh.num_cells}), one value for each cell.")
    said = [f"frame {number}" for number in range(len(values))] if titles is None else list(titles)
    if len(said) != len(values):
        raise ValueError(f"titles are {len(said)}, and the frames {len(values)}; give one each.")
    fitted, chosen = fit_scale(values, mesh, scale), chosen_frames(len(values), most)
    columns = min(len(chosen), 4)
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(2.3 * columns + 1.1, 2.5 * rows + 0.3), layout="constrained")
    places = figure.add_gridspec(rows, columns + 1, width_ratios=[1] * columns + [0.05])
    pictures = []
    for place, frame in enumerate(chosen):
        ax = figure.add_subplot(places[place // columns, place % columns])
        pictures.append(FramePicture(ax, mesh, electrodes, fitted, number=False, bar=place == 0))
        pictures[-1].show(values[frame], said[frame])
    if scale.bar:
        where = figure.add_subplot(places[:, -1])
        draw_colour_bar(where, pictures[0].drawn, fitted.label, signed=scale.difference, position=where)
    if count is None:
        refused = [title for title, row in zip(said, values, strict=True) if not np.isfinite(row).all()]
        count = FrameCount(len(values), len(refused), refused)
    text = _count_text(count, len(chosen), mesh)
    if text:
        figure.supxlabel(text, fontsize=9, color=SOFT)
    return figure


def _count_text(count: FrameCount, chosen: int, mesh: Mesh) -> str:
    """Text on the number of frames drawn and on refused frames."""
    parts = [] if chosen == count.number else [f"{chosen} of {count.number} frames"]
    if count.refused:
        some = ", ".join(count.names[:_MAX_NAMED]) + (" …" if count.refused > _MAX_NAMED else "")
        parts.append(f"{count.refused} of {count.number} refused: {some}")
    return "; ".join([*parts, *filter(None, [slice_text(mesh, subject="slices")])])


# Minimum amplitude for the phase to be drawn: as a share of the maximum amplitude, and as a multiple of its noise.
_MIN_PHASE_SHARE, _MIN_PHASE_SNR = 0.15, 3.0
# Minimum number of frames for a spectrum, as for `jeit.image.oscillation`.
_MIN_FRAMES = 5


def plot_series(
    series: ImageSeries,
    regions: Mapping[str, Bool[np.ndarray, " m"]],
    oscillations: Sequence[Oscillation] = (),
    electrodes: AbstractElectrodes | None = None,
    *,
    height: float | None = None,
) -> Figure:
    """Draw a series of images: evenly spaced frames on one colour scale; the standard deviation over time; amplitude
    and phase of each oscillation; and the mean change of every region over time, with its spectrum if there are enough
    frames.

    The phase is drawn where the amplitude exceeds three times its noise and 15 % of the maximum. `regions`: (m,)
    booleans by name. `height`: z in metres of the slice through a 3-D mesh; default: half the height.
    """
    check_body(series.mesh, electrodes)
    rows = len(oscillations)
    lines = -(-min(len(series.times), SERIES_FRAMES) // _FRAMES_PER_ROW)
    figure = Figure(figsize=(11.0, 2.2 * lines + 3.4 * rows + 3.4), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[2.2 * lines, 3.4 * rows + 3.4])
    sheet, others = parts
    _draw_frames(sheet, series, electrodes, lines, height)
    grid = others.add_gridspec(rows + 1, 3, height_ratios=[1.0] * (rows + 1))
    maps = _RegionMaps(series, electrodes, height)
    functional = ", ".join(filter(None, ["functional image", slice_text(series.mesh, height)]))
    deviation = ColourScale(difference=False, quantity="Standard deviation over time")
    maps.draw(others.add_subplot(grid[0, 0]), series.functional(), deviation, functional)
    for row, one in enumerate(oscillations):
        amplitude = ColourScale(difference=False, quantity=f"Amplitude at {one.frequency:.3g} Hz")
        said = f"{one.frequency:.4g} Hz (resolution {one.resolution:.2g} Hz)"
        maps.draw(others.add_subplot(grid[row, 1]), one.amplitude, amplitude, said)
        clear = (one.amplitude > _MIN_PHASE_SHARE * one.amplitude.max()) & (one.amplitude > _MIN_PHASE_SNR * one.noise)
        maps.draw_phase(others.add_subplot(grid[row, 2]), np.where(clear, np.degrees(one.phase), np.nan))
    means = {name: series.mean_change(region) for name, region in regions.items()}
    largest = max((float(np.nanmax(np.abs(one))) for one in means.values()), default=0.0)
    factor, unit = with_si_prefix(largest or 1.0, series.unit)
    spectra = {name: _spectrum(factor * mean, series.times) for name, mean in means.items()} if series.timed else {}
    drawn = {name: one for name, one in spectra.items() if one is not None}
    # Without oscillations, curves stand beside the functional image.
    below = (grid[rows, :] if rows else grid[0, 1:]).subgridspec(1, 2, width_ratios=[1.6, 1.0])
    place = below[0] if drawn else below[:]
    _draw_curves(others.add_subplot(place), means, series, factor, unit)
    if drawn:
        _draw_spectra(others.add_subplot(below[1]), drawn, oscillations, unit)
    return figure


def _draw_frames(
    figure, series: ImageSeries, electrodes: AbstractElectrodes | None, lines: int, height: float | None
) -> None:
    """Draw evenly spaced frames in so many lines, on one colour scale."""
    chosen, fitted = chosen_frames(len(series.times), SERIES_FRAMES), fit_scale(series.changes, series.mesh)
    places = figure.add_gridspec(lines, _FRAMES_PER_ROW + 1, width_ratios=[1] * _FRAMES_PER_ROW + [0.05])
    for place, frame in enumerate(chosen):
        ax = figure.add_subplot(places[place // _FRAMES_PER_ROW, place % _FRAMES_PER_ROW])
        picture = FramePicture(ax, series.mesh, electrodes, fitted, number=False, bar=place == 0, height=height)
        picture.show(series.changes[frame], series.titles[frame])
        if place == 0:
            where = figure.add_subplot(places[:, -1])
            draw_colour_bar(where, picture.drawn, fitted.label, signed=True, position=where)


class _RegionMaps:
    """Maps of values per cell, sampled on a common raster."""

    def __init__(self, series: ImageSeries, electrodes: AbstractElectrodes | None, height: float | None):
        self.mesh, self.unit, self.electrodes = series.mesh, series.unit, electrodes
        self.raster = Raster.create(self.mesh, shape=(_PIXELS, _PIXELS), height=height)

    def draw(self, ax: Axes, values: np.ndarray, scale: ColourScale, title: str) -> None:
        pixels = np.asarray(self.raster.sample(as_array(values)))
        fitted: FittedScale = scale.of(pixels[np.isfinite(pixels)], self.unit)
        fitted.draw_bar(ax, self._show(ax, fitted.factor * pixels, title, **fitted.keywords))

    def draw_phase(self, ax: Axes, degrees: np.ndarray) -> None:
        pixels = np.asarray(self.raster.sample(as_array(degrees)))
        drawn = self._show(ax, pixels, "phase", cmap="hsv", vmin=-180, vmax=180)
        ax.figure.colorbar(drawn, ax=ax, ticks=[-180, -90, 0, 90, 180], label="Phase (degrees)")

    def _show(self, ax: Axes, pixels: np.ndarray, title: str, **keywords):
        extent = self.raster.extent
        drawn = ax.imshow(pixels, extent=extent, interpolation="nearest", **keywords)
        if self.mesh.dimension == 2:
            draw_outline(self.mesh, ax)
        else:
            draw_slice_outline(np.where(np.asarray(self.raster.cell) >= 0, 0.0, np.nan), extent, ax)
        if self.electrodes is not None:
            draw_electrodes(self.mesh, self.electrodes, numbers=False, ax=ax)
        hide_axes(ax, extent, numbered=False)
        draw_scale_bar(ax, extent)
        ax.set_title(title, fontsize=10)
        return drawn


def _spectrum(mean: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Frequencies and amplitudes of a curve; None if there are too few frames for more than one frequency."""
    if np.isfinite(mean).sum() < _MIN_FRAMES:
        return None
    frequencies, amplitude = amplitude_spectrum(mean, times)
    return (frequencies, amplitude) if len(frequencies) > 1 else None


def _draw_curves(ax: Axes, means: Mapping[str, np.ndarray], series: ImageSeries, factor: float, unit: str) -> None:
    """Draw the mean change of each region over time."""
    for name, mean in means.items():
        ax.plot(series.times, factor * mean, linewidth=1.2, label=name)
    ax.set(xlabel="Time (s)" if series.timed else "Frame", ylabel=f"Mean change ({unit})", title="regions over time")
    if means:
        ax.legend(fontsize=8, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=3)
    _soften(ax)


def _draw_spectra(ax: Axes, spectra: Mapping, oscillations: Sequence[Oscillation], unit: str) -> None:
    """Draw the spectra of the regions, in the same order of colours as their curves."""
    for frequencies, amplitude in spectra.values():
        ax.plot(frequencies, amplitude, linewidth=1.2)
    for one in oscillations:
        ax.axvline(one.frequency, color=INK, linewidth=0.8, linestyle=":")
    ax.set(xlabel="Frequency (Hz)", ylabel=f"Amplitude ({unit})", title="their spectra")
    _soften(ax)


def _soften(ax: Axes) -> None:
    ax.title.set_fontsize(10)
    ax.spines[["top", "right"]].set_visible(False)
