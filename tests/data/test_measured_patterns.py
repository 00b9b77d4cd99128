"""Files that hold their currents beside electrodes × patterns × frames, and conversions by the transfer impedance."""

import re

import numpy as np
import pytest
import scipy.io

from jeit import data, protocol
from jeit.data.frame_checks import assess
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.imaging import select_frames
from jeit.inverse import Noser, one_step
from jeit.layout import ring
from jeit.mesh import Disk

COUNT, FRAMES = 8, 5
DESCRIBED = """
[geometry]
shape = "disk"
radius = 0.1
[electrodes]
layout = "ring"
number = 8
clockwise = true
width = 0.01
contact_impedance = 0.01
[protocol]
kind = "measured"
[data]
keys = ["frame_voltage"]
"""


@pytest.fixture
def published(tank):
    """Fields of a published system's file: currents (L, S) A and voltages (L, S, F) V without their mean."""
    chosen = protocol.haar(COUNT, current=2.4e-4)
    voltages = tank(chosen).reshape(COUNT - 1, COUNT).T
    drift = 1 + 1e-3 * np.arange(FRAMES)
    return {"current_patterns": np.asarray(chosen.drive).T, "frame_voltage": voltages[:, :, None] * drift}


def read(folder, arrays, description=DESCRIBED, suffix=".mat"):
    file = folder / f"tank{suffix}"
    scipy.io.savemat(file, arrays) if suffix == ".mat" else np.savez(file, **arrays)
    (folder / "description.toml").write_text(description, "utf-8")
    return data.read(file)


@pytest.mark.parametrize("suffix", [".mat", ".npz"])
def test_read_with_a_short_description(published, tank, tmp_path, suffix):
    found = read(tmp_path, published, suffix=suffix)
    assert found.protocol.same_patterns(protocol.haar(COUNT, current=2.4e-4))
    assert found.voltages.shape == (FRAMES, (COUNT - 1) * COUNT)
    np.testing.assert_allclose(found.voltages[2], 1.002 * tank(found.protocol), rtol=1e-12)
    assert found.electrodes.num_electrodes == COUNT
    assert data.reciprocity_error(found) < 1e-12


def test_mean_of_the_frames(published, tank, tmp_path):
    found = read(tmp_path, published, DESCRIBED + 'frames = "mean"\n')
    np.testing.assert_allclose(found.voltages, [1.002 * tank(found.protocol)], rtol=1e-12)
    assert found.notes[-1] == "the mean of 5 frames."
    assert found.times is None


@pytest.mark.parametrize("suffix", [".mat", ".npz"])
def test_potentials_against_ground_lose_their_mean_with_a_note(published, tank, tmp_path, suffix):
    raw = published | {"frame_voltage": published["frame_voltage"] + 0.5}
    found = read(tmp_path, raw, suffix=suffix)
    np.testing.assert_allclose(found.voltages[0], tank(found.protocol), rtol=1e-9)
    assert found.notes[-1] == "the potentials had a mean, 0.5 V at most; it is subtracted."
    assert not any("mean" in note for note in read(tmp_path, published, suffix=suffix).notes)
    raw["frame_voltage"][3, 2, 1] = np.nan
    assert not np.isfinite(read(tmp_path, raw, suffix=suffix).voltages[1]).all()


@pytest.mark.parametrize("suffix", [".mat", ".npz"])
def test_part_of_complex_voltages_is_noted(published, tmp_path, suffix):
    found = read(tmp_path, published | {"frame_voltage": published["frame_voltage"] * (1 + 0.1j)}, suffix=suffix)
    assert found.notes[-1] == "of complex voltages this is the real part; see [data] component."


def test_other_axes_names_and_units(published, tank, tmp_path):
    turned = {"i": 1e3 * published["current_patterns"].T, "u": np.transpose(published["frame_voltage"], (2, 0, 1))}
    described = (
        DESCRIBED.replace("frame_voltage", "u") + 'axes = ["frames", "electrodes", "patterns"]\nframe_rate = 20.0\n'
    )
    described = described.replace(
        '"measured"\n', '"measured"\ndrive_key = "i"\npatterns_in = "rows"\ncurrent_unit = "mA"\n'
    )
    found = read(tmp_path, turned, described)
    np.testing.assert_allclose(found.voltages[0], tank(found.protocol), rtol=1e-12)
    np.testing.assert_allclose(found.times, np.arange(FRAMES) / 20)
    assert found.frame_rate == pytest.approx(20)


