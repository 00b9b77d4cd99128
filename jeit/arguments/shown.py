"""How objects are shown in consoles and notebooks: in a line or two, and as a picture.

Pictures are drawn by `jeit.report.notebook`, which is imported by its name when the first is drawn: the objects are of
lower layers than reports.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any


def brief(described: Callable[[], str], one: Any) -> str:
    """The text of an object from `described`, or its class alone where it cannot be described: JAX puts other things
    in place of arrays for a while."""
    try:
        return described()
    except Exception:
        return f"<{type(one).__name__}>"


def picture(one: Any) -> bytes | None:
    """PNG of an object for a notebook (`_repr_png_`), or None if it has none, such as a traced one."""
    return importlib.import_module("jeit.report.notebook").picture(one)
