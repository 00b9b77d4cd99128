"""A live session: frames are read, recorded and imaged in threads of their own, and the results are published."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jeit.arguments import counted
from jeit.data import Measurement
from jeit.inverse.streaming.stream import FrameStatus
from jeit.live.pictures import AbstractView, LiveFrame, Picture, Scene
from jeit.live.quality import Quality, QualityWatch, RateWatch, change_during
from jeit.live.recording import Recorder
from jeit.live.sources import ENDED, MESSAGES, AbstractSource

# Seconds for which frames wait for the imaging: older ones are left out of the view.
_PATIENCE = 0.05
# Memory of the pictures that are kept, bytes, frames that wait at most, and kinds of reasons that are counted.
_MOST_BYTES, _MOST_WAITING, _MOST_REASONS = 128_000_000, 256, 30
_NUMBER = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")
# Frames over which latency is summarised; seconds over which the rate is measured, and from one look at the quality of
# the frames to the next.
_LATENCIES, _RATE_SPAN, _LOOK = 600, 2.0, 0.5
# Frames of another number of channels, one after another, that are reported; most frames of a reference.
_OTHERS, _MOST_REFERENCE = 3, 10_000
# Longest name of an event; seconds for which events of skipped frames are kept for a program that is busy.
_LABEL, _SKIPPED = 200, 30.0


@dataclass(frozen=True)
class Result:
    """A frame, and what was made of it.

    **Fields**: `frame`: the frame; `picture`: what the view made of it; `latency`: time from the frame's last byte
    until the picture was made, seconds.

    **Example:**

    ```python
    result = next(frames(simulated_tank(100.0, limit=20), view))
    print(isinstance(result, Result), result.latency)
    ```
    """

    frame: LiveFrame
    picture: Picture
    latency: float


class Session:
    """A source whose frames are recorded and turned into pictures by a view, until the source ends or `stop`.

    One thread reads; one images, and leaves frames out of the view, never of the recording, when it falls behind. Use
    it as a context manager, or call `start` and `stop`.

    **Arguments:**

    - `source`: the source.
    - `view`: the view of its frames.
    - `recorder`: where to record once `record(True)` is called.
    - `history`: seconds for which results are kept; these take 128 MB at most.
    - `reference`: a measurement of the undisturbed sensor, by which the quality of frames is judged; by default that of
      the recorder.

    **Example:**

    ```python
    with Session(simulated_tank(100.0, limit=20), view) as session:
        print(session.newest(after=-1, timeout=5.0))
    ```
    """

    def __init__(
        self,
        source: AbstractSource,
        view: AbstractView,
        *,
        recorder: Recorder | None = None,
        history: float = 60.0,
        reference: Measurement | None = None,
    ):
        self.source, self.view, self.recorder, self.history = source, view, recorder, history
        if reference is None and recorder is not None:
            reference = recorder.reference
        self._watch, self._quality, self._rates = QualityWatch(reference), Quality(), RateWatch()
        self._channels = None if reference is None else reference.num_channels
        self._length = self._channels or 0
        self._others = 0
        self._changed = threading.Condition()
        self._waiting: deque[LiveFrame] = deque()
        self._results: deque[Result] = deque()
        self._bytes = 0
        self._ended = self._finished = False
        self._closed = threading.Event()
        self._read = self._imaged = self._dropped = self._refused = 0
        self._reasons: dict[str, list] = {}
        self._statuses: Counter[FrameStatus] = Counter()
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
            for name, work in (("reader", self._reading), ("imaging", self._imaging), ("quality", self._judging))
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

    def with_events(self, result: Result, after: int) -> Result:
        """A result with the events of those kept before it, of frames above `after`, too."""
        with self._changed:
            skipped = [one for one in self._results if after < one.frame.number < result.frame.number]
        before = tuple(event for one in skipped for event in one.picture.events)
        return replace(result, picture=replace(result.picture, events=(*before, *result.picture.events)))

    def take_reference(self, count: int) -> None:
        """Take the mean of the next `count` frames, of the undisturbed sensor, as the new reference. Raises
        `ValueError` unless `count` is between 1 and 10,000."""
        if not 1 <= count <= _MOST_REFERENCE:
            raise ValueError(f"count must be a number of frames between 1 and {_MOST_REFERENCE:,}; it is {count}.")
        with self._changed:
            self._wanted, self._collected = count, []

    def mark(self, label: str) -> None:
        """Mark an event now, also in the recording."""
        label = " ".join(label.split())[:_LABEL] or "event"
        second = time.monotonic() - self.source.begun
        self.say(f"Event: {label}")
        if self.recorder is not None:
            self.recorder.mark(second, label)

    def record(self, on: bool) -> None:
        """Begin a recording in a new folder, or end the one under way. What fails is reported in `state`."""
        if self.recorder is None:
            if on:
                self.say("There is nowhere to record to.")
            return
        if not on:
            ended = self.recorder.stop()
            if ended:
                self.say(ended)
            return
        try:
            folder = self.recorder.start()
        except (OSError, ValueError) as error:
            self.say(f"The recording cannot begin: {error}")
            return
        self.say(f"Recording into {folder}.")

    def say(self, sentence: str) -> None:
        """Keep a message for the user."""
        self._messages.append((time.monotonic() - self.source.begun, sentence[:300]))

    def state(self) -> dict[str, Any]:
        """Counters, rate, latency, quality, connection, recording and messages, as JSON can hold them."""
        with self._changed:
            latencies = np.array(self._latencies)
            counters = {
                "read": self._read,
                "imaged": self._imaged,
                "dropped": self._dropped,
                "refused": self._refused,
                "reasons": dict(self._reasons.values()),
                "statuses": {str(status): count for status, count in self._statuses.items()},
            }
            quality, ended = self._quality, self._ended
        median, high = np.quantile(latencies, (0.5, 0.99)).tolist() if latencies.size else (None, None)
        said = sorted([*self.source.messages.copy(), *self._messages.copy()])[-MESSAGES:]
        return {
            **counters,
            "rate": self._rate(),
            "latency_median": median,
            "latency_99": high,
            "noise": quality.noise,
            "reciprocity": quality.reciprocity,
            "dead": self._names(quality.dead),
            "drifting": self._names(quality.drifting),
            "connection": ENDED if ended else self.source.connection,
            "recording": None if self.recorder is None else self.recorder.state(),
            "messages": [{"second": second, "text": text} for second, text in said],
        }

    @property
    def ended(self) -> bool:
        """Whether the source has ended and its last frame is imaged."""
        return self._finished

    def _rate(self) -> float:
        """Frames/s in the last two seconds."""
        now = time.monotonic()
        with self._changed:
            recent = [one for one in self._arrivals if one > now - _RATE_SPAN]
        span = recent[-1] - recent[0] if len(recent) > 1 else 0.0
        return (len(recent) - 1) / span if span > 0 else 0.0

    def _names(self, electrodes: Sequence[int]) -> list[str]:
        names = self.scene.names
        return [names[one] if one < len(names) else str(one + 1) for one in electrodes]

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
                    self._watch.add(frame)
                    self._collect(frame)
                    self._changed.notify_all()
                self._compare_length(frame)
        except Exception as error:  # of any device or file: the page reports it
            self.say(f"The source failed: {error}")
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _compare_length(self, frame: LiveFrame) -> None:
        """Report frames whose number of channels has changed and stays changed."""
        if isinstance(frame.values, str):
            return
        length = frame.values.size
        self._others = self._others + 1 if length != self._length else 0
        if self._others == _OTHERS:
            if self._length:
                self.say(f"Frames now have {counted(length, 'channel')}; they had {self._length}.")
            self._length, self._others = length, 0

    def _judging(self) -> None:
        while not self._closed.wait(_LOOK):
            try:
                quality = self._watch.look()
            except Exception as error:  # a fault here must not be one of the session
                self.say(f"Noise and electrodes are no longer judged: {type(error).__name__}: {error}")
                return
            with self._changed:
                self._quality = quality
            if said := self._rates(self._rate()):
                self.say(said)

    def _collect(self, frame: LiveFrame) -> None:
        """Keep a frame for the new reference, if one is wanted."""
        if not self._wanted or isinstance(frame.values, str):
            return
        if self._channels is not None and frame.values.shape != (self._channels,):
            return
        if self._collected and self._collected[0].shape != frame.values.shape:
            self._collected = []
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
        self._closed.set()
        with self._changed:
            if self._wanted:
                self._messages.append(
                    (time.monotonic() - self.source.begun, "The source ended before a new reference.")
                )
            self._finished = True
            self._changed.notify_all()

    def _set_reference(self) -> None:
        with self._changed:
            frames, self._reference = self._reference, None
        if frames is None:
            return
        if (change := change_during(frames)) is not None:
            self.say(
                f"The old reference stays: the sensor changed by {100 * change:.2g} % while the new one was taken. "
                "Take it while nothing touches the sensor."
            )
            return
        try:
            self.view.set_reference(frames)
        except ValueError as error:
            self.say(f"The old reference stays: {error}")
            return
        self._watch.renew(frames)
        if self.recorder is not None:
            self.recorder.renew(time.monotonic() - self.source.begun, frames)
        self.say(f"New reference: mean of {counted(len(frames), 'frame')}.")

    def _publish(self, result: Result) -> None:
        with self._changed:
            self._results.append(result)
            self._bytes += _size(result)
            oldest = result.frame.arrived - self.history
            while len(self._results) > 1 and (self._bytes > _MOST_BYTES or self._results[0].frame.arrived < oldest):
                self._bytes -= _size(self._results.popleft())
            if result.picture.status == FrameStatus.REFUSED:
                self._refused += 1
            else:
                self._imaged += 1
                self._latencies.append(result.latency)
            if result.picture.status == FrameStatus.REFUSED:
                self._count(result.picture.reason)
            else:
                self._statuses[result.picture.status] += 1
            self._changed.notify_all()
        for event in result.picture.events:
            self.say(event)

    def _count(self, reason: str) -> None:
        """Count a reason; those that differ by numbers only are one kind."""
        kind = _NUMBER.sub("#", reason)
        if kind not in self._reasons and len(self._reasons) >= _MOST_REASONS:
            kind, reason = "", "other reasons"
        self._reasons.setdefault(kind, [reason, 0])[1] += 1


def frames(source: AbstractSource, view: AbstractView, *, recorder: Recorder | None = None) -> Iterator[Result]:
    """Yield the newest result of a view each time the program asks, until the source has ended.

    Frames that arrive while the program is busy are skipped; their events are added before those of the next result.

    **Arguments:**

    - `source`: the source.
    - `view`: the view of its frames.
    - `recorder`: where all frames are recorded.

    **Example:**

    ```python
    for result in frames(simulated_tank(100.0, limit=20), view):
        print(result.frame.second, result.picture.markers)
    ```
    """
    session, last = Session(source, view, recorder=recorder, history=_SKIPPED), -1
    if recorder is not None:
        session.record(True)
    with session:
        while True:
            result = session.newest(last, 0.5)
            if result is not None:
                yield session.with_events(result, last)
                last = result.frame.number
            elif session.ended:
                return


def _size(result: Result) -> int:
    """Memory of a result, bytes."""
    pixels, values = result.picture.pixels, result.frame.values
    return 500 + (0 if pixels is None else pixels.nbytes) + (len(values) if isinstance(values, str) else values.nbytes)
