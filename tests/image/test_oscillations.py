"""Amplitude, phase and frequency of oscillations in image series, and the regions in which they occur."""

import numpy as np
import pytest

from jeit.image import ImageSeries, amplitude_spectrum, ball_region, box_region, half_region, oscillation
from jeit.image.image_series import _window_weights
from jeit.mesh import Disk, centroids, measures

TIMES = np.arange(400) / 20.0


def wave(frequency, amplitude=2.0, phase=0.7, times=TIMES):
    return amplitude * np.cos(2 * np.pi * frequency * times + phase)


@pytest.mark.parametrize("window", ["hann", "none"])
@pytest.mark.parametrize("frequency", [0.25, 0.333, 1.234, 9.7])
def test_a_single_oscillation_is_estimated_exactly(window, frequency):
    """Not a whole number of periods, with an offset and a drift."""
    found = oscillation(wave(frequency) + 5 - 0.3 * TIMES, TIMES, frequency, window=window)
    assert found.amplitude == pytest.approx(2, rel=1e-9)
    assert found.phase == pytest.approx(0.7, abs=1e-9)
    assert found.resolution == pytest.approx({"hann": 2, "none": 1}[window] / 19.95)


def test_the_window_is_that_of_hann_shifted_by_half_a_step():
    phases = np.pi * (np.arange(9) + 0.5) / 9
    np.testing.assert_allclose(_window_weights(2 + 0.1 * np.arange(9), "hann"), np.sin(phases) ** 2, rtol=1e-12)


def test_uneven_times_and_missing_frames():
    random = np.random.default_rng(0)
    times = np.sort(random.uniform(0, 20, 300))
    values = np.stack([wave(0.4, times=times), wave(0.4, 1.0, -2.0, times)], axis=1)
    values[[3, 70]] = np.nan
    found = oscillation(values, times, 0.4)
    np.testing.assert_allclose(found.amplitude, [2, 1], rtol=1e-9)
    np.testing.assert_allclose(found.phase, [0.7, -2.0], atol=1e-9)


def test_whole_periods_without_a_window_are_the_discrete_fourier_transform():
    values = np.random.default_rng(1).normal(size=400)
    values -= np.polyval(np.polyfit(TIMES, values, 1), TIMES)
    found = oscillation(values, TIMES, 3.0, window="none")
    term = np.fft.rfft(values)[60] * 2 / 400
    # The drift is orthogonal to a sine only up to one over the number of periods.
    assert found.amplitude * np.exp(1j * found.phase) == pytest.approx(term, rel=1e-2)


def test_the_strongest_oscillation_of_a_band():
    random = np.random.default_rng(2)
    values = np.stack([wave(0.31, 1.0), wave(1.2, 0.5), wave(0.31, 0.3, 2.0)], axis=1)
    noisy = values + 0.1 * random.normal(size=values.shape)
    slow, quick = oscillation(noisy, TIMES, (0.1, 0.6)), oscillation(noisy, TIMES, (0.8, 2.5))
    assert slow.frequency == pytest.approx(0.31, abs=1e-3)
    assert quick.frequency == pytest.approx(1.2, abs=2e-3)
    np.testing.assert_allclose(slow.amplitude[[0, 2]], [1, 0.3], atol=4 * slow.noise[0])
    assert slow.noise[2] == pytest.approx(0.1 * np.sqrt(2 / 400 * 1.94), rel=0.2)  # 1.94 is the loss of the Hann window


def test_noise_of_an_amplitude_is_the_scatter_of_repetitions():
    random = np.random.default_rng(3)
    found = oscillation(wave(2.0)[:, None] + random.normal(size=(400, 500)), TIMES, 2.0)
    assert found.amplitude.std() == pytest.approx(found.noise.mean(), rel=0.1)


