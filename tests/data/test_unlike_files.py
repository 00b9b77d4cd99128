"""Voltages in text files of many kinds: each is read alike, or an error names what is undecided."""

from itertools import product

import numpy as np
import pytest
import scipy.io

from jeit import data
from jeit.data import load_description
from jeit.data.description import TableLayout, parse_description
from jeit.data.formats.text import frames_in_table
from jeit.data.inferred_properties import fitting_protocol
from jeit.protocol import adjacent

TANK = """
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
current = 1e-3
[data]
"""
SEPARATORS = {"comma": ",", "spaces": "  ", "tab": "\t", "semicolon": ";", "comma and space": " , "}


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Three noisy frames of every channel of a ring, (3, 8, 8) volts: drive, measurement."""
    folder = tmp_path_factory.mktemp("tank")
    (folder / "tank.toml").write_text(TANK.replace("[data]", "driven_electrodes = true\norder = 'fixed'\n[data]"))
    model = load_description(folder / "tank.toml").model("a.csv", num_points=300)
    rest = np.asarray(model.voltages(1e-3))
    shape = np.random.default_rng(0).normal(size=(3, 8, 8))
    noise = 1e-3 * (shape + np.swapaxes(shape, 1, 2))
    return rest.reshape(8, 8) * (1 + noise)


def voltages_of(frames, driven, order, reciprocal):
    """The voltages (3, M) of a protocol, in its order."""
    protocol = adjacent(8, driven_electrodes=driven, order=order, reciprocal=reciprocal)
    return frames[:, np.asarray(protocol.drive_index), np.asarray(protocol.measurement_index)], protocol


def written(path, values, separator=",", wrap=0, heading=False, decimal=".", times=None, end="", label=""):
    lines = []
    for k, frame in enumerate(values):
        cells = [f"{one:.9e}" for one in frame]
        if times is not None:
            cells = [f"{times[k]:.3f}", *cells]
        for start in range(0, len(cells), wrap or len(cells)):
            some = cells[start : start + (wrap or len(cells))]
            lines.append(label + separator.join(some).replace(".", decimal) + end)
    top = [separator.join(f"channel {k}" for k in range(len(values[0]) + (times is not None)))] if heading else []
    path.write_text("\n".join([*top, *lines]) + "\n", "utf-8")
    return path


def read(path, extra="", protocol=""):
    table = TANK.replace("[data]", f"{protocol}\n[data]\n{extra}")
    path.with_suffix(".toml").write_text(table, "utf-8")
    return data.read(path)


VARIANTS = [
    *({"separator": one, "wrap": wrap} for one, wrap in product(SEPARATORS.values(), (0, 10))),
    *({"separator": one, "heading": True} for one in SEPARATORS.values()),
    *({"separator": one, "decimal": ","} for one in (";", "  ", "\t")),
    *({"separator": one, "times": [0.0, 0.1, 0.25]} for one in (",", "  ")),
    {"separator": " ", "end": " "},
    {"separator": ",", "end": ","},
    {"separator": " , ", "label": "    magnitudes : "},
    {"separator": ";", "heading": True, "decimal": ",", "times": [1.0, 2.5, 3.0]},
]


@pytest.mark.parametrize("way", VARIANTS, ids=str)
def test_text_formats_are_read_alike(way, frames, tmp_path):
    values, _ = voltages_of(frames, False, "rotating", "all")
    found = read(written(tmp_path / "a.txt", values, **way))
    np.testing.assert_allclose(found.voltages, values, rtol=1e-8)
    np.testing.assert_allclose(0 if found.times is None else found.times, way.get("times", 0))
    assert found.mask.all()


@pytest.mark.parametrize(
    ("driven", "order", "reciprocal"), [*product((False, True), ("rotating", "fixed"), ("all", "half"))]
)
def test_channel_orders_without_a_description(driven, order, reciprocal, frames, tmp_path):
    """Half of the channels have no reciprocal ones, so that their order must be stated."""
    values, protocol = voltages_of(frames, driven, order, reciprocal)
    stated = f'order = "{order}"' if reciprocal == "half" else ""
    found = read(written(tmp_path / "a.csv", values), protocol=stated)
    assert found.protocol.same_patterns(adjacent(8, driven_electrodes=driven, order=order, reciprocal=reciprocal))
    np.testing.assert_allclose(found.voltages, values, rtol=1e-8)
    assert any("is taken, for" in note for note in found.notes) == (driven or order == "fixed" or reciprocal == "half")
    assert protocol.num_measurements == found.voltages.shape[1]


CHANGES = [("reversed", False), *product(("magnitudes", "zeros"), (False, True))]


@pytest.mark.parametrize(("change", "driven"), CHANGES)
def test_signs_without_a_description(change, driven, frames, tmp_path):
    values, protocol = voltages_of(frames, driven, "rotating", "all")
    own = (np.asarray(protocol.channel_drive) != 0) & (np.asarray(protocol.channel_measurement) != 0)
    zero = own.any(axis=1) & (change == "zeros")
    changed = {"reversed": -values, "magnitudes": np.abs(values), "zeros": np.where(zero, 0, -values)}[change]
    found = read(written(tmp_path / "a.csv", changed))
    np.testing.assert_allclose(np.asarray(found.voltages)[:, ~zero], values[:, ~zero], rtol=1e-8)
    np.testing.assert_array_equal(~np.asarray(found.mask), np.tile(zero, (3, 1)))
    if change != "zeros" or driven:
        assert any("sign" in note for note in found.notes)


def test_a_zero_of_an_undriven_channel_is_a_voltage(frames, tmp_path):
    values = voltages_of(frames, True, "fixed", "all")[0].copy()
    values[:, 20] = 0  # of drive 3, between electrodes 5 and 6
    assert read(written(tmp_path / "a.csv", values)).mask.all()


def test_a_stated_polarity_is_kept(frames, tmp_path):
    values, _ = voltages_of(frames, False, "rotating", "all")
    np.testing.assert_allclose(read(written(tmp_path / "a.csv", -values), 'polarity = "normal"').voltages, -values)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("unit", ["V", "uV"])
def test_plain_arrays(unit, turned, frames, tmp_path):
    values, _ = voltages_of(frames, True, "fixed", "all")
    table = (values if turned else values.T) * {"V": 1, "uV": 1e6}[unit]
    scipy.io.savemat(tmp_path / "a.mat", {"frames": table.astype(complex), "words": "nothing", "rate": 3.0})
    found = read(tmp_path / "a.mat", f'unit = "{unit}"')
    np.testing.assert_allclose(found.voltages, values, rtol=1e-8)
    np.savez(tmp_path / "b.npz", frames=values, other=values[:1])
    (tmp_path / "b.toml").write_text(TANK)
    np.testing.assert_allclose(data.read(tmp_path / "b.npz", key="frames").voltages, values, rtol=1e-8)


def test_two_matching_arrays_are_ambiguous(frames, tmp_path):
    values, _ = voltages_of(frames, True, "fixed", "all")
    scipy.io.savemat(tmp_path / "a.mat", {"first": values.T, "second": values[:1].T})
    with pytest.raises(ValueError, match=r"first \(64 × 3\), second \(64 × 1\). Name the array of frames by key="):
        read(tmp_path / "a.mat")
    assert data.read(tmp_path / "a.mat", key="second").num_frames == 1


def test_frames_are_read_in_the_order_of_their_reference(frames, tmp_path):
    """Noise hides the order in a single frame; that of the reference is used."""
    values, _ = voltages_of(frames, True, "fixed", "all")
    reference = read(written(tmp_path / "reference.csv", -values))
    noisy = -values + 2 * np.random.default_rng(1).normal(size=values.shape) * np.abs(values).min()
    found = data.read(written(tmp_path / "frame.csv", noisy), description=tmp_path / "reference.toml", like=reference)
    assert found.protocol.same_patterns(reference.protocol)


def test_an_incomplete_last_line_is_left_out(frames, tmp_path):
    values, _ = voltages_of(frames, False, "rotating", "all")
    for wrap, cut in ((0, -30), (10, -20), (10, -70)):
        path = written(tmp_path / "a.txt", values, wrap=wrap)
        path.write_text(path.read_text("utf-8")[:cut])
        found = read(path)
        assert found.num_frames == 2
        assert any("cut off" in note for note in found.notes)


@pytest.mark.parametrize("line", [1, 2, 4])
def test_a_missing_line_of_a_wrapped_frame_is_reported(line, frames, tmp_path):
    """Of the one frame of 40 channels in five lines, 32 numbers remain; 20 of them are not read as another protocol."""
    values, _ = voltages_of(frames[:1], False, "rotating", "all")
    path = written(tmp_path / "a.txt", values, wrap=8)
    lines = path.read_text("utf-8").splitlines()
    path.write_text("\n".join(lines[:line] + lines[line + 1 :]))
    with pytest.raises(ValueError, match="32 numbers, 8 fewer than a frame has: is a line missing"):
        read(path)


def test_another_number_of_electrodes_is_suggested(frames, tmp_path):
    path = written(tmp_path / "a.txt", np.ones((1, 208)), wrap=13)
    with pytest.raises(ValueError, match="208 numbers are what 16 electrodes give with adjacent pairs"):
        read(path)


def test_spreadsheet_exports(frames, tmp_path):
    values, _ = voltages_of(frames, False, "rotating", "all")
    rows = [";".join(f'"{one:.9e}"'.replace(".", ",") for one in frame) for frame in values]
    (tmp_path / "a.txt").write_text("\r\n".join(rows) + "\r\n", "utf-16")
    np.testing.assert_allclose(read(tmp_path / "a.txt").voltages, values, rtol=1e-8)


@pytest.mark.parametrize(("heading", "unit"), [("t_ms", 1e-3), ("time_us", 1e-6), ("t / µs", 1e-6), ("t", 1.0)])
def test_times_in_the_unit_of_their_heading(heading, unit, frames, tmp_path):
    values, _ = voltages_of(frames, False, "rotating", "all")
    path = written(tmp_path / "a.csv", values, heading=True, times=[1000, 1050, 1100])
    path.write_text(path.read_text("utf-8").replace("channel 0", heading, 1), "utf-8")
    np.testing.assert_allclose(read(path).times, unit * np.array([1000, 1050, 1100]))


def test_a_rising_first_channel_is_not_taken_for_times():
    """The description matches the number of columns; another one would match one column fewer."""
    table = np.column_stack([[1.0, 2.5, 4.0], np.ones((3, 4))])
    found = frames_in_table(table, [5, 4], TableLayout())
    assert found.times is None
    np.testing.assert_array_equal(found.table, table)


def test_whole_numbers_in_an_unknown_unit_are_not_taken_for_times(frames, tmp_path):
    values, _ = voltages_of(frames, False, "rotating", "all")
    found = read(written(tmp_path / "a.csv", values, times=[1000, 1050, 1100]))
    assert found.times is None
    assert any("rises by 50; its unit is not known" in note for note in found.notes)


def test_a_possibly_truncated_number_is_noted(frames, tmp_path):
    values, _ = voltages_of(frames, False, "rotating", "all")
    path = written(tmp_path / "a.csv", values)
    path.write_text(path.read_text("utf-8")[:-8])
    assert any("is it cut off?" in note for note in read(path).notes)


def test_one_column_too_many_and_an_array_without_a_file(frames, tmp_path):
    values, _ = voltages_of(frames, False, "rotating", "all")
    with pytest.raises(ValueError, match="There are 2 too many: are there times, counters or states"):
        read(written(tmp_path / "a.csv", np.column_stack([values, np.ones((3, 2))])))
    with pytest.raises(ValueError, match=r"key: a\.csv has no arrays"):
        data.read(tmp_path / "a.csv", key="rod")


@pytest.mark.parametrize("last", ["END", "1.5,2.5,x: 3"])
def test_words_after_the_numbers_are_refused(last, frames, tmp_path):
    """A word is ignored before the numbers of a line, and nowhere else."""
    values, _ = voltages_of(frames, False, "rotating", "all")
    path = written(tmp_path / "a.csv", values)
    path.write_text(path.read_text("utf-8") + last + "\n", "utf-8")
    with pytest.raises(ValueError, match=r"a\.csv, line 4.*is no number"):
        read(path)


def test_a_protocol_without_reciprocal_channels_stays_as_described(frames):
    """Nothing contradicts it, even if another protocol with the same number of channels breaks reciprocity."""
    values, described = voltages_of(frames, False, "rotating", "half")
    other = adjacent(8, order="fixed").subset(np.arange(20))
    random = np.random.default_rng(0).normal(size=values.shape)
    assert fitting_protocol(random, [(described, ""), (other, "order")]) == (described, ())


def test_a_frame_has_the_sign_of_its_reference(frames, tmp_path):
    """This holds even if the frame alone has voltages of one sign while the reference, because of its noise, has
    not."""
    values, _ = voltages_of(frames, False, "rotating", "all")
    reference = read(written(tmp_path / "reference.csv", -values[:1]), 'polarity = "normal"')
    written(tmp_path / "frame.csv", -values[1:])
    (tmp_path / "frame.toml").write_text(TANK, "utf-8")
    found = data.read(tmp_path / "frame.csv", like=reference)
    np.testing.assert_allclose(found.voltages, -values[1:], rtol=1e-8)


SPOILED = {
    "a word among the numbers": lambda rows: [*rows[:1], rows[1].replace(",", ",abc,", 1), *rows[2:]],
    "a word in the first line": lambda rows: [rows[0].replace(",", ",abc,", 1).rsplit(",", 1)[0], *rows[1:]],
    "a line that is short": lambda rows: [rows[0], rows[1].rsplit(",", 3)[0], rows[2]],
    "a line that is long": lambda rows: [rows[0], rows[1] + ",1,2", rows[2]],
    "an empty cell": lambda rows: [rows[0], rows[1].replace(",", ",,", 1), rows[2]],
    "two columns too many": lambda rows: [f"{row},1,2" for row in rows],
    "a column too few": lambda rows: [row.rsplit(",", 1)[0] for row in rows],
    "decimal commas between commas": lambda rows: [row.replace(".", ",") for row in rows],
    "lines without numbers": lambda rows: ["nothing"] * 3,
    "a column that does not rise": lambda rows: [f"{one},{row}" for one, row in zip((3, 1, 2), rows, strict=True)],
    "another heading half way": lambda rows: [rows[0], "a,b,c", *rows[1:]],
}


@pytest.mark.parametrize("how", SPOILED)
def test_unreadable_files_are_refused(how, frames, tmp_path):
    values, _ = voltages_of(frames, False, "rotating", "all")
    rows = written(tmp_path / "a.csv", values).read_text("utf-8").splitlines()
    (tmp_path / "a.csv").write_text("\n".join(SPOILED[how](rows)), "utf-8")
    with pytest.raises(ValueError, match=r"a: the data have shape|a\.csv"):
        read(tmp_path / "a.csv")


def test_hyphens_and_underscores_are_alike():
    for kind in ("two-terminal", "two_terminal"):
        table = {"protocol": {"kind": kind, "number": 8, "current": 1e-3}}
        described = parse_description(table, "a.toml").protocol("a.csv")
        assert described is not None
        assert described.num_measurements == 28
    table = {"protocol": {"kind": "haar", "number": 8, "current": 1e-3, "measurement": "mean_removed"}}
    assert parse_description(table, "a.toml").protocol("a.csv") is not None


@pytest.mark.parametrize("form", ["({:.9e}{:+.9e}j)", "{:.9e}{:+.9e}i", "({:.9e}+{:.9e}j)"])
def test_complex_numbers_in_text(form, frames, tmp_path):
    """In the notations of NumPy, MATLAB and older NumPy."""
    values, _ = voltages_of(frames, False, "rotating", "all")
    (tmp_path / "a.txt").write_text("\n".join(" ".join(form.format(v, -0.1 * v) for v in frame) for frame in values))
    found = read(tmp_path / "a.txt", 'component = "complex"')
    np.testing.assert_allclose(found.voltages, values * (1 - 0.1j), rtol=1e-8)
    np.testing.assert_allclose(read(tmp_path / "a.txt").voltages, values, rtol=1e-8)


def test_printed_arrays(frames, tmp_path):
    values, _ = voltages_of(frames, False, "rotating", "all")
    for text in (str(values.tolist()).replace("], ", "],\n"), "\n".join(map(str, values.tolist()))):
        (tmp_path / "a.txt").write_text(text)
        np.testing.assert_allclose(read(tmp_path / "a.txt").voltages, values)
    with np.printoptions(precision=9, threshold=1000):
        (tmp_path / "a.txt").write_text(str(values[:1]))
    np.testing.assert_allclose(read(tmp_path / "a.txt").voltages, values[:1], rtol=1e-6)


@pytest.mark.parametrize(("index", "first"), [(True, 0), (False, 0), (False, 1)])
def test_a_first_line_of_column_numbers_is_no_frame(index, first, frames, tmp_path):
    """Data frames written with and without their index."""
    values, _ = voltages_of(frames, False, "rotating", "all")
    lines = [("," if index else "") + ",".join(str(first + k) for k in range(values.shape[1]))]
    lines += [(f"{k}," if index else "") + ",".join(map(repr, frame.tolist())) for k, frame in enumerate(values)]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    found = read(tmp_path / "a.csv")
    np.testing.assert_allclose(found.voltages, values)
    assert any("the first line is a heading" in note for note in found.notes)


def test_json_is_named(frames, tmp_path):
    (tmp_path / "a.txt").write_text('{"t": 0.0, "v": [1.0, 2.0]}')
    with pytest.raises(ValueError, match="line 1: this is JSON; write its numbers as CSV"):
        read(tmp_path / "a.txt")


def test_titles_between_frames(frames, tmp_path):
    """A title like the first one, apart from its number, is accepted; any other word is refused."""
    values, _ = voltages_of(frames, True, "fixed", "all")
    blocks = [
        f"Frame {k}\n" + "\n".join(",".join(f"{v:.9e}" for v in row) for row in frame.reshape(8, 8)) + "\n"
        for k, frame in enumerate(values)
    ]
    (tmp_path / "a.csv").write_text("\n".join(blocks))
    found = read(tmp_path / "a.csv")
    np.testing.assert_allclose(found.voltages, values, rtol=1e-8)
    assert any("between the numbers, 2 lines such as 'Frame 1' are left out" in note for note in found.notes)
    (tmp_path / "a.csv").write_text("\n".join(blocks).replace("Frame 2", "broken"))
    with pytest.raises(ValueError, match="'broken' is no number"):
        read(tmp_path / "a.csv")
