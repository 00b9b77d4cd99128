"""Images of sound: sines in the right bands at every rate, windows of any length, and faults."""

import numpy as np
import pytest

from jeit.acoustic import Recording
from jeit.touch.listening import Levels, SoundImages, sound_features, sound_images
from jeit.touch.listening.feature_images import WINDOW_DURATION, band_edges, image_blocks


def sine(frequency: float, rate: float, seconds: float = 1.0, amplitude: float = 0.5) -> Recording:
    times = np.arange(round(seconds * rate)) / rate
    return Recording(amplitude * np.sin(2 * np.pi * frequency * times)[None], rate)


def noise(channels: int, rate: float = 10_000.0, seconds: float = 1.0, seed: int = 0) -> Recording:
    return Recording(np.random.default_rng(seed).standard_normal((channels, round(seconds * rate))), rate)


def test_at_10_khz_bands_are_the_papers_bins():
    """Bins 1 to 64 of 128 samples, 41 of them 120 apart: 89 × 41 of 25 microphones, with any transform."""
    quiet = noise(25)
    recording = Recording(quiet.samples * np.where(np.arange(25) == 7, 1.1, 1.0)[:, None], quiet.rate)
    images = sound_images(recording)
    assert set(images.strongest.tolist()) == {7}
    assert images.intensity.shape == (len(images), 25, 41)
    assert images.spectrum.shape == (len(images), 64, 41)
    shown = Levels.from_images(images)(images)
    assert shown.shape == (len(images), 89, 41)
    # The loudest microphone's row is the first, followed by the others.
    loud = Levels.from_images(images)
    rows = 10 ** ((shown[:, :25] * loud.deviation[0] + loud.mean[0]) / 10)
    assert (np.diff(rows.mean(axis=2), axis=1) < 1e-4).all()
    np.testing.assert_allclose(np.sort(rows.mean(axis=2)), np.sort(images.intensity.mean(axis=2)), rtol=1e-3)
    taper = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(128) / 128)
    frame = recording.samples[images.strongest[0], 240:368]
    power = np.abs(np.fft.rfft((frame - frame.mean()) * taper)) ** 2 * 2 / (128 * (taper**2).sum())
    np.testing.assert_allclose(images.spectrum[0, :, 2], power[1:65], rtol=1e-5)
    np.testing.assert_allclose(images.intensity[0, images.strongest[0], 2], power[1:65].sum(), rtol=1e-5)
    # White noise of variance 1: all of it except the bin of 0 Hz and half of that at half the rate.
    assert sound_images(quiet).intensity.mean() == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("rate", [8000.0, 10_000.0, 22_050.0, 44_100.0, 48_000.0])
@pytest.mark.parametrize("frequency", [250.0, 1000.0, 3500.0])
def test_a_sine_has_its_power_in_its_band_at_every_rate(rate, frequency):
    images = sound_images(sine(frequency, rate))
    np.testing.assert_allclose(images.intensity, 0.125, rtol=0.02)
    (band,) = np.unique(images.spectrum.argmax(axis=1))
    edges = band_edges(5000.0)
    # Within a bin: 78 Hz.
    assert edges[band] - 80 < frequency < edges[band + 1] + 80


def test_bands_widen_above_5_khz():
    even, wide = band_edges(5000.0), band_edges(22_050.0)
    np.testing.assert_allclose(np.diff(even), 78.125)
    ratio = np.diff(wide)[1:] / np.diff(wide)[:-1]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
    assert np.diff(wide)[0] == pytest.approx(78.125, rel=0.05)
    assert wide[-1] == pytest.approx(22_050 + 39.0625)
    images = sound_images(sine(12_000.0, 44_100.0), 22_050.0)
    (band,) = np.unique(images.spectrum.argmax(axis=1))
    assert wide[band] < 12_000 < wide[band + 1]
    assert sound_images(sine(12_000.0, 44_100.0), 5000.0).intensity.max() < 1e-6


def test_windows_are_a_tenth_of_a_second_apart():
    images = sound_images(noise(2, seconds=3.0))
    assert len(images) == 26
    np.testing.assert_allclose(images.times, WINDOW_DURATION / 2 + 0.1 * np.arange(26), atol=0.0061)
    # One after the other, or some at a time, as for recordings of hours.
    again = SoundImages.concatenate(list(image_blocks(noise(2, seconds=30.0))))
    assert len(again) == 296
    np.testing.assert_array_equal(
        again.intensity[:26, :, :10], sound_images(noise(2, seconds=30.0)).intensity[:26, :, :10]
    )


@pytest.mark.parametrize("samples", [1, 50, 2000, 4927])
def test_short_recordings_are_padded_with_silence(samples):
    """At any position of the window one of them contains all of the sound."""
    recording = Recording(np.random.default_rng(0).standard_normal((1, samples)), 10_000.0)
    images = sound_images(recording)
    assert len(images) >= 1
    assert images.known.all()
    if samples > 200:
        energy = images.intensity.sum(axis=(1, 2)) * 120
        assert energy.max() == pytest.approx((recording.samples**2).sum(), rel=0.2)


def test_nan_is_silence_and_is_reported():
    recording = noise(3, seconds=2.0)
    samples = recording.samples.copy()
    samples[:, 6000:14_000] = np.nan
    images = sound_images(Recording(samples, 10_000.0))
    assert np.isfinite(images.intensity).all()
    assert images.known[0]
    assert not images.known[7]
    silent = sound_images(Recording(np.zeros((2, 8000)), 10_000.0))
    shown = Levels.from_images(silent)(silent)
    assert (shown == 0).all()
    assert np.isfinite(sound_features(silent)).all()


def test_the_number_of_features_does_not_depend_on_microphones_and_their_unit_does_not_matter():
    """At twice the loudness only the three levels change, by 6 dB."""
    counts = {sound_features(sound_images(noise(channels))).shape[1] for channels in (1, 2, 25)}
    assert len(counts) == 1
    recording = noise(4)
    one = sound_features(sound_images(recording))
    other = sound_features(sound_images(Recording(2 * recording.samples, recording.rate)))
    moved = np.flatnonzero(~np.isclose(one, other, rtol=1e-4, atol=1e-4).all(axis=0))
    np.testing.assert_allclose((other - one)[:, moved], 20 * np.log10(2), rtol=1e-3)
    assert len(moved) == 3


def test_features_count_taps():
    """Five taps a second: two or three in a window, and their interval."""
    times = np.arange(20_000) / 10_000
    beats = np.exp(-((times - 0.1) % 0.2) / 0.01) * np.random.default_rng(0).standard_normal(20_000)
    steady = np.random.default_rng(1).standard_normal(20_000)
    taps, rest = (sound_features(sound_images(Recording(one[None], 10_000.0))) for one in (beats, steady))
    (count,) = np.flatnonzero(np.isin(taps, [2, 3]).all(axis=0) & (rest <= 1).all(axis=0))
    np.testing.assert_allclose(taps[:, count + 1], 0.2, atol=0.013)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sound_images(np.zeros((1, 9000))), "recording must be a Recording"),
        (lambda: sound_images(noise(1), 100.0), "highest must be a frequency"),
        (lambda: sound_images(noise(1), np.nan), "highest must be a frequency"),
        (lambda: sound_images(noise(1, rate=1000.0)), "no sound above 500 Hz"),
    ],
)
def test_bad_input_is_explained(call, message):
    with pytest.raises(ValueError, match=message):
        call()
