"""Checks of whether measured frames can be imaged: comparison with the reference, and noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jeit.arguments import counted, percent
from jeit.data.measurement import Measurement
from jeit.data.quality import (
    NoiseEstimate,
    channel_reciprocity_error,
    estimate_noise,
    impossible_signs,
    reciprocity_error,
    reciprocity_noise,
    rounding_deviation,
    signal_evidence,
)
from jeit.inverse import relative_noise
from jeit_solvers.engines import as_array

# Maximum fraction of voltages with an impossible sign. A quarter means that half of the voltages are noise, because
# noise has the wrong sign half of the time.
MAX_IMPOSSIBLE_SIGN_SHARE = 0.25
# Fraction of voltages with an impossible sign above which the polarity is reversed: noise alone yields only one half.
REVERSED_POLARITY_SIGN_SHARE = 0.75
# Maximum reciprocity error of a frame. A reciprocity error r corresponds to a ratio of noise to signal of
# r / sqrt(2 - r²), here one half.
MAX_RECIPROCITY_ERROR = 0.63
# Maximum of `FrameQuality.noise_share` that raises no doubt; it corresponds to that reciprocity error.
MAX_NOISE_SHARE = MAX_RECIPROCITY_ERROR / np.sqrt(2)
# Share of a common factor in the power of the difference above which it is drift of the bath or of a gain. In simulated
# tanks it was 0.82 to 0.99 with 3 to 100 % drift, and at most 0.55 without drift, even if half of the tank resists.
_MAX_COMMON_FACTOR_SHARE = 0.7
# An electrode is reported as the cause of the noise if at most this fraction of it remains without its channels.
_MAX_REMAINING_NOISE_SHARE = 0.5
# Minimum evidence that a difference contains more than noise, in standard deviations (`signal_evidence`). Bodies are
# found reliably where noise exceeds the signal, because a body alters many channels in a pattern.
MIN_SIGNAL_EVIDENCE = 3.0
# Cosine of the angle between a frame and its reference below which the frame or the reference has the opposite
# polarity.
_OPPOSITE_POLARITY_COSINE = -0.5
# Maximum fraction of the difference between frame and reference that is due to rounding of the voltages.
_MAX_ROUNDING_SHARE = 0.7


@dataclass(frozen=True)
class FrameQuality:
    """Result of `assess` for one frame and its difference from the reference.

    **Fields**

    - `difference`: ‖v - v_reference‖ / ‖v_reference‖ over the usable channels, where v are the voltages of the frame.
    - `difference_noise`: noise of the difference, in volts and relative to the difference; None if the noise cannot be
      estimated.
    - `trusted_noise`: noise of the difference in units of `jeit.inverse.relative_noise` of the reference (the expected
      errors of channels relative to each other); None if it cannot be estimated.
    - `rounding`: standard deviation of the difference due to rounding of the voltages, relative to the difference; 0 if
      the voltages are not rounded.
    - `difference_reciprocity_error`: relative reciprocity error of the difference; None if no channels are reciprocal.
    - `noise_share`: root mean square of the noise relative to that of the difference, from reciprocity, without a
      factor that all voltages have in common; None if no channels are reciprocal.
    - `noisy_electrode`: the electrode, numbered from 0, whose channels contain most of the noise, if `noise_share` is
      large and a single electrode explains it; otherwise None.
    - `common_factor`: relative change that all voltages have in common, if it is most of the difference; otherwise 0.
    - `noise_source`: what `noise_share` was estimated from; `noise_apart_from`: the part of the difference that
      `noise_share` does not count.
    - `impossible_signs`: fraction of voltages whose sign is impossible on a passive body (the larger of the fractions
      of frame and reference); None if no sign is known.
    - `usable_channels`: number of channels that are usable in both frame and reference.
    - `reason`: why the frame cannot be imaged; empty if it can.

    **Example:**

    ```python
    quality = check_imageable(pressed, rest)[0]
    quality.difference, quality.usable_channels
    ```
    """

    difference: float
    difference_noise: NoiseEstimate | None
    trusted_noise: float | None
    difference_reciprocity_error: float | None
    impossible_signs: float | None
    usable_channels: int
    reason: str
    rounding: float = 0.0
    noise_share: float | None = None
    noisy_electrode: int | None = None
    common_factor: float = 0.0
    noise_source: str = "reciprocity"
    noise_apart_from: str = "a common factor"

    @property
    def doubt(self) -> str:
        """A sentence about noise that exceeds half of the signal; otherwise empty."""
        if self.noise_share is None or self.noise_share <= MAX_NOISE_SHARE:
            return ""
        noise_text = (
            f"by {self.noise_source}, noise is {percent(self.noise_share)} of the difference from the reference"
        )
        if self.common_factor:
            return (
                f"all voltages have changed by {percent(self.common_factor)} alike, as when a bath's temperature or a "
                f"gain changes. By {self.noise_source}, noise is {percent(self.noise_share)} of the rest of the "
                "difference: bodies may be missed, or shown where none are."
            )
        if self.noisy_electrode is not None:
            return (
                f"{noise_text}, most of it in the channels of electrode {self.noisy_electrode + 1}: check its contact "
                "and cable, or leave the channels out (NaN in the file)."
            )
        return (
            f"{noise_text} (apart from {self.noise_apart_from}): bodies may be missed, or shown where none are. "
            "Average more frames, or use more current."
        )

    def of_rest(self, share: float) -> FrameQuality:
        """Quality of the rest of the difference, a `share` of it, that moved electrodes do not explain."""
        noise, noise_share = self.difference_noise, self.noise_share
        return replace(
            self,
            difference_noise=noise and replace(noise, relative=noise.relative / share),
            noise_share=noise_share and min(1.0, noise_share / share),
            noise_apart_from="a common factor and moved electrodes",
        )

    @property
    def imageable(self) -> bool:
        """Whether the frame can be imaged, i.e. no check found a reason against it."""
        return not self.reason


def check_same_setup(measurement: Measurement, reference: Measurement) -> None:
    """Raise `ValueError` unless measurement and reference have the same electrodes, patterns, currents and unit."""
    protocol, reference_protocol = measurement.protocol, reference.protocol
    if protocol.num_electrodes != reference_protocol.num_electrodes:
        raise ValueError(
            f"'{measurement.name}' has {protocol.num_electrodes} electrodes and the reference '{reference.name}' "
            f"{reference_protocol.num_electrodes}: they are not of the same set-up. Give a reference from the same "
            "body."
        )
    if protocol.num_measurements != reference_protocol.num_measurements:
        raise ValueError(
            f"'{measurement.name}' has {protocol.num_measurements} channels ({protocol.name}) and the reference "
            f"'{reference.name}' {reference_protocol.num_measurements} ({reference_protocol.name}). Both must use "
            "one protocol."
        )
    if not protocol.same_patterns(reference_protocol):
        current_ratio = float(np.linalg.norm(protocol.channel_drive) / np.linalg.norm(reference_protocol.channel_drive))
        scaled_drive = current_ratio * np.asarray(reference_protocol.channel_drive)
        if np.allclose(protocol.channel_drive, scaled_drive, rtol=1e-6, atol=1e-12) and np.allclose(
            protocol.channel_measurement, reference_protocol.channel_measurement, rtol=1e-6
        ):
            raise ValueError(
                f"'{measurement.name}' was driven with {current_ratio:.4g} times the current of the reference "
                f"'{reference.name}'. Their difference would show the current, not the body: use a reference "
                "at the same current, or divide both by their currents first."
            )
        raise ValueError(
            f"'{measurement.name}' ({protocol.name}) and the reference '{reference.name}' ({reference_protocol.name}) "
            "drive or read different electrodes. Give a reference measured with the same protocol."
        )
    if np.iscomplexobj(measurement.voltages) != np.iscomplexobj(reference.voltages):
        raise ValueError(
            f"'{measurement.name}' and the reference '{reference.name}' are not both complex. Read both with "
            "the same component (real, imaginary, magnitude or complex)."
        )
    for each_measurement, name_prefix in ((measurement, ""), (reference, "the reference ")):
        if not np.asarray(each_measurement.mask).any():
            raise ValueError(
                f"{name_prefix}'{each_measurement.name}' has no usable voltage: each is NaN, infinite, or masked for "
                "what its notes say. Give another frame."
            )
    common_channels = np.asarray(measurement.mask).any(axis=0) & np.asarray(reference.mask).any(axis=0)
    if not common_channels.any():
        raise ValueError(f"'{measurement.name}' and the reference '{reference.name}' have no usable channel in common.")
    different_sizes = [
        np.median(np.abs(np.asarray(compared_measurement.mean_frame().voltages)[0, common_channels]))
        for compared_measurement in (measurement, reference)
    ]
    current_ratio = different_sizes[0] / different_sizes[1] if different_sizes[1] > 0 else np.inf
    if not 1 / 100 < current_ratio < 100:
        raise ValueError(
            f"The voltages of '{measurement.name}' are {current_ratio:.3g} times those of the reference "
            f"'{reference.name}': the two are in different units (volts and millivolts?) or at different "
            "gains. Give both in volts."
        )


def assess(measurement: Measurement, reference: Measurement) -> list[FrameQuality]:
    """Check for each frame of `measurement` whether its difference from the mean frame of `reference` can be imaged.

    A frame cannot be imaged if

    - more than a quarter of the voltages of the frame, or of the reference, have an impossible sign
      (`impossible_signs`): at least half of the voltages are then smaller than the noise or the offset of the
      instrument;
    - the reciprocity error of the frame or of the reference exceeds 0.63, so that noise exceeds half of the signal;
    - by reciprocity, the difference of both is not distinguishable from noise (`jeit.data.quality.signal_evidence`).
      Channels are weighted as in imaging (`jeit.inverse.relative_noise`), because voltages on driven electrodes are
      large and mostly due to contact impedances;
    - the cosine of the angle between the voltages of frame and reference is less than -0.5: no change of a passive body
      reverses all voltages, so the frame or the reference has the opposite polarity;
    - the frame does not differ from the reference, or the difference is mostly rounding of the voltages;
    - the number of usable channels is smaller than the number of electrodes.

    In the available measured data sets, usable frames have at most 0.18 impossible signs and a reciprocity error of at
    most 0.21; a frame measured with too small a current has 0.54 impossible signs.

    Raises `ValueError` if measurement and reference are not from the same set-up (`check_same_setup`).
    """
    check_same_setup(measurement, reference)
    mean_reference = reference.mean_frame()
    reference_signs, reference_error = impossible_signs(mean_reference), reciprocity_error(mean_reference)
    noise_deviations = np.asarray(
        relative_noise(np.abs(np.asarray(mean_reference.voltages)[0]), np.asarray(mean_reference.mask)[0])
    )
    frame_qualities = []
    for frame_index in range(measurement.num_frames):
        frame = measurement.frame(frame_index)
        mask_of_common_channels = np.asarray(frame.mask) & np.asarray(mean_reference.mask)
        voltage_change = Measurement(
            np.where(mask_of_common_channels, np.asarray(frame.voltages) - np.asarray(mean_reference.voltages), np.nan),
            mask_of_common_channels,
            measurement.protocol,
        )
        change_norm = float(np.linalg.norm(np.asarray(voltage_change.filled())))
        relative_difference = change_norm / float(
            np.linalg.norm(np.where(mask_of_common_channels, np.asarray(mean_reference.filled()), 0)) or np.inf
        )
        sign_shares = [
            float(sign_fractions[0])
            for sign_fractions in (impossible_signs(frame), reference_signs)
            if sign_fractions is not None
        ]
        num_usable = int(mask_of_common_channels.sum())
        frame_cosine = _cosine_similarity(
            *(
                np.where(mask_of_common_channels, np.asarray(each_frame.filled()), 0).ravel()
                for each_frame in (frame, mean_reference)
            )
        )
        error, signal_to_noise = (
            (reciprocity_error(voltage_change, noise_deviations), signal_evidence(voltage_change, noise_deviations))
            if num_usable and change_norm > 0
            else (None, None)
        )
        common_factor, common_share = _find_common_factor(voltage_change, mean_reference, noise_deviations)
        noise_share, noisy_electrode = (
            (None, None)
            if error is None
            else _find_noise_share(voltage_change, mean_reference, noise_deviations, common_factor)
        )
        errors_by_name = {
            f"the reference '{reference.name}'": reference_error,
            "the frame": reciprocity_error(frame),
        }
        impossible_share = max(sign_shares) if sign_shares else None
        rounding_fraction = (
            float(np.linalg.norm(rounding_of_difference(frame, mean_reference))) / change_norm
            if change_norm > 0
            else 0.0
        )
        frame_qualities.append(
            FrameQuality(
                difference=relative_difference,
                difference_noise=estimate_noise(voltage_change) if num_usable and change_norm > 0 else None,
                trusted_noise=reciprocity_noise(voltage_change, noise_deviations)
                if num_usable and change_norm > 0
                else None,
                difference_reciprocity_error=error,
                impossible_signs=impossible_share,
                usable_channels=num_usable,
                rounding=rounding_fraction,
                noise_share=noise_share,
                noisy_electrode=noisy_electrode,
                common_factor=float(np.real(common_factor)) if common_share > _MAX_COMMON_FACTOR_SHARE else 0.0,
                reason=_rejection_reason(
                    measurement.protocol.num_electrodes,
                    num_usable,
                    relative_difference,
                    rounding_fraction,
                    impossible_share,
                    (error, signal_to_noise),
                    errors_by_name,
                    frame_cosine,
                ),
            )
        )
    return frame_qualities


def _find_common_factor(
    change: Measurement, mean: Measurement, deviations: Float[np.ndarray, " M"]
) -> tuple[complex, float]:
    """Relative change that the voltages of a `change` from the reference `mean` have in common, and its share of the
    change's power. Channels are weighted by their `deviations` (M,)."""
    weights = np.where(np.asarray(change.mask)[0], deviations**-2.0, 0.0)
    voltages, levels = np.nan_to_num(np.asarray(change.voltages)[0]), np.nan_to_num(np.asarray(mean.voltages)[0])
    power, change_power = (float(np.sum(weights * np.abs(values) ** 2)) for values in (levels, voltages))
    factor = np.vdot(levels, weights * voltages) / power if power > 0 else 0.0
    return factor, float(np.abs(factor) ** 2 * power / change_power) if change_power > 0 else 0.0


