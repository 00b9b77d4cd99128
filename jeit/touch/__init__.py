"""From frames to meaning: where, how hard and how a skin is touched.

Rooms: `contacts` (what an image shows, from frame to frame, in newtons), `learnt` (skins that learn from recorded
presses, without a model), `kohonen` (maps that order frames by themselves), `gestures` (touches of a stream, and what
they mean), `health` (cuts, electrodes that fail, repair), `attributes` (how finely a skin feels), `training` (of
networks, and their files), `networks` (that image).

`LogitBoostClassifier` is imported when it is first used, and scikit-learn with it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jeit.touch.attributes import TouchAttributes, touch_attributes
from jeit.touch.contacts import (
    CellFinder,
    Contact,
    ContactTracker,
    ImageNoise,
    LoadCalibration,
    RasterFinder,
    find_contacts,
    track_contacts,
)
from jeit.touch.gestures import GestureModel, TouchLevel, TouchStream, find_touches, touch_features
from jeit.touch.health import HealthEvent, SkinHealth, watch
from jeit.touch.kohonen import PlacedMap, SelfOrganisingMap
from jeit.touch.learnt.file import read_skin, write_skin
from jeit.touch.learnt.learnt_skin import LearntSkin, Standing
from jeit.touch.learnt.presses import Presses, read_frames, read_presses
from jeit.touch.learnt.touches import Touches

if TYPE_CHECKING:
    from jeit.touch.gestures.logit_boost import LogitBoostClassifier as LogitBoostClassifier


def __getattr__(name: str):
    if name == "LogitBoostClassifier":
        from jeit.arguments.extras import optional

        optional("sklearn", "LogitBoostClassifier")
        from jeit.touch.gestures.logit_boost import LogitBoostClassifier

        return LogitBoostClassifier
    from jeit.arguments.moved import missing

    raise missing(__name__, name)


__all__ = [
    "CellFinder",
    "Contact",
    "ContactTracker",
    "GestureModel",
    "HealthEvent",
    "ImageNoise",
    "LearntSkin",
    "LoadCalibration",
    "LogitBoostClassifier",
    "PlacedMap",
    "Presses",
    "RasterFinder",
    "SelfOrganisingMap",
    "SkinHealth",
    "Standing",
    "TouchAttributes",
    "TouchLevel",
    "TouchStream",
    "Touches",
    "find_contacts",
    "find_touches",
    "read_frames",
    "read_presses",
    "read_skin",
    "touch_attributes",
    "touch_features",
    "track_contacts",
    "watch",
    "write_skin",
]
