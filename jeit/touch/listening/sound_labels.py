"""The classes of the sounds in a recording, every 0.1 s, and events, which are runs of windows of the same class."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.touch.listening.feature_images import WINDOW_INTERVAL


@dataclass(frozen=True)
class Event:
    """A sound from `start` to `end`, seconds.

    `name`: class of the sound, "" for quiet; `probability`: probability of the most likely class, averaged over the
    windows of the sound; `place` (2,) or (3,), metres: mean of the places estimated in these windows, None without any.
    """

    start: float
    end: float
    name: str
    probability: float
    place: np.ndarray | None


@dataclass(frozen=True)
class SoundLabels:
    """The classification of W windows of a recording by a listener.

    **Fields**

    - `times` (W,): middles of the windows, seconds.
    - `probabilities` (W, C): probabilities of the classes `names` (C,).
    - `quiet` (W,): whether a window is clearly quieter than all windows of the training set, so that its probabilities
      are not meaningful.
    - `known` (W,): whether more than half of a window's samples are finite.
    - `strongest` (W,): index of the loudest microphone.
    - `loud` (W,): whether a window is at most 20 dB below the loudest window of the recording; `whole` uses only loud
      windows.
    - `name`: name of the recording.
    - `notes`: remarks on the recording.
    - `position` (W, d), `position_std` (W, d): estimated place of the touch and its standard deviations, metres, NaN in
      windows without a place; both are None without a calibration of the microphones.

    **Example:**

    ```python
    sounds = listener.classify(recordings[0])
    print(isinstance(sounds, SoundLabels), sounds.whole, sounds.events)
    ```
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
        """Name of the most likely class of each window (W,); "" for windows that are quiet or not `known`."""
        likeliest_names = np.array([*self.names, ""])[self.probabilities.argmax(axis=1)]
        return np.where(self.quiet | ~self.known, "", likeliest_names)

    @property
    def probability(self) -> Float[np.ndarray, " W"]:
        """Probability (W,) of the most likely class of each window."""
        return self.probabilities.max(axis=1)

    @property
    def whole(self) -> tuple[str, float]:
        """Most likely class of the whole recording, from its loud windows together, and the probability of this class.

        The probability is the normalised geometric mean over the windows, so that overlapping windows do not count as
        independent; the class is "" if all windows are quiet.
        """
        is_used_window = self.loud & self.known & ~self.quiet
        if not is_used_window.any():
            return "", 0.0
        mean_probabilities = np.exp(np.log(np.maximum(self.probabilities[is_used_window], 1e-9)).mean(axis=0))
        class_probabilities = mean_probabilities / mean_probabilities.sum()
        return self.names[int(class_probabilities.argmax())], float(class_probabilities.max())

    @property
    def events(self) -> tuple[Event, ...]:
        """Sounds of the recording: intervals of consecutive windows of the same class."""
        window_names, sound_events = self.named, []
        # An event extends half way to the previous and to the next window.
        boundary_segments = [
            self.times[:1] - WINDOW_INTERVAL / 2,
            (self.times[1:] + self.times[:-1]) / 2,
            self.times[-1:] + WINDOW_INTERVAL / 2,
        ]
        window_edges = np.maximum(np.concatenate(boundary_segments), 0).tolist()
        class_changes = np.flatnonzero(window_names[1:] != window_names[:-1]) + 1
        for event_windows in np.split(np.arange(len(window_names)), class_changes):
            if not event_windows.size:
                continue
            event_place = None
            if self.position is not None:
                event_positions = self.position[event_windows][np.isfinite(self.position[event_windows]).all(axis=1)]
                event_place = event_positions.mean(axis=0) if len(event_positions) else None
            sound_events.append(
                Event(
                    window_edges[event_windows[0]],
                    window_edges[event_windows[-1] + 1],
                    str(window_names[event_windows[0]]),
                    float(self.probability[event_windows].mean()),
                    event_place,
                )
            )
        return tuple(sound_events)
