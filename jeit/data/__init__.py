"""Measured data: readers, checks of what was measured, and writing it out again.

`read(path)` gives a `Measurement`: voltages, mask, protocol, electrodes, outline. `check_imageable` says
whether a frame can be imaged against a reference.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
