from .people import SoundClip, SoundingPerson, simulate_sound_clips
from .sound import Burst, simulate_silence
from .sounding_skin import SoundingSkin, microphone_grid
from .touch_sounds import simulate_calibration_taps, simulate_pat, simulate_stroke, simulate_tap, simulate_tickle
from .wind_sound import simulate_room_sound, simulate_wind

__all__ = [
    "Burst",
    "SoundClip",
    "SoundingPerson",
    "SoundingSkin",
    "microphone_grid",
    "simulate_calibration_taps",
    "simulate_pat",
    "simulate_room_sound",
    "simulate_silence",
    "simulate_sound_clips",
    "simulate_stroke",
    "simulate_tap",
    "simulate_tickle",
    "simulate_wind",
]
