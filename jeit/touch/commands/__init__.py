"""Commands of `jeit` that find and classify touches, and train models of touches."""

from __future__ import annotations
