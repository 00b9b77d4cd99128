"""Files without a description: explained, or a question asked, but never described as something else."""

import functools
import io
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.io

from jeit import data
from jeit.cli import main
from jeit.cli.commands.describe import _body_tables
from jeit.data.description import TableLayout, parse_description
from jeit.data.formats.text import frames_in_table
from jeit.imaging.describe import Findings, _fit_wiring, find_description
from jeit.imaging.possible_protocols import Candidate
from jeit.imaging.wiring import Wiring
from jeit.layout import ring
from jeit.mesh import centroids

DISK = {"shape": "disk", "radius": 0.1}
RING = {"layout": "ring", "width": 0.012}


@pytest.fixture(scope="module", autouse=True)
def coarse_models():
    """There is no option for the meshes of the compared descriptions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jeit.imaging.describe._NUM_NODES_BY_DIMENSION", {2: 300})
        yield


@functools.cache
def empty_disk():
    """A model of the empty disk with eight electrodes."""
    electrodes = {**RING, "number": 8, "contact_impedance": 3.0}
    tables = {"geometry": DISK, "electrodes": electrodes, "protocol": {"current": 1e-3, "kind": "adjacent"}}
    return parse_description(tables, "a.toml").model("a.csv", num_points=600)


def simulated(table, conductivity=1e-5):
    """Voltages (2, M) of a disk, empty and with a rod at (50, 0) mm, with the protocol of a table."""
    table = {"number": 8, "current": 1e-3, **table}
    model = empty_disk().with_protocol(parse_description({"protocol": table}, "a.toml").protocol(Path("a.csv")))
    away = np.asarray(centroids(model.mesh)) - [0.05, 0]
    rod = np.where(np.linalg.norm(away, axis=1) < 0.025, conductivity, 2e-3)
    voltages = np.stack([model.voltages(2e-3), model.voltages(rod)])
    return voltages * (1 + 1e-4 * np.random.default_rng(0).normal(size=voltages.shape)), model.protocol


def saved(folder, voltages, separator=","):
    paths = folder / "empty.csv", folder / "rod.csv"
    for path, values in zip(paths, voltages, strict=True):
        np.savetxt(path, values[None], delimiter=separator)
    return paths


KINDS = [
    {"kind": "adjacent"},
    {"kind": "adjacent", "order": "fixed"},
    {"kind": "adjacent", "driven_electrodes": True, "order": "fixed"},
    {"kind": "skip", "skipped": 1, "order": "fixed"},
    {"kind": "two_terminal"},
]


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_the_protocol_is_found(kind, tmp_path):
    voltages, protocol = simulated(kind)
    empty, rod = saved(tmp_path, voltages)
    found = find_description(rod, DISK, RING, reference=empty)
    assert not found.fault
    assert not found.undecided
    best = found.candidates[0]
    assert best.measurement.protocol.same_patterns(protocol)
    assert best.misfit < 0.05
    # An order that a uniform body explains after a permutation is not explained without it.
    models: dict = {}
    others = [_fit_wiring(one, models) for one in found.candidates[1:12]]
    turned = [one for one in others if one.wiring is not None and one.wiring.order]
    assert all(one.misfit > 0.2 for one in turned)
    assert turned or kind["kind"] == "two_terminal"
    (tmp_path / "description.toml").write_text(found.text, "utf-8")
    np.testing.assert_allclose(np.asarray(data.read(rod).voltages)[0], voltages[1])


@pytest.mark.slow
def test_magnitudes_with_gains(tmp_path):
    """As recorded by an instrument with one converter for each pair of electrodes."""
    voltages, protocol = simulated(KINDS[2])
    gains = np.exp(0.1 * np.random.default_rng(1).normal(size=8))
    driven = (np.asarray(protocol.channel_drive) != 0) & (np.asarray(protocol.channel_measurement) != 0)
    raw = 1e4 * np.abs(voltages) * gains[np.asarray(protocol.measurement_index)]
    raw[:, driven.any(axis=1)] = 0
    scipy.io.savemat(tmp_path / "a.mat", {"empty": raw[:1].T, "rod": raw[1:].T})
    found = find_description(tmp_path / "a.mat", DISK, RING, keys=("rod", "empty"))
    assert not found.fault
    assert not found.undecided
    estimated = found.candidates[0].gains
    np.testing.assert_allclose(estimated / gains, np.mean(estimated / gains), rtol=2e-3)
    (tmp_path / "description.toml").write_text(found.text, "utf-8")
    read = data.read(tmp_path / "a.mat", key="rod")
    inside = ~driven.any(axis=1)
    ratio = np.asarray(read.voltages)[0, inside] / voltages[1, inside]
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=2e-3)
    with pytest.raises(ValueError, match=r"arrays of numbers are empty \(64 × 1\), rod \(64 × 1\)"):
        find_description(tmp_path / "a.mat", DISK, RING)
    with pytest.raises(ValueError, match="has no array 'rad' \\(did you mean 'rod'"):
        find_description(tmp_path / "a.mat", DISK, RING, keys=("rad", "empty"))


def test_zeros_in_place_of_driven_electrodes_determine_the_protocol(tmp_path):
    """But not zeros of a measurement pattern that is never read, which would fit another order of the channels."""
    voltages, protocol = simulated({"kind": "adjacent", "driven_electrodes": True, "order": "fixed"})
    filled = np.where(np.asarray(protocol.channels_on_driven_electrodes()), 0, voltages)
    empty, rod = saved(tmp_path, filled)
    only_one = find_description(rod, DISK, RING, reference=empty)
    assert [item.name for item in only_one.candidates] == [
        "adjacent, 8 electrodes, driven_electrodes true, order fixed"
    ]
    empty, rod = saved(tmp_path, np.where(np.asarray(protocol.measurement_index) == 1, 0, voltages))
    several = find_description(rod, DISK, RING, reference=empty)
    assert len(several.candidates) > 4
    assert several.candidates[0].protocol == only_one.candidates[0].protocol
    assert any(item.protocol["kind"] == "opposite" for item in several.candidates)  # other drives, same measurements


def test_one_frame_may_be_a_matrix_of_drives_and_measurements(tmp_path):
    """Reciprocity makes it almost symmetric, so that noise decides whether rows or columns resemble each other more."""
    voltages, protocol = simulated({"kind": "adjacent", "driven_electrodes": True, "order": "fixed"})
    noise = 1 + 1e-4 * np.random.default_rng(2).normal(size=64)
    matrix = (voltages[1] * noise).reshape(8, 8)
    np.savetxt(tmp_path / "a.csv", matrix, delimiter=",")
    scipy.io.savemat(tmp_path / "a.mat", {"frame": matrix})
    for name in ("a.csv", "a.mat"):
        found = find_description(tmp_path / name, DISK, RING)
        assert found.candidates[0].measurement.protocol.same_patterns(protocol), name
        assert not found.undecided, name
        (tmp_path / "description.toml").write_text(found.text, "utf-8")
        np.testing.assert_allclose(np.asarray(data.read(tmp_path / name).voltages), matrix.reshape(1, 64))


def test_the_longer_side_of_a_matrix_of_one_frame_is_taken_for_its_drives():
    """For 16 drives of 13 measurements, as rows or as columns. A side that is a frame decides."""
    frame = np.arange(208.0)
    for table in (frame.reshape(16, 13), frame.reshape(16, 13).T):
        np.testing.assert_array_equal(frames_in_table(table, [208], TableLayout()).table, frame[None])
    assert frames_in_table(frame.reshape(16, 13), [13], TableLayout()).table.shape == (16, 13)


@pytest.mark.slow
def test_zeros_of_a_dead_electrode_do_not_rule_out_the_protocol(tmp_path):
    """In counts, of which small ones are zero, too."""
    voltages, protocol = simulated({"kind": "skip", "skipped": 3, "driven_electrodes": True, "order": "fixed"})
    counts = np.round(voltages / np.abs(voltages).max() * 100)
    dead = (np.asarray(protocol.channel_drive)[:, 0] != 0) | (np.asarray(protocol.channel_measurement)[:, 0] != 0)
    _, rod = saved(tmp_path, np.where(dead, 0, counts))
    found = find_description(rod, DISK, RING)
    assert found.candidates[0].protocol["order"] == "fixed"


def test_half_of_the_channels_leaves_the_order_open(tmp_path):
    """Without reciprocal channels, and in a round body, both orders explain a frame nearly as well: a question is
    asked.
    """
    voltages, protocol = simulated({"kind": "adjacent", "reciprocal": "half", "order": "fixed"})
    empty, rod = saved(tmp_path, voltages)
    found = find_description(rod, DISK, RING, reference=empty)
    same = [one for one in found.candidates if one.measurement.protocol.same_patterns(protocol)]
    assert same[0] in (found.candidates[0], *found.undecided)


def test_an_insufficient_explanation_is_reported(tmp_path):
    random = np.random.default_rng(0).normal(size=(2, 10))
    empty, rod = saved(tmp_path, random)
    found = find_description(rod, DISK, RING, reference=empty)
    assert "not good enough to go on" in found.fault
    assert not found.known
    with pytest.raises(ValueError, match=r"1 line of 1\. Are there columns of other things"):
        find_description(saved(tmp_path, random[:, :1])[0], DISK, RING)


def test_the_best_explanation_is_refused_by_what_it_leaves_unexplained():
    """A misfit of 30 % is good enough for voltages that differ from channel to channel, which another order of the
    channels would explain far worse, and for any voltages if the kind of protocol is known. 60 % is never enough."""
    protocol = {"kind": "adjacent", "number": 8}
    alike, different = (
        SimpleNamespace(voltages=voltages[None], mask=np.ones((1, 40), bool))
        for voltages in (np.linspace(1.0, 1.1, 40), np.geomspace(0.01, 1, 40))
    )

    def fault(measurement, misfit, known=False, **others):
        wiring = Wiring(tuple(range(8)), described=misfit)
        given: dict[str, Any] = {"frames": 1, "spread": 0.01, "reciprocity": None, **others}
        best = Candidate(protocol, measurement=measurement, wiring=wiring, **given)
        return Findings((best,), (), "", known).fault

    assert not fault(different, 0.3)
    assert not fault(alike, 0.2)
    assert not fault(alike, 0.3, known=True)
    assert "adjacent, 8 electrodes, misses 30 % of the empty body: that" in fault(alike, 0.3)
    # The reciprocity error counts by 1/√2: with 0.3, a misfit of 0.1 is 0.23 together, and 0.2 is 0.29.
    assert not fault(alike, 0.1, reciprocity=0.3)
    assert "misses 20 % of the empty body and breaks reciprocity by 30 %" in fault(alike, 0.2, reciprocity=0.3)
    for measurement in (alike, different):
        assert "misses 60 %" in fault(measurement, 0.6, known=True)
        assert "frames of the empty body differ by 25 %" in fault(measurement, 0.01, known=True, spread=0.25)
    columns = "its two columns are real and imaginary parts"
    assert [columns in fault(alike, 0.01, spread=0.25, frames=number) for number in (1, 2, 3)] == [False, True, False]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "deviation", "fault"),
    [
        ({"kind": "adjacent", "reciprocal": "half"}, 0.2, ""),
        ({"kind": "two_terminal"}, 0.3, "not good enough to go on"),
    ],
    ids=str,
)
def test_the_order_of_different_channels_supports_an_explanation(kind, deviation, fault, tmp_path):
    """A tank that deviates from its description is explained. Any description explains voltages that are all alike."""
    voltages, _ = simulated(kind)
    factors = np.exp(deviation * np.random.default_rng(3).normal(size=voltages.shape[1]))
    empty, rod = saved(tmp_path, voltages * factors)
    found = find_description(rod, DISK, RING, reference=empty)
    assert 0.25 < found.candidates[0].misfit < 0.4
    assert fault in found.fault
    assert bool(fault) == bool(found.fault)
    if fault:
        assert not find_description(rod, DISK, RING, reference=empty, known=kind).fault


@pytest.mark.slow
def test_a_column_of_other_data_is_not_explained_away(tmp_path):
    """Frames of the empty body are similar, and any description explains a few channels."""
    voltages, _ = simulated(KINDS[0])
    for path, values in zip((tmp_path / "empty.csv", tmp_path / "rod.csv"), voltages, strict=True):
        np.savetxt(path, np.tile(np.append(values, 0.01), (6, 1)), delimiter=",")
    try:
        fault = find_description(tmp_path / "rod.csv", DISK, RING, reference=tmp_path / "empty.csv").fault
    except ValueError as error:
        fault = str(error)
    assert "columns of other things" in fault
    with pytest.raises(ValueError, match=r"of what is known: 20, 36, 40, 64\) as there are numbers: 6 lines of 41"):
        find_description(tmp_path / "rod.csv", DISK, RING, known={"kind": "adjacent", "number": 8})
    np.savetxt(tmp_path / "wide.csv", np.random.default_rng(0).random((2, 600)), delimiter=",")
    with pytest.raises(ValueError, match="no protocol of common kinds"):
        find_description(tmp_path / "wide.csv", DISK, RING, known={"number": 4})
    with pytest.raises(ValueError, match="number must be from 4 to 64 electrodes; it is 3"):
        find_description(tmp_path / "wide.csv", DISK, RING, known={"number": 3})
    with pytest.raises(ValueError, match=r"key: wide\.csv has no arrays"):
        find_description(tmp_path / "wide.csv", DISK, RING, keys=("a", None))


@pytest.mark.slow
def test_a_square_table_is_transposed_where_its_columns_are_similar(tmp_path):
    voltages, protocol = simulated(KINDS[0])
    noise = 1 + 1e-4 * np.random.default_rng(2).normal(size=(2, 40, 40))
    for name, values, own in zip(("empty", "rod"), voltages, noise, strict=True):
        np.savetxt(tmp_path / f"{name}.csv", (values * own).T, delimiter=",")
    found = find_description(tmp_path / "rod.csv", DISK, RING, reference=tmp_path / "empty.csv", known={"number": 8})
    assert not found.fault
    assert not found.undecided
    assert found.candidates[0].measurement.protocol.same_patterns(protocol)
    (tmp_path / "description.toml").write_text(found.text, "utf-8")
    np.testing.assert_allclose(data.read(tmp_path / "rod.csv").mean_frame().voltages[0], voltages[1], rtol=1e-3)


@pytest.mark.slow
def test_a_frame_of_16_similar_lines(tmp_path):
    """One line for each drive of a ring: the same from every electrode."""
    voltages, protocol = simulated(KINDS[0])
    paths = tmp_path / "empty.txt", tmp_path / "rod.txt"
    for path, values in zip(paths, voltages, strict=True):
        np.savetxt(path, values.reshape(8, 5))
    found = find_description(paths[1], DISK, RING, reference=paths[0], known={"kind": "adjacent"})
    assert not found.fault
    assert found.candidates[0].measurement.protocol.same_patterns(protocol)


def test_known_settings_restrict_the_search(tmp_path):
    voltages, _ = simulated(KINDS[0])
    empty, rod = saved(tmp_path, voltages, " ")
    found = find_description(rod, DISK, RING, reference=empty, known={"kind": "adjacent", "number": 8})
    assert found.known
    assert {one.protocol["kind"] for one in found.candidates} == {"adjacent"}
    assert {replace(one.measurement).num_frames for one in found.candidates} == {1}


def test_for_a_file_with_its_protocol_the_body_is_described(tmp_path):
    """Electrodes are where the file places them, if it does. Files of instruments do not."""
    voltages, made = simulated(KINDS[1])
    values, position = voltages[0] / 1e-3, ring(0.1, 8)
    places = "\n".join(f"{x:.7f} {y:.7f}" for x, y in position)
    pairs = (np.asarray(one) for one in (made.channel_drive, made.channel_measurement))
    rows = np.stack([choose(one, axis=1) for one in pairs for choose in (np.argmax, np.argmin)], axis=1) + 1
    lines = "\n".join(f"{a} {b} {m} {n} {r:.9g}" for (a, b, m, n), r in zip(rows, values, strict=True))
    path = tmp_path / "a.ohm"
    path.write_text(f"8\n# x y\n{places}\n40\n# a b m n r\n{lines}\n")
    found = find_description(path, DISK, RING)
    assert found.fault == ""
    assert found.candidates[0].misfit < 0.05
    assert "[protocol]" not in found.text
    assert "Electrodes are where the file places them" in found.text
    (tmp_path / "a.toml").write_text(found.text)
    np.testing.assert_allclose(data.read(path).electrodes.position, position, atol=1e-6)
    path = tmp_path / "b.txt"
    path.write_text(f"a b m n r\n{lines}\n")
    assert 'layout = "ring"' in find_description(path, DISK, RING).text
    with pytest.raises(ValueError, match="states its protocol, of 8 electrodes: leave out"):
        find_description(path, DISK, RING, known={"number": 16})


def test_plates_of_a_solid_are_on_half_its_height():
    geometry, electrodes = _body_tables("cylinder:0.1,0.2", 0.01, None)
    assert geometry == {"shape": "cylinder", "radius": 0.1, "height": 0.2}
    assert electrodes == {"kind": "patch", "layout": "ring", "width": 0.01, "height": 0.2, "levels": 0.1}
    _, low = _body_tables("box:0.3,0.2,0.1", 0.01, 0.02)
    assert (low["layout"], low["height"], low["levels"]) == ("perimeter", 0.02, 0.05)


def test_command(tmp_path, capsys, monkeypatch):
    voltages, _ = simulated(KINDS[1], conductivity=1.7e-3)  # imaged in one step
    empty, rod = saved(tmp_path, -voltages, "\t")
    given = ["describe", str(rod), "--reference", str(empty), "--output", str(tmp_path / "out")]
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert main(given) == 1
    missing = "the file does not state all sizes; add them in metres, such as --shape disk:0.1 --width 0.01"
    assert missing in capsys.readouterr().err
    assert main([*given, "--shape", "disk:0.1,3", "--width", "0.012"]) == 1
    assert "--shape: give one of disk:RADIUS" in capsys.readouterr().err
    for options, message in (
        (("disk:big", "--width", "0.012"), "--shape: give one of disk:RADIUS"),
        (("disk:0.1", "--width", "0.012", "--height", "0.1"), "--height: a disk is a sheet; leave it out"),
        (("disk:0.1", "--width", "0.012", "--order", "back"), "--order"),
        (("disk:0.1", "--width", "0.2", "--electrodes", "8", "--protocol", "adjacent"), "--width: electrodes 1 and"),
    ):
        assert main([*given, "--shape", *options]) == 1
        assert capsys.readouterr().err.startswith(f"jeit: {message}")
    assert main([*given, "--shape", "disk:0.1", "--width", "0", "--electrodes", "8"]) == 1
    assert capsys.readouterr().err.startswith("jeit: --width is 0, and must be from")
    assert main([*given, "--shape", "disk:0.1", "--width", "0.012", "--electrodes", "8", "--protocol", "adjacent"]) == 0
    printed = capsys.readouterr().out
    assert "adjacent, 8 electrodes, order fixed" in printed
    assert "resistive" in printed
    assert {"description.toml", "image.png", "report.json"} <= {path.name for path in (tmp_path / "out").iterdir()}
    assert 'polarity = "reversed"' in (tmp_path / "out" / "description.toml").read_text("utf-8")
    assert main([*given, "--shape", "disk:0.1", "--width", "0.012"]) == 1
    assert "exists already" in capsys.readouterr().err
