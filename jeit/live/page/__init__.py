"""The page of a live session: what is sent to it, what it may ask for, who may open it, and the files in `static/`."""

from __future__ import annotations
