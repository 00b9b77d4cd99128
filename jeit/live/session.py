"""Live session: frames are read, recorded and imaged in separate threads, and the pictures are published."""

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
from jeit.live.sources import ENDED, MAX_MESSAGES, AbstractSource

# Maximum time in seconds for which frames wait to be imaged. Older frames are not imaged.
_MAX_WAIT = 0.05
# Maximum memory in bytes of the stored results.
_MAX_BYTES = 128_000_000
# Maximum number of waiting frames.
_MAX_WAITING_IN_QUEUE = 256
# Maximum number of different reasons for refusing frames that are counted separately.
_MAX_REASONS = 30
_NUMBER_PATTERN = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")
# Number of frames over which the latency is computed.
_NUM_LATENCIES = 600
# Time in seconds over which the frame rate is measured.
_RATE_TIME_SPAN = 2.0
# Period in seconds with which the quality of the frames is computed.
_QUALITY_PERIOD = 0.5
# Number of successive frames with a different number of channels after which the change is reported.
_NUM_OTHER_LENGTHS = 3
# Maximum number of frames of a reference.
_MAX_REFERENCE_FRAMES = 10_000
# Maximum length of the name of an event.
_MAX_LABEL_LENGTH = 200
# Time in seconds for which the events of skipped frames are stored for a busy program.
_EVENT_STORAGE_TIME = 30.0


