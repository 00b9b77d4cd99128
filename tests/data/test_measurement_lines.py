"""Text files of loggers and of the CN0565 kit, with a line for each measurement or hexadecimal lines."""

import numpy as np
import pytest

from jeit import data, protocol

RING = (
    '[geometry]\nshape = "disk"\nradius = 0.1\n[electrodes]\nlayout = "ring"\nwidth = 0.01\ncontact_impedance = 0.01\n'
    "clockwise = true\nnumber = "
)
FIXED = protocol.adjacent(8, order="fixed")
# Electrodes, counted from 0, of each channel: current source and sink, first and second voltage electrode.
QUADRUPOLES = [(d, (d + 1) % 8, s, (s + 1) % 8) for d in range(8) for s in range(8) if (s - d) % 8 in range(2, 7)]


def hexadecimal(frame, scale=1e5):
    """A line of the kit: 32-bit two's complement, alternating real and imaginary parts."""
    words = [int(part) & 0xFFFFFFFF for one in np.round(scale * frame) for part in (one.real, one.imag)]
    return "!V " + ",".join(f"{one:08X}" for one in words)


def test_lines_of_a_cn0565(tank, tmp_path):
    """Times before the lines, answers between them, a lost character, and an incomplete last line."""
    frame = tank(FIXED) * (1 + 0.2j)
    line = hexadecimal(frame)
    text = f"OK\n[10:00:01] {line}\r\n!C 0\nOK\n{line[:-30]}{line}\n{line}\n{line[:100]}"
    (tmp_path / "a.log").write_text(text)
    (tmp_path / "a.toml").write_text(RING + '8\n[data]\ncomponent = "complex"\n')
    found = data.read(tmp_path / "a.log")
    assert found.protocol.same_patterns(FIXED)
    assert np.asarray(found.mask).sum(axis=1).tolist() == [40, 0, 0, 40]
    np.testing.assert_allclose(found.voltages[0], 1e5 * frame, atol=1)
    for note in (
        "distance are taken to be 1",
        "lost in frames 1, 2: masked",
        "cut off after",
        "nor the current is known",
    ):
        assert any(note in one for one in found.notes), note
    assert data.reciprocity_error(found.frame(0)) < 1e-2


def test_other_distances_of_a_cn0565_are_described(tank, tmp_path):
    path, made = tmp_path / "a.txt", protocol.skip(8, 3, measurement_skipped=0, order="fixed", current=2e-3)
    frame = tank(made, 0.1)
    path.write_text(hexadecimal(frame + 0j) + "\n")
    with pytest.raises(ValueError, match="32 voltages in a frame; with force and sense distance 1 they are 40 "):
        data.read(path)
    table = RING + '8\n[protocol]\nkind = "skip"\ncurrent = 2e-3\nmeasurement_skipped = 0\nskipped = '
    path.with_suffix(".toml").write_text(table + "3\n")
    found = data.read(path)
    assert found.protocol.same_patterns(made)
    np.testing.assert_allclose(found.voltages[0], 1e5 * frame, atol=1)
    path.with_suffix(".toml").write_text(table + "0\n")
    with pytest.raises(ValueError, match=r"has 40 channels, and a frame of a\.txt 32: with force and sense distance"):
        data.read(path)
    for text, message in (("!V 1,2,3,4,5,6,7,8,9\n", "9 numbers"), ("V 1\n", "no line begins with '!V'")):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            data.read(path, "cn0565")


def rows_of(frames, heading, first=0):
    """A table of a logger: a line for each measurement, with the names of frame and electrodes."""
    lines = [heading]
    for number, frame in enumerate(frames):
        for k, ((a, b, m, n), value) in enumerate(zip(QUADRUPOLES, frame, strict=True)):
            electrodes = (one + first for one in (a, m, n, b))
            lines.append(",".join(map(str, (number, "rest", k, *electrodes, value.real, value.imag))))
    return "\n".join(lines) + "\n"


def test_a_logger_of_named_electrodes(tank, tmp_path):
    """Lines in any order: a missing line is masked, and columns of text are ignored."""
    heading = "frame_id,block,k,f_plus_index,s_plus_index,s_minus_index,f_minus_index,real_raw,imag_raw"
    frames = np.stack([tank(FIXED, change) for change in (0, 0.1)]) * (1 + 0.1j)
    text = rows_of(frames, heading)
    (tmp_path / "a.csv").write_text(text)
    (tmp_path / "description.toml").write_text(RING + '8\n[data]\ncomponent = "complex"\n')
    found = data.read(tmp_path / "a.csv")
    assert found.protocol.same_patterns(FIXED)  # sorted by electrodes, as in the kit's files
    np.testing.assert_allclose(found.voltages, frames, rtol=1e-12)
    first, *lines = text.splitlines()
    shuffled = [lines[k] for k in np.random.default_rng(0).permutation(len(lines)) if k != 7]
    (tmp_path / "b.csv").write_text("\n".join([first, *shuffled]))
    again = data.read(tmp_path / "b.csv", like=found)
    assert again.protocol.same_patterns(FIXED)
    missing = np.argwhere(~np.asarray(again.mask))
    assert len(missing) == 1
    assert missing[0, 1] == 7
    np.testing.assert_allclose(again.filled(), np.where(again.mask, frames, 0), rtol=1e-12)


