"""Conductivities, contact impedances and sizes of any order of magnitude, compared with exact arithmetic."""

from contextlib import nullcontext
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exact_arithmetic import exact, exact_change
from extremes import CONTACTS, KINDS, compiled, middles, miss, uneven, with_contacts

from jeit.design.skin.touched_cells import TouchedCells
from jeit.design.skin.voltage_changes import RestingSkin, touch_changes
from jeit.forward import ForwardModel
from jeit.forward.transfer import _refinement_correction
from jeit.inverse import calibrate, one_step
from jeit_solvers.engines import on_device, on_host

UNITS = {"micrometres": 1e-5, "a power of two": 2.0**-17, "kilometres": 1e4}


class Case(NamedTuple):
    """A kind of electrode, and whether compiled code is tested beside NumPy, which takes seconds to compile."""

    kind: str
    compiled: bool = True


QUICK = (Case("boundary"), Case("face", compiled=False))
SLOW = [Case(kind) for kind in KINDS if kind != "boundary"]


@pytest.fixture(
    params=[*QUICK, *(pytest.param(case, marks=pytest.mark.slow) for case in SLOW)],
    ids=lambda case: case.kind if case.compiled else f"{case.kind} in NumPy",
    scope="module",
)
def case(request):
    return request.param


@pytest.fixture(scope="module")
def model(case):
    return KINDS[case.kind](1.0)


@pytest.fixture(scope="module")
def worst(case):
    """Errors of the voltages and Jacobians of both engines and of Z, each relative to the largest value."""

    def of(model, conductivity):
        expected = exact(model, conductivity)
        voltages, jacobian = model.voltages(conductivity), model.jacobian(conductivity)
        misses = [miss(voltages, expected.voltages), miss(jacobian, expected.jacobian)]
        misses.append(miss(model.transfer_impedance(conductivity), expected.impedance))
        if case.compiled:
            voltages, *jacobians = compiled(model, conductivity)
            misses.append(miss(voltages, expected.voltages))
            misses.extend(miss(jacobian, expected.jacobian) for jacobian in jacobians)
        return max(misses)

    return of


@pytest.mark.parametrize("contacts", CONTACTS)
def test_contacts_of_any_impedance(model, worst, contacts):
    """Almost short-circuited, almost open, or some of each."""
    if model.electrodes.is_point:
        return
    assert worst(with_contacts(model, CONTACTS[contacts]), uneven(model)) < 1e-10


@pytest.mark.parametrize(("contacts", "most"), [("tight", 1e-4), ("good", 1e-7), ("open", 1e-8), ("unlike", 1e-4)])
def test_conjugate_gradients_with_contacts_of_any_impedance(case, model, contacts, most):
    """Their stopping rule is the residual. Where the load enters by entries a billion times the others, the residual
    must weight all equations."""
    if case.kind != "boundary":
        return
    model = with_contacts(model, CONTACTS[contacts])
    iterative = ForwardModel(model.mesh, model.electrodes, model.protocol, solver="cg")
    assert miss(iterative.voltages(uneven(model)), exact(model, uneven(model)).voltages) < most


