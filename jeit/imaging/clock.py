"""Progress reports and timing of the steps of imaging."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import contextmanager


class Clock:
    """Reports each step to `progress` and keeps the seconds that it took in `seconds`."""

    def __init__(self, progress: Callable[[str], None] | None):
        self.progress = progress
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, step: str):
        if self.progress is not None:
            self.progress(step)
        start = time.perf_counter()
        yield
        self.seconds[step] = time.perf_counter() - start
