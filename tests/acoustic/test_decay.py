"""Decay models: their formulas, their logarithms, and their derivatives at the microphone itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.acoustic.decay import DECAY_MODELS, AttenuatedInverseSquare, Exponential, InverseSquare, find_decay

A, B, LENGTH = np.array([2e-3, 5e-4]), np.array([1e-3, 3e-4]), np.array([0.05, 0.02])
DISTANCE = np.array([[0.0, 0.01, 0.2], [0.0, 0.03, 0.1]])
FORMULAS = {
    "inverse-square": ((A, B), lambda r, a, b: a / (r**2 + b)),
    "exponential": ((A, LENGTH), lambda r, a, length: a * np.exp(-r / length)),
    "attenuated": ((A, B, LENGTH), lambda r, a, b, length: a * np.exp(-r / length) / (r**2 + b)),
}
every = pytest.mark.parametrize("name", FORMULAS)


def model(name):
    return DECAY_MODELS[name](*(np.asarray(values) for values in FORMULAS[name][0]))


@every
def test_formula(name):
    parameters, formula = FORMULAS[name]
    expected = formula(DISTANCE, *(values[:, None] for values in parameters))
    # The tip of exp(-r / l) is rounded off within a hundredth of a micrometre: 5e-7 of the length.
    np.testing.assert_allclose(np.exp(model(name).log_response(np.asarray(DISTANCE**2))), expected, rtol=1e-5)
    away = DISTANCE[:, 1:]
    expected = formula(away, *(values[:, None] for values in parameters))
    np.testing.assert_allclose(np.exp(model(name).log_response(np.asarray(away**2))), expected, rtol=1e-9)


@every
def test_response_is_the_exponential_of_its_logarithm(name):
    squared = np.asarray(DISTANCE**2)
    np.testing.assert_allclose(model(name).response(squared), np.exp(model(name).log_response(squared)), rtol=1e-13)


@every
def test_gain_is_the_response_at_the_microphone(name):
    parameters, formula = FORMULAS[name]
    np.testing.assert_allclose(model(name).gain, formula(0.0, *parameters), rtol=1e-14)


@every
def test_logarithms_and_back(name):
    one = model(name)
    np.testing.assert_allclose(one.logarithms(), np.log(FORMULAS[name][0]), rtol=1e-14)
    again = DECAY_MODELS[name].from_logarithms(one.logarithms())
    for key, values in zip(one.parameters, FORMULAS[name][0], strict=True):
        np.testing.assert_allclose(getattr(again, key), values, rtol=1e-14)


@every
def test_the_first_parameter_is_a_factor(name):
    factor = np.eye(len(FORMULAS[name][0]))[:, :1] * np.log(3.0)
    shifted = DECAY_MODELS[name].from_logarithms(model(name).logarithms() + factor)
    squared = np.asarray(DISTANCE**2)
    difference = shifted.log_response(squared) - model(name).log_response(squared)
    np.testing.assert_allclose(difference, np.log(3.0), rtol=1e-12)


@every
def test_any_axes_after_the_microphones(name):
    squared = np.asarray(np.random.default_rng(0).random((2, 3, 4)) * 0.01)
    all_at_once = model(name).log_response(squared)
    for k in range(3):
        np.testing.assert_allclose(all_at_once[:, k], model(name).log_response(squared[:, k]), rtol=1e-14)
    np.testing.assert_allclose(all_at_once[:, 1, 2], model(name).log_response(squared[:, 1, 2]), rtol=1e-14)


@every
def test_slopes(name):
    """Derivatives in the parameters against differences, and in the place, which are finite at the microphone too."""
    values, squared = model(name).logarithms(), np.asarray(DISTANCE**2)
    direction = np.asarray(np.random.default_rng(1).normal(size=values.shape))

    def response(logarithms):
        return DECAY_MODELS[name].from_logarithms(logarithms).log_response(squared)

    def slope_of(values):
        return jax.jvp(response, (values,), (direction,))[1]

    def at(x):
        return model(name).log_response(jnp.full(2, x**2))[0]

    slope, (first, second, away) = jax.jit(
        lambda values: (slope_of(values), (jax.grad(at)(0.0), jax.hessian(at)(0.0), jax.grad(at)(0.03)))
    )(values)
    step = 1e-5
    difference = (response(values + step * direction) - response(values - step * direction)) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-7, atol=1e-9)

    assert float(first) == 0.0
    assert np.isfinite(second)
    ahead, behind = (model(name).log_response(np.full(2, (0.03 + by) ** 2))[0] for by in (step, -step))
    assert float(away) == pytest.approx((ahead - behind) / (2 * step), rel=1e-7)


@every
def test_the_start_reaches_one_spacing(name):
    """The gain is 1 at the microphone for the exponential and inverse square, and smaller but not zero one spacing
    away.
    """
    start = DECAY_MODELS[name].start(0.04, 5)
    response = np.exp(start.log_response(np.asarray(np.full((5, 2), [0.0, 0.04**2]))))
    np.testing.assert_allclose(response[:, 0], 1, rtol=1e-5)
    assert ((response[:, 1] > 0.2) & (response[:, 1] < 0.7)).all()


@every
def test_bounds_contain_the_start(name):
    low, high = (np.array(bound) for bound in DECAY_MODELS[name].bounds(0.2))
    start = np.asarray(DECAY_MODELS[name].start(0.04, 1).logarithms())[:, 0]
    assert ((low < start) & (start < high)).all()
    assert len(low) == len(high) == len(DECAY_MODELS[name].parameters)
    # The factor is free. The other parameters are bounded on both sides.
    assert np.isinf(low[0])
    assert np.isinf(high[0])
    assert np.isfinite([*low[1:], *high[1:]]).all()


def test_attenuated_tends_to_inverse_square():
    far = AttenuatedInverseSquare(A, B, np.full(2, 1e9))
    squared = np.asarray(DISTANCE**2)
    np.testing.assert_allclose(far.log_response(squared), model("inverse-square").log_response(squared), rtol=1e-9)


def test_find_decay():
    assert find_decay("inverse-square") is InverseSquare
    assert find_decay("exponential") is Exponential
    assert find_decay(AttenuatedInverseSquare) is AttenuatedInverseSquare
    for wrong in ("linear", None, int, ""):
        with pytest.raises(ValueError, match=r"inverse-square, exponential, attenuated"):
            find_decay(wrong)
