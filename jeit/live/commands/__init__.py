"""Commands of live sessions."""

from __future__ import annotations
