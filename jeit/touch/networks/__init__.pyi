from .image_network import DESIGNS, ImageNetwork, read_network, write_network
from .learn import PRESETS, ImageStanding, LearntImages, NetworkPreset, learn_images
from .measured import FrameDepth, resting_frame, stream_depths

__all__ = [
    "DESIGNS",
    "PRESETS",
    "FrameDepth",
    "ImageNetwork",
    "ImageStanding",
    "LearntImages",
    "NetworkPreset",
    "learn_images",
    "read_network",
    "resting_frame",
    "stream_depths",
    "write_network",
]
