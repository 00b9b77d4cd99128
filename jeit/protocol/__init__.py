"""Protocols: matrices of driven currents and of measured voltages, with names and units."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
