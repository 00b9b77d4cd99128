"""Commands of acoustic localisation."""

from __future__ import annotations
