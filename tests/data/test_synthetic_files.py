"""The readers on files written here, which need no measured data."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.io

from jeit import data, protocol
from jeit.electrodes import PointElectrodes, SheetDiscs
from jeit.mesh import Polygon, Rectangle

DESCRIPTION = """
[geometry]
shape = "disk"
radius = 0.1

[electrodes]
layout = "ring"
number = 8
clockwise = true
width = 0.005
contact_impedance = 0.01

[protocol]
kind = "adjacent"
current = 1.0
current_unit = "mA"
"""


def test_kit4_layout(tmp_path):
    current = np.random.default_rng(0).normal(size=(16, 79))
    current -= current.mean(axis=0)
    pattern = np.eye(16) - np.roll(np.eye(16), 1, axis=0)
    voltages = np.arange(16 * 79, dtype=float).reshape(16, 79)
    scipy.io.savemat(
        tmp_path / "a.mat", {"Uel": voltages, "CurrentPattern": current, "MeasPattern": pattern.astype(np.int16)}
    )
    measurement = data.read(tmp_path / "a.mat")
    # Channel 16 j + m is measurement m (row) of injection j (column).
    assert float(measurement.voltages[0, 16 * 5 + 3]) == voltages[3, 5]
    np.testing.assert_allclose(measurement.protocol.channel_drive[16 * 5 + 3], 1e-3 * current[:, 5])
    np.testing.assert_allclose(measurement.protocol.channel_measurement[16 * 5 + 3], pattern[:, 3])
    # Clockwise from 12 o'clock: electrode 5 is at 3 o'clock.
    np.testing.assert_allclose(np.asarray(measurement.electrodes.position)[[0, 4]], [[0, 0.14], [0.14, 0]], atol=1e-12)


def test_ktc_layout_and_missing_electrodes(tmp_path):
    current = np.zeros((32, 76))
    for column in range(76):
        current[2 * (column % 16), column], current[(2 * (column % 16) + 2) % 32, column] = 1.4, -1.4
    pattern = (np.eye(32) - np.roll(np.eye(32), 1, axis=0))[:, :31]
    voltages = np.linspace(1, 2, 2356)
    voltages[31 * 7 : 31 * 8] = np.nan
    scipy.io.savemat(tmp_path / "d.mat", {"Uel": voltages[:, None], "Inj": current, "Mpat": pattern})
    measurement = data.read(tmp_path / "d.mat")
    mask = np.asarray(measurement.mask)[0]
    np.testing.assert_array_equal(np.flatnonzero(~mask), np.arange(31 * 7, 31 * 8))
    assert np.isnan(np.asarray(measurement.voltages)[0, ~mask]).all()
    assert any("31 of 2356 voltages masked" in note and "NaN" in note for note in measurement.notes)
    # Counter-clockwise from 12 o'clock: electrode 9 is at 9 o'clock. Electrodes cover half of the circumference.
    np.testing.assert_allclose(
        np.asarray(measurement.electrodes.position)[[0, 8]], [[0, 0.115], [-0.115, 0]], atol=1e-12
    )
    np.testing.assert_allclose(32 * np.asarray(measurement.electrodes.width), np.pi * 0.115)


@pytest.mark.parametrize("polarity", [1, -1])
def test_eidors_vectors(tmp_path, tank, polarity):
    chosen = protocol.adjacent(8)
    voltages = tank(chosen)
    scipy.io.savemat(
        tmp_path / "e.mat",
        {
            "stim": polarity * np.asarray(chosen.drive).T,
            "meas": scipy.sparse.csc_matrix(np.asarray(chosen.channel_measurement)),
            "meas_stim": np.asarray(chosen.drive_index)[:, None] + 1.0,
            "vh": polarity * voltages[:, None],
            "vi": 1.1 * polarity * voltages[:, None],
        },
    )
    measurement = data.read(tmp_path / "e.mat")
    objects, reference = measurement.split_reference()
    np.testing.assert_allclose(reference.voltages[0], polarity * voltages)
    np.testing.assert_allclose(objects.voltages, 1.1 * reference.voltages)
    assert measurement.protocol.num_drives == 8
    np.testing.assert_allclose(measurement.protocol.channel_drive, polarity * chosen.channel_drive)


def test_eidors_vectors_with_stated_pattern(tmp_path, tank):
    voltages = tank(protocol.adjacent(8))
    scipy.io.savemat(tmp_path / "frames.mat", {"vv": np.stack([voltages, 2 * voltages], axis=1)})
    (tmp_path / "frames.toml").write_text(DESCRIPTION + '[data]\nkeys = ["vv"]\nunit = "mV"\n', "utf-8")
    measurement = data.read(tmp_path / "frames.mat")
    np.testing.assert_allclose(measurement.voltages, 1e-3 * np.stack([voltages, 2 * voltages]))
    assert measurement.electrodes.num_electrodes == 8


@pytest.mark.parametrize("suffix", ["csv", "txt", "npy", "npz"])
def test_tables(tmp_path, tank, suffix):
    chosen = protocol.adjacent(8)
    frames = np.stack([tank(chosen), 1.2 * tank(chosen)])
    file = tmp_path / f"frames.{suffix}"
    extra = "[data]\n"
    if suffix == "npz":
        np.savez(file, voltages=frames)
    elif suffix == "npy":
        np.save(file, frames)
    else:
        delimiter = ";" if suffix == "csv" else " "
        extra += f'delimiter = "{delimiter}"\nskip_rows = 1\nframes_in = "columns"\n'
        np.savetxt(file, frames.T, delimiter=delimiter, header="made in a test", comments="")
    (tmp_path / "description.toml").write_text(DESCRIPTION + extra, "utf-8")
    measurement = data.read(file)
    np.testing.assert_allclose(measurement.voltages, frames, rtol=1e-12)
    assert measurement.protocol.same_patterns(chosen)
    assert measurement.num_frames == 2


@pytest.mark.parametrize(
    ("component", "expected"), [("real", 0.3), ("imaginary", -0.4), ("magnitude", 0.5), ("complex", 0.3 - 0.4j)]
)
def test_complex_pairs_gain_and_polarity(tmp_path, component, expected):
    values = np.arange(1, 41)[:, None] * np.array([[-3.0, 4.0]])
    np.savetxt(tmp_path / "c.csv", values, delimiter=",")
    extra = '[data]\nframes_in = "columns"\ncomplex_pairs = true\ngain = 10\npolarity = "reversed"\n'
    (tmp_path / "c.toml").write_text(f'{DESCRIPTION}{extra}component = "{component}"\n', "utf-8")
    measurement = data.read(tmp_path / "c.csv")
    np.testing.assert_allclose(measurement.voltages[0], np.arange(1, 41) * expected, rtol=1e-12)


def test_bundled_description_by_name(tmp_path):
    rng = np.random.default_rng(1)
    np.savetxt(tmp_path / "mine.csv", rng.normal(size=(208, 4)), delimiter=",")
    with pytest.raises(ValueError, match="finds no current in the name"):
        data.read(tmp_path / "mine.csv", format="tank6cm")
    (tmp_path / "mine.csv").rename(tmp_path / "t_1_10.00_30uA_500Hz.csv")
    measurement = data.read(tmp_path / "t_1_10.00_30uA_500Hz.csv")
    assert float(measurement.protocol.drive.max()) == pytest.approx(30e-6)
    assert any("not documented" in note for note in measurement.notes)


KINDS = {
    "skip": {"skipped": 1, "current": 1e-3},
    "opposite": {"drives": "all", "current": 1e-3},
    "all_against_one": {"common": 2, "current": 1e-3},
    "reference_electrode": {"current": 1e-3},
    "two_terminal": {"pairs": [[0, 1], [3, 4]], "current": 1e-3},
    "trigonometric": {"measurement": "mean", "current": 1e-3},
    "haar": {"measurement": "against", "reference": 2, "current": 1e-3},
    "optimal": {"transfer": [[2, -1, -1], [-1, 2, -1], [-1, -1, 2]], "drives": 1, "current": 1, "current_unit": "mA"},
    "bipolar": {"drive_pairs": [[0, 1]], "measurement_pairs": [[2, 3], [4, 5]], "current": 1e-3},
    "matrices": {"drive": [[1e-3, -1e-3, 0]], "measurement": [[0, 1, -1], [1, 0, -1]]},
    "channels": {
        "drive": [[1e-3, -1e-3, 0]],
        "measurement": [[0, 1, -1], [1, 0, -1]],
        "drive_index": [0, 0],
        "measurement_index": [1, 0],
    },
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_protocol_can_be_described(tmp_path, kind):
    lines = [f'kind = "{kind}"', *(f"{key} = {json.dumps(value)}" for key, value in KINDS[kind].items())]
    number = [] if kind in ("matrices", "channels", "optimal") else ["number = 8"]
    (tmp_path / "p.toml").write_text("\n".join(["[protocol]", *lines, *number]), "utf-8")
    made = data.load_description(tmp_path / "p.toml").protocol(tmp_path / "p.csv")
    assert made is not None
    assert made.num_electrodes == {"matrices": 3, "channels": 3, "optimal": 3, "reference_electrode": 9}.get(kind, 8)


def test_round_trip(tmp_path, tank, setup):
    chosen = protocol.skip(8, 1, measurement_skipped=0)
    voltages = np.stack([tank(chosen), 1.01 * tank(chosen)])
    voltages[1, 3] = np.nan
    first = data.screen(voltages, chosen, frame_names=("reference", "object"), notes=("ein „Test“.",), **setup(8))
    data.write_table(first, tmp_path / "out.npz")
    again = data.read(tmp_path / "out.npz")
    np.testing.assert_array_equal(again.voltages, first.voltages)
    np.testing.assert_array_equal(again.mask, first.mask)
    assert again.protocol.same_patterns(first.protocol)
    assert again.protocol.name == first.protocol.name
    np.testing.assert_array_equal(again.electrodes.position, first.electrodes.position)
    np.testing.assert_array_equal(again.electrodes.width, first.electrodes.width)
    assert again.domain == first.domain
    assert again.frame_names == first.frame_names
    assert again.notes[0] == "ein „Test“."


def test_written_descriptions_apply_to_other_tables(tmp_path, tank, setup):
    """A protocol in an order that no constructor makes, and frames other than the named ones."""
    chosen = protocol.adjacent(8, current=1e-3).subset(np.random.default_rng(0).permutation(40)[:33])
    frames = np.stack([tank(chosen), 1.2 * tank(chosen), 1.3 * tank(chosen)])
    frames[0, 3] = np.nan
    written = data.screen(frames[:2], chosen, frame_names=("reference", "press"), **setup(8))
    _, description = data.write_table(written, tmp_path / "out.npz")
    np.savetxt(tmp_path / "live.csv", frames, delimiter=",")
    live = data.read(tmp_path / "live.csv", description=description)
    np.testing.assert_allclose(live.voltages, frames, rtol=1e-12)
    assert live.protocol.same_patterns(chosen)
    assert live.domain == written.domain
    assert not any("masked" in note and "2 frames" in note for note in live.notes)
    assert live.frame_names == ()


@pytest.mark.parametrize("given", ["npz", "table in millivolts", "nothing but itself"])
def test_a_table_uses_the_description_of_another_measurement(given, tmp_path, tank, setup):
    """The description of the reference applies to frames of the same sensor; its units too, if it is a table."""
    chosen = protocol.adjacent(8, current=1e-3)
    rest, scale = tank(chosen), 1.0
    reference = data.screen(rest, chosen, frame_names=("empty",), **setup(8))
    if given == "npz":
        data.write_table(reference, tmp_path / "empty.npz")
        reference = data.read(tmp_path / "empty.npz")
    elif given == "table in millivolts":
        scale = 1e-3
        np.savetxt(tmp_path / "empty.csv", rest[:, None], delimiter=";")
        layout = '[data]\nunit = "mV"\ndelimiter = ";"\nframes_in = "columns"\nframe_names = ["empty"]\n'
        (tmp_path / "empty.toml").write_text(DESCRIPTION + layout, "utf-8")
        reference = data.read(tmp_path / "empty.csv")
    frames = np.stack([rest, 1.1 * rest])
    live = {"delimiter": ";"} if scale != 1 else {"delimiter": ","}
    np.savetxt(tmp_path / "live.csv", frames.T if scale != 1 else frames, **live)
    found = data.read(tmp_path / "live.csv", like=reference)
    np.testing.assert_allclose(found.voltages, scale * frames, rtol=1e-12)
    assert found.protocol.same_patterns(chosen)
    assert found.domain == reference.domain
    assert found.frame_names == ()
    assert any("described as" in note for note in found.notes)
    (tmp_path / "live.toml").write_text(DESCRIPTION + '[data]\ndelimiter = "x"\n', "utf-8")
    with pytest.raises(ValueError, match="delimiter"):  # its own description takes precedence
        data.read(tmp_path / "live.csv", like=reference)


@pytest.mark.parametrize("shape", ["rectangle", "polygon", "polygon with a hole"])
def test_round_trip_of_other_shapes(tmp_path, tank, shape):
    chosen = protocol.adjacent(4)
    holes = [[[0.09, 0.01], [0.1, 0.03], [0.11, 0.01]]] if shape == "polygon with a hole" else []
    domain = Rectangle(0.2, 0.1) if shape == "rectangle" else Polygon([[0, 0], [0.2, 0], [0.1, 0.1]], holes)
    position = 0.02 * np.array([[1.0, 1], [2, 1], [2, 2], [1, 2]])
    electrodes = SheetDiscs(position, 0.001, 1e-4) if shape == "rectangle" else PointElectrodes(position)
    first = data.screen(tank(chosen) * (1 + 0.1j), chosen, electrodes=electrodes, domain=domain)
    data.write_table(first, tmp_path / "out.npz")
    again = data.read(tmp_path / "out.npz")
    np.testing.assert_array_equal(again.voltages, first.voltages)
    assert type(again.domain) is type(domain)
    for loop, wanted in zip(again.domain.loops(), domain.loops(), strict=True):
        np.testing.assert_array_equal(loop, wanted)
    assert type(again.electrodes) is type(electrodes)
    np.testing.assert_array_equal(again.electrodes.position, position)


def test_times_are_kept(tmp_path, tank, setup):
    """Selections and written files keep times; an average has none."""
    chosen = protocol.adjacent(8)
    times = np.array([0.0, 0.02, 0.04, 0.07])
    made = replace(data.screen(np.stack([k * tank(chosen) for k in range(1, 5)]), chosen, **setup(8)), times=times)
    assert made.frame_rate == pytest.approx(3 / 0.07)
    data.write_table(made, tmp_path / "out.npz")
    again = data.read(tmp_path / "out.npz")
    np.testing.assert_array_equal(again.times, times)
    np.testing.assert_array_equal(again.frames([1, 3]).times, times[[1, 3]])
    np.testing.assert_array_equal(again.frames(slice(2, None)).voltages, made.voltages[2:])
    np.testing.assert_array_equal(again.frames(times > 0.03).times, times[2:])
    np.testing.assert_array_equal(again.frame(-1).times, times[-1:])
    np.testing.assert_array_equal(again.masked(np.arange(40) != 3, "no reason.").times, times)
    assert again.masked(np.ones(40, bool), "no reason.").notes == again.notes
    assert again.frame(0).frame_rate is None
    assert again.mean_frame().times is None


@pytest.mark.parametrize(
    ("times", "message"),
    [([0, 1], "each of 3 frames"), ([0, 1, 1], "rise from frame to frame"), ([0, 1, np.nan], "must be finite")],
)
def test_bad_times(tank, times, message):
    chosen = protocol.adjacent(8)
    with pytest.raises(ValueError, match=message):
        replace(data.screen(np.stack([tank(chosen)] * 3), chosen), times=times)


@pytest.mark.parametrize("which", [[], [2, 1], [0, 3], [0.5], np.ones(4, bool), slice(3, None)])
def test_frames_that_do_not_exist(tank, which):
    chosen = protocol.adjacent(8)
    with pytest.raises(ValueError, match="which: "):
        data.screen(np.stack([tank(chosen)] * 3), chosen).frames(which)
