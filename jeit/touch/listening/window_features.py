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
        for image_powers in (images.intensity, images.spectrum):
            max_level = _to_decibels(np.quantile(image_powers, _LOUDEST_QUANTILE), -np.inf)
            image_levels = _to_decibels(image_powers, float(max_level) - _LEVEL_RANGE_DB)
            max_levels.append(float(max_level))
            mean_levels.append(float(image_levels.mean(dtype=float)))
            level_deviations.append(float(image_levels.std(dtype=float)) or 1.0)
        return cls(np.array(max_levels), np.array(mean_levels), np.array(level_deviations))

    @classmethod
    def of(cls, images: SoundImages) -> "Levels":
        """Former name of `from_images`; the next version no longer has this name."""
        warning_text = "Levels.of is now Levels.from_images; the old name goes with the next version."
        warnings.warn(warning_text, DeprecationWarning, stacklevel=2)
        return cls.from_images(images)

    def __call__(self, images: SoundImages) -> Float[np.ndarray, "W rows 41"]:
        """Convert feature images to levels (W, M + 64, 41): M rows of intensity, then 64 rows of the spectrogram.

        Microphones are sorted by their loudness in the window, the loudest first, so that a touch gives the same image
        at any place. Park et al. do not state the order of microphones. Levels are in single precision.
        """
        loudness_order = np.argsort(-images.intensity.sum(axis=2), axis=1, kind="stable")
        sorted_intensity = np.take_along_axis(images.intensity, loudness_order[..., None], axis=1)
        level_images = [
            (_to_decibels(image_powers, self.loudest[image_index] - _LEVEL_RANGE_DB) - self.mean[image_index])
            / self.deviation[image_index]
            for image_index, image_powers in enumerate((sorted_intensity, images.spectrum))
        ]
        return np.concatenate(level_images, axis=1).astype(np.float32)


def _to_decibels(powers, min_level: float) -> np.ndarray:
    """Convert powers to decibels, clipped from below at `min_level`. Silence has the level −300 dB."""
    return np.maximum(10 * np.log10(np.maximum(powers, 1e-30)), min_level)


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
    frame_levels = _relative_decibels(images.intensity.sum(axis=1))
    feature_groups = [
        _loudness_features(frame_levels),
        _spectral_features(images.spectrum.astype(float), frame_levels),
        _microphone_features(images.intensity.astype(float)),
    ]
    return np.concatenate(feature_groups, axis=1)


def spectrum_features(images: SoundImages) -> Float[np.ndarray, "W k"]:
    """Compute the `sound_features` of windows of sound, and statistics of the level in each of the 64 bands.

    The level is in decibels relative to the maximum of the window. Its statistics are the mean, maximum and spread over
    the window, the mean over the loudest frame and the two frames after it, and the mean over the next five frames.
    """
    band_levels = _relative_decibels(images.spectrum.astype(float))
    band_levels -= band_levels.max(axis=(1, 2), keepdims=True, initial=-np.inf)
    loudest_frames = images.intensity.sum(axis=1).argmax(axis=1)
    window_indices = np.arange(len(band_levels))
    later_levels = [
        band_levels[window_indices, :, np.minimum(loudest_frames + frame_step, NUM_FRAMES - 1)]
        for frame_step in range(_NUM_DECAY_FRAMES)
    ]
    band_statistics = [
        band_levels.mean(axis=2),
        band_levels.max(axis=2),
        band_levels.std(axis=2),
        np.mean(later_levels[:3], 0),
        np.mean(later_levels[3:], 0),
    ]
    return np.hstack([sound_features(images), *band_statistics])


def _relative_decibels(powers: np.ndarray) -> np.ndarray:
    """Convert powers to levels in decibels (W, …), clipped at 60 dB below the maximum of each window."""
    levels_db = 10 * np.log10(np.maximum(powers, 1e-30))
    return np.maximum(levels_db, levels_db.max(axis=tuple(range(1, levels_db.ndim)), keepdims=True) - _LEVEL_RANGE_DB)


