"""Invalid files and descriptions: each is refused with one line that says what is wrong and what to do."""

import numpy as np
import pytest
import scipy.io

from jeit import data, protocol

GOOD = """
[geometry]
shape = "disk"
radius = 0.1
[electrodes]
layout = "ring"
number = 8
width = 0.005
contact_impedance = 0.01
[protocol]
kind = "adjacent"
current = 1e-3
[data]
delimiter = ","
"""
FRAME = ",".join(str(k + 1.0) for k in range(40))


def table(text=FRAME, description=GOOD, name="a.csv"):
    def write(folder):
        (folder / name).write_text(text, "utf-8")
        if description is not None:
            (folder / "a.toml").write_text(description, "utf-8")
        return folder / name

    return write


def changed(old, new):
    assert old in GOOD
    return table(description=GOOD.replace(old, new))


def matlab(**content):
    def write(folder):
        scipy.io.savemat(folder / "a.mat", content)
        return folder / "a.mat"

    return write


def raw(name, content):
    def write(folder):
        (folder / name).write_bytes(content)
        return folder / name

    return write


def numpy_file(**content):
    def write(folder):
        np.savez(folder / "a.npz", **content)
        (folder / "a.toml").write_text(GOOD, "utf-8")
        return folder / "a.npz"

    return write


KIT4 = {"Uel": np.ones((16, 79)), "CurrentPattern": np.ones((16, 79)), "MeasPattern": np.eye(16)}
PATTERN = {"stim": [[1e-3], [-1e-3]], "meas": [[1.0, -1]], "meas_stim": [[1]], "vh": [[1.0]]}

