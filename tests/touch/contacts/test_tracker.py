"""Tracked touches: identities where paths cross, gaps, onsets and offsets."""

import numpy as np
import pytest

from jeit.touch.contacts import Contact, ContactTracker, track_contacts
from jeit.touch.contacts.tracker import TouchPath, remove_side_lobes

TIMES = np.arange(60) / 60


def contact(place, peak=1.0):
    return Contact(np.asarray(place, float), 1e-4, peak, 1e-4, np.zeros((3, 2)), 0.0)


def crossing(hide):
    """Two fingers at right angles, one contact between them while they are closer than `hide`. Their peaks distinguish
    them.
    """
    along = np.linspace(-0.03, 0.03, 60)
    frames = []
    for x in along:
        first, second = np.array([x, x]) / np.sqrt(2), np.array([x, -x]) / np.sqrt(2)
        near = np.linalg.norm(first - second) < hide
        frames.append([contact((first + second) / 2)] if near else [contact(second, 2.0), contact(first, 1.0)])
    return frames


@pytest.mark.parametrize("hide", [0.0, 0.008, 0.02])
def test_fingers_that_cross_keep_their_identities(hide):
    touches = track_contacts(TIMES, crossing(hide))
    assert len(touches) == 2
    for path in touches:
        apart = np.abs(np.linspace(-0.03, 0.03, 60)) * np.sqrt(2) > 0.021
        own = path.peak[np.isin(path.times, TIMES[apart])]
        assert len(set(own)) == 1
        assert path.length == pytest.approx(0.06, rel=0.3)


def test_without_velocity_they_would_be_exchanged():
    """Fingers that meet head on and pass: the nearest places alone would exchange them."""
    along = np.linspace(-0.03, 0.03, 61)
    frames = [[contact((x, 0.001), 1.0), contact((-x, -0.001), 2.0)] for x in along]
    touches = track_contacts(np.arange(61) / 60, frames)
    assert [len(set(path.peak)) for path in touches] == [1, 1]


def test_short_gaps_are_bridged_and_long_ones_separate_touches():
    place = np.stack([0.1 * TIMES, 0 * TIMES], axis=-1)
    seen = [[contact(one)] for one in place]
    short = [[] if 20 <= k < 26 else one for k, one in enumerate(seen)]
    (path,) = track_contacts(TIMES, short)
    assert (path.onset, path.offset, len(path.times)) == (0.0, TIMES[-1], 54)
    long = [[] if 20 <= k < 40 else one for k, one in enumerate(seen)]
    first, second = track_contacts(TIMES, long)
    assert first.offset == TIMES[19]
    assert second.onset == TIMES[40]


def test_a_touch_of_one_frame_is_not_reported():
    frames = [[contact((0.0, 0.0))] if k == 5 else [] for k in range(20)]
    assert track_contacts(TIMES[:20], frames) == []
    assert len(track_contacts(TIMES[:20], frames, ContactTracker(least=1))) == 1


def test_distant_contacts_are_another_touch():
    frames = [[contact((0.0, 0.0))]] * 10 + [[contact((0.04, 0.0))]] * 10
    assert len(track_contacts(TIMES[:20], frames)) == 2


@pytest.mark.parametrize(("rate", "speed", "side"), [(30, 0.4, 0.07), (30, 0.6, 0.8), (10, 0.1, 0.1), (200, 1.0, 0.05)])
def test_a_stroke_is_one_touch_of_its_length(rate, speed, side):
    """With a reach of 12 mm at any rate, the first was reported with 17 mm of its length and the second not at all."""
    along = np.arange(0, side, speed / rate)
    stray = np.random.default_rng(0).normal(0, 5e-4, (len(along), 2))
    frames = [[contact(place)] for place in stray + np.stack([along, 0 * along], axis=-1)]
    frames[len(along) // 2] = []  # missed
    (path,) = track_contacts(np.arange(len(along)) / rate, frames)
    assert path.position[-1, 0] - path.position[0, 0] == pytest.approx(along[-1], abs=3e-3)


@pytest.mark.parametrize("rate", [10, 30, 200])
def test_two_adjacent_fingers_stay_two_touches(rate):
    """Three centimetres apart at 0.3 m/s, one behind the other: at 10 frames/s each moves farther in a frame than their
    distance.
    """
    along = np.arange(0, 0.3, 0.3 / rate)
    frames = [[contact((x, 0.0), 1.0), contact((x + 0.03, 0.0), 2.0)] for x in along]
    touches = track_contacts(np.arange(len(along)) / rate, frames)
    assert [set(path.peak) for path in touches] == [{1.0}, {2.0}]


def test_missed_frames_of_a_slow_stream_are_bridged():
    frames = [[] if k == 5 else [contact((0.01 * k, 0.0))] for k in range(10)]
    assert len(track_contacts(np.arange(10) / 10, frames)) == 1


def test_a_tracker_is_immutable():
    empty = ContactTracker()
    after = empty.follow(0.0, [contact((0, 0))]).follow(0.1, [contact((0, 0))])
    assert empty.touches == []
    assert len(after.touches) == 1


def test_bad_input():
    with pytest.raises(ValueError, match="later"):
        ContactTracker().follow(1.0, []).follow(1.0, [])
    with pytest.raises(ValueError, match="times: give one"):
        track_contacts(TIMES[:3], [[]])
    with pytest.raises(ValueError, match=r"contacts\[0\]"):
        ContactTracker().follow(0.0, [(0.0, 0.0)])  # pyright: ignore[reportArgumentType]
    for times, frames, message in (
        ("abc", [[]] * 3, "times must be seconds"),
        ([[]] * 3, TIMES[:3], r"contacts\[0\] must be a list"),
        (TIMES[:3], [contact((0.0, 0.0))] * 3, r"contacts\[0\] must be a list"),
        (TIMES[:3], None, "contacts must be a list"),
        (1.0, [[]], "they have shape"),
    ):
        with pytest.raises(ValueError, match=message):
            track_contacts(times, frames)
    with pytest.raises(ValueError, match="tracker must be"):
        track_contacts(TIMES[:1], [[]], ContactTracker)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="contacts must be a list"):
        ContactTracker().follow(0.0, contact((0.0, 0.0)))  # pyright: ignore[reportArgumentType]
    for options in ({"gap": 0.0}, {"reach": -1.0}, {"fastest": -1.0}, {"least": 0}):
        with pytest.raises(ValueError, match=next(iter(options))):
            ContactTracker(**options)


def test_paths_beside_a_much_stronger_touch_are_side_lobes():
    """At the same time only: a light touch that is alone stays."""

    def path(number, onset, offset, peak):
        times = np.array([onset, offset])
        return TouchPath(number, times, np.zeros((2, 2)), np.full(2, peak), np.ones(2))

    strong, beside = path(0, 0.0, 1.0, 1.0), path(1, 0.5, 2.0, 0.3)
    alone, negative = path(2, 3.0, 4.0, 0.2), path(3, 0.0, 1.0, -0.9)
    remaining = remove_side_lobes([strong, beside, alone, negative], 0.4)
    assert [touch.number for touch in remaining] == [0, 2, 3]
    assert len(remove_side_lobes([strong, beside], 0.3)) == 2
