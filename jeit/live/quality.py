"""Quality of a live stream: noise, reciprocity, and electrodes that are dead or drift, from its latest frames."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jeit.data import Measurement, reciprocity_error
from jeit.live.pictures import LiveFrame

# Latest frames that are judged, and fewest of them.
_FRAMES, _FEWEST = 32, 8
# Medians of these that are kept: over as many looks an electrode must drift.
_LOOKS = 40
# A reading is lost if there is none, or if its relative difference from the reference exceeds the first number; an
# electrode is dead if the second share of its readings is lost, those of dead electrodes aside. It drifts if the median
# relative difference of its readings exceeds the third number, and the fourth times that of all others.
_LOST, _MOST_LOST, _DRIFTED, _APART = 0.5, 0.7, 0.05, 3.0
# Parts of the frames of a reference whose means are compared, and fewest frames of a part; ratio of the deviation of
# these means to what noise explains from which the sensor was disturbed meanwhile.
_PARTS, _FEWEST_OF_A_PART, _DISTURBED = 4, 2, 4.0
# Factor by which a frame rate must change to be reported, and looks for which it must last.
_RATE_CHANGE, _LASTING = 1.4, 3


@dataclass(frozen=True)
class Quality:
    """**Fields**: `noise`: standard deviation of a reading from frame to frame, relative to the root mean square of a
    frame; `reciprocity`: as `jeit.data.reciprocity_error`, of the mean of the latest frames; both None if unknown;
    `dead`, `drifting`: numbers of electrodes, from 0."""

    noise: float | None = None
    reciprocity: float | None = None
    dead: Sequence[int] = ()
    drifting: Sequence[int] = ()


@np.errstate(all="ignore")  # readings of faulty frames may overflow
def change_during(frames: Float[np.ndarray, "N M"]) -> float | None:
    """Change of a sensor while frames (N, M) were taken, relative to their mean: the largest difference of the mean of
    a quarter of them from that of all. None if noise, which is estimated from successive frames, explains it or is as
    large in a frame, and for fewer than eight frames."""
    frames = np.asarray(frames, float)[:, np.isfinite(frames).all(axis=0)]
    if len(frames) < _PARTS * _FEWEST_OF_A_PART or not frames.size:
        return None
    away = np.array([part.mean(axis=0) for part in np.array_split(frames, _PARTS)]) - frames.mean(axis=0)
    noise = (np.diff(frames, axis=0) ** 2).mean(axis=0).sum() / 2
    # A change within the noise of a frame, such as a slow drift in thousands of frames, does no harm.
    if not (away**2).sum() > (_PARTS - 1) * noise * max(_DISTURBED**2 * _PARTS / len(frames), 1.0):
        return None
    return float(np.sqrt((away**2).sum(axis=1).max()) / np.linalg.norm(frames.mean(axis=0)))


class QualityWatch:
    """Judges the latest frames of a sensor whenever it is asked, in any thread.

    `reference`: a measurement of the undisturbed sensor; without it only the noise is estimated.
    """

    def __init__(self, reference: Measurement | None):
        self.protocol = None if reference is None else reference.protocol
        self.expected = self.touching = None
        self._lock = threading.Lock()
        self._frames: deque[np.ndarray] = deque(maxlen=_FRAMES)
        self._slow: deque[np.ndarray] = deque(maxlen=_LOOKS)
        if reference is not None:
            self.renew(np.where(reference.mask, np.real(np.asarray(reference.voltages)), np.nan))
            count = reference.protocol.num_electrodes
            self.touching = np.array([reference.protocol.channels_touching(one) for one in range(count)])

    def renew(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Compare with the mean of these frames from now on."""
        known = np.isfinite(frames)
        total = np.where(known, frames, 0.0).sum(axis=0)
        mean = np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)
        with self._lock:
            self.expected = mean
            self._slow.clear()

    def add(self, frame: LiveFrame) -> None:
        """Take a frame into account; frames of other sensors and text are left out."""
        values = frame.values
        if isinstance(values, str) or values.ndim != 1 or values.dtype.kind not in "iuf":
            return
        if self.expected is not None and len(values) != len(self.expected):
            return
        with self._lock:
            if self._frames and len(self._frames[0]) != len(values):
                self._frames.clear()
            self._frames.append(values)

    @np.errstate(all="ignore")  # squares of numbers that are no voltages may overflow
    def look(self) -> Quality:
        """The quality of the latest frames; call it every half a second or so."""
        with self._lock:
            if len(self._frames) < _FEWEST:
                return Quality()
            frames = np.array(self._frames, float)
            expected = self.expected
        frames[~np.isfinite(frames)] = np.nan
        noise = _noise(frames)
        if expected is None or self.protocol is None or self.touching is None:
            return Quality(noise)
        known = np.isfinite(frames).sum(axis=0) > len(frames) // 2
        middle = np.full(frames.shape[1], np.nan)
        middle[known] = np.nanmedian(frames[:, known], axis=0)
        reciprocity = None
        if known.any():
            measured = Measurement(np.where(known, middle, 0.0)[None], known[None], self.protocol)
            reciprocity = reciprocity_error(measured)
        with self._lock:
            self._slow.append(middle)
            slow = np.array(self._slow)
        readable = np.isfinite(expected) & (expected != 0)
        change = np.abs(middle - expected) / np.abs(np.where(readable, expected, 1.0))
        dead = _dead(~known | (change > _LOST), readable, self.touching)
        if len(slow) < _LOOKS // 2:
            return Quality(noise, reciprocity, dead)
        lasting = np.isfinite(slow).all(axis=0) & readable & ~self.touching[dead].any(axis=0)
        drift = np.zeros(len(expected))
        drift[lasting] = np.median(np.abs(slow[:, lasting] / expected[lasting] - 1), axis=0)
        return Quality(noise, reciprocity, dead, _drifting(drift, lasting, self.touching))