def _find_noise_share(
    change: Measurement, mean: Measurement, deviations: Float[np.ndarray, " M"], factor: complex
) -> tuple[float | None, int | None]:
    """`FrameQuality.noise_share` and `FrameQuality.noisy_electrode` of a `change` from the reference `mean`.
    `deviations` (M,): expected errors of the channels, relative to each other; `factor`: relative change that all
    voltages have in common."""
    protocol = change.protocol
    voltages, levels = np.nan_to_num(np.asarray(change.voltages)[0]), np.nan_to_num(np.asarray(mean.voltages)[0])
    change_without_common_factor = replace(change, voltages=as_array((voltages - factor * levels)[None]))
    if not (error := reciprocity_error(change_without_common_factor, deviations)):
        return error, None
    noise_share, electrode = min(1.0, error / np.sqrt(2)), None
    if noise_share > MAX_NOISE_SHARE:
        squared_relative_error = (
            np.nan_to_num(channel_reciprocity_error(change_without_common_factor)[0] / deviations) ** 2
        )
        touching = np.array(
            [protocol.channels_touching(electrode_index) for electrode_index in range(protocol.num_electrodes)]
        )
        noisiest_electrode = int(np.argmax(touching @ squared_relative_error / np.maximum(touching.sum(axis=1), 1)))
        remaining_error = reciprocity_error(
            change_without_common_factor.masked(~touching[noisiest_electrode], "they use the noisy electrode."),
            deviations,
        )
        electrode = (
            noisiest_electrode
            if remaining_error is not None and remaining_error < _MAX_REMAINING_NOISE_SHARE * error
            else None
        )
    return noise_share, electrode


