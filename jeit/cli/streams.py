"""Streams on the command line: frames from standard input, with times from a specified frame rate or from the clock;
and the handling of Ctrl-C and SIGTERM. When one of these signals arrives, the frames received so far are written, and
the command ends with an exit status of 128 plus the number of the signal."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import numpy as np
import typer
from jaxtyping import Float

from jeit.arguments import counted
from jeit.cli.console import Steps
from jeit.cli.options import remove_empty_folders

# Minimum time that a live frame must be waited for, as a fraction of the usual interval between frames. Frames that
# arrive sooner were buffered before reading began.
_MIN_RELATIVE_WAITING_TIME = 0.4
# Number of consecutive live frames after which all buffered frames are assumed to have been read.
_NUM_CONSECUTIVE_LIVE_FRAMES = 3
# Maximum time in seconds for reading frames that were buffered before reading began.
_MAX_SKIPPING_DURATION = 5.0
_STOPPING_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_END_OF_FRAMES = object()
# Interval in seconds between reports of the number of frames received.
_FRAME_COUNT_INTERVAL = 0.25


class LiveFrames:
    """Iterator of pairs (time in seconds, frame) over `lines`, the frames that `parse_frames` returns.

    With a `rate`, in frames/s, all frames are used. Without a `rate`, times come from the clock, and frames that
    arrived before reading began are skipped and counted in `left_out`. If the input ends among these frames, as for a
    file, no frame is skipped, and times are computed from the `usual_rate`.
    """

    def __init__(self, lines: Iterator[object], rate: float | None, usual_rate: float):
        self.lines, self.rate, self.usual_rate = lines, rate, usual_rate
        self.by_clock, self.left_out = rate is None, 0
        self.read_frames: list[tuple[float, object]] = []
        self.first_time, self.num_returned = 0.0, 0

    @property
    def measured_rate(self) -> float:
        """Frame rate in frames/s: the specified rate, else the mean rate of the frames read so far, else the usual
        rate."""
        if self.rate is not None:
            return self.rate
        frame_times = [frame_time for frame_time, _ in self.read_frames]
        return (
            (len(frame_times) - 1) / frame_times[-1]
            if len(frame_times) > 1 and frame_times[-1] > 0
            else self.usual_rate
        )

    def initial_frames(self, duration: float) -> Float[np.ndarray, "u M"]:
        """Read the frames (frames, channels) of the first `duration` seconds; iteration returns these frames again.
        Raises `ValueError` if there are none."""
        self._skip_earlier_frames()
        while not self.read_frames or self.read_frames[-1][0] < duration:
            frame = self._next_frame()
            if frame is None:
                break
            self.read_frames.append((self._next_frame_time(), frame))
        numeric_frames = [
            frame for frame_time, frame in self.read_frames if isinstance(frame, list) and frame_time <= duration
        ]
        if not numeric_frames:
            raise ValueError("standard input: there was no frame of numbers in it.")
        channel_counts = [len(numeric_frame) for numeric_frame in numeric_frames]
        usual_num_channels = max(set(channel_counts), key=channel_counts.count)
        return np.array([numeric_frame for numeric_frame in numeric_frames if len(numeric_frame) == usual_num_channels])

    def __iter__(self) -> Iterator[tuple[float, object]]:
        self._skip_earlier_frames()
        yield from self.read_frames
        while (frame := self._next_frame()) is not None:
            yield self._next_frame_time(), frame

    def _skip_earlier_frames(self) -> None:
        """Skip frames that arrived before reading began. If the input ends among these frames, none is skipped, and
        their times are computed from the usual rate."""
        if not self.by_clock:
            return
        skipped_frames, num_live_frames, skipping_start_time = [], 0, time.monotonic()
        while time.monotonic() - skipping_start_time < _MAX_SKIPPING_DURATION:
            wait_start_time = time.monotonic()
            frame = self._next_frame()
            if frame is None:
                self.rate = self.measured_rate
                self.num_returned = len(self.read_frames)
                self.by_clock = False
                self.read_frames += [(self._next_frame_time(), skipped_frame) for skipped_frame in skipped_frames]
                return
            num_live_frames = (
                num_live_frames + 1
                if time.monotonic() - wait_start_time > _MIN_RELATIVE_WAITING_TIME / self.usual_rate
                else 0
            )
            if num_live_frames == _NUM_CONSECUTIVE_LIVE_FRAMES:
                self.left_out += len(skipped_frames)
                self.read_frames.append((self._next_frame_time(), frame))
                return
            skipped_frames.append(frame)
        self.left_out += len(skipped_frames)

    def _next_frame_time(self) -> float:
        current_time = time.monotonic()
        self.first_time = current_time if self.num_returned == 0 else self.first_time
        frame_time = current_time - self.first_time if self.by_clock else self.num_returned / self.measured_rate
        self.num_returned += 1
        return max(frame_time, self.read_frames[-1][0] if self.read_frames else 0.0)

    def _next_frame(self) -> object | None:
        """Wait for the next frame, and return it; None after the last frame."""
        return next(self.lines, None)


class _StoppedError(Exception):
    """Error raised to skip the drawing of pictures when a signal has stopped a stream."""


class StreamStopper:
    """Context manager that stops a stream on Ctrl-C and SIGTERM: the iterator of `frames_until_signal` ends after the
    current frame, or immediately if it waits for the next frame. A second signal, or a signal before the first frame,
    stops the command immediately."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._is_streaming, self._is_waiting = False, False
        self._earlier_signal_handlers: dict[int, Any] = {}

    def frames_until_signal(self, frames: Iterable) -> Iterator:
        """Iterate over the frames until a signal arrives."""
        self._is_streaming = True
        frame_iterator = iter(frames)
        try:
            while True:
                self._is_waiting = True
                if self.signal is not None:
                    return
                frame = next(frame_iterator, _END_OF_FRAMES)
                self._is_waiting = False
                if frame is _END_OF_FRAMES:
                    return
                yield frame
        except KeyboardInterrupt:
            return
        finally:
            self._is_waiting = False

    def drawing_reporter(self, picture_names: Sequence[str], step: Steps) -> Callable[[str], None]:
        """Create a function that reports writing and drawing as steps, and raises `_StoppedError` before drawing if a
        signal has arrived."""

        def report(task: str) -> None:
            step_name = "draw" if task.partition(":")[0] in picture_names else "write"
            if step_name == "draw" and self.signal is not None:
                raise _StoppedError
            if step.current_step_name != step_name:
                step(step_name)
            step.report(task)

        return report

    @contextmanager
    def exit_after_signal(self, frame_counter: "FrameCounter", *files: str) -> Iterator[None]:
        """Context manager that, if a signal has arrived, prints the number of frames received and the `files` that
        contain them, and exits the command."""
        try:
            yield
            files_hint = f"; {' and '.join(files)} have them"
        except (_StoppedError, ValueError) as error:
            if self.signal is None:
                raise
            files_hint = f"; {' and '.join(files)} have them" if isinstance(error, _StoppedError) else ""
        except KeyboardInterrupt:
            if self.signal is None or frame_counter.number:
                raise
            files_hint = ""  # the command was stopped before the first frame, during compilation
        if self.signal is not None:
            self._exit_command(f" after {counted(frame_counter.number, 'frame')}{files_hint}")

    def _exit_command(self, message_end: str) -> NoReturn:
        remove_empty_folders()
        print(f"jeit: stopped{message_end}.", file=sys.stderr)
        raise typer.Exit(128 + (self.signal or 0))

    def __enter__(self) -> "StreamStopper":
        if threading.current_thread() is threading.main_thread():
            handled_signals = [
                signal_number
                for signal_number in _STOPPING_SIGNALS
                if signal.getsignal(signal_number) is not signal.SIG_IGN
            ]
            self._earlier_signal_handlers = {
                signal_number: signal.signal(signal_number, self._handle_signal) for signal_number in handled_signals
            }
        return self

    def __exit__(self, kind: type[BaseException] | None, *_) -> None:
        for signal_number, handler in self._earlier_signal_handlers.items():
            signal.signal(signal_number, handler)
        if kind is KeyboardInterrupt and self.signal is not None:
            self._exit_command("")

    def _handle_signal(self, signal_number: int, _) -> None:
        stops_immediately = self.signal is not None or self._is_waiting or not self._is_streaming
        self.signal = signal_number
        if stops_immediately:
            raise KeyboardInterrupt


class FrameCounter:
    """Counter of received frames, which reports their number a few times per second. `num_frames`: total number of
    frames, if known."""

    def __init__(self, step: Steps, num_frames: int | None = None):
        self._steps, self._total_text = step, "" if num_frames is None else f" of {num_frames:,}"
        self.number, self._last_report_time = 0, 0.0

    def count_frame(self) -> None:
        """Count a frame."""
        self.number += 1
        current_time = time.monotonic()
        if current_time - self._last_report_time > _FRAME_COUNT_INTERVAL:
            self._last_report_time = current_time
            self._steps.report(f"frame {self.number:,}{self._total_text}")