class RateWatch:
    """Notices when a frame rate changes and stays changed."""

    def __init__(self):
        self.usual: float | None = None
        self._other = 0

    def __call__(self, rate: float) -> str:
        """A sentence if the rate, frames/s, has changed; empty if it has not."""
        if rate <= 0:
            return ""
        if self.usual is not None and max(rate / self.usual, self.usual / rate) < _RATE_CHANGE:
            self._other = 0
            return ""
        self._other += 1
        if self._other < _LASTING:
            return ""
        before, self.usual, self._other = self.usual, rate, 0
        return "" if before is None else f"The frame rate has changed from {before:.3g} to {rate:.3g} frames a second."


def _noise(frames: Float[np.ndarray, "F M"]) -> float | None:
    """Relative noise from second differences in time, which a steady motion does not change."""
    size = np.sqrt(np.nanmean(frames**2)) if np.isfinite(frames).any() else 0.0
    bent = frames[:-2] - 2 * frames[1:-1] + frames[2:]
    bent = bent[np.isfinite(bent)]
    if not size > 0 or not bent.size or not np.isfinite(size):
        return None
    return float(1.4826 * np.median(np.abs(bent)) / np.sqrt(6) / size)


def _dead(
    lost: Bool[np.ndarray, " M"], readable: Bool[np.ndarray, " M"], touching: Bool[np.ndarray, "L M"]
) -> list[int]:
    """Electrodes most of whose readings are lost: the worst first, then others without its channels."""
    dead: list[int] = []
    left = readable.copy()
    while left.any():
        own = touching & left
        count = own.sum(axis=1)
        share = np.where(count > 0, (own & lost).sum(axis=1) / np.maximum(count, 1), 0.0)
        worst = int(share.argmax())
        if share[worst] < _MOST_LOST:
            break
        dead.append(worst)
        left &= ~touching[worst]
    return sorted(dead)


def _drifting(
    drift: Float[np.ndarray, " M"], lasting: Bool[np.ndarray, " M"], touching: Bool[np.ndarray, "L M"]
) -> list[int]:
    """Electrodes whose readings have changed for long, and much more than those of the others."""
    drifting: list[int] = []
    left = lasting.copy()
    while True:
        own = [touching[one] & left for one in range(len(touching))]
        middle = np.array([np.median(drift[one]) if one.any() else 0.0 for one in own])
        worst = int(middle.argmax())
        rest = left & ~touching[worst]
        if middle[worst] < _DRIFTED or not rest.any() or middle[worst] < _APART * np.median(drift[rest]):
            return sorted(drifting)
        drifting.append(worst)
        left = rest
