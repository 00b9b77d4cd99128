from .feature_images import SoundImages, sound_images
from .labelled_clips import LabelledClips, read_clips
from .listener import Listener
from .modality_network import ModalityNetwork, train_network
from .sound_labels import Event, SoundLabels
from .window_features import Levels, sound_features

__all__ = [
    "Event",
    "LabelledClips",
    "Levels",
    "Listener",
    "ModalityNetwork",
    "SoundImages",
    "SoundLabels",
    "read_clips",
    "sound_features",
    "sound_images",
    "train_network",
]
