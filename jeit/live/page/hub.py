"""Pictures of a live session handed to open pages: the newest to each, as fast as that page draws."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from typing import Any

import numpy as np

from jeit.live.page.wire import picture_message, scene_message, to_json
from jeit.live.session import Result, Session

_IN_FLIGHT = 2
"""Pictures sent to a page and not yet drawn: one on its way while another is drawn."""

_STATE_PERIOD = 0.5
_LATENCIES = 10.0
"""Seconds over which a page's latency is computed."""


class Viewer:
    """One open page: what was sent to it and is not drawn yet, and how late its pictures were drawn.

    A page that is slow or asleep reports nothing drawn, is sent nothing more, and sees the newest when it wakes.
    """

    def __init__(self) -> None:
        self.news = asyncio.Event()
        self.following = True
        self.state_due = True
        self._state_read = True
        self._sent = -1
        self._flying: deque[tuple[int, float]] = deque()
        self._drawn: deque[tuple[float, float]] = deque(maxlen=2000)

    def ready_for(self, number: int) -> bool:
        """Whether a picture may be sent now."""
        return self.following and number > self._sent and len(self._flying) < _IN_FLIGHT

    def sent(self, number: int, arrived: float) -> None:
        """Note that a picture was sent."""
        self._sent = number
        self._flying.append((number, arrived))

    def drew(self, number: int, *, hidden: bool) -> None:
        """Note that the page has drawn a picture, and with it has passed over those sent before."""
        now = time.monotonic()
        while self._flying and self._flying[0][0] <= number:
            sent, arrived = self._flying.popleft()
            if sent == number and not hidden:
                self._drawn.append((now, now - arrived))
        self.news.set()

    def wants_state(self) -> bool:
        """Whether a state is due, and the last one was read."""
        if not (self.state_due and self._state_read):
            return False
        self.state_due = self._state_read = False
        return True

    def read_state(self) -> None:
        """Note that the page has read the last state."""
        self._state_read = True

    def summary(self) -> dict[str, float | None]:
        """Pictures drawn a second, and the latency from a frame's last byte until the page reports it drawn, seconds.

        The report's way back counts as well, so that no two clocks are compared.
        """
        now = time.monotonic()
        late = [delay for at, delay in self._drawn if now - at <= _LATENCIES]
        recent = sum(now - at <= 2.0 for at, _ in self._drawn)
        if not late:
            return {"rate": 0.0, "latency_median": None, "latency_99": None}
        median, worst = np.percentile(late, [50, 99])
        return {"rate": recent / 2.0, "latency_median": float(median), "latency_99": float(worst)}


class Hub:
    """Waits for a session's pictures in a thread, and wakes the pages in the server's event loop."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.scene = scene_message(session.scene)
        self.viewers: set[Viewer] = set()
        self.ended = threading.Event()
        self._closing = threading.Event()
        self._newest: Result | None = None
        self._encoded: tuple[int, bytes] | None = None
        self._state: dict[str, Any] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._woken = False
        self._thread = threading.Thread(target=self._pump, name="jeit-live-pages", daemon=True)

    def start(self) -> None:
        """Begin, in the event loop that serves the pages."""
        self._loop = asyncio.get_running_loop()
        self._state = self.session.state()
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        self._thread.join(5.0)

    def newest(self) -> tuple[Result, bytes] | None:
        """Return the newest picture, and its bytes; they are made once for all pages."""
        result = self._newest
        if result is None:
            return None
        if self._encoded is None or self._encoded[0] != result.frame.number:
            message = picture_message(result.frame, result.picture, latency=result.latency)
            self._encoded = (result.frame.number, message)
        return result, self._encoded[1]

    def state_message(self, viewer: Viewer) -> str:
        """Return the session's state, and that of a page, as JSON text."""
        return to_json("state", {**self._state, "drawn": viewer.summary(), "viewers": len(self.viewers)})

    def past(self, number: int, direction: int) -> bytes | None:
        """Return the bytes of a picture of the last minute: that of a frame, or else the nearest in a direction."""
        for candidate in range(number, max(-1, number + 600 * direction), direction):
            result = self.session.result(candidate)
            if result is not None and (result.frame.number - number) * direction >= 0:
                return picture_message(result.frame, result.picture, latency=result.latency, past=True)
        return None

    def _pump(self) -> None:
        after, state_at = -1, 0.0
        while not self._closing.is_set():
            result = self.session.newest(after, 0.1)
            now = time.monotonic()
            if result is not None:
                after = result.frame.number
                self._newest = result
                self._wake()
            if now - state_at >= _STATE_PERIOD:
                state_at = now
                self._state = self.session.state()
                if self._state.get("connection") == "ended":
                    self.ended.set()
                self._wake(state=True)
            if result is None and self.ended.is_set():
                self._closing.wait(0.1)

    def _wake(self, *, state: bool = False) -> None:
        """Have the event loop look at what is new, once, however many pictures came meanwhile."""
        if self._loop is None or (self._woken and not state):
            return
        self._woken = True
        try:
            self._loop.call_soon_threadsafe(self._notify, state)
        except RuntimeError:  # the loop has been closed
            self._closing.set()

    def _notify(self, state: bool) -> None:
        self._woken = False
        for viewer in self.viewers:
            viewer.state_due = viewer.state_due or state
            viewer.news.set()
