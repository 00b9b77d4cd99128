"""Readers of instruments' files: what is written by the published description is read back in order, and every fault is
reported."""

import numpy as np
import pytest
import scipy.io
from instrument_files import (
    adjacent_channels,
    adjacent_voltages,
    write_carefusion,
    write_draeger,
    write_get,
    write_sciospec,
    write_swisstom,
)

from jeit import data, protocol
from jeit.data.formats import table
from jeit.data.quality import impossible_signs
from jeit.data.registry import FORMATS

RING = (
    '[geometry]\nshape = "disk"\nradius = 0.1\n[electrodes]\nlayout = "ring"\nwidth = 0.01\ncontact_impedance = 0.01\n'
)


def impedance(number, seed=0):
    """Transfer impedance of a disk with small electrodes and a body in it; symmetric, with rows that sum to zero."""
    angle = 2 * np.pi * np.arange(number) / number
    place = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    distance = np.linalg.norm(place[:, None] - place, axis=-1) + np.eye(number) * 0.05
    made = -30 * np.log(distance)
    bump = np.exp(-((place - [0.3, 0.9]) ** 2).sum(axis=1)) * (1 + 0.1 * seed)
    made = made + 2 * np.outer(bump, bump)
    keep = np.eye(number) - 1 / number
    return keep @ made @ keep


def frames(count=3):
    return np.array([adjacent_voltages(impedance(16, seed)) for seed in range(count)])


ADJACENT = {
    "draeger": ("a.eit", write_draeger, 20.0),
    "draeger, 32": ("a.eit", lambda path, made: write_draeger(path, made, version=0x20, rate="50"), 50.0),
    "goettingen": ("a.get", write_get, None),
    "goettingen, with text": ("a.get", lambda path, made: write_get(path, made, text=True), None),
    "carefusion": ("a.eit", write_carefusion, None),
}


@pytest.mark.parametrize("kind", ADJACENT)
def test_adjacent_voltages_are_read_in_order(kind, tmp_path):
    name, write, rate = ADJACENT[kind]
    made = frames()
    write(tmp_path / name, made)
    (tmp_path / "a.toml").write_text(RING + "number = 16\n")
    found = data.read(tmp_path / name)
    exact = 1e-6 if name.endswith(".get") or kind == "carefusion" else 1e-12  # 32-bit numbers
    np.testing.assert_allclose(found.voltages, -made, rtol=exact)
    drives, reads = np.asarray(found.protocol.channel_drive), np.asarray(found.protocol.channel_measurement)
    for channel, (p, q, r, s) in enumerate(adjacent_channels()):
        assert [drives[channel].argmax(), drives[channel].argmin()] == [p, q]
        assert [reads[channel].argmax(), reads[channel].argmin()] == [r, s]
    assert data.reciprocity_error(found) < 10 * exact
    assert impossible_signs(found).max() == 0
    assert found.frame_rate == (None if rate is None else pytest.approx(rate))
    assert any("not" in note for note in found.notes)


@pytest.mark.parametrize(
    ("made", "table"),
    [
        (protocol.opposite(8, drives="all", order="fixed"), "number = 8\n"),
        (protocol.opposite(16, drives="all", order="fixed"), "number = 16\n"),
        (protocol.adjacent(32, order="fixed"), "number = 32\n"),
        (protocol.two_terminal(8), "number = 8\n"),
    ],
    ids=lambda one: getattr(one, "name", ""),
)
def test_lines_of_openeit(made, table, tmp_path):
    """Line ends of every kind or none, zeros of open circuits, and an incomplete last frame; the signs come from the
    body."""
    ohms = made.channel_measurement @ impedance(made.num_electrodes) * made.channel_drive
    ohms = np.asarray(ohms.sum(axis=1)) / 1e-3
    line = "magnitudes :" + "".join(f"{abs(one):12.4f} ," for one in ohms)
    (tmp_path / "empty.bin").write_bytes(f"\r\n{line}\r{line} \r\n{line}{line[:54]}".encode())
    (tmp_path / "empty.toml").write_text(RING + table)
    found = data.read(tmp_path / "empty.bin")
    assert found.num_frames == 3
    assert found.protocol.same_patterns(made)
    np.testing.assert_allclose(found.voltages, np.tile(1e-3 * ohms, (3, 1)), atol=1e-7)
    assert any("cut off after 3 numbers" in note for note in found.notes)
    first = f"{abs(ohms[0]):.4f}"
    (tmp_path / "rod.txt").write_text(line.replace(first, "0", 1))
    rod = data.read(tmp_path / "rod.txt", like=found)
    assert np.asarray(rod.mask)[0].tolist() == [False] + [True] * (len(ohms) - 1)
    np.testing.assert_allclose(rod.voltages[0, 1:], found.voltages[0, 1:])
    # A described protocol takes precedence and decides the meaning of the numbers.
    kind = '[protocol]\nkind = "two-terminal"\ncurrent = 1.0\n'
    (tmp_path / "rod.toml").write_text(RING + "number = 8\n" + kind)
    if made.num_measurements == 28:
        np.testing.assert_allclose(data.read(tmp_path / "rod.txt").voltages[0, 1:], ohms[1:], atol=1e-4)
    else:
        with pytest.raises(ValueError, match="28"):
            data.read(tmp_path / "rod.txt")


