"""Frames that a device sends as several lines after a separator line, against the frames that were sent."""

import numpy as np
import pytest
from small_sensor import CHANNELS, measured, noisy

from jeit.data.formats.lines import LineParser
from jeit.data.formats.separated import WrappedLines

LENGTH = CHANNELS // 4


def lines_of(frame, separator="s"):
    rows = frame.reshape(-1, LENGTH).tolist()
    return [separator, *(" ".join(map(repr, row)) + "  " for row in rows)]


def read_lines(lines):
    reading = LineParser(None, measured())
    return [found for line in lines if (found := reading(line.encode())) is not None]


@pytest.mark.parametrize("separators", [("s", "s", "s"), ("frame 1", "frame 2", "frame 3")])
def test_lines_of_a_frame_are_joined(separators):
    frames = noisy(3)
    lines = [line for frame, separator in zip(frames, separators, strict=True) for line in lines_of(frame, separator)]
    first, *found = read_lines(lines)
    assert first == separators[0]
    np.testing.assert_allclose(np.stack(found), frames, rtol=1e-9)


def test_damaged_frames_are_refused_alone():
    """A frame that lacks a line has the wrong number of channels, and an unreadable line is returned as text."""
    frames = noisy(5)
    parts = [lines_of(frame) for frame in frames]
    del parts[1][2]
    parts[3][2] = "0.87.57 1.0"
    _, first, short, third, text, last = read_lines([line for part in parts for line in part])
    assert len(short) == CHANNELS - LENGTH
    assert text == "0.87.57 1.0"
    np.testing.assert_allclose(np.stack([first, third, last]), frames[[0, 2, 4]], rtol=1e-9)


def test_words_before_the_separator_of_later_frames():
    """The reference comes after its own word."""
    frames = noisy(4)
    lines = [*lines_of(frames[0], "ref:"), "diff:", *(line for frame in frames[1:] for line in lines_of(frame))]
    found = [one for one in read_lines(lines) if not isinstance(one, str)]
    np.testing.assert_allclose(np.stack(found), frames, rtol=1e-9)


def test_lines_that_are_frames_are_not_joined():
    """A device that sends a frame a line, and text at its start; one line is cut off."""
    line = [1.0] * CHANNELS
    join_lines = WrappedLines(CHANNELS)
    assert join_lines("ready") == "ready"
    assert join_lines(line) == line
    assert join_lines(line[:-1]) == line[:-1]
    assert join_lines(line) == line
