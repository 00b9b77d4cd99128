"""Checks whether a frame can be imaged against a reference: the same set-up, and more signal than noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jeit.arguments import counted, percent
from jeit.data.measurement import Measurement
from jeit.data.quality import (
    NoiseEstimate,
    estimate_noise,
    impossible_signs,
    reciprocity_error,
    reciprocity_noise,
)
from jeit.inverse import relative_noise

# A quarter of the signs wrong means that half of the voltages are noise (noise is wrong half the time).
MOST_IMPOSSIBLE_SIGNS = 0.25
# Noise has as many right signs as wrong ones: so many wrong ones are not noise.
MOST_OPPOSITE_SIGNS = 0.75
# Reciprocity error r of a difference means noise over signal of r / sqrt(2 - r²): here a half.
MOST_DIFFERENCE_RECIPROCITY_ERROR = 0.63
# Cosine of a frame and its reference, below which one of them has the opposite sign.
_LEAST_COSINE = -0.5


@dataclass(frozen=True)
class FrameQuality:
    """Result of `assess` for one frame and its difference from the reference.

    - `difference`: ‖v - v_reference‖ / ‖v_reference‖ over usable channels.
    - `difference_noise`: noise of the difference in volts, and relative to it; None when it cannot be estimated.
    - `trusted_noise`: noise of the difference in units of `jeit.inverse.relative_noise` of the reference, the expected
      error of channels relative to each other; None when it cannot be estimated.
    - `difference_reciprocity_error`: relative reciprocity error of the difference, or None.
    - `impossible_signs`: the larger fraction, of frame and reference, of voltages of a sign that no passive
      body gives; or None.
    - `usable_channels`: channels usable in both.
    - `reason`: why the frame cannot be imaged; empty when it can.
    """

    difference: float
    difference_noise: NoiseEstimate | None
    trusted_noise: float | None
    difference_reciprocity_error: float | None
    impossible_signs: float | None
    usable_channels: int
    reason: str

    @property
    def imageable(self) -> bool:
        """True when nothing speaks against imaging the frame."""
        return not self.reason


def check_same_setup(measurement: Measurement, reference: Measurement) -> None:
    """Raise `ValueError` unless both were measured with the same electrodes, patterns, currents and unit."""
    ours, theirs = measurement.protocol, reference.protocol
    if ours.num_electrodes != theirs.num_electrodes:
        raise ValueError(
            f"'{measurement.name}' has {ours.num_electrodes} electrodes and the reference '{reference.name}' "
            f"{theirs.num_electrodes}: they are not of the same set-up. Give a reference from the same body."
        )
    if ours.num_measurements != theirs.num_measurements:
        raise ValueError(
            f"'{measurement.name}' has {ours.num_measurements} channels ({ours.name}) and the reference "
            f"'{reference.name}' {theirs.num_measurements} ({theirs.name}). Both must use one protocol."
        )
    if not ours.same_patterns(theirs):
        ratio = float(np.linalg.norm(ours.channel_drive) / np.linalg.norm(theirs.channel_drive))
        scaled = ratio * np.asarray(theirs.channel_drive)
        if np.allclose(ours.channel_drive, scaled, rtol=1e-6, atol=1e-12) and np.allclose(
            ours.channel_measurement, theirs.channel_measurement, rtol=1e-6
        ):
            raise ValueError(
                f"'{measurement.name}' was driven with {ratio:.4g} times the current of the reference "
                f"'{reference.name}'. Their difference would show the current, not the body: use a reference "
                "at the same current, or divide both by their currents first."
            )
        raise ValueError(
            f"'{measurement.name}' ({ours.name}) and the reference '{reference.name}' ({theirs.name}) drive "
            "or read different electrodes. Give a reference measured with the same protocol."
        )
    if np.iscomplexobj(measurement.voltages) != np.iscomplexobj(reference.voltages):
        raise ValueError(
            f"'{measurement.name}' and the reference '{reference.name}' are not both complex. Read both with "
            "the same component (real, imaginary, magnitude or complex)."
        )
    for one, prefix in ((measurement, ""), (reference, "the reference ")):
        if not np.asarray(one.mask).any():
            raise ValueError(
                f"{prefix}'{one.name}' has no usable voltage: each is NaN, infinite, or masked for what its notes say. "
                "Give another frame."
            )
    common = np.asarray(measurement.mask).any(axis=0) & np.asarray(reference.mask).any(axis=0)
    if not common.any():
        raise ValueError(f"'{measurement.name}' and the reference '{reference.name}' have no usable channel in common.")
    sizes = [np.median(np.abs(np.asarray(m.mean_frame().voltages)[0, common])) for m in (measurement, reference)]
    ratio = sizes[0] / sizes[1] if sizes[1] > 0 else np.inf
    if not 1 / 100 < ratio < 100:
        raise ValueError(
            f"The voltages of '{measurement.name}' are {ratio:.3g} times those of the reference "
            f"'{reference.name}': the two are in different units (volts and millivolts?) or at different "
            "gains. Give both in volts."
        )


def assess(measurement: Measurement, reference: Measurement) -> list[FrameQuality]:
    """Judge each frame of `measurement` for difference imaging against the mean of `reference`'s frames.

    A frame cannot be imaged when

    - it, or the reference, has an impossible sign in more than a quarter of its voltages
      (`impossible_signs`): half of the voltages or more then lie below the instrument's noise or offset;
    - it, or the reference, breaks reciprocity by more than 0.63, or the difference does: its noise is over half its
      signal, each channel trusted as images trust it (`jeit.inverse.relative_noise`): driven electrodes read large
      voltages, mostly of contacts;
    - its voltages are those of the reference with the opposite sign, nearly: their cosine is less than -0.5, and no
      change of a passive body turns all of them round;
    - it does not differ from the reference at all;
    - fewer channels than electrodes are usable.

    On the measured sets in reach, usable frames stay below 0.18 and 0.21; a frame measured at too small a
    current has 0.54 of its signs wrong.

    Raises `ValueError` when the two are not of one set-up (`check_same_setup`).
    """
    check_same_setup(measurement, reference)
    mean = reference.mean_frame()
    reference_signs, reference_error = impossible_signs(mean), reciprocity_error(mean)
    trusted = np.asarray(relative_noise(np.abs(np.asarray(mean.voltages)[0]), np.asarray(mean.mask)[0]))
    results = []
    for index in range(measurement.num_frames):
        frame = measurement.frame(index)
        both = np.asarray(frame.mask) & np.asarray(mean.mask)
        change = Measurement(
            np.where(both, np.asarray(frame.voltages) - np.asarray(mean.voltages), np.nan), both, measurement.protocol
        )
        size = float(np.linalg.norm(np.asarray(change.filled())))
        relative = size / float(np.linalg.norm(np.where(both, np.asarray(mean.filled()), 0)) or np.inf)
        signs = [float(s[0]) for s in (impossible_signs(frame), reference_signs) if s is not None]
        usable = int(both.sum())
        alike = _cosine(*(np.where(both, np.asarray(one.filled()), 0).ravel() for one in (frame, mean)))
        error = reciprocity_error(change, trusted) if usable and size > 0 else None
        own = {f"the reference '{reference.name}'": reference_error, "the frame": reciprocity_error(frame)}
        wrong = max(signs) if signs else None
        results.append(
            FrameQuality(
                difference=relative,
                difference_noise=estimate_noise(change) if usable and size > 0 else None,
                trusted_noise=reciprocity_noise(change, trusted) if usable and size > 0 else None,
                difference_reciprocity_error=error,
                impossible_signs=wrong,
                usable_channels=usable,
                reason=_reason(measurement.protocol.num_electrodes, usable, relative, wrong, error, own, alike),
            )
        )
    return results


def check_imageable(measurement: Measurement, reference: Measurement) -> list[FrameQuality]:
    """`assess(measurement, reference)`; raises `ValueError` with the reason for the first bad frame."""
    qualities = assess(measurement, reference)
    for index, quality in enumerate(qualities):
        if not quality.imageable:
            where = f", frame {index}" if measurement.num_frames > 1 else ""
            raise ValueError(f"'{measurement.name}'{where} cannot be imaged: {quality.reason}")
    return qualities


def _reason(
    electrodes: int,
    usable: int,
    difference: float,
    signs: float | None,
    reciprocity: float | None,
    own: dict[str, float | None],
    alike: float,
) -> str:
    """Why a frame cannot be imaged; `own`: the reciprocity errors of both frames themselves; `alike`: their cosine."""
    if usable < electrodes:
        return f"only {counted(usable, 'channel')} usable in both it and its reference, for {electrodes} electrodes."
    if difference < 1e-12:
        return "it equals its reference, so there is no difference to image. Is it the same file?"
    if signs is not None and signs > MOST_OPPOSITE_SIGNS:
        return (
            f"{percent(signs)} of the voltages have a sign that no passive body gives: reverse the polarity of it, or "
            "of its reference."
        )
    if signs is not None and signs > MOST_IMPOSSIBLE_SIGNS:
        return (
            f"too noisy: {percent(signs)} of the voltages have a sign that no passive body gives, so that "
            "more than half of them lie below the instrument's noise or offset. Measure with more current or gain."
        )
    if alike < _LEAST_COSINE:
        return (
            "its voltages have the opposite sign of its reference's: reverse the polarity of it, or of its reference."
        )
    for name, error in own.items():
        if error is not None and error > MOST_DIFFERENCE_RECIPROCITY_ERROR:
            return (
                f"{name} breaks reciprocity by {percent(error)} on its own: it is too noisy, or its channels are in "
                "another order than described. See `jeit info`."
            )
    if reciprocity is not None and reciprocity > MOST_DIFFERENCE_RECIPROCITY_ERROR:
        return (
            f"too noisy: the difference from the reference breaks reciprocity by {percent(reciprocity)}, "
            "so that its noise is more than half its signal. Average more frames, or use more current."
        )
    return ""


def _cosine(one: np.ndarray, other: np.ndarray) -> float:
    """Cosine of the angle between two frames, 1 where they are alike but for their size; 0 where one is zero."""
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.real(np.vdot(one, other))) / size if size > 0 else 0.0
