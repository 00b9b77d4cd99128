"""Calibration: what was put in comes out; a frame it cannot explain says so."""

import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, PointElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import calibrate
from jeit.layout import ring
from jeit.mesh import disk
from jeit.protocol import skip

MESH = disk(0.1, num_points=300)
PROTOCOL = skip(8, 1, current=1e-3)


@pytest.fixture(scope="module")
def model():
    return ForwardModel(MESH, BoundaryElectrodes(ring(0.1, 8), 0.02, 1e-3), PROTOCOL)


def test_recovers_conductivity_and_common_impedance(model):
    truth = model.with_electrodes(model.electrodes.with_contact_impedance(8e-3))
    result = calibrate(model, truth.voltages(0.27))
    assert result.status == "converged"
    assert float(result.conductivity) == pytest.approx(0.27, rel=1e-6)
    np.testing.assert_allclose(result.model.electrodes.contact_impedance, 8e-3, rtol=1e-4)
    assert float(result.misfit) < 1e-6


def test_masked_channels_do_not_count(model):
    voltages = np.array(model.voltages(0.5))
    mask = np.ones(len(voltages), bool)
    mask[::7] = False
    voltages[~mask] = np.nan
    result = calibrate(model, voltages, mask=mask)
    assert float(result.conductivity) == pytest.approx(0.5, rel=1e-6)


def test_point_electrodes_have_only_a_conductivity_to_fit():
    model = ForwardModel(MESH, PointElectrodes(0.99 * ring(0.1, 8)), PROTOCOL)
    result = calibrate(model, model.voltages(2.0) * 1.0)
    assert float(result.conductivity) == pytest.approx(2.0, rel=1e-8)


def test_noise_ends_up_in_the_misfit(model):
    voltages = model.voltages(0.5)
    noise = np.random.default_rng(0).normal(size=voltages.shape)
    noise *= 0.02 * float(jnp.linalg.norm(voltages)) / np.linalg.norm(noise)
    result = calibrate(model, voltages + noise)
    assert float(result.misfit) == pytest.approx(0.02, rel=0.1)
    assert result.note == ""
    spoilt = calibrate(model, voltages + 12 * noise)
    assert "misses 2" in spoilt.note
    assert "width of the electrodes" in spoilt.note
