from .feature_images import SoundImages, sound_images
from .heard import Event, Heard
from .labelled_clips import LabelledClips, read_clips
from .levels import Levels
from .listener import Listener
from .modality_network import ModalityNetwork, train_network
from .window_features import sound_features

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
