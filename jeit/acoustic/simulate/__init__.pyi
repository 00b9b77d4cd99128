from .calibration_recording import calibration_taps
from .microphones import microphone_grid
from .people import SoundClip, SoundingPerson, sound_clips
from .sound import quiet
from .sounding_skin import SoundingSkin
from .synthesis import Burst
from .touches import pat, stroke, tap, tickle
from .wind_sound import room_sound, wind

__all__ = [
    "Burst",
    "SoundClip",
    "SoundingPerson",
    "SoundingSkin",
    "calibration_taps",
    "microphone_grid",
    "pat",
    "quiet",
    "room_sound",
    "sound_clips",
    "stroke",
    "tap",
    "tickle",
    "wind",
]