def test_a_matrix_of_measurement_patterns(published, tmp_path):
    rows = np.eye(COUNT)[:3] - np.eye(COUNT)[3:6]
    arrays = {**published, "meas": rows.T, "frame_voltage": np.einsum("kl,lsf->ksf", rows, published["frame_voltage"])}
    found = read(tmp_path, arrays, DESCRIBED.replace('"measured"\n', '"measured"\nmeasurement_key = "meas"\n'))
    np.testing.assert_array_equal(found.protocol.measurement, rows)


def test_one_frame_of_two_axes(published, tmp_path):
    one = {**published, "frame_voltage": published["frame_voltage"][:, :, 0]}
    assert read(tmp_path, one).num_frames == 1


@pytest.mark.parametrize(
    ("change", "replaced", "message"),
    [
        ({"current_patterns": np.ones((8, 7))}, None, "sums to 8"),
        ({"current_patterns": np.eye(8)[None]}, None, "must be a matrix"),
        ({"current_patterns": np.full((8, 7), np.nan)}, None, "without NaN"),
        ({"frame_voltage": np.ones((8, 6, 5))}, None, "channels"),
        ({"frame_voltage": np.ones((8, 7, 5, 2))}, None, "are 3 axes"),
        ({}, ("kind =", 'drive_key = "other"\nkind ='), "no variable 'other'"),
        ({}, ("[data]", '[data]\naxes = ["frames", "frames", "patterns"]'), "each once"),
        ({}, ("[data]", '[data]\nframes = "mean"\nframe_rate = 5.0'), "no use where the frames are averaged"),
        ({}, ("number = 8", "number = 9"), "9 electrodes were placed"),
        ({}, ("kind =", 'measurement = "against"\nreference = 8\nkind ='), "0 to 7"),
        ({}, ("kind =", "reference = 1\nkind ="), "no use"),
    ],
)
def test_arrays_that_do_not_match(published, tmp_path, change, replaced, message):
    description = DESCRIBED if replaced is None else DESCRIBED.replace(*replaced, 1)
    with pytest.raises(ValueError, match=message):
        read(tmp_path, {**published, **change}, description)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ('kind = "optimal"\ntransfer = [[1, -1], [-1, 1]]', "give one of them"),
        ('kind = "optimal"\ntransfer = [[1, -1], [-1, 1]]\npower = 1e-6', "power needs other"),
        ('kind = "measured"', "from a .mat or .npz file; 'p.csv' is none"),
        ('kind = "haar"\nnumber = 8', "current"),
    ],
)
def test_impossible_protocols(tmp_path, options, message):
    (tmp_path / "p.toml").write_text(f"[protocol]\n{options}\n", "utf-8")
    (tmp_path / "p.csv").write_text("1,2\n", "utf-8")
    with pytest.raises(ValueError, match=re.escape(message)):
        data.load_description(tmp_path / "p.toml").protocol(tmp_path / "p.csv")


def measured(tank, chosen, noise=0.0, seed=0):
    voltages = tank(chosen, 0.3)
    return data.screen(voltages + noise * np.random.default_rng(seed).normal(size=voltages.shape), chosen)


@pytest.mark.parametrize("measurement", ["adjacent", "mean", "mean-removed", "against"])
def test_voltages_under_other_currents_follow_from_the_transfer_impedance(tank, measurement):
    made = measured(tank, protocol.trigonometric(COUNT, measurement=measurement))
    for other in (protocol.haar(COUNT), protocol.adjacent(COUNT, driven_electrodes=True), protocol.opposite(COUNT)):
        converted = data.driven_by(made, other)
        np.testing.assert_allclose(
            converted.voltages[0], tank(other, 0.3), rtol=0, atol=1e-10 * np.abs(converted.voltages).max()
        )
        assert converted.protocol is other


