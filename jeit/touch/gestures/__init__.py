"""Gestures: a stream of images cut into touches, what is measured of each, and which of the learnt gestures it is."""

from __future__ import annotations

from jeit.touch.gestures.change_course import ChangeCourse, TouchLevel
from jeit.touch.gestures.features import COURSE_FEATURES, FEATURES, TouchFeatures, course_features, touch_features
from jeit.touch.gestures.gesture_model import GestureModel, Gestures
from jeit.touch.gestures.segmentation import StreamTouch, TouchStream, find_touches

__all__ = [
    "COURSE_FEATURES",
    "FEATURES",
    "ChangeCourse",
    "GestureModel",
    "Gestures",
    "StreamTouch",
    "TouchFeatures",
    "TouchLevel",
    "TouchStream",
    "course_features",
    "find_touches",
    "touch_features",
]
