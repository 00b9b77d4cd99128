"""Commands for touches, and for models learnt from them."""

from __future__ import annotations
