"""Measured data: readers of data files, checks of the measurements, and export.

`read(path)` returns a `Measurement`, which contains voltages, mask, protocol, electrodes and body. `check_imageable`
checks whether a frame can be imaged against a reference.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