def test_an_undetermined_transfer_impedance_is_refused(tank):
    with pytest.raises(ValueError, match="leave the transfer impedance open"):
        data.transfer_impedance(measured(tank, protocol.adjacent(COUNT)))
    with pytest.raises(ValueError, match="both must be of the same body"):
        data.driven_by(measured(tank, protocol.haar(COUNT)), protocol.haar(9))


def test_noise_from_reciprocity_of_patterns_on_all_electrodes(tank):
    """Potentials with independent noise, less their mean: 28 independent differences give the noise within 15 %."""
    chosen, noise = protocol.haar(16), 1e-4
    clean = tank(chosen).reshape(-1, 16)
    found = []
    for seed in range(8):
        rough = clean + noise * np.random.default_rng(seed).normal(size=clean.shape)
        rough -= rough.mean(axis=1, keepdims=True)
        estimate = data.estimate_noise(data.screen(rough.ravel(), chosen))
        assert estimate is not None
        assert estimate.method == "reciprocity"
        found.append(estimate.standard_deviation)
    assert np.mean(found) == pytest.approx(noise, rel=0.1)


def test_unequal_gains_break_reciprocity(tank):
    chosen = protocol.haar(16)
    gains = 1 + 0.02 * np.random.default_rng(3).normal(size=16)
    uneven = (tank(chosen).reshape(-1, 16) * gains).ravel()
    assert data.reciprocity_error(data.screen(tank(chosen), chosen)) < 1e-12
    assert data.reciprocity_error(data.screen(uneven, chosen)) > 5e-3


@pytest.mark.parametrize("rule", ["noise-figure", "gcv", "discrepancy", "l-curve"])
def test_potentials_without_their_mean_are_not_counted_twice(rule):
    """L potentials without their mean hold L - 1 values: image and hyperparameter equal those of L - 1 orthonormal
    combinations."""
    electrodes = BoundaryElectrodes(ring(0.1, COUNT), 0.02, 0.01)
    redundant = ForwardModel(Disk(0.1).mesh(num_points=300), electrodes, protocol.haar(COUNT))
    rows = np.linalg.svd(protocol.measurement_patterns(COUNT, "mean-removed"))[2][:-1]
    rows -= rows.mean(axis=1, keepdims=True)
    facts = redundant.with_protocol(protocol.from_matrices(redundant.protocol.drive, rows))
    noise = np.random.default_rng(5).normal(size=(COUNT - 1, COUNT))
    noise -= noise.mean(axis=1, keepdims=True)
    conductivity = np.ones(redundant.mesh.num_cells)
    conductivity[:40] = 1.3
    change = np.asarray(redundant.voltages(conductivity) - redundant.voltages(1.0)).reshape(COUNT - 1, COUNT)
    change = change + 1e-2 * np.abs(change).max() * noise
    found = [
        one_step(
            model, 1.0, prior=Noser(), hyperparameter=rule, noise=0.01 * np.abs(change).max(), difference=one.ravel()
        )
        for model, one in ((redundant, change), (facts, change @ rows.T))
    ]
    images = [np.asarray(one.image(given.ravel())) for one, given in zip(found, (change, change @ rows.T), strict=True)]
    assert float(found[0].hyperparameter) == pytest.approx(float(found[1].hyperparameter), rel=1e-6)
    np.testing.assert_allclose(images[0], images[1], rtol=0, atol=1e-6 * np.abs(images[1]).max())


def test_a_reference_under_other_currents_is_converted_to_those_of_the_frames(tank):
    frame = measured(tank, protocol.haar(COUNT), noise=1e-7)
    other = data.screen(tank(protocol.trigonometric(COUNT)), protocol.trigonometric(COUNT))
    _, base = select_frames(frame, other)
    np.testing.assert_allclose(base.voltages[0], tank(frame.protocol), rtol=0, atol=1e-10 * np.abs(base.voltages).max())
    assert any("turned into what" in note for note in base.notes)
    assert any(note.startswith(f"'{other.name}' was measured with") for note in base.notes)
    # Not if the transfer impedance is undetermined, or if only the amplitude of the currents differs.
    for made in (protocol.adjacent(COUNT), protocol.haar(COUNT, current=2e-3)):
        _, base = select_frames(frame, data.screen(tank(made), made))
        assert base.protocol is made
        with pytest.raises(ValueError, match=r"drive or read different|times the current|channels"):
            assess(frame, base)
