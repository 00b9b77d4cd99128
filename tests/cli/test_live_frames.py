"""Frames from standard input: old frames are skipped, times come from the clock or a given rate; files have a rate.
Their number is reported as they come."""

import signal
from types import SimpleNamespace

import numpy as np
import pytest

from jeit.cli import streams
from jeit.cli.streams import FrameCounter, LiveFrames, StreamStopper


@pytest.fixture
def clock(monkeypatch):
    """A clock whose time tests advance."""

    class Clock:
        now = 100.0

        def monotonic(self):
            self.now += 1e-6
            return self.now

    own = Clock()
    monkeypatch.setattr(streams, "time", own)
    return own


def frames(clock, number, period=0.01, first=0):
    """Frames that arrive after a delay."""
    for one in range(number):
        clock.now += period
        yield [float(first + one), 1.0]


def backlog(clock, before, number, period=0.01):
    """Frames that are available at once, followed by frames that arrive after a delay."""
    yield from ([float(one), 1.0] for one in range(before))
    yield from frames(clock, number, period, before)


def test_no_frame_is_skipped_with_a_given_rate(clock):
    live = LiveFrames(backlog(clock, 20, 30), 100.0, 60.0)
    still = live.initial_frames(0.095)
    assert still[:, 0].tolist() == list(range(10))
    seconds, values = zip(*live, strict=True)
    np.testing.assert_allclose(seconds, np.arange(50) / 100)
    assert [one[0] for one in values] == list(range(50))
    assert (live.left_out, live.measured_rate) == (0, 100.0)


def test_old_frames_are_skipped(clock):
    live = LiveFrames(backlog(clock, 20, 300), None, 100.0)
    still = live.initial_frames(0.1)
    assert live.left_out == 22  # and two of the three delayed frames
    assert still[0, 0] == 22
    assert live.measured_rate == pytest.approx(100, rel=1e-2)
    clock.now += 1.0  # time that the caller takes to get ready
    seconds, values = zip(*live, strict=True)
    assert values[0][0] == 22
    assert seconds[0] == 0
    assert (np.diff(seconds) >= 0).all()
    assert np.diff(seconds).max() > 1.0
    assert values[-1][0] == 319


def test_a_file_without_a_rate_has_the_default_one(clock):
    live = LiveFrames(backlog(clock, 50, 0), None, 25.0)
    assert len(live.initial_frames(0.4)) == 11
    seconds, values = zip(*live, strict=True)
    np.testing.assert_allclose(seconds, np.arange(50) / 25)
    assert len(values) == 50
    assert live.left_out == 0


def test_a_source_that_never_waits_is_read_all_the_same(clock):
    live = LiveFrames(frames(clock, 20_000, 1e-3), None, 60.0)
    assert len(live.initial_frames(1.0)) == pytest.approx(1000, abs=3)
    assert live.left_out == pytest.approx(5000, rel=0.05)


def test_lines_without_numbers_are_not_taken_for_the_reference(clock):
    def lines():
        yield from frames(clock, 5)
        yield "no numbers"
        yield [1.0]
        yield from frames(clock, 30)

    live = LiveFrames(lines(), 100.0, 60.0)
    assert live.initial_frames(0.2).shape[1] == 2
    assert sum(frame == "no numbers" for _, frame in live) == 1
    with pytest.raises(ValueError, match="no frame of numbers"):
        LiveFrames(iter(["a", "b"]), None, 60.0).initial_frames(1.0)


def test_ctrl_c_ends_the_stream(clock):
    """Both while waiting for a frame and while a frame is processed."""

    def lines():
        yield from frames(clock, 3)
        signal.raise_signal(signal.SIGINT)
        yield from frames(clock, 3)

    with StreamStopper() as stopping:
        assert len(list(stopping.frames_until_signal(LiveFrames(lines(), 10.0, 10.0)))) == 3
    seen = []
    with StreamStopper() as stopping:
        for second, _ in stopping.frames_until_signal(LiveFrames(frames(clock, 9), 10.0, 10.0)):
            seen.append(second)
            if len(seen) == 4:
                signal.raise_signal(signal.SIGINT)
    assert len(seen) == 4


@pytest.mark.parametrize(("number", "total"), [(None, ""), (1200, " of 1,200")])
def test_the_number_of_frames_is_reported_at_once_and_then_a_few_times_a_second(clock, number, total):
    reported = []
    counter = FrameCounter(SimpleNamespace(report=reported.append), number)
    for _ in range(1100):
        counter.count_frame()
        clock.now += 0.001
    assert counter.number == 1100
    first, *others, last = [text.removesuffix(total) for text in reported]
    assert first == "frame 1"
    assert len(others) in (2, 3, 4)
    assert last.startswith("frame 1,0")
