"""The likelihood against NumPy formulas, its gradient against JAX's, its matrix against the covariance of scores."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from microphone_arrays import array as device_array
from microphone_arrays import inside, listen, noisy, received_power, variance

from jeit.acoustic.localisation.likelihood import Likelihood
from jeit_solvers.engines import on_device, on_host

FRAMES = 12


def array(*arguments, **noise):
    """Computed in NumPy, without compilation."""
    return on_host(device_array(*arguments, **noise))


@pytest.fixture(scope="module")
def microphone_array():
    return array(9, relative=0.1, floor=0.05, freedom=30.0)


@pytest.fixture(scope="module")
def frames(microphone_array):
    places = inside(FRAMES)
    strength = np.exp(np.linspace(-2, 3, FRAMES))
    power = noisy(microphone_array.noise, received_power(microphone_array, places, strength), np.random.default_rng(0))
    use = np.ones(power.shape, bool)
    use[3, [1, 4]] = use[5, 7] = False
    power[3, 1], power[5, 7] = np.inf, np.nan
    return power, use


def likelihood(microphone_array, frames):
    return Likelihood.create(np.asarray(frames[0].T), np.asarray(frames[1].T), microphone_array)


def unknowns(number, seed=1):
    places, rng = inside(number, seed=seed), np.random.default_rng(seed)
    return np.concatenate([places.T, rng.normal(size=(1, number))])


def terms_of(microphone_array, power, use, x):
    """(y − m)² / v and log v for sources x = (u, s, u', s', …), one frame, of the microphones used, in NumPy."""
    a, b, noise = microphone_array.decay.a, microphone_array.decay.b, microphone_array.noise
    received = sum(
        listen(microphone_array.microphones, a, b, [x[k : k + 2]], np.exp(x[k + 2]))[0] for k in range(0, len(x), 3)
    )
    floor = np.asarray(noise.floor)
    deviation2 = np.asarray(variance(noise, received)) / (received + floor) ** 2
    with np.errstate(invalid="ignore"):
        off = np.log(power + floor) - np.log(received + floor)
    return (off**2 / deviation2)[use], np.log(deviation2)[use]


@pytest.mark.parametrize("sources", [1, 2])
def test_cost_is_the_formula(sources, microphone_array, frames):
    """Σ ½ (y − m)² / v + ½ log v. The misfit is twice its first part."""
    x = np.concatenate([unknowns(FRAMES, seed=k) for k in range(sources)])
    cost, misfit = (
        f(np.asarray(x))
        for f in (likelihood(microphone_array, frames).cost, likelihood(microphone_array, frames).misfit)
    )
    for frame in range(FRAMES):
        squares, logarithms = terms_of(microphone_array, frames[0][frame], frames[1][frame], x[:, frame])
        assert float(cost[frame]) == pytest.approx(0.5 * (squares + logarithms).sum(), rel=1e-11)
        assert float(misfit[frame]) == pytest.approx(squares.sum(), rel=1e-11)


def test_a_level_far_below_the_floor_is_finite(microphone_array):
    """Power that is minus the floor has no logarithm: the level is limited to a twentieth of the floor."""
    power = np.full((1, 9), -0.06)
    one = Likelihood.create(np.asarray(power.T), np.ones((9, 1), bool), microphone_array)
    np.testing.assert_allclose(one.level[:, 0], np.log(0.05 * np.asarray(microphone_array.noise.floor)), rtol=1e-12)


@pytest.mark.parametrize("sources", [1, 2])
def test_gradient(sources, microphone_array, frames):
    one = likelihood(microphone_array, frames)
    x = np.asarray(np.concatenate([unknowns(FRAMES, seed=k) for k in range(sources)]))
    value, gradient, matrix = one.expand(x)
    np.testing.assert_allclose(value, one.cost(x), rtol=1e-12)
    expected = np.asarray(jax.jit(jax.grad(lambda y: jnp.sum(on_device(one).cost(y))))(x))
    np.testing.assert_allclose(gradient, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(matrix, np.swapaxes(matrix, 0, 1), rtol=1e-12)
    assert (np.linalg.eigvalsh(np.moveaxis(np.asarray(matrix), -1, 0)) > 0).all()


def test_matrix_is_the_covariance_of_scores(microphone_array):
    """Fisher's matrix: E[∇cost ∇costᵀ] over draws at the truth, where the mean of ∇cost is zero. 20,000 draws determine
    it to 2 %.
    """
    number = 20_000
    place, strength = np.array([0.02, -0.03]), 0.3
    power = noisy(
        microphone_array.noise,
        np.repeat(received_power(microphone_array, [place], strength), number, axis=0),
        np.random.default_rng(2),
    )
    truth = np.asarray(np.repeat([[*place, np.log(strength)]], number, axis=0).T)
    one = Likelihood.create(np.asarray(power.T), np.ones((9, number), bool), microphone_array)
    _, gradient, matrix = one.expand(truth)
    score, fisher = np.asarray(gradient), np.asarray(matrix)[:, :, 0]
    scale = np.sqrt(np.diag(fisher))
    spread = score @ score.T / number
    np.testing.assert_allclose(spread / np.outer(scale, scale), fisher / np.outer(scale, scale), atol=0.05)
    # The level is limited where power is below minus the floor: in few draws, which shifts the mean slightly.
    assert (np.abs(score.mean(axis=1)) < 0.03 * scale).all()


@pytest.mark.slow
def test_matrix_is_the_expected_hessian(microphone_array):
    """E[∇²cost] over draws, by JAX's Hessian of the cost, at the truth."""
    number = 2000
    place, strength = np.array([-0.05, 0.04]), 3.0
    power = noisy(
        microphone_array.noise,
        np.repeat(received_power(microphone_array, [place], strength), number, axis=0),
        np.random.default_rng(3),
    )
    one = Likelihood.create(np.asarray(power.T), np.ones((9, number), bool), microphone_array)
    truth = np.asarray([*place, np.log(strength)])
    hessian = jax.jit(jax.hessian(lambda x: jnp.mean(on_device(one).cost(x[:, None] * jnp.ones(number)))))(truth)
    fisher = one.expand(truth[:, None] * np.ones(number))[2][:, :, 0]
    scale = np.sqrt(np.diag(fisher))
    np.testing.assert_allclose(hessian / np.outer(scale, scale), fisher / np.outer(scale, scale), atol=0.05)


