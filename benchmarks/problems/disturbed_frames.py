"""An endless stream of a touched sensor whose frames are faulty in bursts, each of a known kind."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from benchmarks.problems.touched_sensors import NOISE
from jeit.inverse.streaming.stream import FrameStatus


class Kind(NamedTuple):
    """Kind of faulty frames: the expected status, and a word of the reason that must be reported."""

    status: FrameStatus
    word: str


KINDS = {
    "no readings": Kind(FrameStatus.REFUSED, "channels can be used"),
    "some readings missing": Kind(FrameStatus.PARTIAL, "without a reading"),
    "another length": Kind(FrameStatus.REFUSED, "of shape"),
    "saturated": Kind(FrameStatus.PARTIAL, "saturated"),
    "saturated throughout": Kind(FrameStatus.REFUSED, "Saturated"),
    "an electrode dead": Kind(FrameStatus.PARTIAL, "Electrode {} seems to be dead"),
    "another sensor's": Kind(FrameStatus.REFUSED, "another sensor's"),
    "no current": Kind(FrameStatus.REFUSED, "All channels read zero"),
}


@dataclass
class DisturbedFrames:
    """Iterator over `number` frames (M,) in volts, with bursts of up to `longest` faulty frames that begin every
    `period` frames.

    Frames are those of `base` (F, M) in turn, with new noise. `rest` (M,) is a frame of the untouched sensor, and
    `touching` (L, M) states in which of the M channels each of the L electrodes takes part. During iteration, the
    `kind` of the last frame (empty for a good frame) and the dead `electrode` are available.
    """

    base: np.ndarray
    rest: np.ndarray
    touching: np.ndarray
    number: int
    period: int
    longest: int
    seed: int = 0
    kind: str = ""
    electrode: int = 0
    planted: dict[str, int] = field(default_factory=lambda: dict.fromkeys(KINDS, 0))

    def __iter__(self) -> Iterator[np.ndarray]:
        random = np.random.default_rng(self.seed)
        scale, names, left = NOISE * np.abs(self.rest), [*KINDS], 0
        for number in range(self.number):
            if number % self.period == self.period // 2:
                self.kind = names[number // self.period % len(names)]
                left = int(random.integers(1, self.longest + 1))
                self.electrode = int(random.integers(len(self.touching)))
            if not left:
                self.kind = ""
            frame = self.base[number % len(self.base)] + scale * random.standard_normal(len(scale))
            if self.kind:
                left -= 1
                self.planted[self.kind] += 1
                frame = self._disturbed(frame, random)
            yield frame

    def _disturbed(self, frame: np.ndarray, random: np.random.Generator) -> np.ndarray:
        channels, largest = len(frame), np.abs(self.rest).max()
        if self.kind == "no readings":
            frame[random.permutation(channels)[: 2 * channels // 3]] = np.nan
        elif self.kind == "some readings missing":
            frame[random.permutation(channels)[: channels // 10]] = np.nan
        elif self.kind == "another length":
            frame = np.resize(frame, int(random.choice([0, 1, channels - 1, channels + 1, 3 * channels])))
        elif self.kind == "saturated":
            frame = np.clip(frame, -0.6 * largest, 0.6 * largest)
        elif self.kind == "saturated throughout":
            frame = np.copysign(2 * largest, frame)
        elif self.kind == "an electrode dead":
            own = self.touching[self.electrode]
            frame[own] = 1e-3 * largest * random.standard_normal(np.count_nonzero(own))
        elif self.kind == "another sensor's":
            frame = 2.5 * frame[::-1].copy()
        else:
            frame = np.zeros(channels)
        return frame
