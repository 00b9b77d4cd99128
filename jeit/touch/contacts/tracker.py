"""Track contacts from frame to frame: assign them to touches, and determine onset, end and path of each touch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from jeit.arguments import check_kind, check_metres, describe, is_number, real_array
from jeit.touch.contacts.finder import Contact
from jeit_solvers.module import Module

# Fraction of the error of a touch's velocity that is corrected in each frame: one half averages the noise of two
# frames.
_VELOCITY_GAIN = 0.5
# Maximum time for which a touch may be hidden by the contact of another touch, as a multiple of `gap`.
_MAX_HIDDEN_GAPS = 4


class TouchPath(Module):
    """Path of one touch over the skin.

    **Fields**: `number`: rank of the touch in order of onset, from 0; `times` (T,): times of the T frames in which the
    touch was detected, seconds; `position` (T, 2): centroids, metres; `peak` (T,): peaks, in the unit of the images;
    `area` (T,): areas, m².
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

    **Fields**: `number`: rank of the touch in order of onset, from 0; `time`: time of the last frame, seconds;
    `position`: position at this time, metres; `velocity`: m/s; `observations`: times and contacts so far; `is_hidden`:
    whether the contact of another touch may hide it now.
    """

    number: int
    time: float
    position: Float[np.ndarray, "2"]
    velocity: Float[np.ndarray, "2"]
    observations: tuple[tuple[float, Contact], ...]
    is_hidden: bool = False

    def predicted_position(self, time: float) -> np.ndarray:
        """Return the position predicted for `time`, seconds, at constant velocity, metres."""
        return self.position + (time - self.time) * self.velocity

    def path(self) -> TouchPath:
        """Return the path of the touch until the last frame."""
        times, contacts = zip(*self.observations, strict=True)
        contact_fields = (
            [getattr(contact, field_name) for contact in contacts] for field_name in ("centroid", "peak", "area")
        )
        return TouchPath(self.number, np.array(times), *map(np.array, contact_fields))


class ContactTracker(Module):
    """State of the tracking of touches from frame to frame.

    `tracker.follow(time, contacts)` returns the state after the next frame; `tracker` is not changed. Contacts are
    assigned to touches such that the sum of the distances between contacts and predicted positions (position + velocity
    · time) is minimal. The distance of a contact from the predicted position of its touch is at most the sum of two
    lengths: `reach`, metres, which allows for noise of positions, and the distance that a touch covers between two
    frames at the maximum speed `fastest`, m/s. A touch ends `gap` seconds after the first frame without a contact. A
    touch that may be hidden in another touch's contact, as when two fingers cross, is assumed to continue at its
    velocity for at most 4 `gap`.

    **Fields**: `gap`, `reach`, `fastest`: as above; `least`: minimum number of frames of a touch that is reported;
    `time`: time of the last frame, -inf before the first; `open`, `closed`: current touches, and touches that have
    ended; `number`: number of touches that have begun.

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
        """Return the tracker after a frame at `time`, seconds, in which `contacts` were found.

        Raises `ValueError` unless `time` is later than the time of the last frame.
        """
        if not (is_number(time) and time > self.time):
            raise ValueError(f"time must be later than the frame before, {self.time:g} s; it is {describe(time)}.")
        check_kind("contacts", contacts, (list, tuple, np.ndarray), "a list of them, those of one frame")
        for checked_index, contact in enumerate(contacts):
            check_kind(f"contacts[{checked_index}]", contact, Contact, "a Contact, as of find_contacts")
        frame_interval = time - self.time
        # The interval between frames is added, up to the gap, so that a single missing frame of a slow stream is
        # bridged too.
        gap_tolerance = min(frame_interval, self.gap)
        has_ended = [
            time - touch.observations[-1][0] > self.gap * (_MAX_HIDDEN_GAPS if touch.is_hidden else 1) + gap_tolerance
            for touch in self.open
        ]
        ended_touches = [touch for touch, is_ended in zip(self.open, has_ended, strict=True) if is_ended]
        current_touches = [touch for touch, is_ended in zip(self.open, has_ended, strict=True) if not is_ended]
        predicted_positions = np.array([touch.predicted_position(time) for touch in current_touches])
        contact_positions = np.array([contact.centroid for contact in contacts])
        touch_contact_distances = np.linalg.norm(
            predicted_positions.reshape(-1, 1, 2) - contact_positions.reshape(1, -1, 2), axis=-1
        )
        max_distance = self.reach + self.fastest * frame_interval if current_touches else 0.0
        # Every pair of a touch and a contact beyond the maximum distance has the same large cost, so that pairs within
        # this distance are preferred.
        touch_indices, assigned_indices = linear_sum_assignment(
            np.where(touch_contact_distances <= max_distance, touch_contact_distances, 1e3 * max_distance)
        )
        # Index of the contact that is assigned to each touch, by the index of the touch.
        assigned_contacts = {
            int(touch_index): int(contact_number)
            for touch_index, contact_number in zip(touch_indices, assigned_indices, strict=True)
            if touch_contact_distances[touch_index, contact_number] <= max_distance
        }
        max_hiding_distances = self.reach + np.sqrt(np.array([contact.area for contact in contacts]) / np.pi)
        unassigned_touches = [
            touch_index for touch_index in range(len(current_touches)) if touch_index not in assigned_contacts
        ]
        hidden_touches = {
            touch_index
            for touch_index in unassigned_touches
            for contact_number in assigned_contacts.values()
            if touch_contact_distances[touch_index, contact_number] <= max_hiding_distances[contact_number]
        }
        updated_touches = [
            _update_touch(touch, time, contacts[assigned_contacts[touch_index]])
            if touch_index in assigned_contacts
            else _TrackedTouch(
                touch.number,
                time,
                touch.predicted_position(time),
                touch.velocity,
                touch.observations,
                touch_index in hidden_touches,
            )
            for touch_index, touch in enumerate(current_touches)
        ]
        new_contacts = [
            contacts[contact_number]
            for contact_number in range(len(contacts))
            if contact_number not in assigned_contacts.values()
        ]
        new_touches = [
            _TrackedTouch(self.number + contact_index, time, contact.centroid, np.zeros(2), ((time, contact),))
            for contact_index, contact in enumerate(new_contacts)
        ]
        closed_touches = self.closed + self._finished_paths(ended_touches)
        tracker_fields = (time, (*updated_touches, *new_touches), closed_touches, self.number + len(new_contacts))
        return ContactTracker(self.gap, self.reach, self.fastest, self.least, *tracker_fields)

    @property
    def touches(self) -> list[TouchPath]:
        """All touches so far, including the current ones, in order of onset."""
        return sorted(self.closed + self._finished_paths(self.open), key=lambda path: path.number)

    def _finished_paths(self, touches: Iterable[_TrackedTouch]) -> tuple[TouchPath, ...]:
        return tuple(touch.path() for touch in touches if len(touch.observations) >= self.least)


