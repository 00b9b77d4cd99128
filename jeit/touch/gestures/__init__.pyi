from .features import COURSE_FEATURES, FEATURES, TouchFeatures, course_features, touch_features
from .gesture_model import GestureModel, Gestures
from .segmentation import ChangeCourse, StreamTouch, TouchLevel, TouchStream, find_touches

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