@dataclass(frozen=True)
class Result:
    """A frame and its picture.

    **Fields**: `frame`: the frame; `picture`: picture that the view computed from the frame; `latency`: time from the
    frame's last byte until the picture was computed, seconds.

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
    """Live session: records the frames of a source and images them by a view, until the source ends or `stop`.

    One thread reads the frames, and another thread images them. If imaging is slower than the source, some frames are
    not imaged, but all are recorded. Use the session as a context manager, or call `start` and `stop`.

    **Arguments:**

    - `source`: source of the frames.
    - `view`: view that computes a picture from each frame.
    - `recorder`: recorder that records the frames after `record(True)` is called.
    - `history`: time in seconds for which results are stored, in at most 128 MB of memory.
    - `reference`: a measurement of the undisturbed sensor, with which frames are compared to assess their quality; by
      default the reference of the recorder.

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
        self._quality_watch, self._quality, self._rate_watch = QualityWatch(reference), Quality(), RateWatch()
        self._num_channels = None if reference is None else reference.num_channels
        self._frame_length = self._num_channels or 0
        self._num_other_lengths = 0
        self._frames_condition = threading.Condition()
        self._waiting_frames: deque[LiveFrame] = deque()
        self._stored_results: deque[Result] = deque()
        self._num_stored_bytes = 0
        self._has_source_ended = self._is_finished = False
        self._closed = threading.Event()
        self._num_frames_read = self._num_imaged = self._num_dropped = self._num_refused = 0
        self._refusal_reasons: dict[str, list] = {}
        self._status_counts: Counter[FrameStatus] = Counter()
        self._latencies: deque[float] = deque(maxlen=_NUM_LATENCIES)
        self._arrival_times: deque[float] = deque(maxlen=4096)
        self._messages: deque[tuple[float, str]] = deque(maxlen=MAX_MESSAGES)
        self._num_requested, self._collected_frames = 0, []
        self._reference: np.ndarray | None = None
        self._threads: list[threading.Thread] = []

    @property
    def scene(self) -> Scene:
        """Scene of the view: outline, electrodes and names, which are drawn around the pictures."""
        return self.view.scene

    def __enter__(self) -> Session:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Start the threads. Raises `RuntimeError` if the session was started before."""
        if self._threads:
            raise RuntimeError("A session starts once; make another for the same source.")
        self._threads = [
            threading.Thread(target=thread_target, name=f"jeit live {name}", daemon=True)
            for name, thread_target in (
                ("reader", self._read_source),
                ("imaging", self._image_frames),
                ("quality", self._assess_quality),
            )
        ]
        for session_thread in self._threads:
            session_thread.start()

    def stop(self) -> None:
        """Close the source, and end the recording and the threads."""
        self.source.close()
        with self._frames_condition:
            self._has_source_ended = True
            self._frames_condition.notify_all()
        for session_thread in self._threads:
            session_thread.join(5.0)
        self.record(False)

    def wait(self) -> None:
        """Wait until the source has ended and its last frame is imaged."""
        with self._frames_condition:
            while not self._is_finished:
                self._frames_condition.wait(0.5)

    def newest(self, after: int, timeout: float) -> Result | None:
        """Return the newest result if its frame number is above `after`; otherwise wait for a newer result, at most
        `timeout` seconds. Returns None if no newer result arrives, or if the session has ended."""
        end_time = time.monotonic() + timeout
        with self._frames_condition:
            while not (self._stored_results and self._stored_results[-1].frame.number > after):
                remaining_time = end_time - time.monotonic()
                if self._is_finished or remaining_time <= 0:
                    return None
                self._frames_condition.wait(min(remaining_time, 0.5))
            return self._stored_results[-1]

    def result(self, number: int) -> Result | None:
        """Return the last stored result whose frame number is at most `number`; None if there is no such result."""
        with self._frames_condition:
            for stored_result in reversed(self._stored_results):
                if stored_result.frame.number <= number:
                    return stored_result
        return None

    def with_events(self, result: Result, after: int) -> Result:
        """Add to `result` the events of earlier stored results whose frame number is above `after`."""
        with self._frames_condition:
            skipped_results = [
                skipped_result
                for skipped_result in self._stored_results
                if after < skipped_result.frame.number < result.frame.number
            ]
        earlier_events = tuple(event for skipped_result in skipped_results for event in skipped_result.picture.events)
        return replace(result, picture=replace(result.picture, events=(*earlier_events, *result.picture.events)))

    def take_reference(self, count: int) -> None:
        """Take the mean of the next `count` frames, of the undisturbed sensor, as the new reference. Raises
        `ValueError` unless `count` is between 1 and 10,000."""
        if not 1 <= count <= _MAX_REFERENCE_FRAMES:
            raise ValueError(
                f"count must be a number of frames between 1 and {_MAX_REFERENCE_FRAMES:,}; it is {count}."
            )
        with self._frames_condition:
            self._num_requested, self._collected_frames = count, []

    def mark(self, label: str) -> None:
        """Mark an event named `label` at the present time, also in the recording."""
        label = " ".join(label.split())[:_MAX_LABEL_LENGTH] or "event"
        event_time = time.monotonic() - self.source.begun
        self.say(f"Event: {label}")
        if self.recorder is not None:
            self.recorder.mark(event_time, label)

    def record(self, on: bool) -> None:
        """Begin a recording in a new folder (`on`), or end the current recording. `state` reports failures."""
        if self.recorder is None:
            if on:
                self.say("There is nowhere to record to.")
            return
        if not on:
            summary_sentence = self.recorder.stop()
            if summary_sentence:
                self.say(summary_sentence)
            return
        try:
            folder = self.recorder.start()
        except (OSError, ValueError) as error:
            self.say(f"The recording cannot begin: {error}")
            return
        self.say(f"Recording into {folder}.")

    def say(self, sentence: str) -> None:
        """Add `sentence` to the messages for the user."""
        self._messages.append((time.monotonic() - self.source.begun, sentence[:300]))

    def state(self) -> dict[str, Any]:
        """Counters, frame rate, latency, quality, connection, recording and messages, in types of JSON."""
        with self._frames_condition:
            latencies = np.array(self._latencies)
            frame_counters = {
                "read": self._num_frames_read,
                "imaged": self._num_imaged,
                "dropped": self._num_dropped,
                "refused": self._num_refused,
                "reasons": dict(self._refusal_reasons.values()),
                "statuses": {
                    str(image_status): status_count for image_status, status_count in self._status_counts.items()
                },
            }
            signal_quality, has_ended = self._quality, self._has_source_ended
        median_latency, latency_99 = np.quantile(latencies, (0.5, 0.99)).tolist() if latencies.size else (None, None)
        messages = sorted([*self.source.messages.copy(), *self._messages.copy()])[-MAX_MESSAGES:]
        return {
            **frame_counters,
            "rate": self._frame_rate(),
            "latency_median": median_latency,
            "latency_99": latency_99,
            "noise": signal_quality.noise,
            "reciprocity": signal_quality.reciprocity,
            "dead": self._electrode_names(signal_quality.dead),
            "drifting": self._electrode_names(signal_quality.drifting),
            "connection": ENDED if has_ended else self.source.connection,
            "recording": None if self.recorder is None else self.recorder.state(),
            "messages": [{"second": elapsed_seconds, "text": text} for elapsed_seconds, text in messages],
        }

    @property
    def ended(self) -> bool:
        """Whether the source has ended and its last frame is imaged."""
        return self._is_finished

    def _frame_rate(self) -> float:
        """Frames/s in the last two seconds."""
        current_time = time.monotonic()
        with self._frames_condition:
            recent_arrivals = [arrival for arrival in self._arrival_times if arrival > current_time - _RATE_TIME_SPAN]
        time_span = recent_arrivals[-1] - recent_arrivals[0] if len(recent_arrivals) > 1 else 0.0
        return (len(recent_arrivals) - 1) / time_span if time_span > 0 else 0.0

    def _electrode_names(self, electrodes: Sequence[int]) -> list[str]:
        names = self.scene.names
        return [names[electrode] if electrode < len(names) else str(electrode + 1) for electrode in electrodes]

    def _read_source(self) -> None:
        try:
            for frame in self.source:
                if self.recorder is not None:
                    self.recorder.add(frame)
                with self._frames_condition:
                    self._num_frames_read += 1
                    self._arrival_times.append(frame.arrived)
                    self._waiting_frames.append(frame)
                    if len(self._waiting_frames) > _MAX_WAITING_IN_QUEUE:
                        self._waiting_frames.popleft()
                        self._num_dropped += 1
                    self._quality_watch.add(frame)
                    self._collect_reference_frame(frame)
                    self._frames_condition.notify_all()
                self._compare_length(frame)
        except Exception as error:  # devices and files raise errors of many types; the page reports the errors
            self.say(f"The source failed: {error}")
        finally:
            with self._frames_condition:
                self._has_source_ended = True
                self._frames_condition.notify_all()

    def _compare_length(self, frame: LiveFrame) -> None:
        """Report a lasting change of the number of channels of the frames."""
        if isinstance(frame.values, str):
            return
        num_channels = frame.values.size
        self._num_other_lengths = self._num_other_lengths + 1 if num_channels != self._frame_length else 0
        if self._num_other_lengths == _NUM_OTHER_LENGTHS:
            if self._frame_length:
                self.say(f"Frames now have {counted(num_channels, 'channel')}; they had {self._frame_length}.")
            self._frame_length, self._num_other_lengths = num_channels, 0

    def _assess_quality(self) -> None:
        while not self._closed.wait(_QUALITY_PERIOD):
            try:
                signal_quality = self._quality_watch.assess()
            except Exception as error:  # an error here must not end the session
                self.say(f"Noise and electrodes are no longer judged: {type(error).__name__}: {error}")
                return
            with self._frames_condition:
                self._quality = signal_quality
            if rate_sentence := self._rate_watch(self._frame_rate()):
                self.say(rate_sentence)

    def _collect_reference_frame(self, frame: LiveFrame) -> None:
        """Store a frame for the new reference if a new reference was requested."""
        if not self._num_requested or isinstance(frame.values, str):
            return
        if self._num_channels is not None and frame.values.shape != (self._num_channels,):
            return
        if self._collected_frames and self._collected_frames[0].shape != frame.values.shape:
            self._collected_frames = []
        self._collected_frames.append(frame.values)
        if len(self._collected_frames) == self._num_requested:
            self._reference, self._num_requested, self._collected_frames = np.array(self._collected_frames), 0, []

    def _wait_for_frame(self) -> LiveFrame | None:
        """Wait for the next frame to image, and return it; None at the end."""
        with self._frames_condition:
            while not self._waiting_frames:
                if self._has_source_ended:
                    return None
                self._frames_condition.wait(0.5)
            oldest_arrival = time.monotonic() - _MAX_WAIT
            while len(self._waiting_frames) > 1 and self._waiting_frames[0].arrived < oldest_arrival:
                self._waiting_frames.popleft()
                self._num_dropped += 1
            return self._waiting_frames.popleft()

    def _image_frames(self) -> None:
        while (frame := self._wait_for_frame()) is not None:
            self._set_reference()
            try:
                picture = self.view.picture(frame)
            except Exception as error:  # an error of a view must not end the recording
                picture = Picture(None, status=FrameStatus.REFUSED, reason=f"{type(error).__name__}: {error}"[:300])
            self._publish_result(Result(frame, picture, time.monotonic() - frame.arrived))
        self._closed.set()
        with self._frames_condition:
            if self._num_requested:
                self._messages.append(
                    (time.monotonic() - self.source.begun, "The source ended before a new reference.")
                )
            self._is_finished = True
            self._frames_condition.notify_all()

    def _set_reference(self) -> None:
        with self._frames_condition:
            frames, self._reference = self._reference, None
        if frames is None:
            return
        if (relative_change := change_during(frames)) is not None:
            self.say(
                f"The old reference stays: the sensor changed by {100 * relative_change:.2g} % while the new one was "
                "taken. Take it while nothing touches the sensor."
            )
            return
        try:
            self.view.set_reference(frames)
        except ValueError as error:
            self.say(f"The old reference stays: {error}")
            return
        self._quality_watch.replace_reference(frames)
        if self.recorder is not None:
            self.recorder.renew(time.monotonic() - self.source.begun, frames)
        self.say(f"New reference: mean of {counted(len(frames), 'frame')}.")

    def _publish_result(self, frame_result: Result) -> None:
        with self._frames_condition:
            self._stored_results.append(frame_result)
            self._num_stored_bytes += _result_bytes(frame_result)
            oldest_arrival = frame_result.frame.arrived - self.history
            while len(self._stored_results) > 1 and (
                self._num_stored_bytes > _MAX_BYTES or self._stored_results[0].frame.arrived < oldest_arrival
            ):
                self._num_stored_bytes -= _result_bytes(self._stored_results.popleft())
            if frame_result.picture.status == FrameStatus.REFUSED:
                self._num_refused += 1
            else:
                self._num_imaged += 1
                self._latencies.append(frame_result.latency)
            if frame_result.picture.status == FrameStatus.REFUSED:
                self._count_reason(frame_result.picture.reason)
            else:
                self._status_counts[frame_result.picture.status] += 1
            self._frames_condition.notify_all()
        for picture_event in frame_result.picture.events:
            self.say(picture_event)

    def _count_reason(self, refusal_reason: str) -> None:
        """Count a reason why a frame was refused. Reasons that differ only in numbers are counted together."""
        reason_pattern = _NUMBER_PATTERN.sub("#", refusal_reason)
        if reason_pattern not in self._refusal_reasons and len(self._refusal_reasons) >= _MAX_REASONS:
            reason_pattern, refusal_reason = "", "other reasons"
        self._refusal_reasons.setdefault(reason_pattern, [refusal_reason, 0])[1] += 1


def frames(source: AbstractSource, view: AbstractView, *, recorder: Recorder | None = None) -> Iterator[Result]:
    """Yield the newest result of a view each time the program asks, until the source has ended.

    Frames that arrive while the program is busy are skipped; their events precede the events of the next result.

    **Arguments:**

    - `source`: source of the frames.
    - `view`: view that computes a picture from each frame.
    - `recorder`: recorder that records all frames.

    **Example:**

    ```python
    for result in frames(simulated_tank(100.0, limit=20), view):
        print(result.frame.second, result.picture.markers)
    ```
    """
    live_session, last_frame_number = Session(source, view, recorder=recorder, history=_EVENT_STORAGE_TIME), -1
    if recorder is not None:
        live_session.record(True)
    with live_session:
        while True:
            newest_result = live_session.newest(last_frame_number, 0.5)
            if newest_result is not None:
                yield live_session.with_events(newest_result, last_frame_number)
                last_frame_number = newest_result.frame.number
            elif live_session.ended:
                return


def _result_bytes(result: Result) -> int:
    """Memory of a result in bytes."""
    pixels, values = result.picture.pixels, result.frame.values
    return 500 + (0 if pixels is None else pixels.nbytes) + (len(values) if isinstance(values, str) else values.nbytes)
