"""Frames of standard input: what came before it was read is left out, the clock tells the rest; files by a rate."""

import signal

import numpy as np
import pytest

from jeit.cli import live_frames
from jeit.cli.live_frames import LiveFrames
from jeit.cli.stopping import Stopping


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes when it is told to."""

    class Clock:
        now = 100.0

        def monotonic(self):
            self.now += 1e-6
            return self.now

    own = Clock()
    monkeypatch.setattr(live_frames, "time", own)
    return own


def frames(clock, number, period=0.01, first=0):
    """Frames that have to be waited for."""
    for one in range(number):
        clock.now += period
        yield [float(first + one), 1.0]


def backlog(clock, before, number, period=0.01):
    """Some that are there already, then such as have to be waited for."""
    yield from ([float(one), 1.0] for one in range(before))
    yield from frames(clock, number, period, before)


def test_by_a_rate_every_frame_counts(clock):
    live = LiveFrames(backlog(clock, 20, 30), 100.0, 60.0)
    still = live.untouched(0.095)
    assert still[:, 0].tolist() == list(range(10))
    seconds, values = zip(*live, strict=True)
    np.testing.assert_allclose(seconds, np.arange(50) / 100)
    assert [one[0] for one in values] == list(range(50))
    assert (live.left_out, live.rate_seen) == (0, 100.0)


def test_what_came_before_is_left_out(clock):
    live = LiveFrames(backlog(clock, 20, 300), None, 100.0)
    still = live.untouched(0.1)
    assert live.left_out == 22  # and two of the three that had to be waited for
    assert still[0, 0] == 22
    assert live.rate_seen == pytest.approx(100, rel=1e-2)
    clock.now += 1.0  # something is made ready meanwhile
    seconds, values = zip(*live, strict=True)
    assert values[0][0] == 22
    assert seconds[0] == 0
    assert (np.diff(seconds) >= 0).all()
    assert np.diff(seconds).max() > 1.0
    assert values[-1][0] == 319


def test_a_file_without_a_rate_has_the_usual_one(clock):
    live = LiveFrames(backlog(clock, 50, 0), None, 25.0)
    assert len(live.untouched(0.4)) == 11
    seconds, values = zip(*live, strict=True)
    np.testing.assert_allclose(seconds, np.arange(50) / 25)
    assert len(values) == 50
    assert live.left_out == 0


def test_a_source_too_quick_to_wait_for_is_read_all_the_same(clock):
    live = LiveFrames(frames(clock, 20_000, 1e-3), None, 60.0)
    assert len(live.untouched(1.0)) == pytest.approx(1000, abs=3)
    assert live.left_out == pytest.approx(5000, rel=0.05)


def test_what_are_no_numbers_is_not_taken_for_the_untouched_skin(clock):
    def lines():
        yield from frames(clock, 5)
        yield "no numbers"
        yield [1.0]
        yield from frames(clock, 30)

    live = LiveFrames(lines(), 100.0, 60.0)
    assert live.untouched(0.2).shape[1] == 2
    assert sum(frame == "no numbers" for _, frame in live) == 1
    with pytest.raises(ValueError, match="no frame of numbers"):
        LiveFrames(iter(["a", "b"]), None, 60.0).untouched(1.0)


def test_ctrl_c_ends_it(clock):
    """While a frame is waited for, and while one is looked at."""

    def lines():
        yield from frames(clock, 3)
        signal.raise_signal(signal.SIGINT)
        yield from frames(clock, 3)

    with Stopping() as stopping:
        assert len(list(stopping.until(LiveFrames(lines(), 10.0, 10.0)))) == 3
    seen = []
    with Stopping() as stopping:
        for second, _ in stopping.until(LiveFrames(frames(clock, 9), 10.0, 10.0)):
            seen.append(second)
            if len(seen) == 4:
                signal.raise_signal(signal.SIGINT)
    assert len(seen) == 4
