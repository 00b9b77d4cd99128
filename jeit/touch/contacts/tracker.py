"""Follow contacts from frame to frame: identify them, and determine when each begins and ends, and its path."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from jeit.arguments import check_kind, check_metres, describe, is_number, real_array
from jeit.touch.contacts.finder import Contact

# The share of a contact's prediction error that is added to the velocity: half, which averages the noise of two frames.
_BELIEVED = 0.5
# The number of gaps for which a touch is waited for that is hidden by another's contact.
_HIDDEN = 4


class TouchPath(eqx.Module):
    """The path of one touch.

    `number`, in order of onset; of every frame in which it was seen, `times` (T,) seconds, `position` (T, 2) metres,
    `peak` (T,) in the images' unit and `area` (T,) m².
    """

    number: int
    times: Float[np.ndarray, " T"]
    position: Float[np.ndarray, "T 2"]
    peak: Float[np.ndarray, " T"]
    area: Float[np.ndarray, " T"]

    @property
    def onset(self) -> float:
        """Time of the first frame, seconds."""
        return float(self.times[0])

    @property
    def offset(self) -> float:
        """Time of the last frame, seconds."""
        return float(self.times[-1])

    @property
    def length(self) -> float:
        """Length of the path, metres."""
        return float(np.linalg.norm(np.diff(self.position, axis=0), axis=1).sum())


class _Followed(eqx.Module):
    """A touch that is being followed: its place at `time`, its velocity (m/s), its path, and whether it may be hidden
    now."""

    number: int
    time: float
    place: Float[np.ndarray, "2"]
    velocity: Float[np.ndarray, "2"]
    seen: tuple[tuple[float, Contact], ...]
    hidden: bool = False

    def at(self, time: float) -> np.ndarray:
        """Predicted place, metres."""
        return self.place + (time - self.time) * self.velocity

    def path(self) -> TouchPath:
        """The path so far."""
        times, contacts = zip(*self.seen, strict=True)
        columns = ([getattr(one, name) for one in contacts] for name in ("centroid", "peak", "area"))
        return TouchPath(self.number, np.array(times), *map(np.array, columns))


class ContactTracker(eqx.Module):
    """The touches up to now. `tracker.follow(time, contacts)` returns the tracker after the next frame; this one is not
    changed.

    A frame's contacts are assigned to the touches whose predicted places (place + velocity · time) are nearest, with
    the least sum of distances, none more than `reach` metres, for the noise of places, plus the distance that a touch
    as fast as `fastest`, m/s, may have moved since the frame before. A touch without a contact is waited for `gap`
    seconds from the first frame without one. Where it may be hidden in another's contact, as when two fingers cross, it
    is assumed to continue with its velocity, for four gaps at most.

    **Fields**: those; `least` frames of a touch, shorter ones are not reported; `time` of the last frame, -inf before
    the first; `open` and `closed` touches; `number`, how many have begun.
    """

    gap: float = 0.15
    reach: float = 0.015
    fastest: float = 1.0
    least: int = 2
    time: float = -np.inf
    open: tuple[_Followed, ...] = ()
    closed: tuple[TouchPath, ...] = ()
    number: int = 0

    def __check_init__(self):
        """Check the fields. Raises `ValueError` for a gap and a reach that are not positive, a negative speed, and
        numbers of frames that are none."""
        check_metres("reach", self.reach)
        if not (is_number(self.fastest) and self.fastest >= 0):
            raise ValueError(f"fastest must be zero or more, in metres a second; it is {describe(self.fastest)}.")
        if not (is_number(self.gap) and self.gap > 0):
            raise ValueError(f"gap must be positive, in seconds; it is {describe(self.gap)}.")
        if not (isinstance(self.least, int) and self.least >= 1):
            raise ValueError(f"least must be a number of frames, 1 or more; it is {describe(self.least)}.")

    def follow(self, time: float, contacts: Sequence[Contact]) -> "ContactTracker":
        """Return the tracker after a frame at `time`, seconds, with these contacts. Raises `ValueError` for a time that
        is not later."""
        if not (is_number(time) and time > self.time):
            raise ValueError(f"time must be later than the frame before, {self.time:g} s; it is {describe(time)}.")
        check_kind("contacts", contacts, (list, tuple, np.ndarray), "a list of them, those of one frame")
        for number, contact in enumerate(contacts):
            check_kind(f"contacts[{number}]", contact, Contact, "a Contact, as of find_contacts")
        passed = time - self.time
        # A touch is lost at the earliest a frame after it was seen: a single missing frame of a slow stream is bridged
        # too.
        spare = min(passed, self.gap)
        waited = [time - one.seen[-1][0] > self.gap * (_HIDDEN if one.hidden else 1) + spare for one in self.open]
        late = [one for one, over in zip(self.open, waited, strict=True) if over]
        going = [one for one, over in zip(self.open, waited, strict=True) if not over]
        expected = np.array([one.at(time) for one in going]).reshape(-1, 1, 2)
        places = np.array([one.centroid for one in contacts]).reshape(1, -1, 2)
        distance = np.linalg.norm(expected - places, axis=-1)
        most = self.reach + self.fastest * passed if going else 0.0
        # All pairs farther apart are equally bad: no pair within reach is given up for them.
        rows, columns = linear_sum_assignment(np.where(distance <= most, distance, 1e3 * most))
        pairs = {int(row): int(one) for row, one in zip(rows, columns, strict=True) if distance[row, one] <= most}
        wide = self.reach + np.sqrt(np.array([one.area for one in contacts]) / np.pi)
        lost = [row for row in range(len(going)) if row not in pairs]
        hidden = {row for row in lost for one in pairs.values() if distance[row, one] <= wide[one]}
        followed = [
            _after(one, time, contacts[pairs[row]])
            if row in pairs
            else _Followed(one.number, time, one.at(time), one.velocity, one.seen, row in hidden)
            for row, one in enumerate(going)
        ]
        new = [contacts[one] for one in range(len(contacts)) if one not in pairs.values()]
        first = [
            _Followed(self.number + k, time, one.centroid, np.zeros(2), ((time, one),)) for k, one in enumerate(new)
        ]
        closed = self.closed + self._reported(late)
        values = (time, (*followed, *first), closed, self.number + len(new))
        return ContactTracker(self.gap, self.reach, self.fastest, self.least, *values)

    @property
    def touches(self) -> list[TouchPath]:
        """All touches so far, including those that continue, in order of onset."""
        return sorted(self.closed + self._reported(self.open), key=lambda path: path.number)

    def _reported(self, followed: Iterable[_Followed]) -> tuple[TouchPath, ...]:
        return tuple(one.path() for one in followed if len(one.seen) >= self.least)


def track_contacts(
    times: Float[np.ndarray, " F"], contacts: Sequence[Sequence[Contact]], tracker: ContactTracker | None = None
) -> list[TouchPath]:
    """Follow the touches of a recording: `contacts` of every frame, at `times` (F,) seconds that rise.

    `tracker` to begin with, `ContactTracker()` unless given. Raises `ValueError` for another number of times, and as
    `ContactTracker.follow` does.
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


def _after(one: _Followed, time: float, contact: Contact) -> _Followed:
    """Return a touch after a frame with this contact."""
    off = (contact.centroid - one.at(time)) / (time - one.time)
    velocity = one.velocity + _BELIEVED * off
    return _Followed(one.number, time, contact.centroid, velocity, (*one.seen, (time, contact)))
