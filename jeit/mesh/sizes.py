"""Check of sizes: those of more than ten metres are nearly always in another unit, and warned of once, where they are
given."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

LARGE = 10.0
"""Metres. No tank or skin is larger."""
_CHECKED: ContextVar[bool] = ContextVar("size_checked", default=False)


@contextmanager
def size_checked() -> Iterator[None]:
    """Within it no size is warned of: meshes of a body or of another mesh, whose own size was. Decorates functions."""
    before = _CHECKED.set(True)
    try:
        yield
    finally:
        _CHECKED.reset(before)


def warn_large(extent: float, name: str, across: float = 1.0, *, of_file: bool = False) -> None:
    """Warn if a length in metres, of something `across` times as large, looks like one of another unit, unless a
    warning was given already; `of_file`: where it may come from a file, which can be read in its own unit."""
    if not across * extent > LARGE or _CHECKED.get():
        return
    scale = [f" (a file is read with scale={one})" if of_file else "" for one in ("1e-3", "1e-2", "0.0254")]
    warnings.warn(
        f"{name}: {extent:g} m is large for what electrodes are put on. If the lengths are millimetres, give "
        f"{1e-3 * extent:g}{scale[0]}, if centimetres, {1e-2 * extent:g}{scale[1]}, if inches, "
        f"{0.0254 * extent:g}{scale[2]}: jeit computes in metres.",
        UserWarning,
        stacklevel=4,
    )