UNIFIED = """8# Number of electrodes
# x z
{places}
40 # Number of data
# a b m n u/mV i/mA err
{lines}
0
"""


def unified(frame, radius=0.1, current=2.0):
    angle = np.pi / 2 - 2 * np.pi * np.arange(8) / 8
    places = "\n".join(f"{radius * np.cos(one):.9f}\t{radius * np.sin(one):.9f}" for one in angle)
    lines = [
        f"{a + 1}\t{b + 1}\t{m + 1}\t{n + 1}\t{1e3 * value:.9g}\t{current}\t0.01"
        for (a, b, m, n), value in zip(QUADRUPOLES, frame, strict=True)
    ]
    return UNIFIED.format(places=places, lines="\n".join(lines))


def test_the_unified_data_format(tank, tmp_path):
    """Electrodes at the file's positions, in the file's unit."""
    made = protocol.adjacent(8, order="fixed", current=2e-3)
    (tmp_path / "a.ohm").write_text(unified(tank(made)))
    no_places = RING.replace('layout = "ring"\n', "").replace("clockwise = true\nnumber = ", "")
    (tmp_path / "a.toml").write_text(no_places)
    found = data.read(tmp_path / "a.ohm")
    assert found.protocol.same_patterns(made)
    np.testing.assert_allclose(found.voltages[0], tank(made), rtol=1e-8)
    np.testing.assert_allclose(found.electrodes.position[0], [0, 0.1], atol=1e-9)
    # Resistances, converted with the reference current.
    ohms = [f"{a + 1} {b + 1} {m + 1} {n + 1} {value / 2e-3}"
            for (a, b, m, n), value in zip(QUADRUPOLES, tank(made), strict=True)]  # fmt: skip
    (tmp_path / "b.dat").write_text("# a b m n r/Ohm\n" + "\n".join(ohms))
    np.testing.assert_allclose(data.read(tmp_path / "b.dat", like=found).voltages[0], tank(made), rtol=1e-8)
    # Apparent resistivities with their geometric factors.
    (tmp_path / "c.dat").write_text(
        "# a b m n k rhoa\n" + "\n".join(f"{' '.join(one.split()[:4])} 2 {2 * float(one.split()[4])}" for one in ohms)
    )
    np.testing.assert_allclose(data.read(tmp_path / "c.dat", like=found).voltages[0], tank(made), rtol=1e-8)
    assert any("1 mA multiplies the resistances" in note for note in data.read(tmp_path / "b.dat").notes)


FAULTS = {
    "one far away": ("1\t2\t3\t4", "1\t0\t3\t4", "measurement 1 has electrode 0, which stands for one far away"),
    "an electrode too many": ("1\t2\t3\t4", "1\t9\t3\t4", "measurement 1 has electrode 9, and there are 8"),
    "a pair of one": ("1\t2\t3\t4", "1\t1\t3\t4", "measurement 1 has an electrode twice in a pair"),
    "half an electrode": ("1\t2\t3\t4", "1\t1.5\t3\t4", "electrodes must be whole numbers"),
    "words": ("1\t2\t3\t4", "1\ttwo\t3\t4", r"line 13: '1\\ttwo"),
    "places": ("8# Number", "9# Number", "line 1 states 9 electrodes; as many lines of two or three coordinates"),
    "names": ("# a b m n", "# a b m k", "no line names the columns of four electrodes"),
    "twice": ("1\t2\t4\t5", "1\t2\t3\t4", "measured twice, and no column numbers frames"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faulty_lines_are_reported(tank, name, tmp_path):
    old, new, message = FAULTS[name]
    text = unified(tank(FIXED))
    assert old in text
    (tmp_path / "a.ohm").write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        data.read(tmp_path / "a.ohm", "quadrupoles")


def test_a_file_with_fewer_lines_than_stated(tank, tmp_path):
    (tmp_path / "a.ohm").write_text(unified(tank(FIXED))[:-60])
    found = data.read(tmp_path / "a.ohm")
    assert any("it states 40 measurements, and holds" in note for note in found.notes)


def test_a_table_of_plain_numbers_is_not_read_as_measurement_lines(tmp_path):
    """A heading of letters alone does not make a line a measurement."""
    (tmp_path / "a.csv").write_text("a,b,c,d\n" + "\n".join(",".join(["1.5"] * 4) for _ in range(10)))
    with pytest.raises(ValueError, match="nothing says what they mean"):
        data.read(tmp_path / "a.csv")
