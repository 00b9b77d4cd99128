"""The loss of Park 2022, text S2, against plain loops written from its formulas, and its minimum against SciPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from microphone_arrays import array as device_array
from microphone_arrays import inside, localise, noisy, received_power
from scipy.optimize import minimize

from jeit.acoustic import MicrophoneArray
from jeit.acoustic.decay import AttenuatedInverseSquare, Exponential
from jeit.acoustic.localisation.consistency import Consistency
from jeit.acoustic.surface import make_surface
from jeit_solvers.engines import on_device, on_host

FRAMES = 12


def array(*arguments, **noise):
    """Computed in NumPy, without compilation."""
    return on_host(device_array(*arguments, **noise))


@pytest.fixture(scope="module")
def microphone_array():
    return array(9, relative=0.1)


@pytest.fixture(scope="module")
def frames(microphone_array):
    """Power (F, M) with 10 % noise and strengths over a factor of 30, and a mask of the used readings: two are unused
    in some frames.
    """
    places = inside(FRAMES, reach=0.8)
    strength = np.exp(np.linspace(-2, 1.5, FRAMES))
    power = noisy(microphone_array.noise, received_power(microphone_array, places, strength), np.random.default_rng(0))
    use = np.ones(power.shape, bool)
    use[3, [1, 4]] = use[5, [7, 8]] = False
    # Readings that are not used may have any value, even the largest.
    power[3, 1], power[5, 7] = 1e9, np.nan
    return power, use


def loss(microphone_array, power, use, place):
    """L = Σ_{i≠k} (I_k (|x − x_k|² + b_k) / a_k − I_i (|x − x_i|² + b_i) / a_i)², k the loudest of those used."""
    microphones, a, b = (
        np.asarray(x) for x in (microphone_array.microphones, microphone_array.decay.a, microphone_array.decay.b)
    )
    used = [i for i in range(len(power)) if use[i]]
    k = max(used, key=lambda i: power[i])

    def source_strength(i):
        return power[i] * (((place - microphones[i]) ** 2).sum() + b[i]) / a[i]

    return sum((source_strength(k) - source_strength(i)) ** 2 for i in used if i != k)


def objective(microphone_array, frames):
    power, use = frames
    return Consistency.create(np.asarray(power.T), np.asarray(use.T), microphone_array)


def test_cost_is_the_papers(microphone_array, frames):
    """Relative to the square of the largest intensity."""
    power, use = frames
    places = inside(FRAMES, seed=1)
    cost = objective(microphone_array, frames).cost(np.asarray(places.T))
    for frame in range(FRAMES):
        loudest = power[frame, use[frame]].max()
        expected = loss(microphone_array, power[frame], use[frame], places[frame]) / loudest**2
        assert float(cost[frame]) == pytest.approx(expected, rel=1e-10)


def test_screen_is_the_same_at_many_places(microphone_array, frames):
    power, use = frames
    places = inside(20, seed=2)
    one = objective(microphone_array, frames)
    screened = np.asarray(one.screen(one.features(microphone_array, np.asarray(places.T))))
    assert screened.shape == (FRAMES, 20)
    for frame in range(FRAMES):
        loudest = power[frame, use[frame]].max()
        for number, place in enumerate(places):
            expected = loss(microphone_array, power[frame], use[frame], place) / loudest**2
            assert screened[frame, number] == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("decay", [Exponential, AttenuatedInverseSquare])
def test_other_models_have_the_same_loss(decay, microphone_array, frames):
    """Cost, screening and formula, with g = 1 / f of another model, in the plane."""
    rng = np.random.default_rng(6)
    values = [np.asarray(one) for one in 0.03 * np.exp(0.3 * rng.normal(size=(len(decay.parameters), 9)))]
    other = MicrophoneArray(
        microphone_array.microphones, microphone_array.surface, decay(*values), microphone_array.noise
    )
    power, use = frames
    places = inside(FRAMES, seed=7)
    one = objective(other, frames)
    cost = np.asarray(one.cost(np.asarray(places.T)))
    screened = np.asarray(one.screen(one.features(other, np.asarray(places.T))))
    for frame, place in enumerate(places):
        squared = ((place - np.asarray(other.microphones)) ** 2).sum(axis=1)
        source_strength = power[frame] / np.exp(np.asarray(other.decay.log_response(np.asarray(squared))))
        used = np.flatnonzero(use[frame])
        k = used[power[frame, used].argmax()]
        expected = np.sum((source_strength[k] - source_strength[used]) ** 2) / power[frame, k] ** 2
        assert cost[frame] == pytest.approx(expected, rel=1e-10)
        assert screened[frame, frame] == pytest.approx(expected, rel=1e-10)


def test_on_a_skin_in_space(microphone_array, frames):
    """In a tilted plane in space the loss is that of the plane."""
    turn = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))[0][:, :2]
    surface = on_host(make_surface(np.asarray(microphone_array.surface.outline.vertices) @ turn.T))
    tilted = MicrophoneArray(
        np.asarray(microphone_array.microphones @ turn.T), surface, microphone_array.decay, microphone_array.noise
    )
    places = inside(FRAMES, seed=1)
    chart = surface.project(np.asarray(turn @ places.T))
    one, flat = objective(tilted, frames), objective(microphone_array, frames)
    plain = flat.cost(np.asarray(places.T))
    np.testing.assert_allclose(one.cost(chart), plain, rtol=1e-9)
    screened = one.screen(one.features(tilted, chart))
    np.testing.assert_allclose(np.diag(screened), plain, rtol=1e-9)


def test_expansion(microphone_array, frames):
    """The gradient against JAX's gradient of the cost, and the matrix against that of the differences, written out."""
    one = objective(microphone_array, frames)
    chart = np.asarray(inside(FRAMES, seed=3).T)
    value, gradient, matrix = one.expand(chart)
    np.testing.assert_allclose(value, one.cost(chart), rtol=1e-13)
    expected = jax.jit(jax.grad(lambda u: jnp.sum(on_device(one).cost(u))))(chart)
    np.testing.assert_allclose(gradient, expected, rtol=1e-9)
    step = 1e-6
    rise = np.stack(
        [
            (one.differences(chart + step * e[:, None]) - one.differences(chart - step * e[:, None])) / (2 * step)
            for e in np.eye(2)
        ]
    )
    np.testing.assert_allclose(matrix, 2 * np.einsum("kmf,lmf->klf", rise, rise), rtol=1e-6)


