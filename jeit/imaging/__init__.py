"""Imaging in one call: `image_difference` images the difference of two frames, `compare_on_data` compares the rules
that choose the hyperparameter λ on such a difference.

`preparation` checks the data and builds the mesh; `calibration` calibrates the model; `wiring` detects wiring that
differs from its description; `method` contains the settings and the imaging methods; `automatic` chooses a method;
`difference` finds inclusions; `sequence` images many frames at once; `stream_preparation` prepares imaging frame by
frame. Streams of tactile skins are in `jeit.touch`.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved_names import with_moved_names as _with_moved_names

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _load_attribute)
