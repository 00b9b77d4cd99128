"""Plots of touches, contacts, gestures and damage of skins, and of the errors of learnt models."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
