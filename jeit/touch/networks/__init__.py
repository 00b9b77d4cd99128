"""Networks that image: from a skin's voltages to a map of how deep it is indented, learnt from simulated touches.

`learn_images` makes the touches of a described skin, trains a network, and keeps it; `read_network` reads it again, and
`ImageNetwork.depth` images frames. Two designs: "three-stages", that of Park et al. 2022, and "unrolled", which is
trained through the skin's forward model.
"""

from __future__ import annotations

from jeit.touch.networks.image_network import DESIGNS, ImageNetwork, read_network, write_network
from jeit.touch.networks.learn import PRESETS, ImageStanding, LearntImages, Preset, learn_images
from jeit.touch.networks.measured import FrameDepth, resting_frame, stream_depths

__all__ = [
    "DESIGNS",
    "PRESETS",
    "FrameDepth",
    "ImageNetwork",
    "ImageStanding",
    "LearntImages",
    "Preset",
    "learn_images",
    "read_network",
    "resting_frame",
    "stream_depths",
    "write_network",
]
