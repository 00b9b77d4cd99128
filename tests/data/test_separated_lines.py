"""Recordings with a separator line before each frame, some frames of which are damaged: against the numbers that were
written."""

import numpy as np
import pytest

from jeit.data import read
from jeit.imaging.possible_protocols import FileNumbers

DESCRIPTION = """
[geometry]
shape = "disk"
radius = 0.1

[electrodes]
layout = "ring"
number = 8
width = 0.01
contact_impedance = 0.01

[protocol]
kind = "adjacent"
number = 8
order = "rotating"
current = 0.001
"""
NUM_FRAMES, LENGTH = 20, 5


@pytest.fixture(scope="module")
def values():
    """Voltages of 8 electrodes, 5 channels of each drive, with the two digits of a serial port."""
    return np.round(np.random.default_rng(0).uniform(0.5, 4.0, (NUM_FRAMES, 8, 5)), 2)


def recording(values, separator="s"):
    """The lines of a recording, a list for each frame."""
    return [[separator, *(" ".join(f"{value:.2f}" for value in row) + "  " for row in frame)] for frame in values]


def written(frames, path):
    path.write_text("\n".join(line for frame in frames for line in frame) + "\n")
    path.with_suffix(".toml").write_text(DESCRIPTION)
    return path


def lose_a_line(frame):
    del frame[4]


def join_two_numbers(frame):
    frame[3] = frame[3].replace(" ", "", 1)


def add_a_number(frame):
    frame[3] += "1.00"


def insert_a_word(frame):
    frame[3] = "overflow"


def join_by_an_underscore(frame):
    frame[3] = frame[3].replace(" ", "_", 1)


def swap_digits_for_a_letter(frame):
    frame[3] = frame[3].replace(".", "x", 1)


@pytest.mark.parametrize(
    "damage",
    [lose_a_line, join_two_numbers, join_by_an_underscore, add_a_number, insert_a_word, swap_digits_for_a_letter],
)
def test_damaged_frames_are_empty(damage, values, tmp_path):
    frames = recording(values)
    for damaged in (6, 13):
        damage(frames[damaged])
    measured = read(written(frames, tmp_path / "a.txt"))
    whole = np.setdiff1d(np.arange(NUM_FRAMES), [6, 13])
    np.testing.assert_array_equal(np.abs(measured.voltages)[whole], values.reshape(NUM_FRAMES, -1)[whole])
    np.testing.assert_array_equal(measured.mask.any(axis=1), np.isin(np.arange(NUM_FRAMES), whole))
    first_line = 1 + sum(map(len, frames[:6]))
    assert any("2 of 20 parts" in note and f"from line {first_line} on" in note for note in measured.notes)


def test_a_recording_that_begins_and_ends_within_a_frame(values, tmp_path):
    frames = recording(values)
    del frames[0][:5], frames[-1][-2:]
    measured = read(written(frames, tmp_path / "a.txt"))
    assert not measured.mask[0].any()
    np.testing.assert_array_equal(np.abs(measured.voltages)[1:], values.reshape(NUM_FRAMES, -1)[1:-1])
    assert any("the last line is cut off" in note for note in measured.notes)


def test_words_beside_separators(values, tmp_path):
    frames = recording(values)
    frames[0][0], frames[1][:1] = "reference:", ["difference:", "s"]
    measured = read(written(frames, tmp_path / "a.txt"))
    np.testing.assert_array_equal(np.abs(measured.voltages), values.reshape(NUM_FRAMES, -1))


def test_a_recording_with_too_many_damaged_frames_is_refused(values, tmp_path):
    frames = recording(values)
    for damaged in (4, 9, 11):
        join_two_numbers(frames[damaged])
        frames[damaged][3] = frames[damaged][3].replace(".", ".x", 1)
    path = written(frames, tmp_path / "a.txt")
    with pytest.raises(
        ValueError, match=r"3 of 20 parts .* from line 37 on: too many .* line 40, column 1: '.*' is no"
    ):
        read(path)


@pytest.mark.parametrize("damaged", [range(0, NUM_FRAMES, 5), range(NUM_FRAMES)], ids=["every fifth", "all"])
def test_frames_without_separators_at_their_beginnings_are_refused(damaged, values, tmp_path):
    """Lines are lost, so that all later frames would be of two."""
    frames = recording(values)
    for index in damaged:
        lose_a_line(frames[index])
    with pytest.raises(ValueError, match=r"too many to be left out|are 35 numbers, and a frame has 40"):
        read(written(frames, tmp_path / "a.txt"))


def test_a_lost_separator_is_no_damage(values, tmp_path):
    frames = recording(values)
    del frames[4][0]
    measured = read(written(frames, tmp_path / "a.txt"))
    np.testing.assert_array_equal(np.abs(measured.voltages), values.reshape(NUM_FRAMES, -1))


def test_a_lost_drive_is_noticed_at_the_separator_of_the_next_frame(values, tmp_path):
    """Both the line and the separator of a drive are lost."""
    frames = [
        ["s", *(cell for k, line in enumerate(frame[1:]) for cell in (f"drive {k}", line))]
        for frame in recording(values)
    ]
    del frames[7][5:7]
    measured = read(written(frames, tmp_path / "a.txt"))
    np.testing.assert_array_equal(measured.mask.any(axis=1), np.arange(NUM_FRAMES) != 7)
    np.testing.assert_array_equal(np.abs(measured.voltages)[8:], values.reshape(NUM_FRAMES, -1)[8:])


def test_a_lost_line_between_drives_is_one_empty_drive(values, tmp_path):
    frames = [
        [cell for k, line in enumerate(frame[1:]) for cell in (f"drive {k}", line)] for frame in recording(values)
    ]
    del frames[7][5]
    measured = read(written(frames, tmp_path / "a.txt"))
    is_lost = np.zeros(values.shape, bool)
    is_lost[7, 2] = True
    np.testing.assert_array_equal(measured.mask, ~is_lost.reshape(NUM_FRAMES, -1))
    np.testing.assert_array_equal(np.abs(measured.voltages)[measured.mask], values[~is_lost])


def test_sections_of_frames_that_are_lines(values, tmp_path):
    """Sections may have any number of frames: none is damaged."""
    lines = [" ".join(f"{value:.2f}" for value in frame.ravel()) for frame in values]
    sections = [["section", *lines[:3]], *(["section", *lines[k : k + 4]] for k in range(3, NUM_FRAMES, 4))]
    measured = read(written(sections, tmp_path / "a.txt"))
    np.testing.assert_array_equal(np.abs(measured.voltages), values.reshape(NUM_FRAMES, -1))


def test_a_disturbed_byte_damages_one_frame(values, tmp_path):
    path = written(recording(values), tmp_path / "a.txt")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] = 0xFF
    path.write_bytes(content)
    assert (~read(path).mask.any(axis=1)).sum() == 1


def test_a_frame_is_a_number_of_whole_parts(values, tmp_path):
    """What a description can be found for: one part, or several."""
    path = written(recording(values), tmp_path / "a.txt")
    sizes = FileNumbers.read(path, None).sizes
    assert 40 in sizes
    assert {size % 40 for size in sizes if size > LENGTH} == {0}


def test_dashes_in_place_of_frames_are_no_separators(values, tmp_path):
    """They would be left out without a word, and later frames would move."""
    frames = [[" ".join(f"{value:.2f}" for value in frame.ravel())] for frame in values]
    frames[3] = frames[7] = ["-- -- --"]
    with pytest.raises(ValueError, match=r"line 4, column 1: '--' is no number"):
        read(written(frames, tmp_path / "a.txt"))
