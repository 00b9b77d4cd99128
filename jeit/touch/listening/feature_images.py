"""Feature images of sound: intensity of every microphone over time, above the spectrogram of the loudest microphone.

The images are those of Park et al. (2022): a window of 0.5 s has 41 frames, 12 ms apart; an image has M rows of
intensity, one for each microphone, and 64 rows of the spectrogram, so that 25 microphones give images of 89 × 41
values. At a sampling rate of 10 kHz, a frame consists of 128 samples under a Hann window, and begins 120 samples after
the previous frame; bins 1 to 64 of its Fourier transform are the 64 bands.

At any other sampling rate, frames have the same duration, and bins are assigned to bands by their frequency; sound is
not resampled. The bands end at the frequency `highest`. If `highest` is at most 5 kHz, all bands are as wide as a bin,
78 Hz; otherwise, the lowest band has this width, and the width increases from band to band by a constant factor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import brentq

from jeit.acoustic import Recording
from jeit.arguments import check_kind, describe, is_number

NUM_BANDS, NUM_FRAMES = 64, 41
# Duration of a frame, time between the starts of two frames, and time between the starts of two windows, seconds.
FRAME_DURATION, FRAME_INTERVAL, WINDOW_INTERVAL = 0.0128, 0.012, 0.1
WINDOW_DURATION = FRAME_DURATION + (NUM_FRAMES - 1) * FRAME_INTERVAL
"""Duration of a window, seconds."""
# Maximum of the frequency `highest` for which all bands are as wide as a bin; minimum of `highest`, below which fewer
# than 8 bins would be left; hertz.
MAX_EVEN_FREQUENCY, MIN_HIGHEST = 5000.0, 625.0
# Number of windows whose images are computed at once.
_MAX_BLOCK_WINDOWS = 128


@dataclass(frozen=True)
class SoundImages:
    """Feature images of W windows of one recording.

    `times` (W,): middles of the windows, seconds; `intensity` (W, M, 41): power at each of M microphones in 41 frames;
    `strongest` (W,): index of the loudest microphone; `spectrum` (W, 64, 41): power of this microphone in each of 64
    bands, divided by the number of bins in the band. Powers are in the square of the samples' unit. `known` (W,):
    whether more than half of a window's samples are finite.
    """

    times: Float[np.ndarray, " W"]
    intensity: Float[np.ndarray, "W M 41"]
    spectrum: Float[np.ndarray, "W 64 41"]
    strongest: Int[np.ndarray, " W"]
    known: Bool[np.ndarray, " W"]

    def __len__(self) -> int:
        """Number of windows."""
        return len(self.times)

    def __getitem__(self, window_selection) -> "SoundImages":
        """Select windows by a slice, indices or a boolean mask."""
        return SoundImages(*(getattr(self, field_name)[window_selection] for field_name in self.__dataclass_fields__))

    @property
    def loudness(self) -> Float[np.ndarray, " W"]:
        """Power of the loudest frame of each window, summed over the microphones."""
        return self.intensity.sum(axis=1).max(axis=1)

    @property
    def normalised(self) -> "SoundImages":
        """The feature images with powers divided by the `loudness` of each window; silent windows are unchanged."""
        positive_loudness = np.where(self.loudness > 0, self.loudness, 1.0)[:, None, None]
        return replace(self, intensity=self.intensity / positive_loudness, spectrum=self.spectrum / positive_loudness)

    @classmethod
    def concatenate(cls, blocks: "list[SoundImages]") -> "SoundImages":
        """Concatenate the windows of several recordings; times remain relative to the start of each recording."""
        return cls(
            *(
                np.concatenate([getattr(block, field_name) for block in blocks])
                for field_name in cls.__dataclass_fields__
            )
        )


def check_highest(highest: float) -> float:
    """Return the maximum frequency of feature images in Hz as a float. Raises `ValueError` if the frequency is not a
    number, or below 625 Hz."""
    if not (is_number(highest) and MIN_HIGHEST <= highest < np.inf):
        raise ValueError(
            f"highest must be a frequency in Hz, {MIN_HIGHEST:g} or more, of the features; it is {describe(highest)}."
        )
    return float(highest)


def band_edges(highest: float) -> Float[np.ndarray, " 65"]:
    """Compute the edges of the 64 frequency bands of feature images, Hz.

    If `highest`, Hz, is at most 5 kHz, all bands have the same width; at 5 kHz, `highest` is the middle of the last
    band.
    """
    bin_width = 1 / FRAME_DURATION
    if highest <= MAX_EVEN_FREQUENCY:
        return bin_width * (0.5 + np.arange(NUM_BANDS + 1))
    # The edges are half a bin plus a (e^(bk) - 1), where a b is the width of a bin; `brentq` finds b such that the last
    # edge is half a bin above `highest`.
    band_index = np.arange(NUM_BANDS + 1)
    band_growth_rate: Any = brentq(lambda b: bin_width * np.expm1(b * NUM_BANDS) / b - highest, 1e-9, 1.0)
    return bin_width * (0.5 + np.expm1(band_growth_rate * band_index) / band_growth_rate)


def sound_images(recording: Recording, highest: float = MAX_EVEN_FREQUENCY) -> SoundImages:
    """Compute feature images of a sound recording: one for each window of 0.5 s, every 0.1 s.

    Bands above half the sampling rate are empty. A recording shorter than 0.5 s is padded with 0.3 s of silence before
    and after it. Samples that are not finite count as zero.

    **Arguments:**

    - `recording`: samples of one or several microphones.
    - `highest`: frequency above which sound is left out, Hz.

    Raises `ValueError` if `recording` is not a `Recording`, its sampling rate is below 1250 Hz, or `highest` is
    invalid.

    **Example:**

    ```python
    feature_images = sound_images(recordings[0])
    print(feature_images.times)
    ```
    """
    return SoundImages.concatenate(list(image_blocks(recording, highest)))


def image_blocks(recording: Recording, highest: float = MAX_EVEN_FREQUENCY) -> Iterator[SoundImages]:
    """Compute the feature images of `sound_images` in blocks of windows, for recordings larger than memory.

    Raises `ValueError` as `sound_images` does.
    """
    check_kind("recording", recording, Recording, "a Recording of samples, as of read_recording(path)")
    check_highest(highest)
    if recording.rate < 2 * MIN_HIGHEST:
        raise ValueError(
            f"{recording.name}: at {recording.rate:g} samples a second there is no sound above "
            f"{recording.rate / 2:g} Hz; record {2 * MIN_HIGHEST:g} a second or more."
        )
    return _compute_image_blocks(recording, highest)


def _compute_image_blocks(recording: Recording, highest: float) -> Iterator[SoundImages]:
    sampling_rate, samples = recording.rate, recording.samples
    frame_length, frame_hop = round(FRAME_DURATION * sampling_rate), round(FRAME_INTERVAL * sampling_rate)
    window_length = frame_length + (NUM_FRAMES - 1) * frame_hop
    padding_before = 0
    if samples.shape[1] < window_length:
        padding_before = round(0.3 * sampling_rate)
        padding_after = max(padding_before, window_length - padding_before - samples.shape[1])
        samples = np.pad(samples, ((0, 0), (padding_before, padding_after)))
    num_frames = 1 + (samples.shape[1] - frame_length) // frame_hop
    num_windows = 1 + int((num_frames - NUM_FRAMES + 0.5) * frame_hop / (WINDOW_INTERVAL * sampling_rate))
    # Each window begins with the frame nearest to a multiple of 0.1 s.
    window_starts = np.minimum(
        np.round(WINDOW_INTERVAL * sampling_rate * np.arange(num_windows) / frame_hop).astype(int),
        num_frames - NUM_FRAMES,
    )
    band_weights = _band_weights(frame_length, sampling_rate, highest)
    hann_taper = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(frame_length) / frame_length)
    power_scale = 2 / (frame_length * (hann_taper**2).sum())
    bins_per_band = np.maximum(band_weights.sum(axis=0), 1.0)
    for first_window in range(0, num_windows, _MAX_BLOCK_WINDOWS):
        block_window_starts = window_starts[first_window : first_window + _MAX_BLOCK_WINDOWS]
        block_samples = samples[
            :,
            block_window_starts[0] * frame_hop : (block_window_starts[-1] + NUM_FRAMES - 1) * frame_hop + frame_length,
        ]
        is_finite_sample = np.isfinite(block_samples)
        missing_fractions = (
            0.0
            if is_finite_sample.all()
            else 1 - _finite_sample_share(is_finite_sample, frame_length, frame_hop).mean(axis=0)
        )
        band_powers = (
            np.stack(
                [
                    _band_powers(channel_samples, hann_taper, frame_hop, band_weights)
                    for channel_samples in np.where(is_finite_sample, block_samples, 0.0)
                ]
            )
            * power_scale
        )
        frame_indices = block_window_starts[:, None] - block_window_starts[0] + np.arange(NUM_FRAMES)
        microphone_intensities = band_powers.sum(axis=-1)[:, frame_indices].transpose(1, 0, 2)
        strongest_microphones = microphone_intensities.sum(axis=2).argmax(axis=1)
        window_spectra = (band_powers / bins_per_band)[strongest_microphones[:, None], frame_indices].transpose(0, 2, 1)
        is_known = np.broadcast_to(missing_fractions, band_powers.shape[1])[frame_indices].mean(axis=1) < 0.5
        window_times = (block_window_starts * frame_hop + window_length / 2 - padding_before) / sampling_rate
        yield SoundImages(
            window_times,
            microphone_intensities.astype(np.float32),
            window_spectra.astype(np.float32),
            strongest_microphones,
            is_known,
        )


def _band_powers(
    channel_samples: np.ndarray, hann_taper: np.ndarray, frame_hop: int, band_weights: np.ndarray
) -> Float[np.ndarray, "F 64"]:
    """Compute the power (F, 64) of a microphone's samples in each of F frames and 64 bands, not yet scaled."""
    sample_frames = sliding_window_view(channel_samples, len(hann_taper))[::frame_hop]
    # The mean is subtracted, since a constant offset would leak into the lowest band.
    fourier_spectra = np.fft.rfft((sample_frames - sample_frames.mean(axis=1, keepdims=True)) * hann_taper)
    return (np.real(fourier_spectra) ** 2 + np.imag(fourier_spectra) ** 2) @ band_weights


def _finite_sample_share(is_finite_sample: np.ndarray, frame_length: int, frame_hop: int) -> np.ndarray:
    """Compute the share (M, F) of finite samples in each of F frames of M microphones."""
    return sliding_window_view(is_finite_sample, frame_length, axis=1)[:, ::frame_hop].mean(axis=-1)


def _band_weights(frame_length: int, sampling_rate: float, highest: float) -> Float[np.ndarray, "K 64"]:
    """Compute the share (K, 64) of the frequency interval of each bin k, (k ± 1/2) rate / length, in each band.

    The share is 0 for bin 0, and for frequencies above half the rate or above `highest`.
    """
    frequency_edges = band_edges(highest)
    bin_width = sampling_rate / frame_length
    low_bin_edges = (np.arange(frame_length // 2 + 1) - 0.5) * bin_width
    high_bin_edges = np.minimum(low_bin_edges + bin_width, highest + 0.5 / FRAME_DURATION)
    overlap_fractions = (
        np.clip(
            np.minimum(high_bin_edges[:, None], frequency_edges[1:])
            - np.maximum(low_bin_edges[:, None], frequency_edges[:-1]),
            0,
            None,
        )
        / bin_width
    )
    overlap_fractions[0] = 0.0
    return overlap_fractions
