"""Pictures of series of images, checked by the drawn artists: frames on one scale, maps of oscillations, curves of
regions and their spectra, against the values of the series."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from jeit.electrodes import BoundaryElectrodes
from jeit.image import ImageSeries, oscillation
from jeit.layout import ring
from jeit.mesh import centroids, disk
from jeit.plot.imaging.series import plot_series

MESH = disk(0.05, num_points=200)
TIMES = 0.1 * np.arange(40)
LEFT = np.asarray(centroids(MESH))[:, 0] < 0
PHASE = 0.9


@pytest.fixture(scope="module")
def drawn() -> Figure:
    """The left half oscillates at 2 Hz, and the right half hardly and without a phase of its own. At 3.5 Hz there is
    noise alone."""
    wave = 2e-6 * np.cos(4 * np.pi * TIMES + PHASE)
    noise = np.random.default_rng(0).normal(size=(40, MESH.num_cells))
    series = ImageSeries(MESH, wave[:, None] * LEFT + 1e-8 * noise, TIMES)
    found = [oscillation(series.changes, TIMES, frequency) for frequency in (2.0, 3.5)]
    electrodes = BoundaryElectrodes(ring(0.05, 8), 0.01, 0.1)
    return plot_series(series, {"left": LEFT, "right": ~LEFT}, found, electrodes)


def titled(figure, title, number=0):
    """The first of the axes with this title, or another one."""
    return [one for one in figure.axes if one.get_title() == title][number]


def cells_of_grid(ax):
    """Rows and columns of the outer grid of a picture that the axes fill."""
    place = ax.get_subplotspec().get_topmost_subplotspec()
    return list(place.rowspan), list(place.colspan)


def labels(figure):
    return [ax.get_ylabel() for ax in figure.axes if ax.get_ylabel()]


def test_frames_share_one_colour_bar_and_one_scale_bar(drawn):
    frames = [ax for ax in drawn.axes if ax.get_title().endswith(" s")]
    assert [ax.get_title() for ax in frames] == [
        f"{TIMES[k]:.2f} s" for k in np.linspace(0, 39, 12).round().astype(int)
    ]
    assert len({ax.images[1].get_clim() for ax in frames}) == 1
    assert labels(drawn).count("Change of sheet conductivity (µS)") == 1
    assert ["20 mm" in [text.get_text() for text in ax.texts] for ax in frames] == [True] + 11 * [False]
    assert not any(text.get_text() == "1" for ax in frames for text in ax.texts)  # too small for numbers


def test_maps_have_the_amplitude_and_the_phase_where_there_is_an_oscillation(drawn):
    amplitude = titled(drawn, "2 Hz (resolution 0.51 Hz)").images[0].get_array()
    columns = np.arange(160)
    left, right = (columns > 20) & (columns < 70), (columns > 90) & (columns < 140)
    np.testing.assert_allclose(amplitude[60:100, left], 2.0, rtol=0.02)  # µS
    assert np.max(amplitude[60:100, right]) < 0.1
    phase = np.ma.filled(titled(drawn, "phase").images[0].get_array(), np.nan)
    np.testing.assert_allclose(phase[60:100, left], np.degrees(PHASE), atol=1)
    assert np.isnan(phase[60:100, right]).all()
    noisy = np.ma.filled(titled(drawn, "phase", 1).images[0].get_array(), np.nan)
    assert np.isfinite(noisy).mean() < 0.05
    deviation = titled(drawn, "functional image").images[0].get_array()
    np.testing.assert_allclose(deviation[60:100, left], 2.0 / np.sqrt(2), rtol=0.02)
    named = labels(drawn)
    assert {"Standard deviation over time (µS)", "Amplitude at 2 Hz (µS)", "Phase (degrees)"} <= set(named)


def test_curves_and_spectra_of_regions(drawn):
    curves, spectra = titled(drawn, "regions over time"), titled(drawn, "their spectra")
    assert [text.get_text() for text in curves.get_legend().get_texts()] == ["left", "right"]
    assert (curves.get_xlabel(), curves.get_ylabel()) == ("Time (s)", "Mean change (µS)")
    left, right = curves.lines
    np.testing.assert_allclose(left.get_xdata(), TIMES)
    np.testing.assert_allclose(left.get_ydata(), 2 * np.cos(4 * np.pi * TIMES + PHASE), atol=0.01)
    assert np.abs(right.get_ydata()).max() < 0.01
    assert (spectra.get_xlabel(), spectra.get_ylabel()) == ("Frequency (Hz)", "Amplitude (µS)")
    left, right, *lines = spectra.lines
    assert left.get_xdata()[left.get_ydata().argmax()] == pytest.approx(2, abs=0.26)
    assert left.get_ydata().max() == pytest.approx(2, rel=0.1)
    assert right.get_ydata().max() < 0.01
    assert [list(line.get_xdata()) for line in lines] == [[2.0, 2.0], [3.5, 3.5]]
    # In the same colours.
    assert [one.get_color() for one in curves.lines] == [one.get_color() for one in (left, right)]
    assert [cells_of_grid(ax) for ax in (curves, spectra)] == 2 * [([2], [0, 1, 2])]
    assert [list(ax.get_subplotspec().colspan) for ax in (curves, spectra)] == [[0], [1]]  # side by side


def test_frames_without_times_have_numbers_and_no_spectrum():
    series = ImageSeries(MESH, np.cos(np.arange(8))[:, None] * LEFT, np.arange(8.0), timed=False)
    figure = plot_series(series, {"left": LEFT})
    assert titled(figure, "regions over time").get_xlabel() == "Frame"
    assert "their spectra" not in [ax.get_title() for ax in figure.axes]
    # Six frames in a row, and the graph of regions beside the functional image.
    rows = [ax.get_subplotspec().rowspan.start for ax in figure.axes if ax.get_title().startswith("frame")]
    assert rows == [0] * 6 + [1] * 2
    places = [cells_of_grid(titled(figure, title)) for title in ("functional image", "regions over time")]
    assert places == [([0], [0]), ([0], [1, 2])]
    assert list(titled(figure, "regions over time").get_subplotspec().colspan) == [0, 1]
