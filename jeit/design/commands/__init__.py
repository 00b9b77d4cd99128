"""Commands for electrode layouts and studies of layouts."""

from __future__ import annotations
