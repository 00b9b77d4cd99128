"""Lines split from bytes, against Python's own splitting, and numbers as volts, against the readers of files."""

import tracemalloc

import numpy as np
import pytest
from small_sensor import CHANNELS, description, measured, noisy

from jeit.data import read
from jeit.data.formats.lines import LineBuffer, LineParser


def pieces(content, longest):
    """Content in chunks of random length."""
    random = np.random.default_rng(0)
    while content:
        size = int(random.integers(1, longest + 1))
        yield content[:size]
        content = content[size:]


@pytest.mark.parametrize("longest", [1, 3, 7, 1000])
def test_lines_do_not_depend_on_chunk_boundaries(longest):
    content = b"1, 2, 3\r\n\n  \n4;5;6\rmagnitudes : 1,2\nx\xff\x00y\nlast"
    buffer = LineBuffer()
    lines = [line for piece in pieces(content, longest) for line in buffer.add_bytes(piece)]
    assert lines == [b"1, 2, 3", b"4;5;6", b"magnitudes : 1,2", b"x\xff\x00y"]
    assert buffer.take_incomplete_line() == b"last"
    assert buffer.take_incomplete_line() == b""


@pytest.mark.parametrize("longest", [1, 5, 1000])
def test_frames_of_openeit_are_separated_without_line_ends(longest):
    buffer = LineBuffer()
    content = b"boot magnitudes : 1, 2,magnitudes : 3, 4\nMagnitudes: 5, 6magnitudes : 7"
    lines = [line for piece in pieces(content, longest) for line in buffer.add_bytes(piece)]
    assert lines == [b"boot ", b"magnitudes : 1, 2,", b"magnitudes : 3, 4", b"Magnitudes: 5, 6"]
    assert buffer.take_incomplete_line() == b"magnitudes : 7"


def test_a_line_without_end_uses_bounded_memory_and_the_next_one_is_complete():
    buffer, piece = LineBuffer(10_000), b"7" * 4096
    tracemalloc.start()
    for _ in range(500):
        assert buffer.add_bytes(piece) == []
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 200_000
    (line,) = buffer.add_bytes(b"\n")
    assert line == b"7" * 10_000 + "…".encode()
    assert buffer.add_bytes(b"1, 2\n") == [b"1, 2"]


def frame_in(reading, line):
    """The frame in a line, which must contain one."""
    found = reading(line)
    assert isinstance(found, np.ndarray)
    return found


LINES = {
    "volts": ("", lambda v: ", ".join(map(repr, v))),
    "millivolts, reversed": ('unit = "mV"\npolarity = "reversed"\n', lambda v: " ".join(repr(-1e3 * x) for x in v)),
    "gain, semicolons": ("gain = 10.0\n", lambda v: ";".join(repr(10 * x) for x in v) + ";"),
    "decimal commas": ("", lambda v: "; ".join(repr(x).replace(".", ",") for x in v)),
    "a word, magnitudes": ("", lambda v: "frame: " + ", ".join(repr(abs(x)) for x in v)),
    "time first": ("", lambda v: ", ".join(map(repr, [12.25, *v]))),
}


@pytest.mark.parametrize("kind", LINES)
def test_a_line_has_the_volts_that_the_reader_finds_in_a_file(kind, tmp_path):
    data, write = LINES[kind]
    described = description(tmp_path / "sensor.toml", data)
    frames = noisy(3, seed=1)
    (tmp_path / "sensor.csv").write_text("".join(write(one.tolist()) + "\n" for one in frames[:1]))
    expected = np.asarray(read(tmp_path / "sensor.csv", description=described, like=measured()).voltages)
    reading = LineParser(described, measured())
    found = [frame_in(reading, write(one.tolist()).encode()) for one in frames]
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-12)
    np.testing.assert_allclose(np.stack(found), frames, rtol=1e-9)
    assert reading.note == ""


def test_openeit_lines_have_the_volts_of_its_reader(tmp_path):
    values = np.random.default_rng(0).uniform(100, 900, 192).round(3)
    values[5] = 0
    line = "magnitudes : " + ", ".join(map(str, values.tolist())) + "\n"
    (tmp_path / "openeit.txt").write_text(line)
    described = tmp_path / "sensor.toml"
    described.write_text(
        '[geometry]\nshape = "disk"\nradius = 0.1\n[electrodes]\nlayout = "ring"\nnumber = 16\nwidth = 0.01\n'
        "contact_impedance = 1e-3\n"
    )
    expected = read(tmp_path / "openeit.txt", description=described)
    reading = LineParser(described, expected)
    for _ in range(2):
        found = frame_in(reading, line.strip().encode())
        np.testing.assert_allclose(found[found == found], np.asarray(expected.voltages)[0][found == found], rtol=1e-9)
        np.testing.assert_array_equal(np.isfinite(found), np.asarray(expected.mask)[0])