def track_contacts(
    times: Float[np.ndarray, " F"], contacts: Sequence[Sequence[Contact]], tracker: ContactTracker | None = None
) -> list[TouchPath]:
    """Track touches: assign the contacts in the frames of a recording to touches, and return the paths of the touches.

    **Arguments:**

    - `times`: increasing times (F,), seconds.
    - `contacts`: contacts of every frame, as from `find_contacts`.
    - `tracker`: tracker before the first frame, by default `ContactTracker()`.

    Raises `ValueError` if there are more or fewer times than frames, and as `ContactTracker.follow` does.

    **Example:**

    ```python
    paths = track_contacts(seconds, film_contacts)
    print([path.position for path in paths])
    ```
    """
    requirement_text = "a list with those of every frame, each a list"
    check_kind("contacts", contacts, (list, tuple, np.ndarray), requirement_text)
    for frame_index, frame_contacts in enumerate(contacts):
        check_kind(
            f"contacts[{frame_index}]",
            frame_contacts,
            (list, tuple, np.ndarray),
            "a list of contacts, those of one frame",
        )
    times = real_array("times", times, "seconds (F,), one for each frame")
    if times.shape != (len(contacts),):
        raise ValueError(f"times: give one for each of the {len(contacts)} frames; they have shape {times.shape}.")
    tracker = ContactTracker() if tracker is None else tracker
    check_kind("tracker", tracker, ContactTracker, "a ContactTracker(), to begin with")
    for time, frame_contacts in zip(times, contacts, strict=True):
        tracker = tracker.follow(float(time), frame_contacts)
    return tracker.touches


def remove_side_lobes(touches: list[TouchPath], weakest: float) -> list[TouchPath]:
    """Return the touches whose maximum peak is at least `weakest` times that of every touch at the same time.

    A linear image of a contact has side lobes, which look like weaker contacts.
    """

    def find_max_simultaneous_peak(touch: TouchPath) -> float:
        simultaneous_touches = [
            other_touch
            for other_touch in touches
            if other_touch.onset <= touch.offset and touch.onset <= other_touch.offset
        ]
        return max(float(np.abs(other_touch.peak).max()) for other_touch in simultaneous_touches)

    return [touch for touch in touches if np.abs(touch.peak).max() >= weakest * find_max_simultaneous_peak(touch)]


def _update_touch(touch: _TrackedTouch, time: float, contact: Contact) -> _TrackedTouch:
    """Return the state of a touch after a frame in which `contact` is assigned to it."""
    velocity_error = (contact.centroid - touch.predicted_position(time)) / (time - touch.time)
    velocity = touch.velocity + _VELOCITY_GAIN * velocity_error
    return _TrackedTouch(touch.number, time, contact.centroid, velocity, (*touch.observations, (time, contact)))
