"""Estimate from frames where, how hard and how a skin is touched.

Packages: `contacts` (detection of contacts in images, tracking, and their loads in newtons), `learnt` (skins that learn
from recorded presses, without a model), `kohonen` (self-organising maps of frames), `gestures` (touches of a stream,
and their gestures), `health` (cuts, failing electrodes, repair), `attributes` (resolution of a skin), `training`
(training of networks, and files of trained networks), `networks` (networks that estimate maps of indentation depth).

`LogitBoostClassifier`, and scikit-learn with it, is imported when it is first used.
"""

from __future__ import annotations

import lazy_loader

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str):
    if name == "LogitBoostClassifier":
        from jeit.arguments.extras import optional

        optional("sklearn", name)
    return _find(name)
