"""Hand-made features of windows of sound: loudness, spectra, and levels of the microphones."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jeit.touch.listening.feature_images import BANDS, FRAMES, HOP, SoundImages

# Range of levels below the loudest, decibels; quantile of the powers that counts as the loudest.
_RANGE, _LOUDEST = 60.0, 0.999


@dataclass(frozen=True)
class Levels:
    """Conversion of powers to standardised levels in decibels; all fields are for intensities, then for spectrograms.

    Levels are clipped at 60 dB below `loudest` (2,), the 99.9 % quantile of the training set, then standardised by
    their `mean` (2,) and `deviation` (2,). All rows are converted alike, so that a louder window has larger values.
    """

    loudest: Float[np.ndarray, " 2"]
    mean: Float[np.ndarray, " 2"]
    deviation: Float[np.ndarray, " 2"]

    @classmethod
    def from_images(cls, images: SoundImages) -> "Levels":
        """Compute the conversion from windows of the training set."""
        loudest, mean, deviation = [], [], []
        for power in (images.intensity, images.spectrum):
            top = _decibels(np.quantile(power, _LOUDEST), -np.inf)
            levels = _decibels(power, float(top) - _RANGE)
            loudest.append(float(top))
            mean.append(float(levels.mean(dtype=float)))
            deviation.append(float(levels.std(dtype=float)) or 1.0)
        return cls(np.array(loudest), np.array(mean), np.array(deviation))

    @classmethod
    def of(cls, images: SoundImages) -> "Levels":
        """Former name of `from_images`, which goes with the next version."""
        text = "Levels.of is now Levels.from_images; the old name goes with the next version."
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return cls.from_images(images)

    def __call__(self, images: SoundImages) -> Float[np.ndarray, "W rows 41"]:
        """Compute feature images (W, M + 64, 41), in single precision: M rows of intensity, then 64 of the spectrogram.

        Microphones are sorted by their loudness in the window, the loudest first, so that a touch looks the same
        wherever it is; the paper does not state their order.
        """
        order = np.argsort(-images.intensity.sum(axis=2), axis=1, kind="stable")
        intensity = np.take_along_axis(images.intensity, order[..., None], axis=1)
        parts = [
            (_decibels(power, self.loudest[part] - _RANGE) - self.mean[part]) / self.deviation[part]
            for part, power in enumerate((intensity, images.spectrum))
        ]
        return np.concatenate(parts, axis=1).astype(np.float32)


def _decibels(power, least: float) -> np.ndarray:
    """Convert powers to decibels, at least `least`; silence, which has no level, is 300 dB below full scale."""
    return np.maximum(10 * np.log10(np.maximum(power, 1e-30)), least)


# Minimum prominence of a peak, decibels.
_PROMINENT = 6.0
# Number of bands of the mean spectrum; number of bands that are followed in time; number of frames after the loudest
# one over which the decay is measured.
_COLOURS, _FEW, _AFTER = 16, 4, 8
_MODULATIONS = 8


def sound_features(images: SoundImages) -> Float[np.ndarray, "W k"]:
    """Compute features (W, k) of windows, with the same k for any number of microphones.

    Features of loudness, in decibels: mean, maximum, spread, duration near the maximum, peaks and their intervals, rise
    and decay, and modulation up to 16 Hz. Features of the spectrogram: mean spectrum in 16 bands, centroid, width,
    flatness, flux, and decay in 4 bands. Features of the microphones: share of the loudest, evenness, correlation
    between their levels, and change of their distribution over time.

    **Arguments:**

    - `images`: feature images of the windows, as from `sound_images`.

    **Example:**

    ```python
    features = sound_features(sound_images(recordings[0]))
    print(features.shape)  # (W, k)
    ```
    """
    if not len(images):
        return np.zeros((0, len(_loudness_features(np.zeros((1, FRAMES)))[0]) + _COLOURS + 2 * _FEW + 8 + 8))
    loud = _relative_decibels(images.intensity.sum(axis=1))
    parts = [
        _loudness_features(loud),
        _spectral_features(images.spectrum.astype(float), loud),
        _microphone_features(images.intensity.astype(float)),
    ]
    return np.concatenate(parts, axis=1)


def spectrum_features(images: SoundImages) -> Float[np.ndarray, "W k"]:
    """Compute the `sound_features`, and statistics of the level in each of the 64 bands.

    The statistics of the level, in decibels relative to the loudest of the window, are its mean, maximum and spread
    over the window, and its means over the loudest frame and the two after it, and over the next five.
    """
    level = _relative_decibels(images.spectrum.astype(float))
    level -= level.max(axis=(1, 2), keepdims=True, initial=-np.inf)
    at = images.intensity.sum(axis=1).argmax(axis=1)
    rows = np.arange(len(level))
    after = [level[rows, :, np.minimum(at + step, FRAMES - 1)] for step in range(_AFTER)]
    bands = [level.mean(axis=2), level.max(axis=2), level.std(axis=2), np.mean(after[:3], 0), np.mean(after[3:], 0)]
    return np.hstack([sound_features(images), *bands])


def _relative_decibels(power: np.ndarray) -> np.ndarray:
    """Convert powers to levels in decibels (W, …), clipped at 60 dB below the maximum of each window."""
    level = 10 * np.log10(np.maximum(power, 1e-30))
    return np.maximum(level, level.max(axis=tuple(range(1, level.ndim)), keepdims=True) - _RANGE)


def _loudness_features(loud: Float[np.ndarray, "W 41"]) -> np.ndarray:
    top = loud.max(axis=1)
    below = top[:, None] - loud
    at = loud.argmax(axis=1)
    rows = np.arange(len(loud))
    peaks = _loudness_peaks(loud)
    count = peaks.sum(axis=1)
    which = np.arange(FRAMES)
    first = np.where(count > 0, np.argmax(peaks, axis=1), 0)
    last = np.where(count > 0, FRAMES - 1 - np.argmax(peaks[:, ::-1], axis=1), 0)
    interval = np.where(count > 1, (last - first) / np.maximum(count - 1, 1), FRAMES)
    swing = np.abs(np.fft.rfft(loud - loud.mean(axis=1, keepdims=True), axis=1))[:, 1 : _MODULATIONS + 1]
    step = np.diff(loud, axis=1)
    after = loud[rows, np.minimum(at + _AFTER, FRAMES - 1)] - top
    soon = loud[rows, np.minimum(at + _AFTER // 4, FRAMES - 1)] - top
    before = loud[rows, np.maximum(at - _AFTER // 4, 0)] - top
    return np.column_stack(
        [
            loud.mean(axis=1),
            top,
            loud.min(axis=1),
            loud.std(axis=1),
            *((below <= decibels).mean(axis=1) for decibels in (3, 6, 10, 20)),
            count,
            interval * HOP,
            at * HOP,
            (which * 10 ** (-below / 10)).sum(axis=1) / (10 ** (-below / 10)).sum(axis=1),
            after,
            soon,
            before,
            step.max(axis=1),
            step.min(axis=1),
            np.abs(step).mean(axis=1),
            swing / FRAMES,
            swing.argmax(axis=1),
        ]
    )


def _loudness_peaks(loud: np.ndarray) -> np.ndarray:
    """Find the frames (W, 41) that are peaks.

    A peak is the loudest of five frames, and at least 6 dB above the minimum of the ten frames before it, and of the
    ten after it.
    """
    padded = np.pad(loud, ((0, 0), (10, 10)), mode="edge")
    near = np.lib.stride_tricks.sliding_window_view(padded, 21, axis=1)
    top = near[..., 8:13].max(axis=-1)
    low = np.maximum(near[..., :11].min(axis=-1), near[..., 10:].min(axis=-1))
    # If consecutive frames are equally loud, only the first is a peak.
    return (loud >= top) & (loud > np.pad(loud, ((0, 0), (1, 0)), mode="constant")[:, :-1]) & (loud - low >= _PROMINENT)


def _spectral_features(spectrum: Float[np.ndarray, "W 64 41"], loud: np.ndarray) -> np.ndarray:
    rows = np.arange(len(spectrum))
    power = spectrum.mean(axis=2) + 1e-30
    share = power / power.sum(axis=1, keepdims=True)
    band = np.arange(BANDS)
    colours = _relative_decibels(power.reshape(len(power), _COLOURS, -1).mean(axis=2))
    colours = colours - colours.max(axis=1, keepdims=True)
    middle = share @ band
    width = np.sqrt(np.maximum(share @ band**2 - middle**2, 0))
    flat = np.exp(np.log(power).mean(axis=1)) / power.mean(axis=1)
    each = spectrum.sum(axis=1) + 1e-30
    moving = np.einsum("wbt,b->wt", spectrum, band) / each
    weight = each / each.sum(axis=1, keepdims=True)
    mean = (moving * weight).sum(axis=1)
    wanders = np.sqrt(np.maximum((moving**2 * weight).sum(axis=1) - mean**2, 0))
    few = _relative_decibels(spectrum.reshape(len(power), _FEW, -1, FRAMES).mean(axis=2))
    at = loud.argmax(axis=1)
    top, later = few[rows, :, at], few[rows, :, np.minimum(at + _AFTER, FRAMES - 1)]
    flux = np.abs(np.diff(_relative_decibels(spectrum.reshape(len(power), _COLOURS, -1, FRAMES).mean(axis=2)), axis=2))
    steep = np.polyfit(np.log(np.arange(1, _COLOURS + 1)), colours.T, 1)[0]
    numbers = [middle, width, flat, mean, wanders, flux.mean(axis=(1, 2)), flux.max(axis=2).mean(axis=1), steep]
    return np.column_stack([colours, *numbers, later - top, few.std(axis=2)])


def _microphone_features(intensity: Float[np.ndarray, "W M 41"]) -> np.ndarray:
    mean = intensity.mean(axis=2) + 1e-30
    share = mean / mean.sum(axis=1, keepdims=True)
    ordered = np.sort(share, axis=1)[:, ::-1]
    even = -(share * np.log(share)).sum(axis=1) / np.log(max(share.shape[1], 2))
    level = _relative_decibels(intensity)
    own = level - level.mean(axis=2, keepdims=True)
    # Correlation of each microphone's level over time with that of the loudest one.
    loudest = own[np.arange(len(own)), share.argmax(axis=1)]
    size = np.sqrt((own**2).sum(axis=2) * (loudest**2).sum(axis=1)[:, None]) + 1e-9
    alike = np.einsum("wmt,wt->wm", own, loudest) / size
    first, last = (intensity[..., part].mean(axis=2) + 1e-30 for part in (slice(FRAMES // 2), slice(FRAMES // 2, None)))
    first, last = (np.sqrt(one / one.sum(axis=1, keepdims=True)) for one in (first, last))
    moved = 1 - (first * last).sum(axis=1)
    where = level.argmax(axis=1)
    changes = (np.diff(where, axis=1) != 0).mean(axis=1)
    return np.column_stack(
        [
            ordered[:, 0],
            ordered[:, : max(1, share.shape[1] // 6)].sum(axis=1),
            even,
            alike.mean(axis=1),
            np.sort(alike, axis=1)[:, share.shape[1] // 2],
            moved,
            changes,
            level.mean(axis=2).std(axis=1),
        ]
    )
