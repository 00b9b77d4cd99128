"""What is heard: kinds of touch, or of anything that sounds, told by the sound of microphones, every 0.1 s.

`read_clips` reads clips in folders, one a class; `Listener.fit` learns them by a network, by trees on hand-made
features or by a linear discriminant, whichever is right most often of what is held out; `Listener.hear` says what a
recording is made of. Beneath: `sound_images`, feature images as Park et al. (2022) have them, and `sound_features`.
"""

from __future__ import annotations

from jeit.touch.listening.feature_images import SoundImages, sound_images
from jeit.touch.listening.heard import Event, Heard
from jeit.touch.listening.labelled_clips import LabelledClips, read_clips
from jeit.touch.listening.levels import Levels
from jeit.touch.listening.listener import Listener
from jeit.touch.listening.modality_network import ModalityNetwork, train_network
from jeit.touch.listening.window_features import sound_features

__all__ = [
    "Event",
    "Heard",
    "LabelledClips",
    "Levels",
    "Listener",
    "ModalityNetwork",
    "SoundImages",
    "read_clips",
    "sound_features",
    "sound_images",
    "train_network",
]