def test_a_disturbed_first_frame_does_not_fix_signs():
    reading = LineParser(None, measured())
    first = np.random.default_rng(0).uniform(1e-3, 1e-2, CHANNELS)
    assert (frame_in(reading, ", ".join(map(repr, first.tolist())).encode()) < 0).any()  # taken for magnitudes
    frame = noisy(1)[0]
    np.testing.assert_allclose(frame_in(reading, ", ".join(map(repr, frame.tolist())).encode()), frame, rtol=1e-12)


def test_a_channel_that_one_frame_has_wrong_is_known_from_the_next():
    """In the first frame the reader masks one channel, and another is zero."""
    reading, frames = LineParser(None, measured()), noisy(3)
    first = frames[0].copy()
    first[[2, 9]] = 0.0, 1e3
    for values in (first, *frames[1:]):
        found = frame_in(reading, ", ".join(map(repr, values.tolist())).encode())
        np.testing.assert_allclose(found, values, rtol=1e-12)


GARBAGE = [b"\xff\xfe\x00\x01", b"hello", b"1, 2, x", b"\x00" * 50, b",,,,", "½, 3".encode(), b"-" * 1000, b"1" * 9999]


@pytest.mark.parametrize("line", GARBAGE)
def test_garbage_is_text_or_numbers_of_another_number(line):
    found = LineParser(None, measured())(line)
    assert found is not None
    assert len(found) <= 400 if isinstance(found, str) else len(found) != CHANNELS


def corrupted(content, random):
    """Content with some bytes changed, removed or repeated, or with numbers made huge."""
    content = bytearray(content)
    for _ in range(int(random.integers(1, 6))):
        place = int(random.integers(len(content)))
        kind = int(random.integers(5))
        if kind == 0:
            content[place] = int(random.integers(256))
        elif kind == 1:
            del content[place : place + int(random.integers(1, 200))]
        elif kind == 2:
            content[place:place] = random.bytes(int(random.integers(1, 50)))
        elif kind == 3:
            content[place:place] = random.choice(
                [b"e308", b"e999", b"nan", b"inf", b"-", b"_", b"magnitudes:", b"\x00"]
            )
        else:
            content[place:place] = content[: int(random.integers(1, 100))]
        content = content or bytearray(b"x")
    return bytes(content)


@pytest.mark.parametrize("word", ["", "magnitudes : "])
def test_corrupted_lines_are_frames_or_text_and_leave_the_others_correct(word):
    """Half of the lines are corrupted at random, from the first on."""
    reading, buffer, random = LineParser(None, measured()), LineBuffer(5000), np.random.default_rng(0)
    frames, right = noisy(400), 0
    for number, values in enumerate(frames):
        line = (word + ", ".join(map(repr, (abs(values) if word else values).tolist()))).encode()
        whole = number % 2 == 1
        for one in buffer.add_bytes((line if whole else corrupted(line, random)) + b"\n"):
            found = reading(one)
            assert found is None or (len(found) <= 400 if isinstance(found, str) else found.ndim == 1)
            if whole and number > 50:
                assert isinstance(found, np.ndarray)
                np.testing.assert_allclose(found, values, rtol=1e-12)
                right += 1
    assert right == 175


def test_gaps_and_non_numeric_words_become_nan_and_comments_notes():
    reading = LineParser()
    np.testing.assert_array_equal(reading(b"1,,nan,4"), [1, np.nan, np.nan, 4])
    assert reading(b"# ready, 16 electrodes") is None
    assert reading.note == "# ready, 16 electrodes"


def test_frames_of_two_lines_are_refused_with_advice(tmp_path):
    with pytest.raises(ValueError, match="complex_pairs makes a frame of two lines"):
        LineParser(description(tmp_path / "d.toml", "complex_pairs = true\n"))


def test_numbers_without_a_reader_are_volts_with_a_note():
    frame = noisy(1)[0]
    sensor = measured()
    reading = LineParser(None, sensor)
    reading._read_volts = lambda row, word: (_ for _ in ()).throw(ValueError("no table"))
    np.testing.assert_array_equal(reading(", ".join(map(repr, frame.tolist())).encode()), frame)
    assert "no table" in reading.note