def rounding_of_difference(frame: Measurement, reference: Measurement) -> Float[np.ndarray, " M"]:
    """Standard deviation (channels,), in volts, of the difference of two frames due to rounding of their voltages; 0
    for channels that are not usable in both frames."""
    rounding_deviations = [
        rounding_deviation(np.asarray(measurement.voltages)[0], np.asarray(measurement.mask)[0])
        for measurement in (frame, reference)
    ]
    mask_of_common_channels = np.asarray(frame.mask)[0] & np.asarray(reference.mask)[0]
    return np.where(mask_of_common_channels, np.hypot(*rounding_deviations), 0.0)


def check_imageable(measurement: Measurement, reference: Measurement) -> list[FrameQuality]:
    """Check whether each frame can be imaged against a reference, and raise an error if not, e.g. because the noise is
    as large as the signal.

    **Arguments:**

    - `measurement`: the frames to image.
    - `reference`: frames of the undisturbed body, from the same set-up.

    Raises `ValueError`, with the reason, if a frame cannot be imaged.

    **Example:**

    ```python
    check_imageable(pressed, rest)[0].difference
    ```
    """
    frame_qualities = assess(measurement, reference)
    for frame_index, frame_quality in enumerate(frame_qualities):
        if not frame_quality.imageable:
            frame_text = f", frame {frame_index}" if measurement.num_frames > 1 else ""
            raise ValueError(f"'{measurement.name}'{frame_text} cannot be imaged: {frame_quality.reason}")
    return frame_qualities


