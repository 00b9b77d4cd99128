"""The page of a live session in the browser: messages to the page, commands from the page, access control, and the
files in `static/`."""

from __future__ import annotations
