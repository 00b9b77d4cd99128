from .calibration.calibrate import calibrate_microphones
from .calibration.calibration import Calibration
from .localisation.likelihood import cramer_rao
from .localisation.localiser import Localiser
from .localisation.locate import locate
from .microphones import MicrophoneArray
from .signal.intensity import IntensitySettings, intensities, tap_intensities
from .signal.recording import Intensities, Recording, Taps, read_recording, read_taps, write_recording, write_taps
from .touches import LocatedTouches, locate_touches
from .tracking import track

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
