"""The `jeit` command: one file for each of its commands, and `app`, which ties them together.

The commands import what they need when they run, so that `jeit --help` answers at once.
"""

from __future__ import annotations

from jeit.cli.app import main

__all__ = [
    "main",
]
