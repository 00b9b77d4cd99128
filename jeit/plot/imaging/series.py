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
from jeit.plot.axes import draw_scale_bar, hide_axes
from jeit.plot.colours import (
    CHANGE_SCALE,
    DARK_GREY,
    LIGHT_GREY,
    ColourScale,
    FittedScale,
    check_scale,
    choose_si_prefix,
)
from jeit.plot.imaging.electrodes import draw_electrodes
from jeit.plot.imaging.image import check_body, draw_outline, draw_slice_outline, slice_text
from jeit_solvers.engines import as_array

# Number of pixels along a side of an image, and colour of a body without an image.
_NUM_PIXELS, _BODY_COLOUR = 160, "#dfe2e6"
NUM_CONTACT_SHEET_FRAMES = 12
"""Default maximum number of frames on a contact sheet."""
SERIES_FRAMES, _FRAMES_PER_ROW = 12, 6
"""Number of frames at the beginning of the picture of a series."""
# Maximum number of refused frames named below a contact sheet.
_MAX_NAMED_FRAMES = 6


class FrameCount(NamedTuple):
    """Counts of the frames of a stream. **Fields**: `number`: number of frames; `refused`: number of refused frames;
    `names`: names of the first refused frames."""

    number: int
    refused: int
    names: Sequence[str]


def select_frames(num_frames: int, max_frames: int) -> list[int]:
    """Numbers of at most `max_frames` evenly spaced frames out of `num_frames`, including the first and the last."""
    return [int(frame) for frame in np.unique(np.linspace(0, num_frames - 1, min(num_frames, max_frames)).round())]


def _make_raster(mesh: Mesh, height: float | None = None) -> Raster:
    """Make the raster on which the images of a stream are sampled. `height`: as for `Raster.create`."""
    return Raster.create(mesh, shape=(_NUM_PIXELS, _NUM_PIXELS), height=height)


class FramePicture:
    """Picture on `ax` of one frame of a stream at a time; `show` replaces it by the image of a different frame.

    `fitted`: colour scale of all frames; `show_numbers`: whether electrodes are numbered; `show_scale_bar`: whether a
    scale bar is drawn; `raster`: raster on which images are sampled, which pictures of one mesh can share; by default a
    raster is made, for a solid at half its height.
    """

    def __init__(
        self,
        ax: Axes,
        mesh: Mesh,
        electrodes: AbstractElectrodes | None,
        fitted: FittedScale,
        *,
        show_numbers: bool = True,
        show_scale_bar: bool = True,
        raster: Raster | None = None,
    ):
        self.ax, self.fitted = ax, fitted
        self.raster = _make_raster(mesh) if raster is None else raster
        extent, is_inside = self.raster.extent, np.asarray(self.raster.cell) >= 0
        body = np.where(is_inside, 0.0, np.nan)
        ax.imshow(body, extent=extent, cmap=ListedColormap([_BODY_COLOUR]), interpolation="nearest", zorder=0)
        self.mappable = ax.imshow(body, extent=extent, interpolation="nearest", zorder=1, **fitted.keywords)
        if mesh.dimension == 2:
            draw_outline(mesh, ax)
        else:
            draw_slice_outline(body, extent, ax)
        if electrodes is not None:
            draw_electrodes(mesh, electrodes, numbers=show_numbers, ax=ax)
        hide_axes(ax, extent, numbered=show_numbers and electrodes is not None)
        if show_scale_bar:
            draw_scale_bar(ax, extent)
        centre = (extent[0] + extent[1]) / 2, (extent[2] + extent[3]) / 2
        style = {"ha": "center", "va": "center", "color": DARK_GREY, "fontsize": 10, "zorder": 5}
        self.refusal_text = ax.text(*centre, "refused", **style)  # pyright: ignore[reportArgumentType]

    def show(self, change: Float[np.ndarray, " m"], title: str) -> None:
        """Show a frame. `change`: change of conductivity per cell (m,), NaN for a refused frame."""
        has_image = bool(np.isfinite(change).all())
        if has_image:
            self.mappable.set_data(self.fitted.factor * np.asarray(self.raster.sample(as_array(change))))
        self.mappable.set_visible(has_image)
        self.refusal_text.set_visible(not has_image)
        self.ax.set_title(title, fontsize=10)


