"""Independent channels: they determine all channels, their number is known, and least squares on them are
equivalent."""

import numpy as np
import pytest

from jeit.inverse.channels import IndependentChannels
from jeit.protocol import adjacent, opposite, reference_electrode, two_terminal

PROTOCOLS = {
    "adjacent": (adjacent(16), 104),
    "with driven electrodes": (adjacent(8, driven_electrodes=True), 28),
    "opposite": (opposite(8), None),
    "against a centre": (reference_electrode(17, reference=16), None),
    "two-terminal": (two_terminal(8), 28),
}


def _chosen(*quick):
    """All protocols, of which the quick tests use these."""
    return [pytest.param(name, marks=() if name in quick else pytest.mark.slow) for name in PROTOCOLS]


def voltages_of_a_body(protocol, key=0):
    """Voltages of a random symmetric transfer impedance whose rows sum to zero, which is the general case."""
    root = np.random.default_rng(key).normal(size=(protocol.num_electrodes, protocol.num_electrodes))
    root = root - root.mean(axis=0)
    impedance = root.T @ root
    impedance = impedance - impedance.mean(axis=0) - impedance.mean(axis=1)[:, None] + impedance.mean()
    drive, measurement = np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement)
    return np.sum(measurement @ impedance * drive, axis=1)


@pytest.mark.parametrize("name", _chosen("with driven electrodes", "against a centre", "two-terminal"))
def test_all_channels_from_the_independent_ones(name):
    protocol, number = PROTOCOLS[name]
    channels = IndependentChannels.create(protocol)
    voltages = voltages_of_a_body(protocol)
    np.testing.assert_allclose(channels.combination @ voltages[channels.index], voltages, rtol=1e-9, atol=1e-12)
    rank = np.linalg.matrix_rank(np.stack([voltages_of_a_body(protocol, k) for k in range(200)]), rtol=1e-9)
    assert len(channels.index) == rank
    assert number is None or rank == number


@pytest.mark.parametrize("name", _chosen("adjacent", "with driven electrodes"))
def test_least_squares_on_them_equal_those_on_all_channels(name):
    """½‖(Tu - y)/noise‖² = ½(u - ŷ)ᵀG(u - ŷ) + rest/2 at any u."""
    protocol, _ = PROTOCOLS[name]
    channels = IndependentChannels.create(protocol)
    rng = np.random.default_rng(2)
    noise = rng.uniform(0.1, 1.1, protocol.num_measurements)
    measured = voltages_of_a_body(protocol) + noise * rng.normal(size=noise.shape)
    data = channels.weigh(noise).combine(measured)
    trial = voltages_of_a_body(protocol, 5)
    away = data.weight * (trial[channels.index] - data.voltages)
    expected = np.sum(((trial - measured) / noise) ** 2)
    np.testing.assert_allclose(away @ data.precision @ away + data.rest, expected, rtol=1e-9)
    np.testing.assert_allclose(np.sum(np.asarray(data.whiten(away)) ** 2) + data.rest, expected, rtol=1e-9)
    np.testing.assert_allclose(data.covariance @ data.precision, np.eye(len(away)), atol=1e-7)


def test_reciprocal_channels_are_uncorrelated():
    channels = IndependentChannels.create(adjacent(16))
    precision = channels.weigh(np.ones(208)).precision
    np.testing.assert_allclose(precision, np.eye(104), atol=1e-12)
