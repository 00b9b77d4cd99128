"""The named protocols: channel counts of the literature, and properties of every protocol."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jeit import protocol

PROTOCOLS = {
    "adjacent 16": (protocol.adjacent(16), 208),  # Pugach et al. 2015
    "adjacent 16, reciprocal half": (protocol.adjacent(16, reciprocal="half"), 104),
    "adjacent 16, driven too": (protocol.adjacent(16, driven_electrodes=True), 256),
    "adjacent 16, fixed order": (protocol.adjacent(16, order="fixed"), 208),
    "skip-1 16": (protocol.skip(16, 1), 192 + 16),
    "skip-3 drive, adjacent measurement": (protocol.skip(16, 3, measurement_skipped=0), 192),
    "opposite 16": (protocol.opposite(16), 96),  # Russo et al. 2017: L(L - 4)/2
    "opposite 16, all drives": (protocol.opposite(16, drives="all"), 192),
    "opposite 8": (protocol.opposite(8), 16),
    "opposite 8, all drives": (protocol.opposite(8, drives="all"), 32),
    "16 and centre": (protocol.reference_electrode(16), 224),  # Silvera Tawil et al. 2011
    "all against one": (protocol.all_against_one(16), 225),
    "all against one, half": (protocol.all_against_one(16, reciprocal="half"), 120),
    "all against one, adjacent": (protocol.all_against_one(16, measurement="adjacent"), 14 * 13),
    "two-terminal, all": (protocol.two_terminal(16), 120),
    "two-terminal, chosen": (protocol.two_terminal(32, [(k, (k + 5) % 32) for k in range(32)]), 32),
    "trigonometric 16": (protocol.trigonometric(16), 240),
    "trigonometric 7, mean": (protocol.trigonometric(7, measurement="mean"), 42),
    "trigonometric 7, mean removed": (protocol.trigonometric(7, measurement="mean-removed"), 42),
    "haar 32": (protocol.haar(32), 31 * 32),  # ACT 5's: 31 patterns, 32 potentials
    "haar 11, against the last": (protocol.haar(11, measurement="against"), 10 * 10),
    "bipolar": (protocol.bipolar(4, [(0, 1), (2, 3)], [(0, 1), (2, 3), (1, 2)]), 2),
}


@pytest.fixture(params=PROTOCOLS)
def case(request):
    return PROTOCOLS[request.param]


def test_channel_counts_of_the_literature(case):
    chosen, count = case
    assert chosen.num_measurements == count


def test_all_against_one_drives_against_one_and_measures_against_it_or_between_neighbours():
    def pairs(patterns):
        return {tuple(sorted(np.flatnonzero(row))) for row in np.asarray(patterns)}

    against_two = {tuple(sorted((2, k))) for k in range(6) if k != 2}
    neighbours = {tuple(sorted((k, (k + 1) % 6))) for k in range(6)}
    for measurement, expected in (("common", against_two), ("adjacent", neighbours)):
        chosen = protocol.all_against_one(6, common=2, measurement=measurement)
        assert (pairs(chosen.drive), pairs(chosen.measurement)) == (against_two, expected)


def test_currents_and_weights_sum_to_zero(case):
    chosen, _ = case
    # Rounding of a sum of 16 terms of size one.
    assert np.abs(np.asarray(chosen.measurement).sum(axis=1)).max() < 1e-14
    assert np.abs(np.asarray(chosen.drive).sum(axis=1)).max() < 1e-14 * 1e-3
    assert np.abs(chosen.drive).max() == pytest.approx(1e-3)


def test_channels_are_unique(case):
    chosen, _ = case
    channels = np.stack([chosen.drive_index, chosen.measurement_index], axis=1)
    assert len(np.unique(channels, axis=0)) == chosen.num_measurements


@pytest.mark.parametrize(
    ("chosen", "name"),
    [
        (protocol.adjacent(16), "adjacent, 16 electrodes"),
        (protocol.skip(16, 3), "skip-3, 16 electrodes"),
        (protocol.skip(16, 0, measurement_skipped=2), "adjacent, skip-2 measurement, 16 electrodes"),
        (protocol.reference_electrode(16), "adjacent drive against reference electrode, 16 + 1 electrodes"),
        (protocol.reference_electrode(16, skipped=1), "skip-1 drive against reference electrode, 16 + 1 electrodes"),
        (protocol.haar(8, measurement="mean"), "haar, mean measurement, 8 electrodes"),
    ],
)
def test_names_state_the_pairs(chosen, name):
    assert chosen.name == name


def test_the_first_of_two_reciprocal_channels_is_measured():
    half = protocol.adjacent(16, reciprocal="half", order="fixed")
    assert np.all(np.asarray(half.drive_index) < half.measurement_index)


def test_rotating_order_starts_after_the_driven_pair():
    # The order of the 6 cm tank's files: row 13 i + t measures the pair that starts at electrode i + 2 + t.
    rows = np.asarray(protocol.adjacent(16).channel_measurement).argmax(axis=1)
    drive, step = np.divmod(np.arange(208), 13)
    np.testing.assert_array_equal(rows, (drive + 2 + step) % 16)


def test_fixed_order_starts_at_the_first_electrode():
    rows = np.asarray(protocol.adjacent(16, order="fixed").channel_measurement).argmax(axis=1)
    np.testing.assert_array_equal(rows[13 * 5 : 13 * 6], [0, 1, 2, 3, *range(7, 16)])


def test_driven_electrodes_are_excluded_by_default():
    assert not protocol.adjacent(8).channels_on_driven_electrodes().any()
    assert protocol.adjacent(8, driven_electrodes=True).channels_on_driven_electrodes().sum() == 3 * 8
    assert protocol.two_terminal(4).channels_on_driven_electrodes().all()


def test_centre_reference_measures_every_boundary_electrode_against_the_last():
    chosen = protocol.reference_electrode(16)
    assert chosen.num_electrodes == 17
    assert np.all(np.asarray(chosen.channel_measurement)[:, 16] == -1)
    assert np.all(np.asarray(chosen.drive)[:, 16] == 0)
    other = protocol.reference_electrode(16, reference=0)
    assert np.all(np.asarray(other.channel_measurement)[:, 0] == -1)


def test_trigonometric_drives_are_orthogonal():
    drive = np.asarray(protocol.trigonometric(16, current=1.0).drive)
    gram = drive @ drive.T
    np.testing.assert_allclose(gram, np.diag([8.0] * 14 + [16.0]), atol=1e-13)
    angle = 2 * np.pi * np.arange(5) / 5
    expected = [np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)]
    np.testing.assert_allclose(protocol.trigonometric(5, current=2e-3).drive, 2e-3 * np.array(expected), atol=1e-15)


def test_from_matrices_selects_channels_drive_by_drive():
    drive = 1e-3 * np.array([[1, -1, 0.0], [0, 1, -1]])
    rows = np.array([[1, 0, -1.0], [0, 1, -1]])
    chosen = protocol.from_matrices(drive, rows, np.array([[True, False], [True, True]]))
    np.testing.assert_array_equal(chosen.drive_index, [0, 1, 1])
    np.testing.assert_array_equal(chosen.measurement_index, [0, 0, 1])


def test_from_channels_stores_equal_rows_once_in_order():
    full = protocol.adjacent(16, current=1.0)
    again = protocol.from_channels(full.drive, full.channel_measurement, full.drive_index)
    assert again.measurement.shape == (16, 16)
    assert again.same_patterns(full)
    # The first channel's row comes first.
    assert again.measurement_index[0] == 0


@given(st.integers(5, 24), st.integers(0, 22), st.booleans())
@settings(max_examples=25, deadline=None)
def test_skip_any(count, skipped, driven):
    skipped = skipped % (count - 1)
    chosen = protocol.skip(count, skipped, measurement_skipped=0, driven_electrodes=driven)
    touching = 3 if skipped in (0, count - 2) else 4
    assert chosen.num_measurements == count * (count if driven else count - touching)
    assert driven or not chosen.channels_on_driven_electrodes().any()


BAD = {
    "too few electrodes": (lambda: protocol.adjacent(3), "at least 4"),
    "too few electrodes to skip": (lambda: protocol.skip(3, 1), "^skip: .* at least 4; got 3"),
    "too few electrodes to skip none": (lambda: protocol.skip(3, 0), "^adjacent: .* at least 4; got 3"),
    "not an integer": (lambda: protocol.adjacent(16.0), "integer"),
    "odd opposite": (lambda: protocol.opposite(15), r"opposite pairs.*skip\(\.\.\., 6\)"),
    "milliamperes": (lambda: protocol.adjacent(16, current=1.4), "1.4 mA, write 1.4e-3 .microamperes: 1.4e-6"),
    "milliamperes in matrices": (lambda: protocol.from_matrices([[1.41, -1.41]], [[1, -1]]), "amperes"),
    "no current": (lambda: protocol.adjacent(16, current=0.0), "positive"),
    "several currents": (
        lambda: protocol.adjacent(16, current=np.full(1, 1e-3)),
        "must be one positive, finite number",
    ),
    "current in words": (lambda: protocol.adjacent(16, current="1e-3"), "must be one positive, finite number"),
    "NaN current": (lambda: protocol.adjacent(16, current=float("nan")), "finite"),
    "skip back to itself": (lambda: protocol.skip(8, 7), "from 0 to 6"),
    "unknown order": (lambda: protocol.adjacent(16, order="clockwise"), "'rotating'"),
    "unknown half": (lambda: protocol.adjacent(16, reciprocal="none"), "'half'"),
    "pair with itself": (lambda: protocol.two_terminal(4, [(0, 1), (2, 2)]), "pair 1 is electrode 2 with itself"),
    "negative electrode": (lambda: protocol.two_terminal(4, [(-1, 1)]), "0 to 3"),
    "electrode that is not": (lambda: protocol.two_terminal(4, [(0, 4)]), "0 to 3"),
    "common that is not": (lambda: protocol.all_against_one(8, common=8), "0 to 7"),
    "nothing left": (lambda: protocol.all_against_one(8, driven_electrodes=False), "driven_electrodes=True"),
    "reference that is not": (lambda: protocol.reference_electrode(16, reference=17), "0 to 16"),
    "skip all around": (
        lambda: protocol.reference_electrode(8, skipped=7),
        "reference_electrode: skipped .* 0 to 6 .* 7",
    ),
    "skip half": (
        lambda: protocol.reference_electrode(8, skipped=0.5),
        "reference_electrode: skipped .* integer .* 0.5",
    ),
    "rows do not sum to zero": (lambda: protocol.from_matrices([[1e-3, 0]], [[1, -1]]), "sums to 0.001"),
    "absolute potential": (lambda: protocol.from_matrices([[1e-3, -1e-3]], [[1, 0]]), "differences"),
    "zero row": (
        lambda: protocol.from_matrices([[1e-3, -1e-3], [0, 0], [0, 0]], [[1, -1]]),
        "drive pattern 1 is all zero: .*.2 such rows",
    ),
    "NaN": (
        lambda: protocol.from_matrices([[1e-3, -1e-3]], [[1, -1], [np.nan, -1]]),
        "measurement pattern 1 contains NaN",
    ),
    "other L": (lambda: protocol.from_matrices([[1e-3, -1e-3]], [[1, -1, 0]]), "3"),
    "select of another shape": (lambda: protocol.from_matrices([[1e-3, -1e-3]], [[1, -1]], [True]), "shape"),
    "select nothing": (lambda: protocol.from_matrices([[1e-3, -1e-3]], [[1, -1]], [[False]]), "no channel"),
    "text": (lambda: protocol.from_matrices([["a", "b"]], [[1, -1]]), "real numbers"),
    "index from one": (
        lambda: protocol.from_channels([[1e-3, -1e-3]] * 3, [[1, -1]] * 3, [1, 2, 3]),
        "drive_index runs from 1 to 3, but there are 3 drive patterns, numbered 0 to 2. Indices are 0-based",
    ),
    "negative index": (lambda: protocol.Protocol([[1e-3, -1e-3]], [[1, -1]], [0, 0], [0, -1]), "runs from -1 to 0"),
    "no index": (lambda: protocol.Protocol([[1e-3, -1e-3]], [[1, -1]], [], []), "integers|at least one"),
    "index of another length": (lambda: protocol.from_channels([[1e-3, -1e-3]], [[1, -1]], [0, 0]), "each of the 1"),
    "fractional index": (lambda: protocol.Protocol([[1e-3, -1e-3]], [[1, -1]], [0.5], [0]), "integers"),
}


@pytest.mark.parametrize("name", BAD)
def test_invalid_patterns_are_refused_with_advice(name):
    build, lesson = BAD[name]
    with pytest.raises(ValueError, match=lesson):
        build()


LEAST = {
    protocol.adjacent: 4,
    protocol.opposite: 4,
    protocol.all_against_one: 3,
    protocol.trigonometric: 3,
    protocol.two_terminal: 2,
    protocol.haar: 2,
}


@pytest.mark.parametrize(("build", "least"), LEAST.items())
def test_the_least_number_of_electrodes_is_accepted_and_one_less_refused(build, least):
    has_options = build in (protocol.all_against_one, protocol.opposite)
    options = {"driven_electrodes": True} if has_options else {}
    assert build(least, **options).num_electrodes == least
    with pytest.raises(ValueError, match=f"at least {least}; got {least - 1}"):
        build(least - 1, **options)