@pytest.mark.slow
def test_minimum_is_scipys(microphone_array, frames):
    """From four starting points each: the localiser's minimum is as low as the lowest of them."""
    power, use = frames
    found = localise(microphone_array, np.where(use, power, np.nan), "consistency")
    # Gauss-Newton steps are short where residuals curve the loss. A frame that needs more iterations is reported as
    # such.
    assert found["converged"].mean() > 0.9
    starts = inside(4, seed=4)
    for frame in (0, 2, 3, 6, 11):
        assert found["converged"][frame]
        level = power[frame, use[frame]].max()
        best = min(
            (
                minimize(
                    lambda x, frame=frame, level=level: (
                        1e3 * loss(microphone_array, power[frame], use[frame], x) / level**2
                    ),
                    start,
                    method="Nelder-Mead",
                    options={"xatol": 1e-9, "fatol": 1e-15, "maxiter": 400},
                )
                for start in starts
            ),
            key=lambda result: result.fun,
        )
        np.testing.assert_allclose(found["position"][frame], best.x, atol=1e-6)


def test_scale_of_intensities_does_not_matter(microphone_array, frames):
    power, use = frames
    chart = np.asarray(inside(FRAMES, seed=1).T)
    plain = objective(microphone_array, frames).cost(chart)
    for scale in (1e-12, 1e12):
        np.testing.assert_allclose(objective(microphone_array, (scale * power, use)).cost(chart), plain, rtol=1e-10)


def test_covariance_is_that_of_draws(microphone_array):
    """Of the minimum for noisy frames at 1 % noise, where the formula is exact within a few per cent."""
    quiet = array(9, relative=0.01)
    rng = np.random.default_rng(5)
    for place in ([0.02, -0.03], [-0.06, 0.05]):
        power = noisy(quiet.noise, np.repeat(received_power(quiet, [place]), 1024, axis=0), rng)
        found = localise(quiet, power, "consistency")
        error = found["position"] - place
        # Each variance of 1,024 draws has a standard error of 4.4 %. The tolerance allows nearly three times that.
        actual, predicted = error.T @ error / len(error), found["covariance"].mean(axis=0)
        np.testing.assert_allclose(actual, predicted, atol=0.12 * np.trace(predicted) / 2)