def test_the_refinement_of_the_terminals_squares_their_error():
    """Of an impedance that is wrong by one part in ten thousand, one part in a hundred million remains."""
    draw = np.random.default_rng(0)
    others, wrong = draw.uniform(1, 2, (5, 5)), draw.normal(size=(5, 5))
    others = (others + others.T) * (1 - np.eye(5))
    kept = np.diag([1.0, 1.0, 1.0, 1.0, 0.0])
    right = np.zeros((5, 5))
    right[:4, :4] = np.linalg.inv((np.diag(others.sum(axis=0)) - others)[:4, :4])
    found = right + 1e-4 * np.abs(right).max() * kept @ (wrong + wrong.T) @ kept
    expected = right - found
    assert miss(_refinement_correction(others, found, kept), expected) < 1e-2
    in_jax = jax.jit(_refinement_correction)(others, found, kept)
    np.testing.assert_allclose(in_jax, _refinement_correction(others, found, kept), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("level", [1e-12, 1e12])
def test_conductivities_of_any_level(model, worst, level):
    """With constant contact impedances, which are then negligible or dominant."""
    assert worst(model, level * uneven(model)) < 1e-10


@pytest.mark.parametrize("contrast", [1e-6, 1e6])
def test_inclusions_of_any_contrast(model, worst, contrast):
    inside = np.linalg.norm(middles(model) - [0.02, 0.03], axis=1) < 0.035
    assert worst(model, np.where(inside, contrast, 1.0) * uneven(model)) < 1e-7
    assert worst(model, np.where(inside, 1.0, contrast) * uneven(model)) < 1e-7


def test_neighbouring_cells_of_any_contrast(model, worst):
    draw = np.random.default_rng(1)
    for conductivity in (
        10 ** draw.uniform(-3, 3, model.mesh.num_cells),
        10.0 ** draw.choice([-3, 3], model.mesh.num_cells),
    ):
        assert worst(model, conductivity) < 1e-8


@pytest.mark.parametrize("unit", UNITS)
def test_the_unit_of_length_does_not_matter(case, model, unit):
    """Voltages of a scaled body with scaled σ and z: equal in a sheet, inversely proportional to the length in a
    solid."""
    large = pytest.warns(UserWarning, match="m is large") if UNITS[unit] > 1 else nullcontext()
    with large:
        other = KINDS[case.kind](UNITS[unit])
    ratio = UNITS[unit] ** (model.mesh.dimension - 2)
    conductivity = uneven(model)
    for one, another in zip(
        model.voltages_and_jacobian(conductivity), other.voltages_and_jacobian(conductivity), strict=True
    ):
        assert miss(ratio * np.asarray(another), one) < 1e-12


def test_images_and_calibrations_scale_with_the_units():
    small = KINDS["boundary"](1.0)
    expected, fit = _image_and_fit(small, 1.0)
    for unit, level in ((1e-5, 1e-12), (2.0**-17, 1e12), (1e-5, 1.0)):
        model = with_contacts(KINDS["boundary"](unit), 1 / level)
        image, conductivity = _image_and_fit(model, level)
        assert miss(image, expected) < 1e-11
        assert conductivity == pytest.approx(fit, rel=1e-11)


def _image_and_fit(model, level):
    inside = np.linalg.norm(middles(model) / np.ptp(model.mesh.points[:, 0]) - [0.1, 0.15], axis=1) < 0.15
    before, after = (np.asarray(model.voltages(level * (1.0 + k * inside))) for k in (0.0, 0.5))
    return np.asarray(one_step(model, level).image(after - before)) / level, float(
        calibrate(model, before).conductivity
    ) / level


@pytest.fixture(scope="module", params=["boundary", pytest.param("face", marks=pytest.mark.slow)])
def touches(request):
    """A model and its touches."""
    model = KINDS[request.param](1.0)
    places = np.array([[0.0, 0.01], [-0.02, -0.01], [0.03, 0.02]])
    cells = np.array([np.argsort(np.linalg.norm(middles(model) - place, axis=1))[:6] for place in places])
    change = np.array([[-0.5] * 6, [-0.9, -0.2, -0.1, 0.0, 0.0, -0.3], [3.0, 1.0, 2.0, -0.99, 0.0, -0.7]])
    return model, on_device(TouchedCells(places, cells, change, model.mesh.num_cells))


def changes_of(model, touched):
    """Changes of the voltages by every touch."""
    expected, conductivity = [], uneven(model)
    for some, by in zip(np.asarray(touched.cells), np.asarray(touched.change), strict=True):
        factor = np.ones(model.mesh.num_cells)
        factor[some] += by
        expected.append(exact_change(model, conductivity, conductivity * factor))
    return expected


@pytest.mark.parametrize("contacts", ["tight", "open", "unlike"])
def test_touches_are_exact_for_any_contacts(touches, contacts):
    model, touched = with_contacts(touches[0], CONTACTS[contacts]), touches[1]
    found = np.asarray(touch_changes(model, uneven(model), touched))
    assert max(map(miss, found, changes_of(model, touched))) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("contacts", ["tight", "open", "unlike"])
def test_touches_of_a_known_skin_are_exact_for_any_contacts(touches, contacts):
    """With a model in NumPy, of which JAX would compile every operation."""
    model, touched = on_host(with_contacts(touches[0], CONTACTS[contacts])), touches[1]
    known = RestingSkin.create(model, uneven(model), np.ones(model.mesh.num_points, bool))
    assert known is not None
    assert max(map(miss, known.changes(touched), changes_of(model, touched))) < 1e-8


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_numbers_are_refused_or_give_nan(case, model, bad):
    """Known values are refused; in compiled code every voltage is NaN."""
    conductivity = uneven(model)
    conductivity[3] = bad
    with pytest.raises(ValueError, match="NaN or infinite"):
        model.voltages(conductivity)
    if case.compiled:
        assert all(np.isnan(found).all() for found in compiled(model, jnp.asarray(conductivity)))


def test_a_negative_conductivity_gives_nan_in_compiled_code(case, model):
    assert not case.compiled or np.isnan(compiled(model, jnp.asarray(-uneven(model)))[0]).all()
