"""Estimate from frames where, how hard and how a skin is touched.

Packages: `contacts` (contacts in images, from frame to frame, in newtons), `learnt` (skins that learn from recorded
presses, without a model), `kohonen` (self-organising maps of frames), `gestures` (touches of a stream, and their
gestures), `health` (cuts, failing electrodes, repair), `attributes` (the resolution of a skin), `training` (of
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
