from .clips import SoundClip, sound_clips
from .manners import MODALITIES, SOUND_MANNERS
from .sounding_person import SoundingPerson

__all__ = [
    "MODALITIES",
    "SOUND_MANNERS",
    "SoundClip",
    "SoundingPerson",
    "sound_clips",
]
