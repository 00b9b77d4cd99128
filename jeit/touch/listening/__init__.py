"""Classify touches, or any other sounds, from microphone recordings, every 0.1 s.

`read_clips` reads clips of sound from folders, one per class. `Listener.fit` trains a classifier on clips: a network,
boosted trees on hand-made features, or a linear discriminant, whichever is most accurate on held-out clips.
`Listener.classify` classifies the windows of a recording. The network sees feature images of sound after Park et al.
(2022), which `sound_images` computes; `sound_features` computes the hand-made features.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved_names import with_moved_names as _with_moved_names

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _load_attribute)
