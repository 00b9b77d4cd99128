"""Estimation, from the voltages, of properties that a description does not state: the order of channels, the measured
channels, and the sign of the voltages.

The order of channels must obey reciprocity. The sign is known if electrodes follow each other along an edge, see
`jeit.data.quality.expected_signs`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Inexact

from jeit.arguments import counted, measurable_values, percent
from jeit.data.measurement import Measurement
from jeit.data.quality import boundary_order, expected_signs, reciprocity_error
from jeit.mesh import Solid
from jeit.protocol import Protocol
from jeit.protocol.patterns import shares_electrode

# Maximum reciprocity error for which the described order of channels is trusted. A different order is used only if its
# error, divided by the error of the described order, is below the second value.
_MAX_TRUSTED_ERROR, _MAX_ERROR_RATIO = 0.25, 0.4
# Cosine of the angle between a frame and its reference below which the frame or the reference has the opposite sign.
_OPPOSITE_SIGN_COSINE = -0.5


def fitting_protocol(
    frames: Inexact[np.ndarray, "F M"], protocols: Sequence[tuple[Protocol, str]], like: Measurement | None = None
) -> tuple[Protocol | None, tuple[str, ...]]:
    """Select the protocol among the candidates `protocols` that has as many channels as the frames and obeys
    reciprocity. Returns the protocol (None if there are no candidates), and a note if it is not the described protocol
    `protocols[0]`.

    The described protocol is used unless it violates reciprocity and another candidate does not. If a measurement
    `like` of the same sensor is specified, its protocol is the first candidate, because properties detected in the
    reference apply to the frames.
    """
    if not protocols:
        return None, ()
    candidate_protocols = [
        candidate_protocol
        for candidate_protocol in protocols
        if candidate_protocol[0].num_measurements == frames.shape[-1]
    ]
    if not candidate_protocols:
        return protocols[0][0], ()
    choice_reason = f"for {counted(frames.shape[-1], 'number')} are in a frame"
    if like is not None and (
        same_protocols := [
            candidate_protocol
            for candidate_protocol in candidate_protocols
            if candidate_protocol[0].same_patterns(like.protocol)
        ]
    ):
        candidate_protocols, choice_reason = [*same_protocols, *candidate_protocols], f"as of '{like.name}'"
    chosen_protocol, option_text = candidate_protocols[0]
    if len(candidate_protocols) == 1 and not option_text:
        return chosen_protocol, ()
    error_of_first = _mean_frame_error(frames, chosen_protocol)
    if _MAX_TRUSTED_ERROR < error_of_first < np.inf:
        candidate_errors = [
            _mean_frame_error(frames, candidate_protocol) for candidate_protocol, _ in candidate_protocols
        ]
        best_candidate_index = int(np.argmin(candidate_errors))
        if candidate_errors[best_candidate_index] < min(_MAX_TRUSTED_ERROR, _MAX_ERROR_RATIO * error_of_first):
            chosen_protocol, option_text = candidate_protocols[best_candidate_index]
            best_error = percent(candidate_errors[best_candidate_index])
            choice_reason = (
                f"for reciprocity is broken by {best_error} so, by {percent(error_of_first)} in the usual order"
            )
    return chosen_protocol, (f"[protocol] {option_text} is taken, {choice_reason}.",) if option_text else ()


def _mean_frame_error(frames: Inexact[np.ndarray, "F M"], protocol: Protocol) -> float:
    """Reciprocity error of the mean of the frames; infinite if it cannot be computed."""
    frame_values = measurable_values(np.atleast_2d(frames))
    is_known = np.isfinite(frame_values).all(axis=0)
    mean_frame = np.where(is_known, np.where(np.isfinite(frame_values), frame_values, 0).mean(axis=0), 0)
    error = (
        reciprocity_error(Measurement(mean_frame[None], is_known[None], protocol))
        if is_known.any() and mean_frame.any()
        else None
    )
    return np.inf if error is None else error


def unmeasured_driven_channels(frames: Inexact[np.ndarray, "F M"], protocol: Protocol) -> Bool[np.ndarray, " M"]:
    """Mask (channels,) of the channels on driven electrodes that are zero in every frame, i.e. were not measured."""
    is_on_driven_electrode = shares_electrode(np.asarray(protocol.drive), np.asarray(protocol.measurement))
    is_driven_channel = is_on_driven_electrode[np.asarray(protocol.drive_index), np.asarray(protocol.measurement_index)]
    is_zero = (np.atleast_2d(frames) == 0).all(axis=0)
    return is_driven_channel & is_zero & ~is_zero.all()


def correct_signs(measurement: Measurement, like: Measurement | None = None) -> Measurement:
    """The measurement with corrected signs of the voltages, and a note if a sign is changed. If all voltages have the
    same sign, i.e. are magnitudes, they receive the signs of a passive body; if their signs are opposite to those of
    `like`, a measurement of the same sensor, all signs are reversed."""
    voltage_values, usable_mask = np.asarray(measurement.voltages), np.asarray(measurement.mask)
    if like is not None and like.protocol.same_patterns(measurement.protocol):
        common_channels = usable_mask.all(axis=0) & np.asarray(like.mask).all(axis=0)
        usable_levels, reference_levels = (
            np.real(np.asarray(compared_measurement.voltages)).mean(axis=0)[common_channels]
            for compared_measurement in (measurement, like)
        )
        norm_product = np.linalg.norm(usable_levels) * np.linalg.norm(reference_levels)
        if norm_product and usable_levels @ reference_levels > -_OPPOSITE_SIGN_COSINE * norm_product:
            return measurement  # the signs agree with the reference
        if norm_product and usable_levels @ reference_levels < _OPPOSITE_SIGN_COSINE * norm_product:
            sign_note = f"the voltages are reversed, to agree with '{like.name}' (polarity = \"reversed\")."
            return _replace_voltages(measurement, -voltage_values, sign_note)
    known_voltages = np.real(voltage_values[usable_mask])
    has_one_sign = (known_voltages >= 0).all() or (known_voltages <= 0).all()
    corrected_signs = _passive_body_signs(measurement)
    if (
        corrected_signs is None
        or not has_one_sign
        or not (corrected_signs[usable_mask.any(axis=0)] != 0).all()
        or not known_voltages.any()
    ):
        return measurement
    signed_values = np.abs(np.real(voltage_values)) * corrected_signs
    if (signed_values[usable_mask] == np.real(voltage_values)[usable_mask]).all():
        return measurement
    if (signed_values[usable_mask] == -np.real(voltage_values)[usable_mask]).all():
        sign_note = (
            'all voltages have one sign, the opposite of what a body gives: it is reversed (polarity = "reversed").'
        )
        return _replace_voltages(measurement, -voltage_values, sign_note)
    if np.iscomplexobj(voltage_values):
        return measurement
    return _replace_voltages(
        measurement, signed_values, "the voltages are magnitudes: they are given the signs that a body gives."
    )


def _replace_voltages(measurement: Measurement, new_voltages, change_note: str) -> Measurement:
    return replace(measurement, voltages=new_voltages, notes=(*measurement.notes, change_note))


def _passive_body_signs(measurement: Measurement) -> Float[np.ndarray, " M"] | None:
    """Signs (channels,) of the voltages of a passive body, 0 for signs that depend on the body; None if electrodes are
    not known to follow each other along an edge, or around a solid at one height."""
    electrode_order = boundary_order(measurement)
    if electrode_order is None and isinstance(measurement.domain, Solid) and measurement.electrodes is not None:
        electrode_heights = np.asarray(getattr(measurement.electrodes, "position", np.zeros((0, 3))))[:, -1]
        if len(electrode_heights) and np.ptp(electrode_heights) < 1e-9:
            electrode_order = np.arange(len(electrode_heights))
    return None if electrode_order is None else expected_signs(measurement.protocol, electrode_order)


def channel_gains(measurement: Measurement) -> tuple[Float[np.ndarray, " K"] | None, float | None]:
    """Gains of the measurement patterns, with a geometric mean of 1, for which the first frame obeys reciprocity best,
    and the remaining reciprocity error; None if reciprocity does not determine the gains."""
    protocol, frame_voltages = measurement.protocol, np.asarray(measurement.voltages)[0]
    reciprocal_pairs, voltage_ratios = protocol.reciprocal_pairs()
    is_used = np.asarray(measurement.mask)[0] & (frame_voltages != 0)
    reciprocal_pairs, voltage_ratios = (
        reciprocal_pairs[is_used[reciprocal_pairs].all(axis=1)],
        voltage_ratios[is_used[reciprocal_pairs].all(axis=1)],
    )
    measurement_index, num_patterns = np.asarray(protocol.measurement_index), len(protocol.measurement)
    if len(reciprocal_pairs) < num_patterns:
        return None, None
    # log |v_b / (r v_a)| is the difference of the logarithms of the two gains.
    first_channels, second_channels = reciprocal_pairs.T
    log_ratios = np.log(np.abs(frame_voltages[second_channels] / (voltage_ratios * frame_voltages[first_channels])))
    gain_rows = np.zeros((len(reciprocal_pairs), num_patterns))
    gain_rows[np.arange(len(reciprocal_pairs)), measurement_index[second_channels]] += 1
    gain_rows[np.arange(len(reciprocal_pairs)), measurement_index[first_channels]] -= 1
    if np.linalg.matrix_rank(gain_rows) < num_patterns - 1:
        return None, None
    pair_weights = np.sqrt(np.abs(frame_voltages[first_channels] * frame_voltages[second_channels]))[:, None]
    pattern_gains = np.exp(np.linalg.lstsq(pair_weights * gain_rows, pair_weights[:, 0] * log_ratios, rcond=None)[0])
    remaining_error = reciprocity_error(
        replace(measurement, voltages=np.asarray(measurement.voltages) / pattern_gains[measurement_index])
    )
    return pattern_gains, remaining_error