def test_a_spectrum_peaks_at_the_amplitude():
    frequencies, amplitude = amplitude_spectrum(wave(2.0) + 1, TIMES)
    assert frequencies[amplitude.argmax()] == pytest.approx(2.0, abs=0.06)
    assert amplitude.max() == pytest.approx(2, rel=0.05)
    assert amplitude[np.abs(frequencies - 2) > 0.3].max() < 0.02


@pytest.mark.parametrize(
    ("values", "options", "message"),
    [
        (wave(1.0), {"frequency": 10.0}, "not below half the frame rate of 20 Hz"),
        (wave(1.0), {"frequency": 0.01}, "no whole period"),
        (wave(1.0), {"frequency": (2.0, 1.0)}, "band"),
        (wave(1.0), {"frequency": np.nan}, "positive hertz"),
        (wave(1.0), {"frequency": 1.0, "window": "hannn"}, "did you mean|hann"),
        (wave(1.0)[:7], {"frequency": 1.0}, "a row for each time"),
        (np.full(400, np.nan), {"frequency": 1.0}, "five at least"),
        (1j * wave(1.0), {"frequency": 1.0}, "complex"),
    ],
)
def test_bad_input(values, options, message):
    with pytest.raises(ValueError, match=message):
        oscillation(values, TIMES, **options)


@pytest.fixture(scope="module")
def mesh():
    return Disk(0.1).mesh(num_points=1500)


def test_regions(mesh):
    size, place = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    assert size[ball_region(mesh, [0.03, 0.0], 0.04)].sum() == pytest.approx(np.pi * 0.04**2, rel=0.02)
    assert size[box_region(mesh, [-0.05, -0.02], [0.03, 0.04])].sum() == pytest.approx(0.08 * 0.06, rel=0.03)
    right = half_region(mesh, (1, 0))
    assert size[right].sum() == pytest.approx(size.sum() / 2, rel=0.03)
    assert place[right, 0].min() > -1e-3


def test_means_are_weighted_by_cell_size(mesh):
    size, place = np.asarray(measures(mesh)), np.asarray(centroids(mesh))
    changes = np.stack([place[:, 0], 1 + 0 * place[:, 0], np.full(len(size), np.nan)])
    series = ImageSeries(mesh, changes, np.array([0.0, 0.1, 0.3]))
    right = half_region(mesh, (1, 0))
    mean = series.mean_change(right)
    assert mean[0] == pytest.approx(4 * 0.1 / (3 * np.pi), rel=0.02)  # of a half disk
    assert mean[1] == pytest.approx(1)
    even = ImageSeries(mesh, 1 / size[None], np.zeros(1)).mean_change(right)
    assert even[0] == pytest.approx(right.sum() / size[right].sum(), rel=1e-9)
    assert np.isnan(mean[2])
    assert series.imaged.tolist() == [True, True, False]
    np.testing.assert_allclose(series.functional(), np.abs(changes[0] - changes[1]) / 2)
    assert (series.unit, series.frame_rate) == ("S", pytest.approx(2 / 0.3))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda mesh: ball_region(mesh, [1.0, 0.0], 0.01), "is empty"),
        (lambda mesh: ball_region(mesh, [0.0, 0.0, 0.0], 0.01), "centre must be 2"),
        (lambda mesh: ball_region(mesh, [0.0, 0.0], -1), "positive number of metres"),
        (lambda mesh: box_region(mesh, [0, 0], [0, 1]), "upper must be larger"),
        (lambda mesh: half_region(mesh, [0, 0]), "not all zero"),
        (lambda mesh: ImageSeries(mesh, np.zeros((2, 3)), np.arange(2.0)), "one number for each cell"),
        (lambda mesh: ImageSeries(mesh, np.zeros((2, mesh.num_cells)), np.zeros(2)), "seconds that rise"),
        (lambda mesh: ImageSeries(mesh, np.full((2, mesh.num_cells), np.nan), np.arange(2.0)), "no frame"),
    ],
)
def test_bad_regions_and_series(mesh, make, message):
    with pytest.raises(ValueError, match=message):
        make(mesh)
