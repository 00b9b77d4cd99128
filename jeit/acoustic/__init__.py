"""Passive acoustic tomography: an array of microphones under a skin hears a touch, and says where it is.

`read_taps` and `calibrate_microphones` give the decay model of every microphone, kept in a `Calibration`;
`read_recording` and `locate_touches` turn a recording into places and strokes, step by step through `intensities`,
`locate` and `track`. Beneath them: `Localiser`, which is batched and differentiable, and the Cramér-Rao bound.

Rooms: `signal` (recordings, faults, intensities), `calibration` (fits to taps), `localisation` (objectives, minima,
maps, two sources). Beside them: `decay`, the decay models; `microphones`, the array; `surface`, on which
sources are; `noise`; `track`, places in time; `touches`, all of it in one call.
"""

from __future__ import annotations

from jeit.acoustic.calibration.calibrate import calibrate_microphones
from jeit.acoustic.calibration.calibration import Calibration
from jeit.acoustic.localisation.cramer_rao import cramer_rao
from jeit.acoustic.localisation.localiser import Localiser
from jeit.acoustic.localisation.locate import locate
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.signal.intensity import IntensitySettings, intensities, tap_intensities
from jeit.acoustic.signal.recording import (
    Intensities,
    Recording,
    Taps,
    read_recording,
    read_taps,
    write_recording,
    write_taps,
)
from jeit.acoustic.touches import LocatedTouches, locate_touches
from jeit.acoustic.tracking import track
from jeit.arguments.moved import tell_old_names as _tell_old_names

_tell_old_names(__name__)

__all__ = [
    "Calibration",
    "Intensities",
    "IntensitySettings",
    "Localiser",
    "LocatedTouches",
    "MicrophoneArray",
    "Recording",
    "Taps",
    "calibrate_microphones",
    "cramer_rao",
    "intensities",
    "locate",
    "locate_touches",
    "read_recording",
    "read_taps",
    "tap_intensities",
    "track",
    "write_recording",
    "write_taps",
]
