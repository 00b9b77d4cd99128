"""The learning rule: equal to MiniSom's, to rounding. Phases, batches, and learning curves that settle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from minisom import MiniSom

from jeit.touch.kohonen import MapSchedule, SelfOrganisingMap, fit_maps, learning_curves, time_constant
from jeit.touch.kohonen.training import train


def minisoms(weights, frames, order, rates, radii):
    """Weights that MiniSom learns from the same frames in the same order. With a very small radius only the winner
    moves.
    """
    oracle = MiniSom(*weights.shape)
    radii = np.append(radii, np.full(len(order) - len(radii), 0.01))
    oracle._weights = weights.copy()
    oracle._learning_rate_decay_function = lambda rate, step, steps: rates[step]
    oracle._sigma_decay_function = lambda radius, step, steps: radii[step]
    for step, number in enumerate(order):
        oracle.update(frames[number], oracle.winner(frames[number]), step, len(order))
    return oracle


@pytest.mark.parametrize(("ordering", "tuning"), [(300, 0), (0, 300), (200, 300), (17, 1)])
def test_weights_are_minisoms(ordering, tuning):
    random = np.random.default_rng(1)
    frames, weights = random.normal(5.0, 1.0, (80, 12)), random.normal(0, 0.1, (7, 5, 12))
    schedule = MapSchedule(ordering, tuning, (0.4, 0.05))
    order = random.integers(0, 80, schedule.steps)
    rates, radii = schedule.rates(), schedule.radii((7, 5))
    learnt, curve = train(jnp.asarray(weights), jnp.asarray(frames), order, rates, radii)
    oracle = minisoms(weights, frames, order, rates, radii)
    np.testing.assert_allclose(learnt, oracle._weights, rtol=0, atol=1e-12)
    assert curve[-1] == pytest.approx(oracle._weights.mean(), abs=1e-12)


def test_tuning_moves_only_the_winner():
    random = np.random.default_rng(2)
    frames, weights = random.normal(size=(1, 6)), random.normal(size=(4, 4, 6))
    learnt, _ = train(jnp.asarray(weights), jnp.asarray(frames), np.zeros(1, int), *_one_step())
    moved = np.abs(np.asarray(learnt) - weights).max(axis=2) > 1e-9
    nearest = np.linalg.norm(weights - frames[0], axis=2).argmin()
    assert np.flatnonzero(moved).tolist() == [nearest]


def _one_step():
    schedule = MapSchedule(0, 1, (0.5, 0.5))
    return schedule.rates(), schedule.radii((4, 4))


@pytest.mark.slow
def test_maps_trained_together_equal_those_trained_alone():
    frames = np.random.default_rng(3).normal(size=(60, 5))
    keys, schedules = [jax.random.key(0), jax.random.key(1)], [MapSchedule(100, 50), MapSchedule(50, 100, (0.1, 0.1))]
    together = fit_maps(frames, keys, shape=(5, 4), schedules=schedules)
    assert len(together) == 4
    for key, one in zip(keys, together[1::2], strict=True):
        alone = SelfOrganisingMap.fit(frames, key, shape=(5, 4), schedule=schedules[1])
        np.testing.assert_allclose(one.weights, alone.weights, rtol=0, atol=1e-12)
        assert one.scale == pytest.approx(alone.scale)
    assert not np.allclose(together[0].weights, together[2].weights)
    assert not np.allclose(together[0].weights, together[1].weights)


def test_curves_settle_without_overshoot_and_more_slowly_at_smaller_rates():
    frames = np.random.default_rng(4).normal(2.0, 0.01, (200, 8))
    curves = learning_curves(frames, jax.random.key(0), (0.01, 0.005, 0.001), steps=8000, shape=(8, 8))
    constants = [time_constant(one) for one in curves]
    assert constants == sorted(constants)
    # Every neuron moves by a fraction of ε between 1 and exp(−(7² + 7²) / 2·4²) of the distance.
    assert all(1 <= constant * rate <= 10 for constant, rate in zip(constants, (0.01, 0.005, 0.001), strict=True))
    assert (curves.max(axis=1) < 2.0 + 0.005).all()
    np.testing.assert_allclose(curves[:2, -1], 2.0, atol=0.01)


@pytest.mark.slow
def test_a_phase_may_end_inside_a_batch():
    """Frames are presented in batches, and the last batch is padded. The padding has no effect."""
    random = np.random.default_rng(5)
    frames, weights = random.normal(size=(30, 6)), random.normal(size=(4, 3, 6))
    schedule = MapSchedule(37, 101)
    order, rates, radii = random.integers(0, 30, schedule.steps), schedule.rates(), schedule.radii((4, 3))
    whole, curve = train(jnp.asarray(weights), jnp.asarray(frames), order, rates, radii)
    first, begun = train(jnp.asarray(weights), jnp.asarray(frames), order[:50], rates[:50], radii)
    then, ended = train(first, jnp.asarray(frames), order[50:], rates[50:], radii[:0])
    np.testing.assert_allclose(then, whole, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.append(begun, ended), curve, rtol=0, atol=1e-12)
    for steps in (37, 110):
        part, _ = train(jnp.asarray(weights), jnp.asarray(frames), order[:steps], rates[:steps], radii)
        assert curve[steps - 1] == pytest.approx(float(part.mean()), abs=1e-12)


BAD = {
    "no frames shown": (lambda: MapSchedule(0, 0), "nothing would be learnt"),
    "half a frame": (lambda: MapSchedule(10.5, 0), "ordering must be a whole number"),
    "negative": (lambda: MapSchedule(10, -1), "tuning must be a whole number"),
    "text": (lambda: MapSchedule("many", 0), "ordering must be a whole number"),
    "rising rate": (lambda: MapSchedule(rate=(0.01, 0.1)), "rate must be"),
    "rate above one": (lambda: MapSchedule(rate=(2.0, 0.1)), "rate must be"),
    "one radius": (lambda: MapSchedule(radius=3.0), "radius must be"),
    "no radius": (lambda: MapSchedule(radius=(3.0, 0.0)), "radius must be"),
    "short curve": (lambda: time_constant(np.ones(5)), "ten steps or more"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    make, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        make()
