"""Warning about sizes above ten metres, which are nearly always given in another unit."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

LARGE = 10.0
"""Size in metres above which a warning is given: no tank or skin is larger."""
_CHECKED: ContextVar[bool] = ContextVar("size_checked", default=False)


@contextmanager
def size_checked() -> Iterator[None]:
    """Context, or decorator of a function, in which sizes are not warned about: for meshes made from a body or another
    mesh, whose size has been checked before."""
    before = _CHECKED.set(True)
    try:
        yield
    finally:
        _CHECKED.reset(before)


def warn_large(extent: float, name: str, across: float = 1.0, *, of_file: bool = False) -> None:
    """Warn if a length of `extent` metres is probably in another unit, because the object is too large.

    `across`: size of the object divided by this length; `of_file`: whether the length may come from a file, for which
    the message suggests a scale. Inside `size_checked` there is no warning.
    """
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
