from .description import Description, load_description
from .exchange import from_eidors, from_pyeit, write_table
from .frame_checks import FrameQuality, check_imageable
from .gesture_set import FrameRecording, GestureSet, join, read_frame_recording
from .measurement import Measurement
from .quality import NoiseEstimate, channel_reciprocity_error, estimate_noise, impossible_signs, reciprocity_error
from .registry import read
from .round_skin import RoundSkin, simulate_press
from .screening import mask_spikes, screen
from .transfer import driven_by, transfer_impedance

__all__ = [
    "Description",
    "FrameQuality",
    "FrameRecording",
    "GestureSet",
    "Measurement",
    "NoiseEstimate",
    "RoundSkin",
    "channel_reciprocity_error",
    "check_imageable",
    "driven_by",
    "estimate_noise",
    "from_eidors",
    "from_pyeit",
    "impossible_signs",
    "join",
    "load_description",
    "mask_spikes",
    "read",
    "read_frame_recording",
    "reciprocity_error",
    "screen",
    "simulate_press",
    "transfer_impedance",
    "write_table",
]
