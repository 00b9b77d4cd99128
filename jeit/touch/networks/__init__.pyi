from .depth_maps import FrameDepth, resting_frame, stream_depths
from .image_network import NETWORK_DESIGNS, ImageNetwork, read_network, write_network
from .learn import PRESETS, ImageStanding, LearntImages, NetworkPreset, learn_images

__all__ = [
    "NETWORK_DESIGNS",
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
