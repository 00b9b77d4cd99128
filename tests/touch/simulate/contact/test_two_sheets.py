"""Two coupled sheets: both limits, a series for uniform coupling, and the accuracy of the saturation formula."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ive

from jeit.electrodes import BoundaryElectrodes, PointElectrodes
from jeit.forward import ForwardModel
from jeit.forward.exact import ConductingDisk, arc_transfer_impedance
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent
from jeit.touch.simulate.contact import TwoSheets

RADIUS, LOWER, UPPER = 0.05, 2e-5, 3e-5
ANGLES = 2 * np.pi * np.arange(16) / 16
RIM = RADIUS * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
PROTOCOL = adjacent(16)
ELECTRODES = BoundaryElectrodes(RIM, 0.008, 300.0)


def sheets(number: int) -> TwoSheets:
    return TwoSheets(ForwardModel(Disk(RADIUS).mesh(num_points=number), ELECTRODES, PROTOCOL))


@pytest.fixture(scope="module")
def pair():
    return sheets(600)


def test_separate_sheets_are_the_lower_one_and_coupled_ones_the_sum(pair):
    apart = pair.voltages(LOWER, UPPER, 0.0)
    np.testing.assert_allclose(apart, pair.model.voltages(LOWER), rtol=1e-6, atol=1e-8 * np.abs(apart).max())
    together = pair.voltages(LOWER, LOWER, 1e9 * LOWER / RADIUS**2)
    double = np.asarray(pair.model.voltages(2 * LOWER))
    np.testing.assert_allclose(together, double, rtol=1e-6, atol=1e-6 * np.abs(double).max())


def test_conductivity_of_both_may_vary(pair):
    """Cells of both sheets with twice the conductivity equal halving both."""
    random = np.random.default_rng(0)
    lower, upper = np.exp(random.normal(size=(2, pair.model.mesh.num_cells))) * LOWER
    conductance = random.uniform(0, 1e3 * LOWER / RADIUS**2, len(lower))
    together = pair.voltages(lower, upper, 1e12 * LOWER / RADIUS**2)
    exact = np.asarray(pair.model.voltages(lower + upper))
    np.testing.assert_allclose(together, exact, rtol=1e-5, atol=1e-5 * np.abs(exact).max())
    between = pair.voltages(lower, upper, conductance)
    assert np.abs(exact).sum() < np.abs(between).sum() < np.abs(pair.model.voltages(lower)).sum()


def points(pair: TwoSheets) -> ForwardModel:
    return ForwardModel(pair.model.mesh, PointElectrodes(RIM), PROTOCOL)


@dataclass(frozen=True)
class CoupledDisk(ConductingDisk):
    """Two round sheets evenly coupled, the lower one fed through its rim.

    With S = (σ₁u + σ₂w)/(σ₁ + σ₂), harmonic, and d = u − w, Δd = κ²d, κ² = g (1/σ₁ + 1/σ₂), all current entering the
    lower: (σ₁ + σ₂) ∂S/∂r = σ₁ ∂d/∂r = j, and u = S + σ₂ d/(σ₁ + σ₂). With x = κa the kernel of the rim is that of
    σ₁ alone with mode k times λ_k = (σ₁ + σ₂ k I_k(x)/(x I_k'(x))) / (σ₁ + σ₂).
    """

    conductance: float = 0.0

    def inclusion_kernel(self, angle):
        x = self.radius * np.sqrt(self.conductance * (1 / LOWER + 1 / UPPER))
        modes = np.arange(1, 600)  # terms fall as one over the cube
        slope = x * ive(modes + 1, x) / np.maximum(ive(modes, x), 1e-300) + modes  # x I_k'(x) / I_k(x)
        less = UPPER / (LOWER + UPPER) * (modes / slope - 1)
        series = np.polynomial.chebyshev.chebval(np.cos(angle), np.concatenate([[0.0], less / modes]))
        return series / (np.pi * self.conductivity)


@pytest.mark.parametrize("strength", [3.0, pytest.param(100.0, marks=pytest.mark.slow)])
def test_evenly_coupled_disks(strength):
    """`strength`: g a² / σ₁."""
    conductance = strength * LOWER / RADIUS**2
    exact = CoupledDisk(RADIUS, LOWER, conductance=conductance)
    impedance = arc_transfer_impedance(exact, ANGLES, np.full(16, 0.008), np.full(16, 300.0), order=24)
    table = np.asarray(PROTOCOL.measurement) @ impedance @ np.asarray(PROTOCOL.drive).T
    exact = table[np.asarray(PROTOCOL.measurement_index), np.asarray(PROTOCOL.drive_index)]
    errors = []
    for number in (400, 1600):
        found = sheets(number).voltages(LOWER, UPPER, conductance)
        errors.append(np.linalg.norm(found - exact) / np.linalg.norm(exact))
    assert errors[1] < 0.01
    assert np.log2(errors[0] / errors[1]) > 1.2


@pytest.mark.parametrize(("whole", "most", "near"), [(False, 1.0, 0.06), (True, 2.0, 0.08)], ids=["cut", "whole"])
def test_a_touch_saturates_and_the_saturation_formula_is_close(whole, most, near):
    """A disc pressed harder and harder, with g proportional to pressure.

    The change of voltages grows and saturates: with an upper sheet cut to the contact, at that of a doubled
    conductivity, with a whole one, at that of a tripled one, except for the contribution of the sheet's edge. c p / (p
    + p½), with p½ fitted at one load, differs by no more than `near`, a fraction of the largest change.
    """
    pair = sheets(1000)
    middles = np.asarray(centroids(pair.model.mesh))
    under = np.linalg.norm(middles - (0.015, 0.0), axis=1) < 0.01
    rest = np.asarray(pair.model.voltages(LOWER))
    upper = np.where(under | whole, LOWER, 1e-6 * LOWER)
    pressure = np.geomspace(1, 1e6, 13)
    changes = np.array([pair.voltages(LOWER, upper, 1e-3 * p * under) - rest for p in pressure])
    change = np.linalg.norm(changes, axis=1)

    def short(load, half):
        return np.linalg.norm(np.asarray(pair.model.voltages(LOWER * (1 + most * load / (load + half) * under))) - rest)

    limit = short(1.0, 0.0)
    assert (np.diff(change) > 0).all()
    assert change[-1] == pytest.approx(limit, rel=0.06 if whole else 0.01)
    middle = int(np.argmin(np.abs(change - limit / 2)))
    half = np.exp(brentq(lambda log: short(pressure[middle], np.exp(log)) - change[middle], 0, 14, xtol=0.01))
    off = np.array([short(p, half) for p in pressure]) - change
    assert np.abs(off).max() < near * limit


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda pair: TwoSheets(ForwardModel(pair.model.mesh, PointElectrodes(RIM), PROTOCOL)),
            "model must be of a sheet",
        ),
        (lambda pair: TwoSheets(pair), "model must be a ForwardModel"),
        (lambda pair: pair.voltages(LOWER, UPPER, -1.0), "conductance must be zero or more"),
        (lambda pair: pair.voltages(LOWER, UPPER, np.ones(3)), r"it has shape \(3,\)"),
        (lambda pair: pair.voltages(LOWER, 0.0, 1.0), "conductivity must be positive"),
    ],
)
def test_impossible_sheets_are_refused(pair, call, message):
    with pytest.raises(ValueError, match=message):
        call(pair)
