"""People who pat, tickle, stroke and blow on a skin with microphones, each in a way of their own."""

from __future__ import annotations

from jeit.simulate.acoustic.people.clips import SoundClip, sound_clips
from jeit.simulate.acoustic.people.manners import MODALITIES, SOUND_MANNERS
from jeit.simulate.acoustic.people.sounding_person import SoundingPerson

__all__ = ["MODALITIES", "SOUND_MANNERS", "SoundClip", "SoundingPerson", "sound_clips"]
