"""Currents on all electrodes: Haar and optimal patterns, and measurements of all potentials."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jeit import protocol
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk, centroids

NUMBER = 12


@pytest.fixture(scope="module")
def bodies():
    """Transfer impedances of a disk, and of one with an inclusion off its middle."""
    model = ForwardModel(
        Disk(0.1).mesh(num_points=600), BoundaryElectrodes(ring(0.1, NUMBER), 0.02, 0.01), protocol.haar(NUMBER)
    )
    inside = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.04, 0.01], axis=1) < 0.025
    return np.asarray(model.transfer_impedance(1.0)), np.asarray(model.transfer_impedance(np.where(inside, 3.0, 1.0)))


def unit(rows):
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@given(st.integers(2, 40))
@settings(max_examples=20, deadline=None)
def test_haar_drives_of_any_number_are_orthogonal_and_complete(number):
    drive = unit(np.asarray(protocol.haar(number, current=1.0).drive))
    assert drive.shape == (number - 1, number)
    np.testing.assert_allclose(drive @ drive.T, np.eye(number - 1), atol=1e-14)


def test_haar_of_a_power_of_two():
    expected = [
        [1, 1, 1, 1, -1, -1, -1, -1],
        [1, 1, -1, -1, 0, 0, 0, 0],
        [0, 0, 0, 0, 1, 1, -1, -1],
        [1, -1, 0, 0, 0, 0, 0, 0],
        [0, 0, 1, -1, 0, 0, 0, 0],
        [0, 0, 0, 0, 1, -1, 0, 0],
        [0, 0, 0, 0, 0, 0, 1, -1],
    ]
    np.testing.assert_array_equal(protocol.haar(8, current=1.0).drive, expected)


def test_optimal_currents_of_a_disk_are_trigonometric(bodies):
    """Isaacson 1986: the eigenvectors of a disk's transfer impedance, in pairs of one frequency each."""
    best = unit(np.asarray(protocol.optimal(bodies[0]).drive))
    waves = unit(np.asarray(protocol.trigonometric(NUMBER).drive))
    for pair in range(5):
        rows = slice(2 * pair, 2 * pair + 2)
        # Both pairs span the same plane; the mesh approximates a disk to 1e-2.
        np.testing.assert_allclose(np.linalg.svd(best[rows] @ waves[rows].T)[1], 1, atol=1e-2)


def test_optimal_currents_distinguish_two_bodies_best(bodies):
    first, second = bodies
    chosen = np.asarray(protocol.optimal(first, second, current=1e-3).drive)
    distinguishability = [np.linalg.norm((first - second) @ one) / np.linalg.norm(one) for one in chosen]
    largest = np.linalg.svd(first - second)[1]
    np.testing.assert_allclose(distinguishability[:5], largest[:5], rtol=1e-7)
    np.testing.assert_allclose(np.abs(chosen).max(axis=1), 1e-3)


def test_optimal_currents_at_fixed_power_distinguish_two_bodies_best(bodies):
    first, second = bodies
    chosen = np.asarray(protocol.optimal(first, second, power=1e-6).drive)
    np.testing.assert_allclose([one @ first @ one for one in chosen], 1e-6)
    best = np.linalg.norm((first - second) @ chosen[0])
    others = np.random.default_rng(0).normal(size=(2000, NUMBER))
    others[:500] = chosen[0] + 3e-4 * others[:500] * np.abs(chosen[0]).max()
    others -= others.mean(axis=1, keepdims=True)
    others *= np.sqrt(1e-6 / np.einsum("si,ij,sj->s", others, first, others))[:, None]
    distinguishability = np.linalg.norm(others @ (first - second), axis=1)
    assert distinguishability.max() < best
    assert distinguishability.max() > (1 - 1e-5) * best  # neighbouring currents are almost as good


def test_a_given_number_selects_the_first_currents(bodies):
    some, every = protocol.optimal(*bodies, number=3), protocol.optimal(*bodies)
    np.testing.assert_array_equal(some.drive, np.asarray(every.drive)[:3])
    assert some.num_measurements == 3 * NUMBER
    one = protocol.optimal(*bodies, number=1)
    np.testing.assert_allclose(one.drive, np.asarray(every.drive)[:1], rtol=1e-9)


def test_optimal_currents_are_as_many_as_the_bodies_differ_by_and_begin_with_a_positive_maximum(bodies):
    first = bodies[0]
    step = np.random.default_rng(3).normal(size=(NUMBER, 2))
    step -= step.mean(axis=0)
    for options in ({}, {"power": 1e-6}):
        drive = np.asarray(protocol.optimal(first, first + step @ step.T, **options).drive)
        assert len(drive) == 2
        np.testing.assert_array_equal(drive.max(axis=1), np.abs(drive).max(axis=1))
    # A measured impedance is only nearly symmetric.
    noisy = first + 0.01 * np.triu(first, 1)
    np.testing.assert_allclose(
        protocol.optimal(noisy).drive, protocol.optimal((noisy + noisy.T) / 2).drive, atol=1e-12 * 1e-3
    )


@pytest.mark.parametrize("measurement", ["adjacent", "mean", "mean-removed", "against"])
def test_measurements_of_potentials(measurement):
    potentials = np.random.default_rng(1).normal(size=7)
    rows = protocol.measurement_patterns(7, measurement)
    expected = {
        "adjacent": potentials - np.roll(potentials, -1),
        "mean": potentials - (potentials.sum() - potentials) / 6,
        "mean-removed": potentials - potentials.mean(),
        "against": (potentials - potentials[-1])[:-1],
    }
    np.testing.assert_allclose(rows @ potentials, expected[measurement], atol=1e-14)
    assert np.linalg.matrix_rank(rows) == 6


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda one, two: protocol.haar(1), "at least 2"),
        (lambda one, two: protocol.haar(8, measurement="men"), "did you mean|must be one of"),
        (lambda one, two: protocol.haar(8, reference=2), "reference has no use"),
        (lambda one, two: protocol.haar(8, measurement="against", reference=8), "0 to 7"),
        (lambda one, two: protocol.optimal(one, one), "equals transfer"),
        (lambda one, two: protocol.optimal(one, two[:5, :5]), r"\(5, 5\)"),
        (lambda one, two: protocol.optimal(one[:5]), r"\(5, 12\)"),
        (
            lambda one, two: protocol.optimal(one[None]),
            r"transfer has shape \(1, 12, 12\), of 1 frame; .* transfer\[0\]",
        ),
        (lambda one, two: protocol.optimal(one, np.stack([two, two])), r"other .* of 2 frames; .* other\[0\]"),
        (lambda one, two: protocol.optimal(one[:1, :1]), r"\(1, 1\)"),
        (lambda one, two: protocol.optimal(one * np.nan), "NaN"),
        (lambda one, two: protocol.optimal(np.triu(one)), "not symmetric"),
        (lambda one, two: protocol.optimal(one, power=1e-3), "power needs other"),
        (lambda one, two: protocol.optimal(-one, two, power=1e-3), "dissipate no power"),
        (lambda one, two: protocol.optimal(0 * one, two, power=1e-3), "dissipate no power"),
        (lambda one, two: protocol.optimal(one, two, power=-1.0), "positive number of watts"),
        (lambda one, two: protocol.optimal(one, two, power="1"), "positive number of watts; it is '1'"),
        (lambda one, two: protocol.optimal(one, two, power=True), "positive number of watts; it is True"),
        (lambda one, two: protocol.optimal(one, two, power=1e9), "above what"),
        (lambda one, two: protocol.optimal(one, two, number=0), "at least 1"),
    ],
)
def test_bad_input(bodies, wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong(*bodies)
