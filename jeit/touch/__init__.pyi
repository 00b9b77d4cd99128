from .attributes import TouchAttributes, touch_attributes
from .contacts import (
    CellFinder,
    Contact,
    ContactTracker,
    ImageNoise,
    LoadCalibration,
    RasterFinder,
    find_contacts,
    track_contacts,
)
from .gestures import GestureModel, TouchLevel, TouchStream, find_touches, touch_features
from .gestures.gesture_learning import LearntGestures, learn_gestures
from .gestures.logit_boost import LogitBoostClassifier
from .gestures.touch_images import TouchImages, untouched_frames
from .gestures.touch_watch import NamedTouch, TouchWatch, WatchedFrame
from .health import HealthEvent, SkinHealth, watch
from .health.health_learning import doubts_of, learn_health
from .kohonen import PlacedMap, SelfOrganisingMap
from .learnt.file import read_skin, write_skin
from .learnt.learnt_skin import LearntSkin, Standing
from .learnt.presses import Presses, Touches, read_frames, read_presses

__all__ = [
    "CellFinder",
    "Contact",
    "ContactTracker",
    "GestureModel",
    "HealthEvent",
    "ImageNoise",
    "LearntGestures",
    "LearntSkin",
    "LoadCalibration",
    "LogitBoostClassifier",
    "NamedTouch",
    "PlacedMap",
    "Presses",
    "RasterFinder",
    "SelfOrganisingMap",
    "SkinHealth",
    "Standing",
    "TouchAttributes",
    "TouchImages",
    "TouchLevel",
    "TouchStream",
    "TouchWatch",
    "Touches",
    "WatchedFrame",
    "doubts_of",
    "find_contacts",
    "find_touches",
    "learn_gestures",
    "learn_health",
    "read_frames",
    "read_presses",
    "read_skin",
    "touch_attributes",
    "touch_features",
    "track_contacts",
    "untouched_frames",
    "watch",
    "write_skin",
]
