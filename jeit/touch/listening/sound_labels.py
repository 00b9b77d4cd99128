"""The classified sounds of a recording: a name for every 0.1 s, and events of consecutive windows of one name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.touch.listening.feature_images import EVERY


@dataclass(frozen=True)
class Event:
    """A sound from `start` to `end`, seconds.

    `name`: its class, "" for quiet; `probability`: the mean over its windows; `place` (2,) or (3,): the mean estimated
    place, metres, None where there is none.
    """

    start: float
    end: float
    name: str
    probability: float
    place: np.ndarray | None


@dataclass(frozen=True)
class SoundLabels:
    """The classification of W windows of a recording by a listener.

    `times` (W,): the middles of the windows, in seconds; `probabilities` (W, C) of the classes `names` (C,); `quiet`
    (W,): windows quieter than any in the training set, whose probabilities do not count; `known` (W,): whether a
    window's samples are finite; `strongest` (W,): the loudest microphone; `loud` (W,): windows no more than 20 dB below
    the recording's loudest, which `whole` uses. `position` (W, d), metres, and `position_std`: the estimated place, NaN
    where there is none, None without a calibration. `name`: the name of the recording; `notes`: notes on it.
    """

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
        """The likeliest name of each window (W,), "" where it is quiet or not finite."""
        likeliest = np.array([*self.names, ""])[self.probabilities.argmax(axis=1)]
        return np.where(self.quiet | ~self.known, "", likeliest)

    @property
    def probability(self) -> Float[np.ndarray, " W"]:
        """Probability of the likeliest name of each window."""
        return self.probabilities.max(axis=1)

    @property
    def whole(self) -> tuple[str, float]:
        """Classify the recording as one sound: the likeliest name of its loud windows together, and its probability.

        The probability is the geometric mean over the windows, so that overlapping windows are not counted as
        independent; the name is "" where all are quiet.
        """
        some = self.loud & self.known & ~self.quiet
        if not some.any():
            return "", 0.0
        mean = np.exp(np.log(np.maximum(self.probabilities[some], 1e-9)).mean(axis=0))
        share = mean / mean.sum()
        return self.names[int(share.argmax())], float(share.max())

    @property
    def events(self) -> tuple[Event, ...]:
        """Intervals of consecutive windows of the same name."""
        names, found = self.named, []
        # A name extends half way to the next window.
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
