"""Track contacts from frame to frame: assign them to touches, and determine onset, end and path of each touch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from jeit.arguments import check_kind, check_metres, describe, is_number, real_array
from jeit.touch.contacts.finder import Contact
from jeit_solvers.module import Module

# Fraction of a contact's prediction error that corrects the velocity: one half averages the noise of two frames.
_VELOCITY_GAIN = 0.5
# Number of gaps for which a touch is kept while it is hidden by another touch's contact.
_HIDDEN_GAPS = 4


class TouchPath(Module):
    """Path of one touch.

    **Fields**: `number`: position in order of onset; `times` (T,): times of the frames in which the touch was seen,
    seconds; `position` (T, 2): centroids, metres; `peak` (T,): peaks, in the unit of the images; `area` (T,): areas,
    m².
    """

    number: int
    times: Float[np.ndarray, " T"]
    position: Float[np.ndarray, "T 2"]
    peak: Float[np.ndarray, " T"]
    area: Float[np.ndarray, " T"]

    @property
    def onset(self) -> float:
        """Time of the first frame of the touch, seconds."""
        return float(self.times[0])

    @property
    def offset(self) -> float:
        """Time of the last frame of the touch, seconds."""
        return float(self.times[-1])

    @property
    def length(self) -> float:
        """Length of the path, metres."""
        return float(np.linalg.norm(np.diff(self.position, axis=0), axis=1).sum())


class _TrackedTouch(Module):
    """State of a touch that is being tracked.

    **Fields**: `number`: position in order of onset; `time`: time of the last frame, seconds; `place`: position at that
    time, metres; `velocity`: m/s; `seen`: times and contacts so far; `hidden`: whether another touch's contact may hide
    it now.
    """

    number: int
    time: float
    place: Float[np.ndarray, "2"]
    velocity: Float[np.ndarray, "2"]
    seen: tuple[tuple[float, Contact], ...]
    hidden: bool = False

    def at(self, time: float) -> np.ndarray:
        """Predicted position at a time, metres."""
        return self.place + (time - self.time) * self.velocity

    def path(self) -> TouchPath:
        """Return the path so far."""
        times, contacts = zip(*self.seen, strict=True)
        columns = ([getattr(one, name) for one in contacts] for name in ("centroid", "peak", "area"))
        return TouchPath(self.number, np.array(times), *map(np.array, columns))


class ContactTracker(Module):
    """State of the tracking of touches.

    `tracker.follow(time, contacts)` returns the state after the next frame; this one is not changed. Contacts are
    assigned to the touches whose predicted positions (position + velocity · time) are nearest, with the minimum sum of
    distances. No distance may exceed `reach` metres, which allows for noise of positions, plus the distance that a
    touch of the maximum speed `fastest`, m/s, covers between two frames. A touch without a contact is kept for `gap`
    seconds from the first frame without one. If it may be hidden in another touch's contact, as when two fingers cross,
    it is assumed to continue with its velocity, for four gaps at most.

    **Fields**: `gap`, `reach`, `fastest`: as above; `least`: minimum number of frames of a touch, shorter ones are not
    reported; `time`: time of the last frame, -inf before the first; `open`, `closed`: current touches, and touches that
    have ended; `number`: number of touches that have begun.

    **Example:**

    ```python
    tracker = ContactTracker(gap=0.2)
    paths = track_contacts(seconds, film_contacts, tracker)
    ```
    """

    gap: float = 0.15
    reach: float = 0.015
    fastest: float = 1.0
    least: int = 2
    time: float = -np.inf
    open: tuple[_TrackedTouch, ...] = ()
    closed: tuple[TouchPath, ...] = ()
    number: int = 0

    def __check_init__(self):
        """Check the fields.

        Raises `ValueError` if `gap` or `reach` is not positive, `fastest` is negative, or `least` is not a positive
        integer.
        """
        check_metres("reach", self.reach)
        if not (is_number(self.fastest) and self.fastest >= 0):
            raise ValueError(f"fastest must be zero or more, in metres a second; it is {describe(self.fastest)}.")
        if not (is_number(self.gap) and self.gap > 0):
            raise ValueError(f"gap must be positive, in seconds; it is {describe(self.gap)}.")
        if not (isinstance(self.least, int) and self.least >= 1):
            raise ValueError(f"least must be a number of frames, 1 or more; it is {describe(self.least)}.")

    def follow(self, time: float, contacts: Sequence[Contact]) -> "ContactTracker":
        """Return the tracker after a frame with these contacts at `time`, seconds.

        Raises `ValueError` if the time is not later than that of the last frame.
        """
        if not (is_number(time) and time > self.time):
            raise ValueError(f"time must be later than the frame before, {self.time:g} s; it is {describe(time)}.")
        check_kind("contacts", contacts, (list, tuple, np.ndarray), "a list of them, those of one frame")
        for number, contact in enumerate(contacts):
            check_kind(f"contacts[{number}]", contact, Contact, "a Contact, as of find_contacts")
        passed = time - self.time
        # The interval between frames is added, up to the gap, so that a single missing frame of a slow stream is
        # bridged too.
        spare = min(passed, self.gap)
        waited = [time - one.seen[-1][0] > self.gap * (_HIDDEN_GAPS if one.hidden else 1) + spare for one in self.open]
        late = [one for one, over in zip(self.open, waited, strict=True) if over]
        going = [one for one, over in zip(self.open, waited, strict=True) if not over]
        expected = np.array([one.at(time) for one in going]).reshape(-1, 1, 2)
        places = np.array([one.centroid for one in contacts]).reshape(1, -1, 2)
        distance = np.linalg.norm(expected - places, axis=-1)
        most = self.reach + self.fastest * passed if going else 0.0
        # Pairs beyond the maximum distance all cost the same, so that no pair within it is given up for them.
        rows, columns = linear_sum_assignment(np.where(distance <= most, distance, 1e3 * most))
        pairs = {int(row): int(one) for row, one in zip(rows, columns, strict=True) if distance[row, one] <= most}
        wide = self.reach + np.sqrt(np.array([one.area for one in contacts]) / np.pi)
        lost = [row for row in range(len(going)) if row not in pairs]
        hidden = {row for row in lost for one in pairs.values() if distance[row, one] <= wide[one]}
        followed = [
            _update_touch(one, time, contacts[pairs[row]])
            if row in pairs
            else _TrackedTouch(one.number, time, one.at(time), one.velocity, one.seen, row in hidden)
            for row, one in enumerate(going)
        ]
        new = [contacts[one] for one in range(len(contacts)) if one not in pairs.values()]
        first = [
            _TrackedTouch(self.number + k, time, one.centroid, np.zeros(2), ((time, one),)) for k, one in enumerate(new)
        ]
        closed = self.closed + self._finished_paths(late)
        values = (time, (*followed, *first), closed, self.number + len(new))
        return ContactTracker(self.gap, self.reach, self.fastest, self.least, *values)

    @property
    def touches(self) -> list[TouchPath]:
        """All touches so far, including the current ones, in order of onset."""
        return sorted(self.closed + self._finished_paths(self.open), key=lambda path: path.number)

    def _finished_paths(self, tracked: Iterable[_TrackedTouch]) -> tuple[TouchPath, ...]:
        return tuple(one.path() for one in tracked if len(one.seen) >= self.least)


def track_contacts(
    times: Float[np.ndarray, " F"], contacts: Sequence[Sequence[Contact]], tracker: ContactTracker | None = None
) -> list[TouchPath]:
    """Track the touches of a recording.

    **Arguments:**

    - `times`: increasing times (F,), seconds.
    - `contacts`: contacts of every frame, as from `find_contacts`.
    - `tracker`: initial state, by default `ContactTracker()`.

    Raises `ValueError` for a different number of times, and as `ContactTracker.follow` does.

    **Example:**

    ```python
    paths = track_contacts(seconds, film_contacts)
    print([path.position for path in paths])
    ```
    """
    wanted = "a list with those of every frame, each a list"
    check_kind("contacts", contacts, (list, tuple, np.ndarray), wanted)
    for number, found in enumerate(contacts):
        check_kind(f"contacts[{number}]", found, (list, tuple, np.ndarray), "a list of contacts, those of one frame")
    times = real_array("times", times, "seconds (F,), one for each frame")
    if times.shape != (len(contacts),):
        raise ValueError(f"times: give one for each of the {len(contacts)} frames; they have shape {times.shape}.")
    tracker = ContactTracker() if tracker is None else tracker
    check_kind("tracker", tracker, ContactTracker, "a ContactTracker(), to begin with")
    for time, found in zip(times, contacts, strict=True):
        tracker = tracker.follow(float(time), found)
    return tracker.touches


def _update_touch(touch: _TrackedTouch, time: float, contact: Contact) -> _TrackedTouch:
    """Return the state of a touch after a frame in which it is seen as this contact."""
    off = (contact.centroid - touch.at(time)) / (time - touch.time)
    velocity = touch.velocity + _VELOCITY_GAIN * off
    return _TrackedTouch(touch.number, time, contact.centroid, velocity, (*touch.seen, (time, contact)))
