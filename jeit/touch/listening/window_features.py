"""Hand-made features of windows of sound: features of loudness, of the spectrogram and of the microphones."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jeit.touch.listening.feature_images import FRAME_INTERVAL, NUM_BANDS, NUM_FRAMES, SoundImages

# Range of levels below the loudest level, decibels.
_LEVEL_RANGE_DB = 60.0
# Quantile of the powers that counts as the loudest.
_LOUDEST_QUANTILE = 0.999


@dataclass(frozen=True)
class Levels:
    """Conversion of the powers in feature images to standardised levels in decibels.

    Levels are clipped at 60 dB below `loudest` (2,), the level of the 99.9 % quantile of the powers in the training
    set, then standardised by their `mean` (2,) and `deviation` (2,). The first value of each field is for intensities,
    the second for spectrograms. All rows of an image are converted alike, so that a louder window has larger values.
    """

    loudest: Float[np.ndarray, " 2"]
    mean: Float[np.ndarray, " 2"]
    deviation: Float[np.ndarray, " 2"]

    @classmethod
    def from_images(cls, images: SoundImages) -> "Levels":
        """Compute the conversion from feature images of the training set."""
        max_levels, mean_levels, level_deviations = [], [], []
        for power in (images.intensity, images.spectrum):
            max_level = _to_decibels(np.quantile(power, _LOUDEST_QUANTILE), -np.inf)
            levels = _to_decibels(power, float(max_level) - _LEVEL_RANGE_DB)
            max_levels.append(float(max_level))
            mean_levels.append(float(levels.mean(dtype=float)))
            level_deviations.append(float(levels.std(dtype=float)) or 1.0)
        return cls(np.array(max_levels), np.array(mean_levels), np.array(level_deviations))

    @classmethod
    def of(cls, images: SoundImages) -> "Levels":
        """Former name of `from_images`; the next version no longer has this name."""
        text = "Levels.of is now Levels.from_images; the old name goes with the next version."
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return cls.from_images(images)

    def __call__(self, images: SoundImages) -> Float[np.ndarray, "W rows 41"]:
        """Convert feature images to levels (W, M + 64, 41): M rows of intensity, then 64 rows of the spectrogram.

        Microphones are sorted by their loudness in the window, the loudest first, so that a touch gives the same image
        at any place. Park et al. do not state the order of microphones. Levels are in single precision.
        """
        loudness_order = np.argsort(-images.intensity.sum(axis=2), axis=1, kind="stable")
        intensity = np.take_along_axis(images.intensity, loudness_order[..., None], axis=1)
        level_images = [
            (_to_decibels(power, self.loudest[image_index] - _LEVEL_RANGE_DB) - self.mean[image_index])
            / self.deviation[image_index]
            for image_index, power in enumerate((intensity, images.spectrum))
        ]
        return np.concatenate(level_images, axis=1).astype(np.float32)


def _to_decibels(power, min_level: float) -> np.ndarray:
    """Convert powers to decibels, clipped from below at `min_level`. Silence has the level −300 dB."""
    return np.maximum(10 * np.log10(np.maximum(power, 1e-30)), min_level)


# Minimum prominence of a peak of the loudness, decibels.
_MIN_PEAK_PROMINENCE_DB = 6.0
# Number of bands of the mean spectrum.
_NUM_SPECTRUM_BANDS = 16
# Number of bands whose decay is measured.
_NUM_DECAY_BANDS = 4
# Number of frames after the loudest frame over which the decay is measured.
_NUM_DECAY_FRAMES = 8
_NUM_MODULATIONS = 8


def sound_features(images: SoundImages) -> Float[np.ndarray, "W k"]:
    """Compute k features (W, k) of windows of sound, with the same k for any number of microphones.

    Features of loudness, in decibels: mean, maximum, spread, duration near the maximum, peaks and their intervals, rise
    and decay, and modulation up to 16 Hz. Features of the spectrogram: mean spectrum in 16 bands, centroid, width,
    flatness, flux, and decay in 4 bands. Features of the microphones: share of the loudest microphone, evenness of the
    power, correlation between levels, and change of the distribution over time.

    **Arguments:**

    - `images`: feature images of the windows, as returned by `sound_images`.

    **Example:**

    ```python
    features = sound_features(sound_images(recordings[0]))
    print(features.shape)  # (W, k)
    ```
    """
    if not len(images):
        return np.zeros(
            (
                0,
                len(_loudness_features(np.zeros((1, NUM_FRAMES)))[0])
                + _NUM_SPECTRUM_BANDS
                + 2 * _NUM_DECAY_BANDS
                + 8
                + 8,
            )
        )
    level = _relative_decibels(images.intensity.sum(axis=1))
    feature_groups = [
        _loudness_features(level),
        _spectral_features(images.spectrum.astype(float), level),
        _microphone_features(images.intensity.astype(float)),
    ]
    return np.concatenate(feature_groups, axis=1)


def spectrum_features(images: SoundImages) -> Float[np.ndarray, "W k"]:
    """Compute the `sound_features` of windows of sound, and statistics of the level in each of the 64 bands.

    The level is in decibels relative to the maximum of the window. Its statistics are the mean, maximum and spread over
    the window, the mean over the loudest frame and the two frames after it, and the mean over the next five frames.
    """
    level = _relative_decibels(images.spectrum.astype(float))
    level -= level.max(axis=(1, 2), keepdims=True, initial=-np.inf)
    loudest_frame = images.intensity.sum(axis=1).argmax(axis=1)
    rows = np.arange(len(level))
    later_levels = [
        level[rows, :, np.minimum(loudest_frame + step, NUM_FRAMES - 1)] for step in range(_NUM_DECAY_FRAMES)
    ]
    statistics = [
        level.mean(axis=2),
        level.max(axis=2),
        level.std(axis=2),
        np.mean(later_levels[:3], 0),
        np.mean(later_levels[3:], 0),
    ]
    return np.hstack([sound_features(images), *statistics])


def _relative_decibels(power: np.ndarray) -> np.ndarray:
    """Convert powers to levels in decibels (W, …), clipped at 60 dB below the maximum of each window."""
    level = 10 * np.log10(np.maximum(power, 1e-30))
    return np.maximum(level, level.max(axis=tuple(range(1, level.ndim)), keepdims=True) - _LEVEL_RANGE_DB)


def _loudness_features(level: Float[np.ndarray, "W 41"]) -> np.ndarray:
    """Compute features (W, k) of the loudness `level` (W, 41), in decibels, over the 41 frames of each window."""
    max_level = level.max(axis=1)
    level_below_max = max_level[:, None] - level
    loudest_frame = level.argmax(axis=1)
    rows = np.arange(len(level))
    peaks = _loudness_peaks(level)
    num_peaks = peaks.sum(axis=1)
    frame_index = np.arange(NUM_FRAMES)
    first_peak = np.where(num_peaks > 0, np.argmax(peaks, axis=1), 0)
    last_peak = np.where(num_peaks > 0, NUM_FRAMES - 1 - np.argmax(peaks[:, ::-1], axis=1), 0)
    interval = np.where(num_peaks > 1, (last_peak - first_peak) / np.maximum(num_peaks - 1, 1), NUM_FRAMES)
    modulation_spectrum = np.abs(np.fft.rfft(level - level.mean(axis=1, keepdims=True), axis=1))[
        :, 1 : _NUM_MODULATIONS + 1
    ]
    level_differences = np.diff(level, axis=1)
    level_at_end_of_decay = level[rows, np.minimum(loudest_frame + _NUM_DECAY_FRAMES, NUM_FRAMES - 1)] - max_level
    level_at_quarter_of_decay = (
        level[rows, np.minimum(loudest_frame + _NUM_DECAY_FRAMES // 4, NUM_FRAMES - 1)] - max_level
    )
    level_before = level[rows, np.maximum(loudest_frame - _NUM_DECAY_FRAMES // 4, 0)] - max_level
    return np.column_stack(
        [
            level.mean(axis=1),
            max_level,
            level.min(axis=1),
            level.std(axis=1),
            *((level_below_max <= decibels).mean(axis=1) for decibels in (3, 6, 10, 20)),
            num_peaks,
            interval * FRAME_INTERVAL,
            loudest_frame * FRAME_INTERVAL,
            (frame_index * 10 ** (-level_below_max / 10)).sum(axis=1) / (10 ** (-level_below_max / 10)).sum(axis=1),
            level_at_end_of_decay,
            level_at_quarter_of_decay,
            level_before,
            level_differences.max(axis=1),
            level_differences.min(axis=1),
            np.abs(level_differences).mean(axis=1),
            modulation_spectrum / NUM_FRAMES,
            modulation_spectrum.argmax(axis=1),
        ]
    )


def _loudness_peaks(level: np.ndarray) -> np.ndarray:
    """Find peaks of the loudness over time: whether each frame (W, 41) is a peak.

    A peak is the loudest of five frames, and at least 6 dB above both the minimum of the ten frames before it and the
    minimum of the ten frames after it.
    """
    padded = np.pad(level, ((0, 0), (10, 10)), mode="edge")
    neighbourhoods = np.lib.stride_tricks.sliding_window_view(padded, 21, axis=1)
    local_max = neighbourhoods[..., 8:13].max(axis=-1)
    surrounding_min = np.maximum(neighbourhoods[..., :11].min(axis=-1), neighbourhoods[..., 10:].min(axis=-1))
    # If consecutive frames are equally loud, only the first is a peak.
    return (
        (level >= local_max)
        & (level > np.pad(level, ((0, 0), (1, 0)), mode="constant")[:, :-1])
        & (level - surrounding_min >= _MIN_PEAK_PROMINENCE_DB)
    )


def _spectral_features(spectrum: Float[np.ndarray, "W 64 41"], level: np.ndarray) -> np.ndarray:
    """Compute features (W, k) of the spectrogram (W, 64, 41) of each window; `level` (W, 41): loudness, decibels."""
    rows = np.arange(len(spectrum))
    power = spectrum.mean(axis=2) + 1e-30
    band_power_fractions = power / power.sum(axis=1, keepdims=True)
    band_index = np.arange(NUM_BANDS)
    spectrum_levels_db = _relative_decibels(power.reshape(len(power), _NUM_SPECTRUM_BANDS, -1).mean(axis=2))
    spectrum_levels_db = spectrum_levels_db - spectrum_levels_db.max(axis=1, keepdims=True)
    centroid = band_power_fractions @ band_index
    width = np.sqrt(np.maximum(band_power_fractions @ band_index**2 - centroid**2, 0))
    spectral_flatness = np.exp(np.log(power).mean(axis=1)) / power.mean(axis=1)
    frame_power = spectrum.sum(axis=1) + 1e-30
    frame_centroid = np.einsum("wbt,b->wt", spectrum, band_index) / frame_power
    frame_weight = frame_power / frame_power.sum(axis=1, keepdims=True)
    mean_centroid = (frame_centroid * frame_weight).sum(axis=1)
    centroid_deviation = np.sqrt(np.maximum((frame_centroid**2 * frame_weight).sum(axis=1) - mean_centroid**2, 0))
    decay_levels = _relative_decibels(spectrum.reshape(len(power), _NUM_DECAY_BANDS, -1, NUM_FRAMES).mean(axis=2))
    loudest_frame = level.argmax(axis=1)
    max_levels, later_levels = (
        decay_levels[rows, :, loudest_frame],
        decay_levels[rows, :, np.minimum(loudest_frame + _NUM_DECAY_FRAMES, NUM_FRAMES - 1)],
    )
    flux = np.abs(
        np.diff(
            _relative_decibels(spectrum.reshape(len(power), _NUM_SPECTRUM_BANDS, -1, NUM_FRAMES).mean(axis=2)), axis=2
        )
    )
    slope = np.polyfit(np.log(np.arange(1, _NUM_SPECTRUM_BANDS + 1)), spectrum_levels_db.T, 1)[0]
    features_per_window = [
        centroid,
        width,
        spectral_flatness,
        mean_centroid,
        centroid_deviation,
        flux.mean(axis=(1, 2)),
        flux.max(axis=2).mean(axis=1),
        slope,
    ]
    return np.column_stack(
        [spectrum_levels_db, *features_per_window, later_levels - max_levels, decay_levels.std(axis=2)]
    )


def _microphone_features(intensity: Float[np.ndarray, "W M 41"]) -> np.ndarray:
    """Compute features (W, k) of the distribution of the power `intensity` over M microphones and 41 frames."""
    mean_power = intensity.mean(axis=2) + 1e-30
    power_fractions = mean_power / mean_power.sum(axis=1, keepdims=True)
    sorted_power_fractions = np.sort(power_fractions, axis=1)[:, ::-1]
    normalised_entropy = -(power_fractions * np.log(power_fractions)).sum(axis=1) / np.log(
        max(power_fractions.shape[1], 2)
    )
    level = _relative_decibels(intensity)
    level_deviation = level - level.mean(axis=2, keepdims=True)
    # Correlation of each microphone's level over time with the level of the loudest microphone.
    loudest_deviation = level_deviation[np.arange(len(level_deviation)), power_fractions.argmax(axis=1)]
    norm_products = np.sqrt((level_deviation**2).sum(axis=2) * (loudest_deviation**2).sum(axis=1)[:, None]) + 1e-9
    correlations = np.einsum("wmt,wt->wm", level_deviation, loudest_deviation) / norm_products
    first_half_power, last_half_power = (
        intensity[..., half].mean(axis=2) + 1e-30 for half in (slice(NUM_FRAMES // 2), slice(NUM_FRAMES // 2, None))
    )
    first_half_power, last_half_power = (
        np.sqrt(distribution / distribution.sum(axis=1, keepdims=True))
        for distribution in (first_half_power, last_half_power)
    )
    distribution_change = 1 - (first_half_power * last_half_power).sum(axis=1)
    loudest_microphone = level.argmax(axis=1)
    change_rate = (np.diff(loudest_microphone, axis=1) != 0).mean(axis=1)
    return np.column_stack(
        [
            sorted_power_fractions[:, 0],
            sorted_power_fractions[:, : max(1, power_fractions.shape[1] // 6)].sum(axis=1),
            normalised_entropy,
            correlations.mean(axis=1),
            np.sort(correlations, axis=1)[:, power_fractions.shape[1] // 2],
            distribution_change,
            change_rate,
            level.mean(axis=2).std(axis=1),
        ]
    )
