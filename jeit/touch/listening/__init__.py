"""What is heard: kinds of touch, or of anything that sounds, told by the sound of microphones, every 0.1 s.

`read_clips` reads clips in folders, one a class; `Listener.fit` learns them by a network, by trees on hand-made
features or by a linear discriminant, whichever is right most often of what is held out; `Listener.hear` says what a
recording is made of. Beneath: `sound_images`, feature images as Park et al. (2022) have them, and `sound_features`.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
