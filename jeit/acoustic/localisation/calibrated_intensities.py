"""Intensities of a recording, computed with the frequency band and windows of the calibration."""

from __future__ import annotations

import dataclasses

import numpy as np

from jeit.acoustic.calibration.calibration import Calibration
from jeit.acoustic.signal.faults import describe_faults
from jeit.acoustic.signal.intensity import IntensitySettings, check_settings, intensities
from jeit.acoustic.signal.recording import Intensities, Recording
from jeit.arguments import check_kind

# Ratio of two noise floors above which the floors are considered different.
_MAX_FLOOR_RATIO = 4.0


def calibrated_intensities(
    recording: Recording | Intensities,
    calibration: Calibration,
    intensity: IntensitySettings | None = None,
    *,
    silence: Recording | None = None,
) -> Intensities:
    """Compute the intensities of a recording. A recording of intensities is returned unchanged.

    `intensity`: frequency band and windows, by default as in the calibration. `silence`: recording of the untouched
    array at the same gain, from which the noise floor is estimated. A silence is required if touches never pause; by
    default the floor is estimated from the quietest windows of the recording. Raises `ValueError` for another number of
    microphones than in the calibration, for a `silence` that is louder than the quietest windows of the recording, and
    for arguments of the wrong type.
    """
    recordings = {"recording": recording} if silence is None else {"recording": recording, "silence": silence}
    for name, value in recordings.items():
        check_kind(name, value, (Recording, Intensities), "a Recording or Intensities, as of read_recording(path)")
    check_kind("calibration", calibration, Calibration, "a Calibration, as of Calibration.load(path)")
    check_settings("intensity", intensity)
    for value in recordings.values():
        num_channels = value.samples.shape[0] if isinstance(value, Recording) else value.power.shape[1]
        if num_channels != calibration.num_microphones:
            raise ValueError(
                f"'{value.name}' has {num_channels} microphones and the calibration '{calibration.name}' "
                f"{calibration.num_microphones}; give the calibration of this array."
            )
    if silence is not None and not (isinstance(recording, Recording) and isinstance(silence, Recording)):
        raise ValueError(
            "silence applies to a recording of samples, and must be one itself; recordings of intensities have "
            "their floor."
        )
    if isinstance(recording, Intensities):
        return recording
    settings = intensity or calibration.intensity or IntensitySettings()
    recorded_intensities = intensities(recording, settings)
    if silence is not None:
        return _replace_floor(recorded_intensities, intensities(silence, settings))
    # Noise floors can be compared only if frequency band and windows are those of the calibration.
    if settings != calibration.intensity:
        if calibration.intensity is None:
            return recorded_intensities
        note = "band or window are not the calibration's: its decay models may not hold; calibrate with the same."
        return dataclasses.replace(recorded_intensities, notes=(note,))
    calibration_floor = np.asarray(calibration.microphone_array.noise.floor)
    ratio = np.where(
        calibration.usable, recorded_intensities.floor / np.where(calibration_floor > 0, calibration_floor, np.inf), 0.0
    )
    description = (
        f"the noise floor, taken from the quietest windows, is up to {ratio.max():.3g} times the calibration's"
    )
    floor_faults = describe_faults([description if value > _MAX_FLOOR_RATIO else "" for value in ratio])
    note = (
        f"{floor_faults}. If the recording never pauses, touches count as silence: give a recording of the array "
        "untouched (silence=). If gain, unit, surroundings or microphones have changed, calibrate again."
    )
    return dataclasses.replace(recorded_intensities, notes=(note,)) if floor_faults else recorded_intensities


def _replace_floor(recorded_intensities: Intensities, silence: Intensities) -> Intensities:
    """Replace the noise floor of a recording by the noise floor of `silence`. Microphones that are unusable in the
    silence become unusable in the recording."""
    is_usable = np.asarray(silence.usable.any(axis=0))
    has_floors = (silence.floor > 0) & (recorded_intensities.floor > 0)
    ratio = (
        float(np.median(silence.floor[has_floors] / recorded_intensities.floor[has_floors]))
        if has_floors.any()
        else 1.0
    )
    if ratio > _MAX_FLOOR_RATIO:
        raise ValueError(
            f"silence '{silence.name}' is {ratio:.3g} times as loud as the quietest windows of "
            f"'{recorded_intensities.name}': record the array untouched, at the same gain."
        )
    silence_faults = [
        ("" if is_working else f"in the silence: {fault}")
        for is_working, fault in zip(is_usable, silence.faults, strict=True)
    ]
    faults = ["; ".join(filter(None, pair)) for pair in zip(recorded_intensities.faults, silence_faults, strict=True)]
    return dataclasses.replace(
        recorded_intensities,
        power=recorded_intensities.power + recorded_intensities.floor - silence.floor,
        floor=silence.floor,
        usable=recorded_intensities.usable & is_usable,
        faults=faults,
    )