def test_characters_lost_by_openeit(tmp_path):
    """Serial lines lose characters: the rest of a number or frame is masked, and never taken for another."""
    path = tmp_path / "a.txt"
    frame = "magnitudes: " + "".join(f"{one}.5 , " for one in range(1, 33))
    cells = frame.replace("3.5", "3x5", 1).replace("7.5", "-7.5", 1).replace("9.5", "1_000", 1)
    path.write_text("12.5 , " + frame + frame.replace("2.5 , ", "2.5", 1) + cells + "\nINFO 3\n" + frame.rstrip(" ,"))
    found = data.read(path)
    assert np.asarray(found.mask).sum(axis=1).tolist() == [32, 0, 29, 31]
    for note in ("lost in frame 1: masked", "6 characters before the first", "nothing follows the last number"):
        assert any(note in one for one in found.notes), note
    assert any("4 readings of zero, as of an open circuit, or illegible" in note for note in found.notes)
    path.write_text(frame + frame[:40])
    assert data.read(path).num_frames == 1
    # A lost word joins two frames; the later frames keep their times.
    path.write_text(frame + frame + frame.replace("magnitudes: ", "") + frame + "\n")
    path.with_suffix(".toml").write_text("[data]\nframe_rate = 10\n")
    found = data.read(path)
    assert np.asarray(found.mask).all(axis=1).tolist() == [True, False, False, True]
    np.testing.assert_allclose(found.times, [0, 0.1, 0.2, 0.3])


def test_defaults_of_openeit_descriptions(tmp_path):
    """The order of opposite drives, which reciprocity cannot show; stated units apply to the numbers."""
    path = tmp_path / "a.txt"
    path.write_text("magnitudes: " + "".join(f"{one}.5 , " for one in range(1, 33)))
    body, kind = RING + "number = 8\n", '[protocol]\nkind = "opposite"\ndrives = "all"\ncurrent = 2e-3\n'
    (tmp_path / "a.toml").write_text(body + kind)
    found = data.read(path)
    assert found.protocol.same_patterns(protocol.opposite(8, drives="all", order="fixed", current=2e-3))
    np.testing.assert_allclose(np.abs(found.voltages[0]), 2e-3 * (np.arange(1, 33) + 0.5))
    assert any("as the firmware sends" in note for note in found.notes)
    (tmp_path / "a.toml").write_text(body + kind + 'order = "rotating"\n')
    assert data.read(path).protocol.same_patterns(protocol.opposite(8, drives="all", current=2e-3))
    (tmp_path / "a.toml").write_text(body + '[data]\nunit = "mV"\n')
    np.testing.assert_allclose(np.abs(data.read(path).voltages[0]), 1e-3 * (np.arange(1, 33) + 0.5))


