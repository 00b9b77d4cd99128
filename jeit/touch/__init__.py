"""From frames to meaning: where, how hard and how a skin is touched.

Rooms: `contacts` (what an image shows, from frame to frame, in newtons), `learnt` (skins that learn from recorded
presses, without a model), `kohonen` (maps that order frames by themselves), `gestures` (touches of a stream, and what
they mean), `health` (cuts, electrodes that fail, repair), `attributes` (how finely a skin feels), `training` (of
networks, and their files), `networks` (that image).

`LogitBoostClassifier` is imported when it is first used, and scikit-learn with it.
"""

from __future__ import annotations

import lazy_loader

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str):
    if name == "LogitBoostClassifier":
        from jeit.arguments.extras import optional

        optional("sklearn", name)
    return _find(name)
