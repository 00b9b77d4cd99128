"""Features of windows made by hand: spectra, and levels between microphones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jeit.touch.listening.feature_images import BANDS, FRAMES, HOP, SoundImages

# Decibels below the loudest that are resolved; and the share of powers that are no louder than that.
_RANGE, _LOUDEST = 60.0, 0.999


@dataclass(frozen=True)
class Levels:
    """Scale from powers to standardised levels in decibels, first of intensities, then of spectrograms.

    Levels are clipped at 60 dB below the `loudest` (2,) of the training set (all but a thousandth of it is no louder),
    then standardised by their `mean` (2,) and `deviation` (2,). One scale holds for all rows, so that a louder window
    has greater values.
    """

    loudest: Float[np.ndarray, " 2"]
    mean: Float[np.ndarray, " 2"]
    deviation: Float[np.ndarray, " 2"]

    @classmethod
    def of(cls, images: SoundImages) -> "Levels":
        """Compute the scale from windows of the training set."""
        loudest, mean, deviation = [], [], []
        for power in (images.intensity, images.spectrum):
            top = _decibels(np.quantile(power, _LOUDEST), -np.inf)
            levels = _decibels(power, float(top) - _RANGE)
            loudest.append(float(top))
            mean.append(float(levels.mean(dtype=float)))
            deviation.append(float(levels.std(dtype=float)) or 1.0)
        return cls(np.array(loudest), np.array(mean), np.array(deviation))

    def __call__(self, images: SoundImages) -> Float[np.ndarray, "W rows 41"]:
        """Feature images (W, M + 64, 41), single precision: M rows of intensity, then 64 of the spectrogram.

        Microphones are sorted by their loudness in the window, the loudest first: the paper does not state their order,
        and so a touch looks the same wherever it is.
        """
        order = np.argsort(-images.intensity.sum(axis=2), axis=1, kind="stable")
        intensity = np.take_along_axis(images.intensity, order[..., None], axis=1)
        parts = [
            (_decibels(power, self.loudest[part] - _RANGE) - self.mean[part]) / self.deviation[part]
            for part, power in enumerate((intensity, images.spectrum))
        ]
        return np.concatenate(parts, axis=1).astype(np.float32)


def _decibels(power, least: float) -> np.ndarray:
    """Decibels of powers, no less than `least`; silence, which has no level, is 300 dB below full scale."""
    return np.maximum(10 * np.log10(np.maximum(power, 1e-30)), least)


# Least prominence of a peak, decibels.
_PROMINENT = 6.0
# Numbers of bands of the mean spectrum, and of those that are followed in time; frames after the loudest by which the
# decay is measured.
_COLOURS, _FEW, _AFTER = 16, 4, 8
_MODULATIONS = 8


def sound_features(images: SoundImages) -> Float[np.ndarray, "W k"]:
    """Compute features (W, k) of windows, with the same k for any number of microphones.

    Of loudness in decibels (mean, greatest, spread, how long it stays near its greatest, its peaks and their intervals,
    rise and decay, modulation up to 16 Hz); of the spectrogram (mean spectrum in 16 bands, centroid, width, flatness,
    flux, decay in 4 bands); of the microphones (share of the loudest, evenness, whether they rise and fall together,
    whether their distribution moves).
    """
    if not len(images):
        return np.zeros((0, len(_time(np.zeros((1, FRAMES)))[0]) + _COLOURS + 2 * _FEW + 8 + 8))
    loud = _level(images.intensity.sum(axis=1))
    parts = [_time(loud), _colour(images.spectrum.astype(float), loud), _microphones(images.intensity.astype(float))]
    return np.concatenate(parts, axis=1)


def spectrum_features(images: SoundImages) -> Float[np.ndarray, "W k"]:
    """Compute the `sound_features`, and statistics of the level in each of the 64 bands.

    Levels are in decibels relative to the loudest of the window: mean, greatest and spread over the window; the mean
    over the loudest frame and the two after it, and over the next five.
    """
    level = _level(images.spectrum.astype(float))
    level -= level.max(axis=(1, 2), keepdims=True, initial=-np.inf)
    at = images.intensity.sum(axis=1).argmax(axis=1)
    rows = np.arange(len(level))
    after = [level[rows, :, np.minimum(at + step, FRAMES - 1)] for step in range(_AFTER)]
    bands = [level.mean(axis=2), level.max(axis=2), level.std(axis=2), np.mean(after[:3], 0), np.mean(after[3:], 0)]
    return np.hstack([sound_features(images), *bands])


def _level(power: np.ndarray) -> np.ndarray:
    """Levels in decibels (W, …), clipped at 60 below the greatest of each window."""
    level = 10 * np.log10(np.maximum(power, 1e-30))
    return np.maximum(level, level.max(axis=tuple(range(1, level.ndim)), keepdims=True) - _RANGE)


def _time(loud: Float[np.ndarray, "W 41"]) -> np.ndarray:
    top = loud.max(axis=1)
    below = top[:, None] - loud
    at = loud.argmax(axis=1)
    rows = np.arange(len(loud))
    peaks = _peaks(loud)
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


def _peaks(loud: np.ndarray) -> np.ndarray:
    """Find the frames (W, 41) that are peaks.

    A peak is the loudest of five frames, and 6 dB above the quietest of the ten before and after.
    """
    padded = np.pad(loud, ((0, 0), (10, 10)), mode="edge")
    near = np.lib.stride_tricks.sliding_window_view(padded, 21, axis=1)
    top = near[..., 8:13].max(axis=-1)
    low = np.maximum(near[..., :11].min(axis=-1), near[..., 10:].min(axis=-1))
    # Of equal frames, the first.
    return (loud >= top) & (loud > np.pad(loud, ((0, 0), (1, 0)), mode="constant")[:, :-1]) & (loud - low >= _PROMINENT)


def _colour(spectrum: Float[np.ndarray, "W 64 41"], loud: np.ndarray) -> np.ndarray:
    rows = np.arange(len(spectrum))
    power = spectrum.mean(axis=2) + 1e-30
    share = power / power.sum(axis=1, keepdims=True)
    band = np.arange(BANDS)
    colours = _level(power.reshape(len(power), _COLOURS, -1).mean(axis=2))
    colours = colours - colours.max(axis=1, keepdims=True)
    middle = share @ band
    width = np.sqrt(np.maximum(share @ band**2 - middle**2, 0))
    flat = np.exp(np.log(power).mean(axis=1)) / power.mean(axis=1)
    each = spectrum.sum(axis=1) + 1e-30
    moving = np.einsum("wbt,b->wt", spectrum, band) / each
    weight = each / each.sum(axis=1, keepdims=True)
    mean = (moving * weight).sum(axis=1)
    wanders = np.sqrt(np.maximum((moving**2 * weight).sum(axis=1) - mean**2, 0))
    few = _level(spectrum.reshape(len(power), _FEW, -1, FRAMES).mean(axis=2))
    at = loud.argmax(axis=1)
    top, later = few[rows, :, at], few[rows, :, np.minimum(at + _AFTER, FRAMES - 1)]
    flux = np.abs(np.diff(_level(spectrum.reshape(len(power), _COLOURS, -1, FRAMES).mean(axis=2)), axis=2))
    steep = np.polyfit(np.log(np.arange(1, _COLOURS + 1)), colours.T, 1)[0]
    numbers = [middle, width, flat, mean, wanders, flux.mean(axis=(1, 2)), flux.max(axis=2).mean(axis=1), steep]
    return np.column_stack([colours, *numbers, later - top, few.std(axis=2)])


def _microphones(intensity: Float[np.ndarray, "W M 41"]) -> np.ndarray:
    mean = intensity.mean(axis=2) + 1e-30
    share = mean / mean.sum(axis=1, keepdims=True)
    ordered = np.sort(share, axis=1)[:, ::-1]
    even = -(share * np.log(share)).sum(axis=1) / np.log(max(share.shape[1], 2))
    level = _level(intensity)
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