def _rejection_reason(
    num_electrodes: int,
    num_usable: int,
    relative_difference: float,
    rounding_fraction: float,
    impossible_share: float | None,
    error_and_evidence: tuple[float | None, float | None],
    errors_by_name: dict[str, float | None],
    frame_cosine: float,
) -> str:
    """Reason why a frame cannot be imaged; empty if it can. `error_and_evidence`: reciprocity error of the difference
    and the evidence that it is not noise; `errors_by_name`: reciprocity errors of frame and reference; `frame_cosine`:
    cosine of the angle between frame and reference."""
    if num_usable < num_electrodes:
        return (
            f"only {counted(num_usable, 'channel')} usable in both it and its reference, for {num_electrodes} "
            "electrodes."
        )
    if relative_difference < 1e-12:
        return "it equals its reference, so there is no difference to image. Is it the same file?"
    if rounding_fraction > _MAX_ROUNDING_SHARE:
        return (
            f"its difference from the reference, {percent(relative_difference)}, is mostly rounding of the voltages: "
            "record them with more digits."
        )
    if impossible_share is not None and impossible_share > REVERSED_POLARITY_SIGN_SHARE:
        return (
            f"{percent(impossible_share)} of the voltages have a sign that no passive body gives: reverse the polarity "
            "of it, or of its reference."
        )
    if impossible_share is not None and impossible_share > MAX_IMPOSSIBLE_SIGN_SHARE:
        return (
            f"too noisy: {percent(impossible_share)} of the voltages have a sign that no passive body gives, so that "
            "more than half of them lie below the instrument's noise or offset. Measure with more current or gain."
        )
    if frame_cosine < _OPPOSITE_POLARITY_COSINE:
        return (
            "its voltages have the opposite sign of its reference's: reverse the polarity of it, or of its reference."
        )
    for name, error in errors_by_name.items():
        if error is not None and error > MAX_RECIPROCITY_ERROR:
            return (
                f"{name} breaks reciprocity by {percent(error)} on its own: it is too noisy, or its channels are in "
                "another order than described. See `jeit info`."
            )
    error, signal_to_noise = error_and_evidence
    if error is not None and signal_to_noise is not None and signal_to_noise < MIN_SIGNAL_EVIDENCE:
        return (
            f"too noisy: the difference from the reference breaks reciprocity by {percent(error)}, as noise alone does "
            "(141 %, less with few channels). Average more frames, or use more current; and check that its channels "
            "and drives are in the order of the reference's."
        )
    return ""


def _cosine_similarity(first_frame: np.ndarray, second_frame: np.ndarray) -> float:
    """Cosine of the angle between two frames as vectors: 1 if the frames differ by a positive factor only, 0 if one
    frame is zero."""
    norm_product = float(np.linalg.norm(first_frame) * np.linalg.norm(second_frame))
    return float(np.real(np.vdot(first_frame, second_frame))) / norm_product if norm_product > 0 else 0.0
