"""Commands of electrode layouts and their studies."""

from __future__ import annotations