def test_setups_that_openeit_does_not_support_are_refused(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("magnitudes: 1, 2, 3")
    with pytest.raises(ValueError, match="most frames have 3 numbers; the firmware sends 32 \\(8 electrodes\\)"):
        data.read(path, "openeit")
    path.write_text("1, 2, 3")
    with pytest.raises(ValueError, match="no frame begins with 'magnitudes:'"):
        data.read(path, "openeit")
    path.write_text(2 * ("magnitudes: " + "1.5, " * 28) + 3 * ("magnitudes: " + "1.5, " * 32))
    with pytest.raises(ValueError, match="2 frames have 28 numbers, and 3 have 32"):
        data.read(path)
    path.write_text("magnitudes: " + "1.5, " * 32)
    with pytest.raises(ValueError, match="no arrays to choose from"):
        data.read(path, key="a")


def test_reciprocal_channels_may_be_missing(tmp_path):
    made = frames()
    later = [(p, r) for p, _, r, _ in adjacent_channels()]
    made[:, [r < p for p, r in later]] = 0
    write_get(tmp_path / "a.get", made)
    found = data.read(tmp_path / "a.get")
    assert np.asarray(found.mask).sum(axis=1).tolist() == [104] * 3
    assert any("104 of 208 channels were not measured" in note for note in found.notes)


def test_the_rate_of_goettingen_frames_is_read_from_the_record_beside_them(tmp_path):
    write_get(tmp_path / "a.get", frames())
    (tmp_path / "a.prl").write_text("Number of frames = 3\r\nFramerate = 13 per second\r\nGain = 1000")
    found = data.read(tmp_path / "a.get")
    assert found.frame_rate == pytest.approx(13)
    assert not any("rate" in note for note in found.notes)
    (tmp_path / "a.toml").write_text("[data]\nframe_rate = 26\n")
    assert data.read(tmp_path / "a.get").frame_rate == pytest.approx(26)
    (tmp_path / "a.toml").unlink()
    (tmp_path / "a.prl").write_text("Framerate = 0 per second")
    assert data.read(tmp_path / "a.get").frame_rate is None


def test_swisstom(tmp_path):
    made = np.array([1e-3 * impedance(32, seed) * (1 + 0.1j) for seed in range(3)])
    times = np.array([2**32 - 30_000, 2**32 - 10_000, 2**32 + 10_000])  # the counter overflows
    write_swisstom(tmp_path / "a.eit", made, times)
    (tmp_path / "a.toml").write_text(RING + 'number = 32\n[data]\ncomponent = "complex"\n')
    found = data.read(tmp_path / "a.eit")
    expected = protocol.skip(32, 4, current=5e-3, driven_electrodes=True, order="fixed")
    assert found.protocol.same_patterns(expected)
    drives, reads = np.asarray(expected.channel_drive), np.asarray(expected.channel_measurement)
    voltages = np.array([np.einsum("kl,lm,km->k", reads, one, drives) for one in made])
    mask = np.asarray(found.mask)
    np.testing.assert_array_equal(mask[0], ~expected.channels_on_driven_electrodes())
    np.testing.assert_allclose(found.voltages[mask], voltages[mask], atol=1e-11)
    assert found.frame_rate == pytest.approx(50)
    assert data.reciprocity_error(found) < 1e-6


PAIRS = [(k + 1, (k + 3) % 8 + 1) for k in range(8)]


@pytest.mark.parametrize("header", [9, 11, 18])
def test_sciospec(tmp_path, header):
    made = np.array([impedance(8) * (1 - 0.2j), impedance(8, 1) * (1 - 0.1j)])
    write_sciospec(tmp_path / "a.eit", made, PAIRS, header=header, spare=24 if header == 18 else 0)
    (tmp_path / "a.toml").write_text(RING + 'number = 8\n[data]\ncomponent = "complex"\n')
    found = data.read(tmp_path / "a.eit")
    assert found.frame_names == ("1000 Hz", "10000 Hz")
    assert found.protocol.num_electrodes == 8
    expected = 1e-3 * made[1] @ (np.eye(8)[2] - np.eye(8)[5])
    np.testing.assert_allclose(found.voltages[1].reshape(8, 8)[2], expected, atol=1e-10)
    assert data.reciprocity_error(found) < 1e-7


def test_sciospec_differences_and_polarity(tmp_path):
    """The current enters at the higher potential, whatever the order of the pair."""
    made = impedance(8)[None]
    write_sciospec(tmp_path / "a.eit", made, PAIRS)
    write_sciospec(tmp_path / "b.eit", -made, PAIRS)
    (tmp_path / "description.toml").write_text(
        RING + 'number = 8\n[protocol]\nkind = "measured"\nmeasurement = "adjacent"\n'
    )
    one, two = data.read(tmp_path / "a.eit"), data.read(tmp_path / "b.eit")
    assert not any("second electrode" in note for note in one.notes)
    assert any("second electrode" in note for note in two.notes)
    np.testing.assert_array_equal(one.protocol.drive, -np.asarray(two.protocol.drive))
    expected = 1e-3 * (made[0] - np.roll(made[0], -1, axis=0)) @ (np.eye(8)[0] - np.eye(8)[3])
    np.testing.assert_allclose(one.voltages[0, :8], expected, atol=1e-10)
    assert impossible_signs(one.without_driven_channels()).max() == 0


@pytest.mark.parametrize(("name", "write"), [("a.get", write_get), ("a.eit", write_carefusion)])
def test_a_rate_is_required_where_none_is_described(name, write, tmp_path):
    write(tmp_path / name, frames())
    (tmp_path / "a.toml").write_text(RING + "number = 16\n")
    assert any("says no rate" in note for note in data.read(tmp_path / name).notes)
    (tmp_path / "a.toml").write_text(RING + "number = 16\n[data]\nframe_rate = 20\n")
    found = data.read(tmp_path / name)
    assert found.frame_rate == pytest.approx(20)
    assert not any("says no rate" in note for note in found.notes)


def test_a_folder_of_sciospec_files_is_a_series(tmp_path):
    for number in range(4):
        write_sciospec(
            tmp_path / f"setup_{number:05d}.eit",
            impedance(8, number)[None],
            PAIRS,
            date=f"2020.01.02. 10:00:00.{50 * number:03d}",
        )
    found = data.read(tmp_path)
    assert found.num_frames == 4
    assert found.frame_rate == pytest.approx(20, rel=1e-4)
    np.testing.assert_allclose(
        found.voltages[3].reshape(8, 8)[0], 1e-3 * impedance(8, 3) @ (np.eye(8)[0] - np.eye(8)[3]), atol=1e-10
    )


def test_the_described_rate_of_a_folder_of_sciospec_files(tmp_path):
    for number in range(3):
        write_sciospec(tmp_path / f"setup_{number}.eit", impedance(8, number)[None], PAIRS)
    assert data.read(tmp_path).times is None  # all files have the same date
    (tmp_path / "description.toml").write_text('[protocol]\nkind = "measured"\n[data]\nframe_rate = 4\n')
    np.testing.assert_allclose(data.read(tmp_path).times, [0, 0.25, 0.5])


def test_join_accepts_one_setup_only(tank):
    one, two = (data.screen(tank(made), made) for made in (protocol.adjacent(8), protocol.opposite(8)))
    with pytest.raises(ValueError, match="is read otherwise"):
        data.join([one, two])
    with pytest.raises(ValueError, match="there is none"):
        data.join([])
    assert data.join([one, one]).num_frames == 2


def test_formats_are_recognised_by_their_content(tmp_path):
    made, small = frames(), impedance(8)[None]
    writers = {
        "draeger": lambda path: write_draeger(path, made),
        "carefusion": lambda path: write_carefusion(path, made),
        "swisstom": lambda path: write_swisstom(path, [1e-3 * impedance(32)], [0]),
        "sciospec": lambda path: write_sciospec(path, small, PAIRS),
    }
    for name, write in writers.items():
        write(tmp_path / "a.eit")
        assert [one for one in FORMATS if FORMATS[one].recognises(tmp_path / "a.eit")] == [name]


def test_an_incomplete_last_frame_is_left_out_and_noted(tmp_path):
    write_draeger(tmp_path / "a.eit", frames(), cut=100)
    found = data.read(tmp_path / "a.eit")
    assert found.num_frames == 2
    assert any("cut off, and left out (5395 bytes)" in note for note in found.notes)


def changed(write, at, new):
    def make(path):
        write(path)
        content = bytearray(path.read_bytes())
        content[at : at + len(new)] = new
        path.write_bytes(content)

    return make


def dragged(path):
    write_draeger(path, frames(1))


def swiss(path):
    write_swisstom(path, [1e-3 * impedance(32)], [0])


def text(old, new):
    def make(path):
        write_sciospec(path, impedance(8)[None], PAIRS)
        content = path.read_text()
        assert old in content
        path.write_text(content.replace(old, new, 1))

    return make


FAULTS = {
    "dräger, another version": (changed(dragged, 0, b"\x1f"), "format 31"),
    "dräger, header beyond the end": (changed(dragged, 4, b"\xff\xff\xff\x7f"), "beyond its end"),
    "dräger, negative header": (changed(dragged, 4, b"\x00\x00\x00\x80"), "beyond its end"),
    "dräger, no rate": (lambda path: write_draeger(path, frames(1), rate="none"), "no 'Framerate"),
    "dräger, no frame": (lambda path: write_draeger(path, frames(1), cut=5000), "no whole frame"),
    "swisstom, another version": (changed(swiss, 0, b"\0\0\0\3"), "not known; format 4 is"),
    "swisstom, header beyond the end": (changed(swiss, 4, b"\xff\xff\xff\x7f"), "beyond its end"),
    "swisstom, a frame of negative length": (changed(swiss, 64 + 12, b"\xff\xff\xff\xff"), "damaged"),
    "swisstom, a frame too short for its voltages": (
        changed(swiss, 64 + 12, b"\x10\0\0\0"),
        "length of 16; it is dama",
    ),
    "carefusion, no header": (
        lambda path: path.write_bytes(b"\xff\xfe" + '<?xml version="1.0" ?><EIT_File>'.encode("utf-16-le")),
        "does not say where",
    ),
    "sciospec, a long header": (text("18\n", "60\n"), "60 lines"),
    "sciospec, no number": (text("1000\n", "fast\n"), "must be a number; it is 'fast'"),
    "sciospec, a million frequencies": (text("0\n1\n", "0\n1000000\n"), "frequencies"),
    "sciospec, ragged": (text("1 4\n", "1 4\n1.0\t2.0\t3.0\t4.0\n"), "two electrodes"),
    "sciospec, an electrode that does not exist": (text("1 4\n", "1 9\n"), "electrode 9"),
    "sciospec, words": (text("1 4\n", "one four\n"), "is not numbers"),
    "sciospec, no current": (text("0.001\n", "0\n"), "positive"),
    "sciospec, a pair of one": (text("1 4\n", "1 1\n"), "line 19: current enters and leaves at electrode 1;"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_reported(name, tmp_path):
    make, message = FAULTS[name]
    make(tmp_path / "a.eit")
    with pytest.raises(ValueError, match=message) as caught:
        data.read(tmp_path / "a.eit")
    assert len(str(caught.value)) < 400


def written(write, name="a.eit"):
    """Return a function that writes a file of this name and modifies its content."""

    def make(folder, change=lambda content: content):
        write(folder / name)
        (folder / name).write_bytes(change((folder / name).read_bytes()))
        return folder / name

    return make


def one_of_sciospec(path):
    write_sciospec(path, impedance(8)[None], PAIRS)


NOISE = np.random.default_rng(0).integers(0, 256, 4096, dtype=np.uint8).tobytes()
DAMAGED = {
    "dräger, start lost": (written(dragged), lambda content: content[40:], "looks like a file of draeger"),
    "carefusion, start lost": (
        written(lambda path: write_carefusion(path, frames(1))),
        lambda content: content[2:],
        "looks like a file of carefusion .* does not say where the frames begin",
    ),
    "sciospec, start lost": (
        written(one_of_sciospec),
        lambda content: content[3:],
        "looks like a file of sciospec .* line 1: a header of 2 lines",
    ),
    "sciospec by another name": (
        written(one_of_sciospec, "a.txt"),
        None,
        r"is a file of sciospec .* which end in \.eit: rename it, or give format='sciospec'",
    ),
    "openeit of three": (
        written(lambda path: path.write_text("magnitudes: 1, 2, 3\n"), "a.txt"),
        None,
        "looks like a file of openeit .* most frames have 3 numbers",
    ),
    "get of text": (
        written(lambda path: path.write_text("GET /\n" * 400), "a.get"),
        None,
        "of no known kind of file ending in '.get'",
    ),
    "get of noise": (written(lambda path: path.write_bytes(NOISE), "a.get"), None, "is it of another program"),
    "eit of text": (
        written(lambda path: path.write_text("hello\n")),
        None,
        "of no known kind of file ending in '.eit' \\(sciospec",
    ),
    "a table that is no text": (written(lambda path: path.write_bytes(NOISE), "a.csv"), None, "is not a text file"),
    "an archive cut off": (
        written(lambda path: np.savez(path, voltages=np.ones((2, 40))), "a.npz"),
        lambda content: content[:200],
        "not a readable",
    ),
    "a spreadsheet": (
        written(lambda path: path.write_bytes(b"PK\x03\x04"), "a.xlsx"),
        None,
        "export its numbers as CSV",
    ),
    "text of another ending": (written(lambda path: path.write_text("1 2 3"), "a.asc"), None, "name it a.txt"),
    "kit4 without a variable": (
        written(lambda path: scipy.io.savemat(path, {"Uel": [1.0], "CurrentPattern": [1.0]}), "a.mat"),
        None,
        "looks like KIT4 .* but lacks the variable MeasPattern",
    ),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_file_is_reported_with_its_probable_format(name, tmp_path):
    make, change, reason = DAMAGED[name]
    path = make(tmp_path) if change is None else make(tmp_path, change)
    with pytest.raises(ValueError, match=reason) as caught:
        data.read(path)
    assert len(str(caught.value)) < 500


def test_a_byte_order_mark_before_a_sciospec_header_is_ignored(tmp_path):
    path = written(one_of_sciospec)(tmp_path, lambda content: b"\xef\xbb\xbf" + content)
    assert data.read(path).num_frames == 1


def test_endings_of_tables_agree():
    """The endings in the registry, which selects the reader, and those in the reader itself."""
    assert FORMATS["table"].endings == table.SUFFIXES