def test_strength_at_a_known_place(microphone_array):
    """From exact data the strength itself is found in any unit, and no other strength has a lower cost."""
    exact = array(9)
    places, strength = inside(5), np.array([1e-12, 0.1, 1.0, 10.0, 1e12])
    one = Likelihood.create(np.asarray(received_power(exact, places, strength).T), np.ones((9, 5), bool), exact)
    start = one.start(np.asarray(places.T))
    np.testing.assert_allclose(start[2], np.log(strength), atol=1e-10)
    np.testing.assert_allclose(start[:2], places.T)
    np.testing.assert_allclose(one.misfit(start), 0, atol=1e-15)


def test_screening_is_lowest_at_the_place(microphone_array):
    """½ Σ w (p − s f)² at the best s, written out. It is zero at the place of exact data."""
    exact = array(9)
    places, candidates = inside(6), np.concatenate([inside(6), inside(20, seed=5)])
    power = received_power(exact, places, np.exp(np.linspace(-3, 3, 6)))
    one = Likelihood.create(np.asarray(power.T), np.ones((9, 6), bool), exact)
    screened = np.asarray(one.screen(one.features(exact, np.asarray(candidates.T))))
    response = received_power(exact, candidates)
    for frame in range(6):
        weight = 1 / np.asarray(variance(exact.noise, power[frame]))
        for number, f in enumerate(response):
            best = np.sum(weight * power[frame] * f) / np.sum(weight * f**2)
            expected = 0.5 * np.sum(weight * (power[frame] - best * f) ** 2)
            assert screened[frame, number] == pytest.approx(expected, rel=1e-6, abs=1e-3)
    np.testing.assert_array_equal(screened.argmin(axis=1), np.arange(6))
