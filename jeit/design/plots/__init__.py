"""Plots of electrode layouts: sensitivity maps, virtual taxels, paths of electrodes, and unrolled skins."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
