"""From frames to meaning: skins that learn where, how hard and by what they are touched."""

from jeit.touch.learnt.file import read_skin, write_skin
from jeit.touch.learnt.learnt_skin import LearntSkin, Standing
from jeit.touch.learnt.presses import Presses, read_frames, read_presses
from jeit.touch.learnt.touches import Touches

__all__ = [
    "LearntSkin",
    "Presses",
    "Standing",
    "Touches",
    "read_frames",
    "read_presses",
    "read_skin",
    "write_skin",
]
