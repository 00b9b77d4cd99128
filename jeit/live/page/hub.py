"""Distribution of the pictures of a live session to open pages. Each page receives the newest picture, as often as the
page can draw."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from typing import Any

import numpy as np

from jeit.live.page.wire import picture_message, scene_message, to_json
from jeit.live.session import Result, Session

_MAX_SENT_UNDRAWN_PICTURES = 2
"""Maximum number of pictures that are sent to a page and not yet drawn: one is on its way while another is drawn."""

_STATE_MESSAGE_PERIOD = 0.5
_LATENCY_TIME_SPAN = 10.0
"""Seconds over which a page's latency is computed."""


class Viewer:
    """State of an open page: the pictures that were sent and are not yet drawn, and the latencies of drawn pictures.

    A page that is slow or suspended does not report pictures as drawn. Such a page receives no further pictures until
    it resumes, and then receives the newest picture.
    """

    def __init__(self) -> None:
        self.wake_event = asyncio.Event()
        self.following = True
        self.state_due = True
        self._state_read = True
        self._last_sent = -1
        self._undrawn_pictures: deque[tuple[int, float]] = deque()
        self._drawn_latencies: deque[tuple[float, float]] = deque(maxlen=2000)

    def is_ready_for(self, number: int) -> bool:
        """Whether the picture with the frame number `number` may be sent to the page now."""
        return self.following and number > self._last_sent and len(self._undrawn_pictures) < _MAX_SENT_UNDRAWN_PICTURES

    def record_sent(self, number: int, arrival_time: float) -> None:
        """Record that the picture with the frame number `number`, whose frame arrived at the time `arrival_time`, was
        sent to the page."""
        self._last_sent = number
        self._undrawn_pictures.append((number, arrival_time))

    def record_drawn(self, number: int, *, hidden: bool) -> None:
        """Record that the page has drawn the picture with the frame number `number`; earlier pictures that were sent
        and not reported as drawn were skipped."""
        current_time = time.monotonic()
        while self._undrawn_pictures and self._undrawn_pictures[0][0] <= number:
            sent_frame_number, arrival_time = self._undrawn_pictures.popleft()
            if sent_frame_number == number and not hidden:
                self._drawn_latencies.append((current_time, current_time - arrival_time))
        self.wake_event.set()

    def is_state_due(self) -> bool:
        """Whether the state of the session is to be sent now: a new state is due, and the page has read the last
        state."""
        if not (self.state_due and self._state_read):
            return False
        self.state_due = self._state_read = False
        return True

    def read_state(self) -> None:
        """Record that the page has read the last state that was sent."""
        self._state_read = True

    def summary(self) -> dict[str, float | None]:
        """Pictures drawn per second, and the latency in seconds from a frame's last byte until the page reports its
        picture as drawn.

        The latency includes the transmission of the report, so that all times are from the same clock.
        """
        current_time = time.monotonic()
        recent_latencies = [
            drawing_latency
            for draw_time, drawing_latency in self._drawn_latencies
            if current_time - draw_time <= _LATENCY_TIME_SPAN
        ]
        num_recent_pictures = sum(current_time - draw_time <= 2.0 for draw_time, _ in self._drawn_latencies)
        if not recent_latencies:
            return {"rate": 0.0, "latency_median": None, "latency_99": None}
        median_latency, latency_99 = np.percentile(recent_latencies, [50, 99])
        return {
            "rate": num_recent_pictures / 2.0,
            "latency_median": float(median_latency),
            "latency_99": float(latency_99),
        }


class PageHub:
    """Waits for a session's pictures in a thread, and wakes the pages in the server's event loop."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.scene = scene_message(session.scene)
        self.viewers: set[Viewer] = set()
        self.ended = threading.Event()
        self._is_closing = threading.Event()
        self._newest_result: Result | None = None
        self._encoded_picture: tuple[int, bytes] | None = None
        self._state: dict[str, Any] = {}
        self._event_loop: asyncio.AbstractEventLoop | None = None
        self._is_woken = False
        self._watch_thread = threading.Thread(target=self._watch_session, name="jeit-live-pages", daemon=True)

    def start(self) -> None:
        """Start the thread; must be called in the event loop that serves the pages."""
        self._event_loop = asyncio.get_running_loop()
        self._state = self.session.state()
        self._watch_thread.start()

    def close(self) -> None:
        """End the thread that waits for pictures."""
        self._is_closing.set()
        self._watch_thread.join(5.0)

    def newest_picture(self) -> tuple[Result, bytes] | None:
        """Return the newest picture and the bytes of its message to pages; the message is computed once for all
        pages."""
        newest_result = self._newest_result
        if newest_result is None:
            return None
        if self._encoded_picture is None or self._encoded_picture[0] != newest_result.frame.number:
            message = picture_message(newest_result.frame, newest_result.picture, latency=newest_result.latency)
            self._encoded_picture = (newest_result.frame.number, message)
        return newest_result, self._encoded_picture[1]

    def state_message(self, viewer: Viewer) -> str:
        """Return the state of the session and of a page as JSON text."""
        return to_json("state", {**self._state, "drawn": viewer.summary(), "viewers": len(self.viewers)})

    def past_picture_message(self, number: int, direction: int) -> bytes | None:
        """Return the message with a past picture as bytes: the picture of the frame `number`, or else of the nearest
        frame in the `direction` (-1: earlier, 1: later) that has a picture."""
        for candidate_number in range(number, max(-1, number + 600 * direction), direction):
            past_result = self.session.result(candidate_number)
            if past_result is not None and (past_result.frame.number - number) * direction >= 0:
                return picture_message(
                    past_result.frame, past_result.picture, latency=past_result.latency, is_past=True
                )
        return None

    def _watch_session(self) -> None:
        last_frame_number, state_time = -1, 0.0
        while not self._is_closing.is_set():
            newest_result = self.session.newest(last_frame_number, 0.1)
            current_time = time.monotonic()
            if newest_result is not None:
                last_frame_number = newest_result.frame.number
                self._newest_result = newest_result
                self._wake_pages()
            if current_time - state_time >= _STATE_MESSAGE_PERIOD:
                state_time = current_time
                self._state = self.session.state()
                if self._state.get("connection") == "ended":
                    self.ended.set()
                self._wake_pages(session_state=True)
            if newest_result is None and self.ended.is_set():
                self._is_closing.wait(0.1)

    def _wake_pages(self, *, session_state: bool = False) -> None:
        """Wake the pages in the event loop, only once for several pictures that arrive before the pages are awake."""
        if self._event_loop is None or (self._is_woken and not session_state):
            return
        self._is_woken = True
        try:
            self._event_loop.call_soon_threadsafe(self._notify_viewers, session_state)
        except RuntimeError:  # the event loop has been closed
            self._is_closing.set()

    def _notify_viewers(self, session_state: bool) -> None:
        self._is_woken = False
        for page_viewer in self.viewers:
            page_viewer.state_due = page_viewer.state_due or session_state
            page_viewer.wake_event.set()
