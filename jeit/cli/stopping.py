"""Handling of Ctrl-C and SIGTERM during streaming: the frames received so far are written, and the exit status is that
of the signal."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import typer

from jeit.arguments import counted
from jeit.cli.console import Steps
from jeit.cli.options import remove_empty_folders

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_END_OF_FRAMES = object()
# Interval in seconds between reports of the number of frames received.
_REPORT_INTERVAL = 0.25


class _StoppedError(Exception):
    """Error raised to skip the remaining work when a stream was stopped."""


class Stopping:
    """Context manager that stops a stream on Ctrl-C and SIGTERM: the iterator of `until` ends after the current frame,
    or at once while waiting for the next frame. A second signal, or a signal before the first frame, stops the command
    at once."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._streaming, self._waiting = False, False
        self._earlier_handlers: dict[int, Any] = {}

    def until(self, frames: Iterable) -> Iterator:
        """Iterate over the frames until a signal arrives."""
        self._streaming = True
        source = iter(frames)
        try:
            while True:
                self._waiting = True
                if self.signal is not None:
                    return
                frame = next(source, _END_OF_FRAMES)
                self._waiting = False
                if frame is _END_OF_FRAMES:
                    return
                yield frame
        except KeyboardInterrupt:
            return
        finally:
            self._waiting = False

    def before(self, pictures: Sequence[str], step: Steps) -> Callable[[str], None]:
        """Create a function that reports writing and drawing as steps, and skips drawing after a signal."""

        def report(task: str) -> None:
            step_name = "draw" if task.partition(":")[0] in pictures else "write"
            if step_name == "draw" and self.signal is not None:
                raise _StoppedError
            if step.under_way != step_name:
                step(step_name)
            step.report(task)

        return report

    @contextmanager
    def ending(self, frame_counter: "FrameCounter", *files: str) -> Iterator[None]:
        """Context manager that exits the command at its end if a signal has arrived, and prints the number of frames
        received and the `files` that contain them."""
        try:
            yield
            hint = f"; {' and '.join(files)} have them"
        except (_StoppedError, ValueError) as error:
            if self.signal is None:
                raise
            hint = f"; {' and '.join(files)} have them" if isinstance(error, _StoppedError) else ""
        except KeyboardInterrupt:
            if self.signal is None or frame_counter.number:
                raise
            hint = ""  # stopped during compilation, before the first frame
        if self.signal is not None:
            self._end(f" after {counted(frame_counter.number, 'frame')}{hint}")

    def _end(self, detail: str) -> NoReturn:
        remove_empty_folders()
        print(f"jeit: stopped{detail}.", file=sys.stderr)
        raise typer.Exit(128 + (self.signal or 0))

    def __enter__(self) -> "Stopping":
        if threading.current_thread() is threading.main_thread():
            handled_signals = [
                signal_number for signal_number in _SIGNALS if signal.getsignal(signal_number) is not signal.SIG_IGN
            ]
            self._earlier_handlers = {
                signal_number: signal.signal(signal_number, self._stop) for signal_number in handled_signals
            }
        return self

    def __exit__(self, kind: type[BaseException] | None, *_) -> None:
        for signal_number, handler in self._earlier_handlers.items():
            signal.signal(signal_number, handler)
        if kind is KeyboardInterrupt and self.signal is not None:
            self._end("")

    def _stop(self, signal_number: int, _) -> None:
        at_once = self.signal is not None or self._waiting or not self._streaming
        self.signal, self._waiting = signal_number, False
        if at_once:
            raise KeyboardInterrupt


class FrameCounter:
    """Counter of frames that reports the number of frames received a few times per second. `number`: total number of
    frames, if known."""

    def __init__(self, step: Steps, num_frames: int | None = None):
        self._step, self._total_text = step, "" if num_frames is None else f" of {num_frames:,}"
        self.number, self._last_report = 0, 0.0

    def one_more(self) -> None:
        """Count a frame."""
        self.number += 1
        now = time.monotonic()
        if now - self._last_report > _REPORT_INTERVAL:
            self._last_report = now
            self._step.report(f"frame {self.number:,}{self._total_text}")
