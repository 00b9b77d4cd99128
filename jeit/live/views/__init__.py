"""Kinds of view: what becomes of a frame, by what is known of the sensor."""

from __future__ import annotations