def fit_scale(changes: Float[np.ndarray, "F m"], mesh: Mesh, scale: ColourScale = CHANGE_SCALE) -> FittedScale:
    """Fit one colour scale to all imaged frames. Raises `ValueError` if all frames were refused."""
    check_scale(scale)
    finite_changes = changes[np.isfinite(changes)]
    if not finite_changes.size:
        raise ValueError("changes: every frame was refused; there is nothing to draw.")
    return scale.of(finite_changes, "S" if mesh.dimension == 2 else "S/m")


def plot_frames(
    mesh: Mesh,
    changes: Float[np.ndarray, "F m"],
    electrodes: AbstractElectrodes | None = None,
    *,
    titles: Sequence[str] | None = None,
    scale: ColourScale = CHANGE_SCALE,
    most: int = NUM_CONTACT_SHEET_FRAMES,
    count: FrameCount | None = None,
) -> Figure:
    """Draw a contact sheet of a stream: evenly spaced frames with titles and one colour scale.

    **Arguments:**

    - `mesh`, `electrodes`: as for `plot_image`.
    - `changes` (F, m): changes of conductivity, S (3-D: S/m, drawn at half the height); rows of NaN are refused frames.
    - `titles`: one title per frame; default: the numbers of the frames from 0.
    - `scale`: colour scale; default: for changes of conductivity.
    - `most`: maximum number of frames on the sheet.
    - `count`: counts of all frames, if `changes` has only some of them.

    The colour scale is fitted to all frames, not only those drawn. Raises `ValueError` for changes of a wrong shape,
    for a wrong number of titles, and if every frame was refused.

    **Example:**

    ```python
    plot_frames(mesh, np.outer(np.linspace(0, 1, 5), image), electrodes)
    ```
    """
    check_body(mesh, electrodes)
    values = np.asarray(changes)
    if values.ndim != 2 or values.shape[1] != mesh.num_cells or not len(values):
        raise ValueError(f"changes has shape {values.shape}; give (frames, {mesh.num_cells}), one value for each cell.")
    frame_titles = [f"frame {number}" for number in range(len(values))] if titles is None else list(titles)
    if len(frame_titles) != len(values):
        raise ValueError(f"titles are {len(frame_titles)}, and the frames {len(values)}; give one each.")
    fitted_scale, selected = fit_scale(values, mesh, scale), select_frames(len(values), most)
    columns = min(len(selected), 4)
    rows = -(-len(selected) // columns)
    figure = Figure(figsize=(2.3 * columns + 1.1, 2.5 * rows + 0.3), layout="constrained")
    grid = figure.add_gridspec(rows, columns + 1, width_ratios=[1] * columns + [0.05])
    raster, pictures = _make_raster(mesh), []
    for panel_index, frame in enumerate(selected):
        ax = figure.add_subplot(grid[panel_index // columns, panel_index % columns])
        picture = FramePicture(
            ax, mesh, electrodes, fitted_scale, show_numbers=False, show_scale_bar=panel_index == 0, raster=raster
        )
        picture.show(values[frame], frame_titles[frame])
        pictures.append(picture)
    if scale.bar:
        colour_bar_axes = figure.add_subplot(grid[:, -1])
        fitted_scale.draw_bar(colour_bar_axes, pictures[0].mappable, colour_bar_axes)
    if count is None:
        refused_titles = [title for title, row in zip(frame_titles, values, strict=True) if not np.isfinite(row).all()]
        count = FrameCount(len(values), len(refused_titles), refused_titles)
    text = _count_text(count, len(selected), mesh)
    if text:
        figure.supxlabel(text, fontsize=9, color=LIGHT_GREY)
    return figure


def _count_text(count: FrameCount, num_drawn: int, mesh: Mesh) -> str:
    """Text about the number of frames drawn and about the refused frames of a stream."""
    sentences = [] if num_drawn == count.number else [f"{num_drawn} of {count.number} frames"]
    if count.refused:
        names = ", ".join(count.names[:_MAX_NAMED_FRAMES]) + (" …" if count.refused > _MAX_NAMED_FRAMES else "")
        sentences.append(f"{count.refused} of {count.number} refused: {names}")
    return "; ".join([*sentences, *filter(None, [slice_text(mesh, beginning="slices")])])


# Minimum amplitude at which the phase is drawn: as a share of the maximum amplitude, and as a multiple of the noise of
# the amplitude.
_MIN_RELATIVE_AMPLITUDE_OF_PHASE, _MIN_SIGNAL_TO_NOISE_OF_PHASE = 0.15, 3.0
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

    The phase is drawn where the amplitude exceeds three times its noise and 15 % of the maximum. `regions`: cells of
    each region, (m,) booleans, by name. `height`: z in metres of the slice through a 3-D mesh; default: half the
    height.
    """
    check_body(series.mesh, electrodes)
    num_rows = len(oscillations)
    num_lines = -(-min(len(series.times), SERIES_FRAMES) // _FRAMES_PER_ROW)
    figure = Figure(figsize=(11.0, 2.2 * num_lines + 3.4 * num_rows + 3.4), layout="constrained")
    subfigures: Any = figure.subfigures(2, 1, height_ratios=[2.2 * num_lines, 3.4 * num_rows + 3.4])
    frames_figure, maps_figure = subfigures
    raster = _make_raster(series.mesh, height)
    _draw_frames(frames_figure, series, electrodes, num_lines, raster)
    grid = maps_figure.add_gridspec(num_rows + 1, 3, height_ratios=[1.0] * (num_rows + 1))
    maps = _RegionMaps(series, electrodes, raster)
    functional_title = ", ".join(filter(None, ["functional image", slice_text(series.mesh, height)]))
    deviation_scale = ColourScale(difference=False, quantity="Standard deviation over time")
    maps.draw_map(maps_figure.add_subplot(grid[0, 0]), series.functional(), deviation_scale, functional_title)
    for row, oscillation in enumerate(oscillations):
        amplitude_scale = ColourScale(difference=False, quantity=f"Amplitude at {oscillation.frequency:.3g} Hz")
        title = f"{oscillation.frequency:.4g} Hz (resolution {oscillation.resolution:.2g} Hz)"
        maps.draw_map(maps_figure.add_subplot(grid[row, 1]), oscillation.amplitude, amplitude_scale, title)
        has_phase = (oscillation.amplitude > _MIN_RELATIVE_AMPLITUDE_OF_PHASE * oscillation.amplitude.max()) & (
            oscillation.amplitude > _MIN_SIGNAL_TO_NOISE_OF_PHASE * oscillation.noise
        )
        maps.draw_phase(
            maps_figure.add_subplot(grid[row, 2]), np.where(has_phase, np.degrees(oscillation.phase), np.nan)
        )
    mean_changes = {name: series.mean_change(region) for name, region in regions.items()}
    max_change = max((float(np.nanmax(np.abs(mean))) for mean in mean_changes.values()), default=0.0)
    factor, unit = choose_si_prefix(max_change or 1.0, series.unit)
    spectra = (
        {name: _spectrum(factor * mean, series.times) for name, mean in mean_changes.items()} if series.timed else {}
    )
    drawn_spectra = {name: spectrum for name, spectrum in spectra.items() if spectrum is not None}
    # Without oscillations, curves are drawn beside the functional image.
    curves_grid = (grid[num_rows, :] if num_rows else grid[0, 1:]).subgridspec(1, 2, width_ratios=[1.6, 1.0])
    curves_position = curves_grid[0] if drawn_spectra else curves_grid[:]
    _draw_curves(maps_figure.add_subplot(curves_position), mean_changes, series, factor, unit)
    if drawn_spectra:
        _draw_spectra(maps_figure.add_subplot(curves_grid[1]), drawn_spectra, oscillations, unit)
    return figure


def _draw_frames(
    figure, series: ImageSeries, electrodes: AbstractElectrodes | None, num_lines: int, raster: Raster
) -> None:
    """Draw evenly spaced frames in `num_lines` lines, on one colour scale."""
    selected, fitted_scale = select_frames(len(series.times), SERIES_FRAMES), fit_scale(series.changes, series.mesh)
    grid = figure.add_gridspec(num_lines, _FRAMES_PER_ROW + 1, width_ratios=[1] * _FRAMES_PER_ROW + [0.05])
    for panel_index, frame in enumerate(selected):
        ax = figure.add_subplot(grid[panel_index // _FRAMES_PER_ROW, panel_index % _FRAMES_PER_ROW])
        picture = FramePicture(
            ax,
            series.mesh,
            electrodes,
            fitted_scale,
            show_numbers=False,
            show_scale_bar=panel_index == 0,
            raster=raster,
        )
        picture.show(series.changes[frame], series.titles[frame])
        if panel_index == 0:
            colour_bar_axes = figure.add_subplot(grid[:, -1])
            fitted_scale.draw_bar(colour_bar_axes, picture.mappable, colour_bar_axes)


class _RegionMaps:
    """Maps of values per cell, sampled on a common raster."""

    def __init__(self, series: ImageSeries, electrodes: AbstractElectrodes | None, raster: Raster):
        self.mesh, self.unit, self.electrodes, self.raster = series.mesh, series.unit, electrodes, raster

    def draw_map(self, ax: Axes, values: np.ndarray, scale: ColourScale, title: str) -> None:
        pixels = np.asarray(self.raster.sample(as_array(values)))
        fitted_scale: FittedScale = scale.of(pixels[np.isfinite(pixels)], self.unit)
        fitted_scale.draw_bar(ax, self._show_pixels(ax, fitted_scale.factor * pixels, title, **fitted_scale.keywords))

    def draw_phase(self, ax: Axes, degrees: np.ndarray) -> None:
        pixels = np.asarray(self.raster.sample(as_array(degrees)))
        mappable = self._show_pixels(ax, pixels, "phase", cmap="hsv", vmin=-180, vmax=180)
        ax.figure.colorbar(mappable, ax=ax, ticks=[-180, -90, 0, 90, 180], label="Phase (degrees)")

    def _show_pixels(self, ax: Axes, pixels: np.ndarray, title: str, **keywords):
        extent = self.raster.extent
        mappable = ax.imshow(pixels, extent=extent, interpolation="nearest", **keywords)
        if self.mesh.dimension == 2:
            draw_outline(self.mesh, ax)
        else:
            draw_slice_outline(np.where(np.asarray(self.raster.cell) >= 0, 0.0, np.nan), extent, ax)
        if self.electrodes is not None:
            draw_electrodes(self.mesh, self.electrodes, numbers=False, ax=ax)
        hide_axes(ax, extent, numbered=False)
        draw_scale_bar(ax, extent)
        ax.set_title(title, fontsize=10)
        return mappable


def _spectrum(mean: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Frequencies and amplitudes of a curve; None if there are too few frames for more than one frequency."""
    if np.isfinite(mean).sum() < _MIN_FRAMES:
        return None
    frequencies, amplitude = amplitude_spectrum(mean, times)
    return (frequencies, amplitude) if len(frequencies) > 1 else None


def _draw_curves(
    ax: Axes, mean_changes: Mapping[str, np.ndarray], series: ImageSeries, factor: float, unit: str
) -> None:
    """Draw the mean change of each region over time."""
    for name, mean in mean_changes.items():
        ax.plot(series.times, factor * mean, linewidth=1.2, label=name)
    ax.set(xlabel="Time (s)" if series.timed else "Frame", ylabel=f"Mean change ({unit})", title="regions over time")
    if mean_changes:
        ax.legend(fontsize=8, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=3)
    _style_graph(ax)


def _draw_spectra(ax: Axes, spectra: Mapping, oscillations: Sequence[Oscillation], unit: str) -> None:
    """Draw the spectra of the regions, in the same order of colours as their curves."""
    for frequencies, amplitude in spectra.values():
        ax.plot(frequencies, amplitude, linewidth=1.2)
    for oscillation in oscillations:
        ax.axvline(oscillation.frequency, color=DARK_GREY, linewidth=0.8, linestyle=":")
    ax.set(xlabel="Frequency (Hz)", ylabel=f"Amplitude ({unit})", title="their spectra")
    _style_graph(ax)


def _style_graph(ax: Axes) -> None:
    ax.title.set_fontsize(10)
    ax.spines[["top", "right"]].set_visible(False)
