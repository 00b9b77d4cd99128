from .description import load_description
from .exchange import from_eidors, from_pyeit, write_table
from .gesture_set import FrameRecording, GestureSet, join, read_frame_recording
from .imageable import check_imageable
from .measurement import Measurement
from .quality import estimate_noise, impossible_signs, reciprocity_error
from .registry import read
from .round_skin import RoundSkin, simulate_press
from .screening import screen
from .transfer import driven_by, transfer_impedance

__all__ = [
    "FrameRecording",
    "GestureSet",
    "Measurement",
    "RoundSkin",
    "check_imageable",
    "driven_by",
    "estimate_noise",
    "from_eidors",
    "from_pyeit",
    "impossible_signs",
    "join",
    "load_description",
    "read",
    "read_frame_recording",
    "reciprocity_error",
    "screen",
    "simulate_press",
    "transfer_impedance",
    "write_table",
]
