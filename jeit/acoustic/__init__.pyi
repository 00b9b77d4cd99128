from .calibration.calibrate import calibrate_microphones
from .calibration.calibration import Calibration
from .localisation.likelihood import cramer_rao
from .localisation.localiser import Localiser
from .localisation.locate import locate
from .localisation.pixels import map_brightness, overlay_images
from .localisation.two_sources import locate_two
from .microphones import MicrophoneArray
from .plots import MapMarks, plot_error_curve, plot_loss_map, plot_position_errors, plot_receptive_fields, plot_track
from .reports import write_calibration, write_track
from .signal.intensity import IntensitySettings, intensities, tap_intensities
from .signal.recording import Intensities, Recording, Taps, read_recording, read_taps, write_recording, write_taps
from .simulate import (
    Burst,
    SoundingPerson,
    SoundingSkin,
    microphone_grid,
    simulate_calibration_taps,
    simulate_pat,
    simulate_room_sound,
    simulate_silence,
    simulate_sound_clips,
    simulate_stroke,
    simulate_tap,
    simulate_tickle,
    simulate_wind,
)
from .touch_tracks import LocatedTouches, locate_touches, track

__all__ = [
    "Burst",
    "Calibration",
    "Intensities",
    "IntensitySettings",
    "Localiser",
    "LocatedTouches",
    "MapMarks",
    "MicrophoneArray",
    "Recording",
    "SoundingPerson",
    "SoundingSkin",
    "Taps",
    "calibrate_microphones",
    "cramer_rao",
    "intensities",
    "locate",
    "locate_touches",
    "locate_two",
    "map_brightness",
    "microphone_grid",
    "overlay_images",
    "plot_error_curve",
    "plot_loss_map",
    "plot_position_errors",
    "plot_receptive_fields",
    "plot_track",
    "read_recording",
    "read_taps",
    "simulate_calibration_taps",
    "simulate_pat",
    "simulate_room_sound",
    "simulate_silence",
    "simulate_sound_clips",
    "simulate_stroke",
    "simulate_tap",
    "simulate_tickle",
    "simulate_wind",
    "tap_intensities",
    "track",
    "write_calibration",
    "write_recording",
    "write_taps",
    "write_track",
]
