"""Estimate from frames of voltages where and how hard a skin is touched, and with which object.

Contacts are detected in images and tracked, and their loads estimated in newtons. Learnt skins and self-organising maps
need recorded presses, but no forward model. Further functions and classes are for gestures, the health of a skin (cuts,
failing electrodes, repair), its attributes (resolution), sounds of touches, networks that estimate maps of indentation
depth, the training of networks, and the simulation of presses, people and damage. The functions `plot_…` draw results.
The functions and classes that users need are exported here.

`LogitBoostClassifier`, and scikit-learn with it, is imported when it is first used.
"""

from __future__ import annotations

import lazy_loader

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str):
    if name == "LogitBoostClassifier":
        from jeit.arguments.extras import import_optional

        import_optional("sklearn", name)
    return _load_attribute(name)
