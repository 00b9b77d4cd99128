"""Commands that find or classify touches, or train models for that purpose."""

from __future__ import annotations