BAD_FILES = {
    "no such file": (lambda folder: folder / "absent.csv", "no file"),
    "a folder": (lambda folder: folder, "a folder"),
    "empty": (raw("a.csv", b""), "is empty"),
    "unknown suffix": (raw("a.docx", b"1,2"), "no known format"),
    "no description": (table(description=None), "nothing says what they mean"),
    "not TOML": (table(description="[geometry"), "no TOML file"),
    "unknown section": (table(description=GOOD + "[tank]\n"), "tank is no key of a description"),
    "unknown key": (changed("radius =", "diameter ="), "diameter is no key of a disk"),
    "no shape": (changed('shape = "disk"', ""), r"geometry\.shape is missing"),
    "unknown shape": (changed('"disk"', '"sphere"'), "must be one of disk"),
    "negative radius": (changed("radius = 0.1", "radius = -0.1"), "radius"),
    "ring without geometry": (
        table(description=GOOD.replace('[geometry]\nshape = "disk"\nradius = 0.1', "")),
        r"needs \[geometry\]",
    ),
    "unknown layout": (changed('"ring"', '"spiral"'), "ring, perimeter"),
    "start of another layout": (
        changed('"ring"', '"ring"\nstart = 0.01'),
        r'electrodes\.start has no effect on layout = "ring"; give start_angle_degrees',
    ),
    "angle of another layout": (
        changed('"ring"', '"perimeter"\nstart_angle_degrees = 0'),
        r'electrodes\.start_angle_degrees has no effect on layout = "perimeter"; give start',
    ),
    "no width": (changed("width = 0.005", ""), r"electrodes\.width is missing"),
    "negative width": (
        changed("width = 0.005", "width = -1"),
        r"electrodes\.width is -1, and must be from 1e-09 to 1000 m",
    ),
    "unknown protocol": (changed('"adjacent"', '"nextdoor"'), "adjacent, skip, opposite"),
    "option of another protocol": (
        changed("current = 1e-3", 'current = 1e-3\ndrives = "all"'),
        r"protocol\.drives is no key of the protocol 'adjacent'",
    ),
    "no current": (changed("current = 1e-3", ""), r"protocol\.current is missing; give it, or current_from_name"),
    "milliamperes": (changed("current = 1e-3", "current = 5"), "5 mA"),
    "unknown current unit": (changed("current = 1e-3", 'current = 1\ncurrent_unit = "kA"'), "current_unit"),
    "no protocol": (
        table(description=GOOD.replace('[protocol]\nkind = "adjacent"\ncurrent = 1e-3', "")),
        r"add a \[protocol\]",
    ),
    "zero gain": (changed('delimiter = ","', "gain = 0"), "gain"),
    "unknown unit": (changed('delimiter = ","', 'unit = "dB"'), "unit must be one of V"),
    "unknown component": (changed('delimiter = ","', 'component = "phase"'), "component"),
    "unknown polarity": (changed('delimiter = ","', 'polarity = "-"'), "polarity"),
    "frame names do not fit": (
        changed('delimiter = ","', 'frame_names = ["a", "b"]'),
        "as many as the frames of a.csv, 1; they are 2",
    ),
    "a heading that is not to be skipped": (
        table("first,second\n" + FRAME, GOOD + "skip_rows = 0\n"),
        "line 1, column 1: 'first' is no number; .* skip_rows",
    ),
    "a word for a number": (
        table(FRAME + "\n" + FRAME.replace(",", ",abc,", 1)),
        "a.csv, line 2, column 2: 'abc' is no n",
    ),
    "an empty cell": (
        table(FRAME + ",,7"),
        r"a.csv, line 1, column 41: nothing stands there; where .* write nan\.$",
    ),
    "semicolons": (
        table("1;2;3", GOOD + "skip_rows = 0\n"),
        "a.csv, line 1: '1;2;3' is no number, nor numbers separated by commas. Set .* delim",
    ),
    "ragged": (table(FRAME + "\n1,2,3\n" + FRAME), "row 2 has length 3"),
    "only comments": (table("# nothing\n"), "no numbers"),
    "binary": (lambda folder: table()(folder) and raw("a.csv", b"\xff\xfe\x00PK")(folder), "not a text file"),
    "odd complex columns": (changed('delimiter = ","', "complex_pairs = true"), "even number"),
    "wrong number of channels": (table("1,2,3,4"), "40 channels"),
    "transposed": (table("\n".join(FRAME.split(",")), GOOD + 'frames_in = "rows"\n'), "transposed"),
    "all zero": (table(",".join(["0"] * 40)), "every usable voltage is zero"),
    "all missing": (table(",".join(["nan"] * 40)), "every usable voltage is zero, NaN or missing"),
    "no voltages in npz": (numpy_file(u=np.ones(40), v=np.ones(40)), "no array 'voltages'"),
    "pickled npz": (numpy_file(voltages=np.array([{}] * 40, dtype=object)), "objects"),
    "damaged npz": (lambda folder: table()(folder) and raw("a.npz", b"PK\x03\x04xx")(folder), "not a readable NPZ"),
    "damaged mat": (raw("a.mat", b"MATLAB 5.0" + b"\0" * 200), "not a readable .mat"),
    "mat of another kind": (matlab(x=1.0), "no known kind; it holds x"),
    "kit4 of another shape": (matlab(**{**KIT4, "Uel": np.ones((16, 78))}), "Uel"),
    "kit4 patterns unbalanced": (matlab(**KIT4), "sums to"),
    "kit4 text": (matlab(**{**KIT4, "Uel": "none"}), "not numbers"),
    "ktc of another shape": (matlab(Uel=np.ones(5), Inj=np.eye(4), Mpat=np.eye(4)), "5 voltages"),
    "eidors without voltages": (matlab(**{**PATTERN, "vh": []}), "not numbers"),
    "eidors unnamed voltages": (
        matlab(**{name: PATTERN[name] for name in ("stim", "meas", "meas_stim")}, u=np.ones((3, 7))),
        r"none of v_h, .* u \(3 × 7\)\. Name the array of frames by key=",
    ),
    "eidors lengths differ": (matlab(**PATTERN, vi=[[1.0, 2]]), "differ in length"),
    "eidors drive beyond the last": (matlab(**{**PATTERN, "meas_stim": [[2]]}), "1 drive patterns"),
    "eidors fractional drive": (matlab(**{**PATTERN, "meas_stim": [[1.5]]}), "whole numbers"),
    "eidors other length": (
        matlab(**{**PATTERN, "meas": [[1.0, -1]] * 3, "meas_stim": [[1]] * 3, "vh": [[1.0], [2.0]]}),
        "3 channels",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_invalid_files_are_refused_with_advice(name, tmp_path):
    write, lesson = BAD_FILES[name]
    with pytest.raises(ValueError, match=lesson) as error:
        data.read(write(tmp_path))
    assert "\n" not in str(error.value)


def test_the_valid_file_is_read(tmp_path):
    assert data.read(table()(tmp_path)).num_channels == 40


@pytest.mark.parametrize(
    ("options", "lesson"),
    [
        (
            {"format": "xlsx"},
            "kit4, ktc2023, eidors, sciospec, draeger, carefusion, swisstom, goettingen, cn0565, quadrupoles, openeit, "
            "table, tank6cm",
        ),
        ({"format": "kit4"}, "not a readable .mat"),
        ({"format": "tank6cm", "description": "other.toml"}, "describes itself"),
        ({"description": "absent.toml"}, "no such file"),
    ],
)
def test_invalid_options(options, lesson, tmp_path):
    with pytest.raises(ValueError, match=lesson):
        data.read(table()(tmp_path), **options)


ADJACENT = protocol.adjacent(8)
ONES = np.linspace(1, 2, 40)
BAD_CALLS = {
    "text": (lambda: data.screen(["a"] * 40, ADJACENT), "must be numbers"),
    "channels": (lambda: data.screen(ONES[:39], ADJACENT), "40 channels"),
    "mask of numbers": (lambda: data.screen(ONES, ADJACENT, mask=np.ones(40)), "booleans"),
    "nothing left": (lambda: data.screen(ONES, ADJACENT, mask=np.zeros(40, bool)), "zero, NaN or missing"),
    "limit": (lambda: data.screen(ONES, ADJACENT, saturation=-1.0), "positive voltage"),
    "everything saturated": (lambda: data.screen(ONES, ADJACENT, saturation=0.5), "no usable voltage"),
    "names": (lambda: data.screen(ONES, ADJACENT, frame_names=("a", "b")), "give one each"),
    "integers": (lambda: data.Measurement(np.ones(40, int), np.ones(40, bool), ADJACENT), "real or complex"),
    "mask shape": (lambda: data.Measurement(ONES, np.ones(39, bool), ADJACENT), "mask has shape"),
    "frame": (lambda: data.screen(ONES, ADJACENT).frame(1), "no frame 1"),
    "frame name": (lambda: data.screen(ONES, ADJACENT).frame("press"), "no frame named 'press'"),
    "reference": (lambda: data.screen(ONES, ADJACENT).split_reference(), "no reference frame"),
    "usable": (lambda: data.screen(ONES, ADJACENT).masked(np.ones(40), "x"), "booleans"),
    "electrode": (lambda: data.screen(ONES, ADJACENT).without_electrodes(8), "0 to 7"),
    "written as text": (lambda: data.write_table(data.screen(ONES, ADJACENT), "a.csv"), "must end in .npz"),
}


@pytest.mark.parametrize("name", BAD_CALLS)
def test_invalid_calls_are_refused_with_advice(name):
    call, lesson = BAD_CALLS[name]
    with pytest.raises(ValueError, match=lesson):
        call()


def test_electrodes_and_protocol_must_agree(setup):
    with pytest.raises(ValueError, match="16 electrodes were placed"):
        data.screen(ONES, ADJACENT, **setup(16))


def test_setups_that_cannot_be_described_are_not_written(tmp_path):
    from jeit.electrodes import NodeElectrodes

    measurement = data.screen(ONES, ADJACENT, electrodes=NodeElectrodes(np.arange(8)))
    with pytest.raises(ValueError, match="NodeElectrodes"):
        data.write_table(measurement, tmp_path / "a.npz")


def test_electrodes_without_any_voltage_are_named_but_none_where_half_of_all_are_missing():
    voltages = np.random.default_rng(0).uniform(1, 2, 40)
    touching = np.asarray(ADJACENT.channels_touching(2))
    (note,) = data.screen(np.where(touching, np.nan, voltages), ADJACENT).notes
    assert "all of electrode 3: check the connection" in note
    pairs, _ = ADJACENT.reciprocal_pairs()
    second = np.isin(np.arange(40), np.asarray(pairs)[:, 1])
    (note,) = data.screen(np.where(second, np.nan, voltages), ADJACENT).notes
    assert note.endswith("NaN, infinite or beyond any instrument.")
