"""Pictures of image series: the functional image, maps of amplitude and phase, and curves and spectra of regions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jeit.electrodes import AbstractElectrodes
from jeit.image import ImageSeries, Oscillation, Raster, amplitude_spectrum
from jeit.plot.axes import INK, bare, draw_scale_bar, prefixed
from jeit.plot.colour_scale import ColourScale, FittedScale
from jeit.plot.imaging.electrodes import draw_electrodes
from jeit.plot.imaging.mesh import check_body, draw_outline, draw_slice_outline, slice_text
from jeit_solvers.engines import as_array

# Share of the largest amplitude below which no phase is drawn; and times its noise.
_SHARE, _NOISE = 0.15, 3.0
_PIXELS = 160
# Frames that a spectrum takes, as `jeit.image.oscillation`.
_FEWEST = 5


def plot_series(
    series: ImageSeries,
    regions: Mapping[str, Bool[np.ndarray, " m"]],
    oscillations: Sequence[Oscillation] = (),
    electrodes: AbstractElectrodes | None = None,
    *,
    height: float | None = None,
) -> Figure:
    """The standard deviation over time; amplitude and phase of each oscillation, the phase only where the amplitude is
    above its noise and 15 % of the largest; and the mean change of every region over time, with its spectrum where
    there are frames enough for one.

    `regions`: (m,) booleans by name. `height`: z in metres of the slice through a 3-D mesh, half way up unless given.
    """
    check_body(series.mesh, electrodes)
    rows = max(len(oscillations), 1)
    figure = Figure(figsize=(11.0, 3.4 * rows + 3.0), layout="constrained")
    grid = figure.add_gridspec(rows + 1, 3, height_ratios=[1.0] * rows + [0.8])
    maps = _Maps(series, electrodes, height)
    functional = ", ".join(filter(None, ["functional image", slice_text(series.mesh, height)]))
    deviation = ColourScale(difference=False, quantity="Standard deviation over time")
    maps.draw(figure.add_subplot(grid[0, 0]), series.functional(), deviation, functional)
    for row, one in enumerate(oscillations):
        amplitude = ColourScale(difference=False, quantity=f"Amplitude at {one.frequency:.3g} Hz")
        said = f"{one.frequency:.4g} Hz (resolution {one.resolution:.2g} Hz)"
        maps.draw(figure.add_subplot(grid[row, 1]), one.amplitude, amplitude, said)
        clear = (one.amplitude > _SHARE * one.amplitude.max()) & (one.amplitude > _NOISE * one.noise)
        maps.draw_phase(figure.add_subplot(grid[row, 2]), np.where(clear, np.degrees(one.phase), np.nan))
    means = {name: series.mean_change(region) for name, region in regions.items()}
    largest = max((float(np.nanmax(np.abs(one))) for one in means.values()), default=0.0)
    factor, unit = prefixed(largest or 1.0, series.unit)
    spectra = {name: _spectrum(factor * mean, series.times) for name, mean in means.items()}
    drawn = {name: one for name, one in spectra.items() if one is not None}
    below = grid[rows, :].subgridspec(1, 2, width_ratios=[1.6, 1.0])
    _draw_curves(figure.add_subplot(below[0] if drawn else grid[rows, :]), means, series.times, factor, unit)
    if drawn:
        _draw_spectra(figure.add_subplot(below[1]), drawn, oscillations, unit)
    return figure


class _Maps:
    """Draws values per cell, sampled once."""

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
        bare(ax, extent, numbered=False)
        draw_scale_bar(ax, extent)
        ax.set_title(title, fontsize=10)
        return drawn


def _spectrum(mean: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Frequencies and amplitudes; None where there are too few frames for more than one."""
    if np.isfinite(mean).sum() < _FEWEST:
        return None
    frequencies, amplitude = amplitude_spectrum(mean, times)
    return (frequencies, amplitude) if len(frequencies) > 1 else None


def _draw_curves(ax: Axes, means: Mapping[str, np.ndarray], times: np.ndarray, factor: float, unit: str) -> None:
    """Mean changes over time."""
    for name, mean in means.items():
        ax.plot(times, factor * mean, linewidth=1.2, label=name)
    ax.set(xlabel="Time (s)", ylabel=f"Mean change ({unit})", title="regions over time")
    if means:
        ax.legend(fontsize=8, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=3)
    _softened(ax)


def _draw_spectra(ax: Axes, spectra: Mapping, oscillations: Sequence[Oscillation], unit: str) -> None:
    """Spectra of those, in their colours."""
    for frequencies, amplitude in spectra.values():
        ax.plot(frequencies, amplitude, linewidth=1.2)
    for one in oscillations:
        ax.axvline(one.frequency, color=INK, linewidth=0.8, linestyle=":")
    ax.set(xlabel="Frequency (Hz)", ylabel=f"Amplitude ({unit})", title="their spectra")
    _softened(ax)


def _softened(ax: Axes) -> None:
    ax.title.set_fontsize(10)
    ax.spines[["top", "right"]].set_visible(False)
