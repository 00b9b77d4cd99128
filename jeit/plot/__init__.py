"""Plots with matplotlib: meshes, images, solids and surfaces in space, electrodes, sensitivity, voltages, series of
frames, and choices of the hyperparameter.

Most functions take axes `ax`, create a new figure if `ax` is not given, and return the axes. Lengths are in metres in
the arguments and in millimetres in the plots.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved_names import with_moved_names as _with_moved_names

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _load_attribute)
