"""Measured data: readers, checks of what was measured, and writing it out again.

`read(path)` gives a `Measurement`: voltages, mask, protocol, electrodes, outline. `check_imageable` says
whether a frame can be imaged against a reference.
"""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.data.description import load_description
from jeit.data.export import write_table
from jeit.data.frame_recording import FrameRecording, read_frame_recording
from jeit.data.gesture_set import GestureSet
from jeit.data.imageable import check_imageable
from jeit.data.measurement import Measurement
from jeit.data.quality import estimate_noise, impossible_signs, reciprocity_error
from jeit.data.registry import read
from jeit.data.screening import screen
from jeit.data.series import join
from jeit.data.transfer import driven_by, transfer_impedance

_tell_old_names(__name__)

__all__ = [
    "FrameRecording",
    "GestureSet",
    "Measurement",
    "check_imageable",
    "driven_by",
    "estimate_noise",
    "impossible_signs",
    "join",
    "load_description",
    "read",
    "read_frame_recording",
    "reciprocity_error",
    "screen",
    "transfer_impedance",
    "write_table",
]
