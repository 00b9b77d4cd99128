"""Calibration: known parameters are recovered, and a frame that cannot be explained gives a note."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, PointElectrodes
from jeit.forward import ForwardModel, changes
from jeit.forward.changes import ContactSensitivity
from jeit.inverse import calibrate
from jeit.layout import ring
from jeit.mesh import cylinder, disk
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


def test_noise_appears_in_the_misfit(model):
    voltages = model.voltages(0.5)
    noise = np.random.default_rng(0).normal(size=voltages.shape)
    noise *= 0.02 * float(jnp.linalg.norm(voltages)) / np.linalg.norm(noise)
    result = calibrate(model, voltages + noise)
    assert float(result.misfit) == pytest.approx(0.02, rel=0.1)
    assert result.note == ""
    noisy = calibrate(model, voltages + 12 * noise)
    assert "misses 2" in noisy.note
    assert "width of the electrodes" in noisy.note


def test_note_on_the_misfit_depends_on_the_body(model):
    places = ring(0.1, 8, height=0.02)
    solid = ForwardModel(cylinder(0.1, 0.05, num_points=300), PointElectrodes(places), PROTOCOL)
    notes = []
    for one in (model, solid):
        found = calibrate(one, one.voltages(1.0), contact="fixed")
        notes.append(eqx.tree_at(lambda found: found.misfit, found, jnp.asarray(0.2)).note)
    sheet, solid = notes
    assert "misses 20 % of the reference: radius, width of the electrodes, protocol" in sheet
    assert "deeper than a sheet" in sheet
    assert "misses 20 % of the reference: size of the body, how high it is filled, places and sizes of" in solid
    assert "sheet" not in solid
    moved = eqx.tree_at(
        lambda found: found.shift, found, jnp.array([[0.003], [0.004]]), is_leaf=lambda one: one is None
    )
    assert "up to 4 mm from where they are described (root mean square 3.5 mm)" in moved.note


def test_every_impedance_is_recovered_separately(model):
    """Sensitivities to contact impedances are exact derivatives; otherwise the fit would not converge here."""
    impedance = np.geomspace(5e-4, 2e-2, 8)
    truth = model.with_electrodes(model.electrodes.with_contact_impedance(impedance))
    result = calibrate(truth, truth.voltages(0.3), contact="each")
    start = calibrate(model, truth.voltages(0.3), contact="each")
    for one in (result, start):
        assert one.status == "converged"
        np.testing.assert_allclose(one.model.electrodes.contact_impedance, impedance, rtol=1e-3)
        assert one.distinguishes_contacts


def test_contact_sensitivity_against_differences(model):
    check_contact_sensitivity(model)


def test_contact_sensitivity_of_electrodes_that_share_facets(monkeypatch):
    """Electrodes around the disk share a facet with a neighbour, so that the integrals of groups without neighbours are
    needed, but not of each electrode."""
    contact, computed = changes._select_contact, []
    monkeypatch.setattr(changes, "_select_contact", lambda *given: computed.append(given[2].sum()) or contact(*given))
    check_contact_sensitivity(ForwardModel(MESH, BoundaryElectrodes(ring(0.1, 8), 0.075, 1e-3), PROTOCOL))
    assert computed[0] == sum(computed[1:]) == 8
    assert len(computed) <= 4


def check_contact_sensitivity(model):
    fields, impedance = map(np.asarray, model.fields(0.4))
    sensitivity = ContactSensitivity(model.mesh, model.electrodes)
    z = np.asarray(model.electrodes.contact_impedance)
    found = sensitivity(fields, impedance, z)
    for electrode in (0, 5):
        step = 1e-4 * (np.arange(8) == electrode)
        ends = [
            np.asarray(model.with_electrodes(model.electrodes.with_contact_impedance(z * np.exp(s))).fields(0.4)[1])
            for s in (step, -step)
        ]
        expected = (ends[0] - ends[1]) / 2e-4
        np.testing.assert_allclose(found[electrode], expected, rtol=0, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: {"voltages": v, "max_steps": 2.5}, "max_steps must be a whole number"),
        (lambda v: {"voltages": v, "max_steps": 0}, "max_steps must be a whole number"),
        (lambda v: {"voltages": 1e150 * v}, "are they in volts"),
        (lambda v: {"voltages": 1e-150 * v}, "are they in volts"),
        (lambda v: {"voltages": v.astype(str)}, "give numbers, in volts"),
    ],
    ids=["half a step", "no step", "huge", "tiny", "text"],
)
def test_invalid_arguments(model, change, message):
    with pytest.raises(ValueError, match=message):
        calibrate(model, **change(np.array(model.voltages(1.0))))


def test_impedances_without_information_are_not_separated(model):
    """Without channels on driven electrodes, contact impedances would be determined by noise alone."""
    protocol = skip(8, 1, current=1e-3)
    blind = ForwardModel(MESH, model.electrodes, protocol.subset(~protocol.channels_on_driven_electrodes()))
    voltages = np.array(blind.voltages(0.3))
    voltages *= 1 + 0.02 * np.random.default_rng(1).normal(size=voltages.size)
    assert not calibrate(blind, voltages, contact="each").distinguishes_contacts
    assert calibrate(blind, voltages, contact="fixed").distinguishes_contacts
