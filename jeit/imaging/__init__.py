"""From two frames to a picture in one call, `image_difference`, and what every rule for λ would choose on the way.

`settings` says how to image, `preparation` checks, meshes and calibrates, `wiring` finds what is not wired as told,
`method` images, `automatic` decides how, `difference` looks for inclusions, `sequence` images many frames at once;
`stream_preparation` makes ready for frame after frame. And from a stream of a touched skin to what it means:
`touch_images`, `gesture_learning`, `touch_watch`; `health_learning`, what it is like while it is healthy.
"""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.imaging.compared_rules import ComparedRules, RuleOutcome, compare_on_data
from jeit.imaging.difference import ImagedDifference, image_difference
from jeit.imaging.frequencies import ImagedFrequencies, frequency_weight, image_frequencies
from jeit.imaging.gesture_learning import LearntGestures, learn_gestures
from jeit.imaging.health_learning import doubts_of, learn_health
from jeit.imaging.method import METHODS
from jeit.imaging.preparation import (
    PreparedDifference,
    calibrated_model,
    imaging_mesh,
    prepare_difference,
    select_frames,
)
from jeit.imaging.sequence import ImagedSequence, image_sequence
from jeit.imaging.settings import CONTACTS, ImagingSettings
from jeit.imaging.stream_preparation import StreamSettings, frames_of, prepare_imager
from jeit.imaging.touch_images import TouchImages, untouched_frames
from jeit.imaging.touch_watch import NamedTouch, TouchWatch, WatchedFrame

_tell_old_names(__name__)

__all__ = [
    "CONTACTS",
    "METHODS",
    "ComparedRules",
    "ImagedDifference",
    "ImagedFrequencies",
    "ImagedSequence",
    "ImagingSettings",
    "LearntGestures",
    "NamedTouch",
    "PreparedDifference",
    "RuleOutcome",
    "StreamSettings",
    "TouchImages",
    "TouchWatch",
    "WatchedFrame",
    "calibrated_model",
    "compare_on_data",
    "doubts_of",
    "frames_of",
    "frequency_weight",
    "image_difference",
    "image_frequencies",
    "image_sequence",
    "imaging_mesh",
    "learn_gestures",
    "learn_health",
    "prepare_difference",
    "prepare_imager",
    "select_frames",
    "untouched_frames",
]