def _loudness_features(frame_levels: Float[np.ndarray, "W 41"]) -> np.ndarray:
    """Compute features (W, k) of the loudness `frame_levels` (W, 41), in decibels, over the frames of each window."""
    max_levels = frame_levels.max(axis=1)
    level_below_max = max_levels[:, None] - frame_levels
    loudest_frames = frame_levels.argmax(axis=1)
    window_indices = np.arange(len(frame_levels))
    is_peak = _loudness_peaks(frame_levels)
    num_peaks = is_peak.sum(axis=1)
    frame_index = np.arange(NUM_FRAMES)
    first_peak_frame = np.where(num_peaks > 0, np.argmax(is_peak, axis=1), 0)
    last_peak_frame = np.where(num_peaks > 0, NUM_FRAMES - 1 - np.argmax(is_peak[:, ::-1], axis=1), 0)
    peak_interval = np.where(
        num_peaks > 1, (last_peak_frame - first_peak_frame) / np.maximum(num_peaks - 1, 1), NUM_FRAMES
    )
    modulation_spectrum = np.abs(np.fft.rfft(frame_levels - frame_levels.mean(axis=1, keepdims=True), axis=1))[
        :, 1 : _NUM_MODULATIONS + 1
    ]
    level_differences = np.diff(frame_levels, axis=1)
    level_at_end_of_decay = (
        frame_levels[window_indices, np.minimum(loudest_frames + _NUM_DECAY_FRAMES, NUM_FRAMES - 1)] - max_levels
    )
    level_at_quarter_of_decay = (
        frame_levels[window_indices, np.minimum(loudest_frames + _NUM_DECAY_FRAMES // 4, NUM_FRAMES - 1)] - max_levels
    )
    level_before = frame_levels[window_indices, np.maximum(loudest_frames - _NUM_DECAY_FRAMES // 4, 0)] - max_levels
    return np.column_stack(
        [
            frame_levels.mean(axis=1),
            max_levels,
            frame_levels.min(axis=1),
            frame_levels.std(axis=1),
            *((level_below_max <= decibels_below_max).mean(axis=1) for decibels_below_max in (3, 6, 10, 20)),
            num_peaks,
            peak_interval * FRAME_INTERVAL,
            loudest_frames * FRAME_INTERVAL,
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


def _loudness_peaks(frame_levels: np.ndarray) -> np.ndarray:
    """Find peaks of the loudness over time: whether each frame (W, 41) is a peak.

    A peak is the loudest of five frames, and at least 6 dB above both the minimum of the ten frames before it and the
    minimum of the ten frames after it.
    """
    padded_levels = np.pad(frame_levels, ((0, 0), (10, 10)), mode="edge")
    level_neighbourhoods = np.lib.stride_tricks.sliding_window_view(padded_levels, 21, axis=1)
    local_max = level_neighbourhoods[..., 8:13].max(axis=-1)
    surrounding_min = np.maximum(
        level_neighbourhoods[..., :11].min(axis=-1), level_neighbourhoods[..., 10:].min(axis=-1)
    )
    # If consecutive frames are equally loud, only the first is a peak.
    return (
        (frame_levels >= local_max)
        & (frame_levels > np.pad(frame_levels, ((0, 0), (1, 0)), mode="constant")[:, :-1])
        & (frame_levels - surrounding_min >= _MIN_PEAK_PROMINENCE_DB)
    )


def _spectral_features(spectrum: Float[np.ndarray, "W 64 41"], frame_levels: np.ndarray) -> np.ndarray:
    """Compute features (W, k) of the spectrogram (W, 64, 41) of each window; `frame_levels` (W, 41): loudness,
    decibels."""
    window_indices = np.arange(len(spectrum))
    band_powers = spectrum.mean(axis=2) + 1e-30
    band_power_fractions = band_powers / band_powers.sum(axis=1, keepdims=True)
    band_index = np.arange(NUM_BANDS)
    spectrum_levels_db = _relative_decibels(band_powers.reshape(len(band_powers), _NUM_SPECTRUM_BANDS, -1).mean(axis=2))
    spectrum_levels_db = spectrum_levels_db - spectrum_levels_db.max(axis=1, keepdims=True)
    spectral_centroid = band_power_fractions @ band_index
    spectral_width = np.sqrt(np.maximum(band_power_fractions @ band_index**2 - spectral_centroid**2, 0))
    spectral_flatness = np.exp(np.log(band_powers).mean(axis=1)) / band_powers.mean(axis=1)
    frame_power = spectrum.sum(axis=1) + 1e-30
    frame_centroid = np.einsum("wbt,b->wt", spectrum, band_index) / frame_power
    frame_weight = frame_power / frame_power.sum(axis=1, keepdims=True)
    mean_centroid = (frame_centroid * frame_weight).sum(axis=1)
    centroid_deviation = np.sqrt(np.maximum((frame_centroid**2 * frame_weight).sum(axis=1) - mean_centroid**2, 0))
    decay_levels = _relative_decibels(spectrum.reshape(len(band_powers), _NUM_DECAY_BANDS, -1, NUM_FRAMES).mean(axis=2))
    loudest_frame = frame_levels.argmax(axis=1)
    max_levels, later_levels = (
        decay_levels[window_indices, :, loudest_frame],
        decay_levels[window_indices, :, np.minimum(loudest_frame + _NUM_DECAY_FRAMES, NUM_FRAMES - 1)],
    )
    spectral_flux = np.abs(
        np.diff(
            _relative_decibels(spectrum.reshape(len(band_powers), _NUM_SPECTRUM_BANDS, -1, NUM_FRAMES).mean(axis=2)),
            axis=2,
        )
    )
    spectral_slope = np.polyfit(np.log(np.arange(1, _NUM_SPECTRUM_BANDS + 1)), spectrum_levels_db.T, 1)[0]
    features_per_window = [
        spectral_centroid,
        spectral_width,
        spectral_flatness,
        mean_centroid,
        centroid_deviation,
        spectral_flux.mean(axis=(1, 2)),
        spectral_flux.max(axis=2).mean(axis=1),
        spectral_slope,
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
    microphone_levels = _relative_decibels(intensity)
    level_deviation = microphone_levels - microphone_levels.mean(axis=2, keepdims=True)
    # Correlation of each microphone's level over time with the level of the loudest microphone.
    loudest_deviation = level_deviation[np.arange(len(level_deviation)), power_fractions.argmax(axis=1)]
    norm_products = np.sqrt((level_deviation**2).sum(axis=2) * (loudest_deviation**2).sum(axis=1)[:, None]) + 1e-9
    microphone_correlations = np.einsum("wmt,wt->wm", level_deviation, loudest_deviation) / norm_products
    first_half_power, last_half_power = (
        intensity[..., frame_half].mean(axis=2) + 1e-30
        for frame_half in (slice(NUM_FRAMES // 2), slice(NUM_FRAMES // 2, None))
    )
    first_half_power, last_half_power = (
        np.sqrt(power_distribution / power_distribution.sum(axis=1, keepdims=True))
        for power_distribution in (first_half_power, last_half_power)
    )
    distribution_change = 1 - (first_half_power * last_half_power).sum(axis=1)
    loudest_microphone = microphone_levels.argmax(axis=1)
    change_rate = (np.diff(loudest_microphone, axis=1) != 0).mean(axis=1)
    return np.column_stack(
        [
            sorted_power_fractions[:, 0],
            sorted_power_fractions[:, : max(1, power_fractions.shape[1] // 6)].sum(axis=1),
            normalised_entropy,
            microphone_correlations.mean(axis=1),
            np.sort(microphone_correlations, axis=1)[:, power_fractions.shape[1] // 2],
            distribution_change,
            change_rate,
            microphone_levels.mean(axis=2).std(axis=1),
        ]
    )
