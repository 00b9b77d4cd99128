"""Localisation of the touches in a recording in one call: intensities, the position in each frame, and the track of
each touch."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import numpy as np

from jeit.acoustic.calibration.calibration import Calibration
from jeit.acoustic.localisation.calibrated_intensities import calibrated_intensities
from jeit.acoustic.localisation.locate import GAIN_DRIFT, locate
from jeit.acoustic.localisation.locations import Locations
from jeit.acoustic.signal.intensity import IntensitySettings
from jeit.acoustic.signal.recording import Intensities, Recording
from jeit.acoustic.tracking import Track, track
from jeit_solvers.module import Module

# Rows and columns of the map on which the consistency loss is minimised, as in Park 2022.
_MAP_SHAPE = (200, 200)


class LocatedTouches(Module):
    """Touches located in a recording.

    **Fields**: `intensities`: intensities of the recording; `locations`: position and status of each frame; `track`:
    smoothed positions of the touches; `calibration`, `method`: the calibration and method used.

    **Example:**

    ```python
    located = locate_touches(recording, calibration)
    print([(touch.onset, touch.offset) for touch in located.track.touches])
    ```
    """

    intensities: Intensities
    locations: Locations
    track: Track
    calibration: Calibration
    method: str = eqx.field(static=True)


def locate_touches(
    recording: Recording | Intensities,
    calibration: Calibration,
    *,
    method: str = "likelihood",
    gap: float = 0.15,
    intensity: IntensitySettings | None = None,
    silence: Recording | None = None,
    gain_drift: float = GAIN_DRIFT,
    progress: Callable[[str], None] | None = None,
) -> LocatedTouches:
    """Locate every touch in a recording of microphones, like the command `jeit locate`.

    **Arguments:**

    - `recording`: samples or intensities of the calibrated microphones.
    - `calibration`: the calibrated array.
    - `method`: "likelihood" (maximum likelihood), or "consistency" for the loss of Park 2022, minimised on a map of 200
      × 200 pixels and then refined.
    - `gap`: time without a position after which a touch has ended, seconds.
    - `intensity`: frequency band and windows, for recordings of samples; by default as in the calibration.
    - `silence`: recording of the untouched array, from which the noise floor is estimated if touches never pause.
    - `gain_drift`: standard deviation of the changes of the microphones' gains since the calibration, as a fraction of
      the intensities; see `locate`.
    - `progress`: function called with the name of each step of the computation when the step begins.

    Raises `ValueError` for a recording with another number of microphones than the calibration, fewer than three usable
    microphones, frames farther apart than `gap`, `intensity` or `silence` given for a recording of intensities, and
    values out of range.

    **Example:**

    ```python
    located = locate_touches(recording, calibration)
    write_track(located, "out")
    ```
    """
    report_step = progress or (lambda step: None)
    if intensity is not None and isinstance(recording, Intensities):
        raise ValueError("intensity: band and window are for samples; this recording holds intensities.")
    if not (np.isfinite(gap) and gap > 0):
        raise ValueError(f"gap must be positive, in seconds; it is {gap}.")
    report_step("measure intensities")
    result = calibrated_intensities(recording, calibration, intensity, silence=silence)
    if len(result.times) > 1 and np.median(np.diff(result.times)) > gap:
        raise ValueError(
            f"gap: frames are {np.median(np.diff(result.times)):g} s apart, more than the {gap:g} s that end a touch: "
            "give times in seconds, or a longer gap."
        )
    report_step("locate")
    map_shape = _MAP_SHAPE if method == "consistency" else None
    locations = locate(result, calibration, method=method, map_shape=map_shape, gain_drift=gain_drift)
    report_step("track")
    return LocatedTouches(result, locations, track(locations, gap=gap), calibration, method)
