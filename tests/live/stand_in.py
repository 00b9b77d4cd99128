"""A session without a device, for tests of the page: a moving Gaussian, and a record of the commands received."""

import math
import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np

from jeit.inverse.streaming.stream import FrameStatus
from jeit.live.pictures import LiveFrame, Marker, Picture, Scene

RADIUS, ORBIT, WIDTH, SIZE = 0.1, 0.05, 0.012, 64


@dataclass(frozen=True)
class StandInResult:
    """A frame with its picture."""

    frame: LiveFrame
    picture: Picture
    latency: float


def round_scene() -> Scene:
    """A disk of 0.1 m with eight electrodes."""
    angles = np.linspace(0, 2 * np.pi, 200)
    middles = np.pi / 2 - 2 * np.pi * np.arange(8) / 8
    arcs = [
        RADIUS * np.column_stack([np.cos(a + w), np.sin(a + w)]) for w in [np.linspace(-0.1, 0.1, 9)] for a in middles
    ]
    return Scene(
        "A <b>round</b> stand-in",
        "conductivity change",
        "S/m",
        True,
        (-RADIUS, RADIUS, -RADIUS, RADIUS),
        [RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])],
        arcs,
        [str(one) for one in range(1, 9)],
        [f"{one}-{one + 1}" for one in range(1, 41)],
        ("made for tests",),
    )


class StandIn:
    """A session's interface for a page: pictures at a rate, or those that a test publishes (`rate` None)."""

    def __init__(self, rate: float | None = 60.0, period: float = 8.0) -> None:
        self.scene, self.rate, self.period = round_scene(), rate, period
        self.asked: list[tuple] = []
        self.extra: dict = {}
        self._condition = threading.Condition()
        self._results: deque[StandInResult] = deque(maxlen=3600)
        self._ended = False
        self._begun = time.monotonic()
        edges = (np.arange(SIZE) + 0.5) / SIZE * 2 * RADIUS - RADIUS
        self._x, self._y = np.meshgrid(edges, edges[::-1])
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._begun = time.monotonic()
        if self.rate is not None:
            self._thread.start()
        return self

    def __exit__(self, *_):
        self.stop()

    def stop(self):
        with self._condition:
            self._ended = True
            self._condition.notify_all()

    def place(self, second: float) -> tuple[float, float]:
        """Where the Gaussian is, metres."""
        angle = 2 * math.pi * second / self.period
        return ORBIT * math.cos(angle), ORBIT * math.sin(angle)

    def publish(self, number: int, second: float, refused: str = "", values=None) -> None:
        """Create the picture for a time, with its largest value, 0.004, at `place(second)`."""
        arrived = time.monotonic()
        x, y = self.place(second)
        pixels = -0.004 * np.exp(-((self._x - x) ** 2 + (self._y - y) ** 2) / (2 * WIDTH**2))
        pixels[self._x**2 + self._y**2 > RADIUS**2] = np.nan
        picture = Picture(pixels.astype(np.float32), (Marker(x, y, "here", 0.01, 1),))
        if refused:
            picture = Picture(None, status=FrameStatus.REFUSED, reason=refused)
        voltages = 1 + 0.1 * np.sin(second + np.arange(40)) if values is None else values
        with self._condition:
            frame = LiveFrame(number, second, arrived, voltages)
            self._results.append(StandInResult(frame, picture, time.monotonic() - arrived))
            self._condition.notify_all()

    @property
    def last(self) -> int:
        """Number of the newest frame, or -1."""
        with self._condition:
            return self._results[-1].frame.number if self._results else -1

    def newest(self, after: int, timeout: float):
        with self._condition:
            self._condition.wait_for(lambda: self._ended or self._has(after), timeout)
            return self._results[-1] if self._has(after) else None

    def result(self, number: int):
        with self._condition:
            return next((one for one in self._results if one.frame.number == number), None)

    def state(self) -> dict:
        state = dict.fromkeys(("read", "imaged", "dropped", "refused"), 0)
        state |= {"reasons": {}, "rate": self.rate or 0.0, "latency_median": 0.001, "latency_99": 0.002}
        state |= {"noise": 1e-4, "reciprocity": float("nan"), "dead": [], "drifting": [], "recording": None}
        state |= {"connection": "connected", "messages": [], **self.extra}
        return state | ({"connection": "ended"} if self._ended else {})

    def take_reference(self, count: int) -> None:
        self.asked.append(("reference", count))

    def mark(self, label: str) -> None:
        self.asked.append(("mark", label))
        second = time.monotonic() - self._begun
        self.extra["messages"] = [*self.extra.get("messages", []), {"second": second, "text": f"Event: {label}"}]

    def record(self, on: bool) -> None:
        self.asked.append(("record", on))
        self.extra["recording"] = (
            {"folder": "recordings/one", "frames": 12, "bytes": 34567, "problem": None} if on else None
        )

    def _has(self, after: int) -> bool:
        return bool(self._results) and self._results[-1].frame.number > after

    def _run(self) -> None:
        assert self.rate is not None
        number = 0
        while not self._ended:
            due = self._begun + number / self.rate
            time.sleep(max(0.0, due - time.monotonic()))
            self.publish(number, time.monotonic() - self._begun)
            number += 1
