from .bursts import Burst
from .calibration_recording import calibration_taps
from .microphones import microphone_grid
from .people.clips import SoundClip, sound_clips
from .people.sounding_person import SoundingPerson
from .sound import quiet
from .sounding_skin import SoundingSkin
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
