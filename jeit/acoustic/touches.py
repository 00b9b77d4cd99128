"""Localisation of touches in one call: intensities, the position in every frame, and the track of every touch."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import numpy as np

from jeit.acoustic.calibration.calibration import Calibration
from jeit.acoustic.localisation.calibrated_intensities import calibrated_intensities
from jeit.acoustic.localisation.locate import locate
from jeit.acoustic.localisation.locations import Locations
from jeit.acoustic.signal.intensity import IntensitySettings
from jeit.acoustic.signal.recording import Intensities, Recording
from jeit.acoustic.tracking import Track, track

# Pixels of the map on which the paper's loss is minimised.
_PAPERS_MAP = (200, 200)


class LocatedTouches(eqx.Module):
    """Touches located in a recording: its `intensities`, the `locations` of its frames, and the `track` through them;
    with the `calibration` and the `method` used."""

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
    progress: Callable[[str], None] | None = None,
) -> LocatedTouches:
    """Locate every touch of a recording, as `jeit locate` does; `jeit.acoustic.reports.write_track` writes its output
    files.

    `method`: "likelihood", or "consistency" for the paper's loss on a map of 200 × 200 pixels, refined. `gap`: seconds
    without a place that end a touch. `intensity`: band and window, for samples, those of the calibration unless given.
    `silence`: samples of the array untouched, for the noise floor of a recording that never pauses. `progress` is
    called with the name of each step as it begins.

    Raises `ValueError` for a recording of another number of microphones, fewer than three of use, frames farther apart
    than `gap`, `intensity` or `silence` for a recording of intensities, and values out of range.
    """
    said = progress or (lambda step: None)
    if intensity is not None and isinstance(recording, Intensities):
        raise ValueError("intensity: band and window are for samples; this recording holds intensities.")
    if not (np.isfinite(gap) and gap > 0):
        raise ValueError(f"gap must be positive, in seconds; it is {gap}.")
    said("measure intensities")
    result = calibrated_intensities(recording, calibration, intensity, silence=silence)
    if len(result.times) > 1 and np.median(np.diff(result.times)) > gap:
        raise ValueError(
            f"gap: frames are {np.median(np.diff(result.times)):g} s apart, more than the {gap:g} s that end a touch: "
            "give times in seconds, or a longer gap."
        )
    said("locate")
    map_shape = _PAPERS_MAP if method == "consistency" else None
    locations = locate(result, calibration, method=method, map_shape=map_shape)
    said("track")
    return LocatedTouches(result, locations, track(locations, gap=gap), calibration, method)
