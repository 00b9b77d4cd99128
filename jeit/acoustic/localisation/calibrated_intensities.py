"""Intensities of a recording, computed with the band and windows of the calibration."""

from __future__ import annotations

import dataclasses

import numpy as np

from jeit.acoustic.calibration.calibration import Calibration
from jeit.acoustic.signal.faults import describe_faults
from jeit.acoustic.signal.intensity import IntensitySettings, check_settings, intensities
from jeit.acoustic.signal.recording import Intensities, Recording
from jeit.arguments import check_kind

# Ratio of two noise floors above which they are considered different.
_SAME_FLOOR = 4.0


def calibrated_intensities(
    recording: Recording | Intensities,
    calibration: Calibration,
    intensity: IntensitySettings | None = None,
    *,
    silence: Recording | None = None,
) -> Intensities:
    """Compute the intensities of a recording. A recording of intensities is returned unchanged.

    `intensity`: band and windows; by default those of the calibration. `silence`: recording of the untouched array at
    the same gain, from which the noise floor is estimated. It is required if touches never pause; by default the floor
    is estimated from the quietest windows of the recording. Raises `ValueError` for another number of microphones, for
    a `silence` that is louder than the quietest windows of the recording, and for arguments of the wrong type.
    """
    given = {"recording": recording} if silence is None else {"recording": recording, "silence": silence}
    for name, one in given.items():
        check_kind(name, one, (Recording, Intensities), "a Recording or Intensities, as of read_recording(path)")
    check_kind("calibration", calibration, Calibration, "a Calibration, as of Calibration.load(path)")
    check_settings("intensity", intensity)
    for one in given.values():
        number = one.samples.shape[0] if isinstance(one, Recording) else one.power.shape[1]
        if number != calibration.num_microphones:
            raise ValueError(
                f"'{one.name}' has {number} microphones and the calibration '{calibration.name}' "
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
    recorded = intensities(recording, settings)
    if silence is not None:
        return _with_floor_of_silence(recorded, intensities(silence, settings))
    # Noise floors can be compared only if band and windows are those of the calibration.
    if settings != calibration.intensity:
        if calibration.intensity is None:
            return recorded
        note = "band or window are not the calibration's: its decay models may not hold; calibrate with the same."
        return dataclasses.replace(recorded, notes=(note,))
    usual = np.asarray(calibration.microphone_array.noise.floor)
    ratio = np.where(calibration.usable, recorded.floor / np.where(usual > 0, usual, np.inf), 0.0)
    higher = f"the noise floor, taken from the quietest windows, is up to {ratio.max():.3g} times the calibration's"
    text = describe_faults([higher if one > _SAME_FLOOR else "" for one in ratio])
    note = (
        f"{text}. If the recording never pauses, touches count as silence: give a recording of the array untouched "
        "(silence=). If gain, unit, surroundings or microphones have changed, calibrate again."
    )
    return dataclasses.replace(recorded, notes=(note,)) if text else recorded


def _with_floor_of_silence(recorded: Intensities, quiet: Intensities) -> Intensities:
    """Replace the noise floor of a recording by that of `quiet`, a recording of silence. Microphones that are unusable
    in the silence become unusable."""
    known = np.asarray(quiet.usable.any(axis=0))
    both = (quiet.floor > 0) & (recorded.floor > 0)
    ratio = float(np.median(quiet.floor[both] / recorded.floor[both])) if both.any() else 1.0
    if ratio > _SAME_FLOOR:
        raise ValueError(
            f"silence '{quiet.name}' is {ratio:.3g} times as loud as the quietest windows of '{recorded.name}': record "
            "the array untouched, at the same gain."
        )
    silence_faults = [
        ("" if good else f"in the silence: {fault}") for good, fault in zip(known, quiet.faults, strict=True)
    ]
    faults = ["; ".join(filter(None, pair)) for pair in zip(recorded.faults, silence_faults, strict=True)]
    return dataclasses.replace(
        recorded,
        power=recorded.power + recorded.floor - quiet.floor,
        floor=quiet.floor,
        usable=recorded.usable & known,
        faults=faults,
    )
