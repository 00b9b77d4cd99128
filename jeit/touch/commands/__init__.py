"""Commands of touches, and of what is learnt from them."""

from __future__ import annotations
