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
        body_pixels = np.where(is_inside, 0.0, np.nan)
        ax.imshow(body_pixels, extent=extent, cmap=ListedColormap([_BODY_COLOUR]), interpolation="nearest", zorder=0)
        self.mappable = ax.imshow(body_pixels, extent=extent, interpolation="nearest", zorder=1, **fitted.keywords)
        if mesh.dimension == 2:
            draw_outline(mesh, ax)
        else:
            draw_slice_outline(body_pixels, extent, ax)
        if electrodes is not None:
            draw_electrodes(mesh, electrodes, numbers=show_numbers, ax=ax)
        hide_axes(ax, extent, numbered=show_numbers and electrodes is not None)
        if show_scale_bar:
            draw_scale_bar(ax, extent)
        extent_centre = (extent[0] + extent[1]) / 2, (extent[2] + extent[3]) / 2
        text_style = {"ha": "center", "va": "center", "color": DARK_GREY, "fontsize": 10, "zorder": 5}
        self.refusal_text = ax.text(*extent_centre, "refused", **text_style)  # pyright: ignore[reportArgumentType]

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
    change_array = np.asarray(changes)
    if change_array.ndim != 2 or change_array.shape[1] != mesh.num_cells or not len(change_array):
        raise ValueError(
            f"changes has shape {change_array.shape}; give (frames, {mesh.num_cells}), one value for each cell."
        )
    frame_titles = (
        [f"frame {frame_number}" for frame_number in range(len(change_array))] if titles is None else list(titles)
    )
    if len(frame_titles) != len(change_array):
        raise ValueError(f"titles are {len(frame_titles)}, and the frames {len(change_array)}; give one each.")
    fitted_scale, selected_frames = fit_scale(change_array, mesh, scale), select_frames(len(change_array), most)
    num_columns = min(len(selected_frames), 4)
    num_rows = -(-len(selected_frames) // num_columns)
    figure = Figure(figsize=(2.3 * num_columns + 1.1, 2.5 * num_rows + 0.3), layout="constrained")
    panel_grid = figure.add_gridspec(num_rows, num_columns + 1, width_ratios=[1] * num_columns + [0.05])
    raster, frame_pictures = _make_raster(mesh), []
    for panel_index, frame in enumerate(selected_frames):
        ax = figure.add_subplot(panel_grid[panel_index // num_columns, panel_index % num_columns])
        frame_picture = FramePicture(
            ax, mesh, electrodes, fitted_scale, show_numbers=False, show_scale_bar=panel_index == 0, raster=raster
        )
        frame_picture.show(change_array[frame], frame_titles[frame])
        frame_pictures.append(frame_picture)
    if scale.bar:
        colour_bar_axes = figure.add_subplot(panel_grid[:, -1])
        fitted_scale.draw_bar(colour_bar_axes, frame_pictures[0].mappable, colour_bar_axes)
    if count is None:
        refused_titles = [
            frame_title
            for frame_title, frame_changes in zip(frame_titles, change_array, strict=True)
            if not np.isfinite(frame_changes).all()
        ]
        count = FrameCount(len(change_array), len(refused_titles), refused_titles)
    text = _count_text(count, len(selected_frames), mesh)
    if text:
        figure.supxlabel(text, fontsize=9, color=LIGHT_GREY)
    return figure


def _count_text(frame_count: FrameCount, num_drawn: int, mesh: Mesh) -> str:
    """Text about the number of frames drawn and about the refused frames of a stream."""
    count_sentences = [] if num_drawn == frame_count.number else [f"{num_drawn} of {frame_count.number} frames"]
    if frame_count.refused:
        refused_names = ", ".join(frame_count.names[:_MAX_NAMED_FRAMES]) + (
            " …" if frame_count.refused > _MAX_NAMED_FRAMES else ""
        )
        count_sentences.append(f"{frame_count.refused} of {frame_count.number} refused: {refused_names}")
    return "; ".join([*count_sentences, *filter(None, [slice_text(mesh, beginning="slices")])])


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
    map_grid = maps_figure.add_gridspec(num_rows + 1, 3, height_ratios=[1.0] * (num_rows + 1))
    region_maps = _RegionMaps(series, electrodes, raster)
    functional_title = ", ".join(filter(None, ["functional image", slice_text(series.mesh, height)]))
    deviation_scale = ColourScale(difference=False, quantity="Standard deviation over time")
    region_maps.draw_map(
        maps_figure.add_subplot(map_grid[0, 0]), series.functional(), deviation_scale, functional_title
    )
    for panel_row, oscillation in enumerate(oscillations):
        amplitude_scale = ColourScale(difference=False, quantity=f"Amplitude at {oscillation.frequency:.3g} Hz")
        map_title = f"{oscillation.frequency:.4g} Hz (resolution {oscillation.resolution:.2g} Hz)"
        region_maps.draw_map(
            maps_figure.add_subplot(map_grid[panel_row, 1]), oscillation.amplitude, amplitude_scale, map_title
        )
        has_phase = (oscillation.amplitude > _MIN_RELATIVE_AMPLITUDE_OF_PHASE * oscillation.amplitude.max()) & (
            oscillation.amplitude > _MIN_SIGNAL_TO_NOISE_OF_PHASE * oscillation.noise
        )
        region_maps.draw_phase(
            maps_figure.add_subplot(map_grid[panel_row, 2]), np.where(has_phase, np.degrees(oscillation.phase), np.nan)
        )
    mean_changes = {name: series.mean_change(region_cells) for name, region_cells in regions.items()}
    max_change = max((float(np.nanmax(np.abs(mean_change))) for mean_change in mean_changes.values()), default=0.0)
    unit_factor, change_unit = choose_si_prefix(max_change or 1.0, series.unit)
    region_spectra = (
        {name: _curve_spectrum(unit_factor * mean_change, series.times) for name, mean_change in mean_changes.items()}
        if series.timed
        else {}
    )
    drawn_spectra = {
        name: region_spectrum for name, region_spectrum in region_spectra.items() if region_spectrum is not None
    }
    # Without oscillations, curves are drawn beside the functional image.
    curves_grid = (map_grid[num_rows, :] if num_rows else map_grid[0, 1:]).subgridspec(1, 2, width_ratios=[1.6, 1.0])
    curves_position = curves_grid[0] if drawn_spectra else curves_grid[:]
    _draw_curves(maps_figure.add_subplot(curves_position), mean_changes, series, unit_factor, change_unit)
    if drawn_spectra:
        _draw_spectra(maps_figure.add_subplot(curves_grid[1]), drawn_spectra, oscillations, change_unit)
    return figure


def _draw_frames(
    figure, image_series: ImageSeries, electrodes: AbstractElectrodes | None, num_lines: int, raster: Raster
) -> None:
    """Draw evenly spaced frames in `num_lines` lines, on one colour scale."""
    selected_frames, fitted_scale = (
        select_frames(len(image_series.times), SERIES_FRAMES),
        fit_scale(image_series.changes, image_series.mesh),
    )
    panel_grid = figure.add_gridspec(num_lines, _FRAMES_PER_ROW + 1, width_ratios=[1] * _FRAMES_PER_ROW + [0.05])
    for panel_index, frame in enumerate(selected_frames):
        ax = figure.add_subplot(panel_grid[panel_index // _FRAMES_PER_ROW, panel_index % _FRAMES_PER_ROW])
        frame_picture = FramePicture(
            ax,
            image_series.mesh,
            electrodes,
            fitted_scale,
            show_numbers=False,
            show_scale_bar=panel_index == 0,
            raster=raster,
        )
        frame_picture.show(image_series.changes[frame], image_series.titles[frame])
        if panel_index == 0:
            colour_bar_axes = figure.add_subplot(panel_grid[:, -1])
            fitted_scale.draw_bar(colour_bar_axes, frame_picture.mappable, colour_bar_axes)


class _RegionMaps:
    """Maps of values per cell, sampled on a common raster."""

    def __init__(self, series: ImageSeries, electrodes: AbstractElectrodes | None, raster: Raster):
        self.mesh, self.unit, self.electrodes, self.raster = series.mesh, series.unit, electrodes, raster

    def draw_map(self, ax: Axes, cell_values: np.ndarray, colour_scale: ColourScale, map_title: str) -> None:
        map_pixels = np.asarray(self.raster.sample(as_array(cell_values)))
        fitted_scale: FittedScale = colour_scale.of(map_pixels[np.isfinite(map_pixels)], self.unit)
        fitted_scale.draw_bar(
            ax, self._show_pixels(ax, fitted_scale.factor * map_pixels, map_title, **fitted_scale.keywords)
        )

    def draw_phase(self, ax: Axes, phase_degrees: np.ndarray) -> None:
        phase_pixels = np.asarray(self.raster.sample(as_array(phase_degrees)))
        mappable = self._show_pixels(ax, phase_pixels, "phase", cmap="hsv", vmin=-180, vmax=180)
        ax.figure.colorbar(mappable, ax=ax, ticks=[-180, -90, 0, 90, 180], label="Phase (degrees)")

    def _show_pixels(self, ax: Axes, map_pixels: np.ndarray, map_title: str, **image_options):
        extent = self.raster.extent
        mappable = ax.imshow(map_pixels, extent=extent, interpolation="nearest", **image_options)
        if self.mesh.dimension == 2:
            draw_outline(self.mesh, ax)
        else:
            draw_slice_outline(np.where(np.asarray(self.raster.cell) >= 0, 0.0, np.nan), extent, ax)
        if self.electrodes is not None:
            draw_electrodes(self.mesh, self.electrodes, numbers=False, ax=ax)
        hide_axes(ax, extent, numbered=False)
        draw_scale_bar(ax, extent)
        ax.set_title(map_title, fontsize=10)
        return mappable


def _curve_spectrum(mean_change: np.ndarray, frame_times: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Frequencies and amplitudes of a curve; None if there are too few frames for more than one frequency."""
    if np.isfinite(mean_change).sum() < _MIN_FRAMES:
        return None
    frequencies, spectrum_amplitudes = amplitude_spectrum(mean_change, frame_times)
    return (frequencies, spectrum_amplitudes) if len(frequencies) > 1 else None


def _draw_curves(
    ax: Axes, mean_changes: Mapping[str, np.ndarray], image_series: ImageSeries, unit_factor: float, change_unit: str
) -> None:
    """Draw the mean change of each region over time."""
    for name, mean_change in mean_changes.items():
        ax.plot(image_series.times, unit_factor * mean_change, linewidth=1.2, label=name)
    ax.set(
        xlabel="Time (s)" if image_series.timed else "Frame",
        ylabel=f"Mean change ({change_unit})",
        title="regions over time",
    )
    if mean_changes:
        ax.legend(fontsize=8, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=3)
    _style_graph(ax)


def _draw_spectra(ax: Axes, region_spectra: Mapping, oscillations: Sequence[Oscillation], amplitude_unit: str) -> None:
    """Draw the spectra of the regions, in the same order of colours as their curves."""
    for frequencies, amplitudes in region_spectra.values():
        ax.plot(frequencies, amplitudes, linewidth=1.2)
    for oscillation in oscillations:
        ax.axvline(oscillation.frequency, color=DARK_GREY, linewidth=0.8, linestyle=":")
    ax.set(xlabel="Frequency (Hz)", ylabel=f"Amplitude ({amplitude_unit})", title="their spectra")
    _style_graph(ax)


def _style_graph(ax: Axes) -> None:
    ax.title.set_fontsize(10)
    ax.spines[["top", "right"]].set_visible(False)
