"""What was heard in a recording: a name for every tenth of a second, and the events that follow each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.touch.listening.feature_images import EVERY


@dataclass(frozen=True)
class Event:
    """What was heard from `start` to `end`, seconds: `name`, "" for quiet; its mean `probability`; `place` (2,) or (3,)
    metres, the mean of where it was located, None where it was not."""

    start: float
    end: float
    name: str
    probability: float
    place: np.ndarray | None


@dataclass(frozen=True)
class Heard:
    """What a listener said of W windows: `times` (W,), seconds, their middles; `probabilities` (W, C) of its `names`
    (C,); `quiet` (W,), windows quieter than any that was learnt from, of which what is said does not count; `known`
    (W,), whether a window is of numbers; the `strongest` microphone of each (W,); `loud` (W,), windows no more than 20
    dB below the recording's loudest, which `whole` goes by. `position` (W, d), metres, and `position_std`, where it was
    located, NaN where not, None without a calibration. `name` of the recording, and `notes` on it."""

    times: Float[np.ndarray, " W"]
    probabilities: Float[np.ndarray, "W C"]
    names: tuple[str, ...]
    quiet: Bool[np.ndarray, " W"]
    known: Bool[np.ndarray, " W"]
    strongest: Int[np.ndarray, " W"]
    loud: Bool[np.ndarray, " W"]
    name: str = "recording"
    notes: tuple[str, ...] = ()
    position: Float[np.ndarray, "W d"] | None = None
    position_std: Float[np.ndarray, "W d"] | None = None

    def __len__(self) -> int:
        """Number of windows."""
        return len(self.times)

    @property
    def named(self) -> np.ndarray:
        """The likeliest name of each window (W,), "" where it is quiet or of no numbers."""
        likeliest = np.array([*self.names, ""])[self.probabilities.argmax(axis=1)]
        return np.where(self.quiet | ~self.known, "", likeliest)

    @property
    def probability(self) -> Float[np.ndarray, " W"]:
        """How probable the likeliest name of each window is."""
        return self.probabilities.max(axis=1)

    @property
    def whole(self) -> tuple[str, float]:
        """The recording as one sound: the name that is likeliest of its loud windows together, and how probable it is
        (the geometric mean of the windows', so that windows which overlap do not count as many); "" where all
        are quiet."""
        some = self.loud & self.known & ~self.quiet
        if not some.any():
            return "", 0.0
        mean = np.exp(np.log(np.maximum(self.probabilities[some], 1e-9)).mean(axis=0))
        share = mean / mean.sum()
        return self.names[int(share.argmax())], float(share.max())

    @property
    def events(self) -> tuple[Event, ...]:
        """Stretches of one name, one after the other."""
        names, found = self.named, []
        # A name holds to half way to the next window.
        steps = [self.times[:1] - EVERY / 2, (self.times[1:] + self.times[:-1]) / 2, self.times[-1:] + EVERY / 2]
        edges = np.maximum(np.concatenate(steps), 0).tolist()
        cuts = np.flatnonzero(names[1:] != names[:-1]) + 1
        for some in np.split(np.arange(len(names)), cuts):
            if not some.size:
                continue
            place = None
            if self.position is not None:
                located = self.position[some][np.isfinite(self.position[some]).all(axis=1)]
                place = located.mean(axis=0) if len(located) else None
            found.append(
                Event(
                    edges[some[0]],
                    edges[some[-1] + 1],
                    str(names[some[0]]),
                    float(self.probability[some].mean()),
                    place,
                )
            )
        return tuple(found)
