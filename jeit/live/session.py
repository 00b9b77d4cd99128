"""A live session: frames are read, recorded and imaged in threads of their own, and the results are published."""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from jeit.inverse.streaming.stream import FrameStatus
from jeit.live.pictures import AbstractView, LiveFrame, Picture, Scene
from jeit.live.sources import ENDED, MESSAGES, AbstractSource

# Seconds for which frames wait for the imaging: older ones are left out of the view.
_PATIENCE = 0.05
# Memory of the pictures that are kept, bytes, frames that wait at most, and kinds of reasons that are counted.
_MOST_BYTES, _MOST_WAITING, _MOST_REASONS = 128_000_000, 256, 30
_NUMBER = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")
# Frames over which latency is summarised, and seconds over which the rate is measured.
_LATENCIES, _RATE_SPAN = 600, 2.0


@dataclass(frozen=True)
class Result:
    """**Fields**: `frame`; `picture`: what the view made of it; `latency`: time from the frame's last byte until the
    picture was made, seconds."""

    frame: LiveFrame
    picture: Picture
    latency: float


class Session:
    """A source whose frames are recorded and turned into pictures by a view, until the source ends or `stop`.

    One thread reads; one images, and leaves frames out of the view, never of the recording, when it falls behind.
    `recorder`: where to record once `record(True)` is called. `history`: seconds for which results are kept; these take
    128 MB at most. Use it as a context manager, or call `start` and `stop`.
    """

    def __init__(self, source: AbstractSource, view: AbstractView, *, recorder: Any = None, history: float = 60.0):
        self.source, self.view, self.recorder, self.history = source, view, recorder, history
        self._changed = threading.Condition()
        self._waiting: deque[LiveFrame] = deque()
        self._results: deque[Result] = deque()
        self._bytes = 0
        self._ended = self._finished = False
        self._read = self._imaged = self._dropped = self._refused = 0
        self._reasons: dict[str, list] = {}
        self._latencies: deque[float] = deque(maxlen=_LATENCIES)
        self._arrivals: deque[float] = deque(maxlen=4096)
        self._messages: deque[tuple[float, str]] = deque(maxlen=MESSAGES)
        self._wanted, self._collected = 0, []
        self._reference: np.ndarray | None = None
        self._threads: list[threading.Thread] = []

    @property
    def scene(self) -> Scene:
        """What is drawn around the pictures of the view."""
        return self.view.scene

    def __enter__(self) -> Session:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Begin to read. Raises `RuntimeError` if it has begun before."""
        if self._threads:
            raise RuntimeError("A session starts once; make another for the same source.")
        self._threads = [
            threading.Thread(target=work, name=f"jeit live {name}", daemon=True)
            for name, work in (("reader", self._reading), ("imaging", self._imaging))
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Close the source, and end the recording and the threads."""
        self.source.close()
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(5.0)
        self.record(False)

    def wait(self) -> None:
        """Wait until the source has ended and its last frame is imaged."""
        with self._changed:
            while not self._finished:
                self._changed.wait(0.5)

    def newest(self, after: int, timeout: float) -> Result | None:
        """The newest result, if the number of its frame is above `after`; else wait for it, `timeout` seconds at most.
        None if there is none by then, or once the session has ended."""
        end = time.monotonic() + timeout
        with self._changed:
            while not (self._results and self._results[-1].frame.number > after):
                left = end - time.monotonic()
                if self._finished or left <= 0:
                    return None
                self._changed.wait(min(left, 0.5))
            return self._results[-1]

    def result(self, number: int) -> Result | None:
        """The last result at or before the frame of a number, or None if none is kept."""
        with self._changed:
            for one in reversed(self._results):
                if one.frame.number <= number:
                    return one
        return None

    def take_reference(self, count: int) -> None:
        """Take the mean of the next `count` frames, of the undisturbed sensor, as the new reference."""
        with self._changed:
            self._wanted, self._collected = count, []

    def mark(self, label: str) -> None:
        """Mark an event now, also in the recording."""
        second = time.monotonic() - self.source.begun
        self.say(f"Event: {label}")
        if self.recorder is not None:
            self.recorder.mark(second, label)

    def record(self, on: bool) -> None:
        """Begin a recording in a new folder, or end the one under way."""
        if self.recorder is not None:
            self.recorder.start() if on else self.recorder.stop()

    def say(self, sentence: str) -> None:
        """Keep a message for the user."""
        self._messages.append((time.monotonic() - self.source.begun, sentence[:300]))

    def state(self) -> dict[str, Any]:
        """Counters, rate, latency, quality, connection, recording and messages, as JSON can hold them."""
        with self._changed:
            latencies = np.array(self._latencies)
            reasons = {text: number for text, number in self._reasons.values()}
            arrivals = [one for one in self._arrivals if one > time.monotonic() - _RATE_SPAN]
            counters = {
                "read": self._read,
                "imaged": self._imaged,
                "dropped": self._dropped,
                "refused": self._refused,
                "reasons": reasons,
            }
        said = sorted([*self.source.messages, *self._messages])[-MESSAGES:]
        median, high = np.quantile(latencies, (0.5, 0.99)).tolist() if latencies.size else (None, None)
        span = arrivals[-1] - arrivals[0] if len(arrivals) > 1 else 0.0
        return {
            **counters,
            "rate": (len(arrivals) - 1) / span if span > 0 else 0.0,
            "latency_median": median,
            "latency_99": high,
            "noise": None,
            "reciprocity": None,
            "dead": [],
            "drifting": [],
            "connection": ENDED if self._ended else self.source.connection,
            "recording": None if self.recorder is None else self.recorder.state(),
            "messages": [{"second": second, "text": text} for second, text in said],
        }

    def _reading(self) -> None:
        try:
            for frame in self.source:
                if self.recorder is not None:
                    self.recorder.add(frame)
                with self._changed:
                    self._read += 1
                    self._arrivals.append(frame.arrived)
                    self._waiting.append(frame)
                    if len(self._waiting) > _MOST_WAITING:
                        self._waiting.popleft()
                        self._dropped += 1
                    self._collect(frame)
                    self._changed.notify_all()
        except Exception as error:  # of any device or file: the page reports it
            self.say(f"The source failed: {error}")
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _collect(self, frame: LiveFrame) -> None:
        """Keep a frame for the new reference, if one is wanted."""
        if not self._wanted or isinstance(frame.values, str):
            return
        if self._collected and len(self._collected[0]) != len(frame.values):
            return
        self._collected.append(frame.values)
        if len(self._collected) == self._wanted:
            self._reference, self._wanted, self._collected = np.array(self._collected), 0, []

    def _take(self) -> LiveFrame | None:
        """Wait for the next frame to image; None at the end."""
        with self._changed:
            while not self._waiting:
                if self._ended:
                    return None
                self._changed.wait(0.5)
            old = time.monotonic() - _PATIENCE
            while len(self._waiting) > 1 and self._waiting[0].arrived < old:
                self._waiting.popleft()
                self._dropped += 1
            return self._waiting.popleft()

    def _imaging(self) -> None:
        while (frame := self._take()) is not None:
            self._set_reference()
            try:
                picture = self.view.picture(frame)
            except Exception as error:  # a fault of a view must not end the recording
                picture = Picture(None, status=FrameStatus.REFUSED, reason=f"{type(error).__name__}: {error}"[:300])
            self._publish(Result(frame, picture, time.monotonic() - frame.arrived))
        with self._changed:
            self._finished = True
            self._changed.notify_all()

    def _set_reference(self) -> None:
        frames, self._reference = self._reference, None
        if frames is None:
            return
        try:
            self.view.set_reference(frames)
            self.say(f"New reference: mean of {len(frames)} frames.")
        except ValueError as error:
            self.say(f"The old reference stays: {error}")

    def _publish(self, result: Result) -> None:
        with self._changed:
            self._results.append(result)
            self._bytes += _size(result)
            oldest = result.frame.arrived - self.history
            while self._bytes > _MOST_BYTES or self._results[0].frame.arrived < oldest:
                self._bytes -= _size(self._results.popleft())
            if result.picture.status == FrameStatus.REFUSED:
                self._refused += 1
            else:
                self._imaged += 1
                self._latencies.append(result.latency)
            if result.picture.reason:
                self._count(result.picture.reason)
            self._changed.notify_all()
        for event in result.picture.events:
            self.say(event)

    def _count(self, reason: str) -> None:
        """Count a reason; those that differ by numbers only are one kind."""
        kind = _NUMBER.sub("#", reason)
        if kind not in self._reasons and len(self._reasons) >= _MOST_REASONS:
            kind, reason = "", "other reasons"
        self._reasons.setdefault(kind, [reason, 0])[1] += 1


def frames(source: AbstractSource, view: AbstractView, *, recorder: Any = None) -> Iterator[Result]:
    """Yield the newest result of a view each time the program asks, until the source has ended.

    Frames that arrive while the program is busy are skipped; their events are added to the next result's.
    """
    with Session(source, view, recorder=recorder, history=5.0) as session:
        last = -1
        while True:
            result = session.newest(last, 0.5)
            if result is None:
                if session._finished:
                    return
                continue
            yield result
            last = result.frame.number


def _size(result: Result) -> int:
    """Memory of a result, bytes."""
    pixels, values = result.picture.pixels, result.frame.values
    return 500 + (0 if pixels is None else pixels.nbytes) + (len(values) if isinstance(values, str) else values.nbytes)
