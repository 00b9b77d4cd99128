"""Derivatives of the estimated place with respect to all inputs, against finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from microphone_arrays import array, assert_same, inside, noisy, quick_likelihood, received_power

from jeit.acoustic import Localiser
from jeit.acoustic.localisation import localiser
from jeit.acoustic.localisation.consistency import find_minima
from jeit.acoustic.localisation.localiser import METHODS
from jeit_solvers.engines import namespace, on_device


@pytest.fixture(scope="module")
def moving():
    """MicrophoneArray, power, a direction in which all inputs are varied, and the result as a function of them."""
    microphone_array = array(9, relative=0.1, floor=1e-4, freedom=100.0)
    beyond = [[0.14, 0.02], [0.15, -0.05], [-0.14, 0.03], [0.01, 0.15], [-0.04, -0.14], [0.05, 0.16]]
    places = np.concatenate([inside(20, reach=0.8), beyond, [[0.16, 0.16], [-0.17, 0.15]]])
    rng = np.random.default_rng(0)
    power = noisy(
        microphone_array.noise, received_power(microphone_array, places, np.exp(rng.normal(size=len(places)))), rng
    )
    point = (
        microphone_array.microphones,
        jnp.asarray(np.log(microphone_array.decay.a)),
        jnp.asarray(np.log(microphone_array.decay.b)),
        power,
    )
    direction = (
        0.01 * rng.normal(size=(9, 2)),
        rng.normal(size=9),
        rng.normal(size=9),
        power * rng.normal(size=power.shape),
    )
    # Two readings are missing.
    power[[3, 9], [1, 4]] = np.nan
    point = (*point[:3], jnp.asarray(power))

    # In NumPy, unless it is differentiated.
    made = {method: Localiser.create(microphone_array, method=method, compiled=False) for method in METHODS}

    def located(method, microphones, log_a, log_b, power):
        moved = eqx.tree_at(
            lambda one: (one.microphone_array.microphones, one.microphone_array.decay.a, one.microphone_array.decay.b),
            made[method],
            (microphones, *(exponential(one) for one in (log_a, log_b))),
        )
        found = moved(power)
        return found.position, found

    return point, tuple(jnp.asarray(part) for part in direction), located


def stepped(point, direction, step):
    return [jnp.asarray(np.asarray(at) + step * np.asarray(by)) for at, by in zip(point, direction, strict=True)]


def exponential(values):
    return jnp.exp(values) if isinstance(values, jax.core.Tracer) else jnp.asarray(np.exp(values))


PARTS = {"microphones": [0], "a": [1], "b": [2], "power": [3], "all": [0, 1, 2, 3]}


def gradient_of(weight, method, located):
    return jax.grad(lambda x: jnp.sum(weight * located(method, *x)[0]))


@pytest.mark.slow
@quick_likelihood
def test_forward_mode_can_be_reversed(method, moving):
    point, _, located = moving
    gradient = jax.eval_shape(gradient_of(np.ones((28, 2)), method, located), tuple(point))
    assert [part.shape for part in gradient] == [part.shape for part in point]


@quick_likelihood
def test_forward_mode_is_traced(method, moving):
    """`test_gradients` compiles it."""
    point, direction, located = moving
    position, slope = jax.eval_shape(lambda *x: jax.jvp(lambda *x: located(method, *x)[0], x, direction), *point)
    assert position.shape == slope.shape == (28, 2)


@quick_likelihood
def test_gradients_of_known_minima(method, moving, monkeypatch):
    """As `test_gradients`, but the compiled program gets the minima that NumPy found. It does not differentiate the
    search for them, which takes long to compile."""
    known = []

    def find(*arguments):
        if namespace(arguments) is jnp:
            return on_device(known[0])  # of the point itself
        known.append(find_minima(*arguments))
        return known[-1]

    monkeypatch.setattr(localiser, "find_minima", find)
    monkeypatch.setattr(localiser, "_call_compiled", lambda function, *args: function(*args))  # for no later test
    check_gradients(method, moving, reversed_too=False)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "reversed_too"), [("likelihood", False), *((one, True) for one in METHODS)])
def test_gradients(method, reversed_too, moving):
    """The compiled result is that of NumPy, and its forward mode agrees with central differences for each input.

    So does reverse mode, which takes longer to compile.
    """
    check_gradients(method, moving, reversed_too)


def check_gradients(method, moving, reversed_too):
    point, direction, located = moving
    _, found = located(method, *point)
    # A frame that needs more iterations is reported as not converged, and its derivatives are as inaccurate as its
    # place.
    done = np.asarray(found.converged)
    assert done.mean() > 0.9
    weight = np.where(done[:, None], np.random.default_rng(2).normal(size=(28, 2)), 0.0)

    @jax.jit
    def derivatives(tangent):
        if not reversed_too:
            _, slope, compiled = jax.jvp(lambda *x: located(method, *x), point, tangent, has_aux=True)
            return slope, None, compiled
        _, push, compiled = jax.linearize(lambda *x: located(method, *x), *point, has_aux=True)
        return push(*tangent), jax.linear_transpose(push, *point)(weight), compiled

    # Frames on a side of the outline move along it. Those in a corner stay there.
    on = np.abs(np.abs(np.asarray(found.position)) - 0.1) < 1e-9
    inside, corner = ~on.any(axis=1), on.all(axis=1)
    assert inside.sum() >= 20
    assert (on.sum(axis=1) == 1).sum() >= 2
    assert corner.any() or method == "consistency"
    for parts in PARTS.values():
        mine = tuple(jnp.asarray(by if k in parts else np.zeros_like(by)) for k, by in enumerate(direction))
        slope, reverse, compiled = derivatives(mine)
        slope = np.asarray(slope)
        step = 3e-6
        ahead, behind = (np.asarray(located(method, *stepped(point, mine, sign * step))[0]) for sign in (1, -1))
        difference = (ahead - behind) / (2 * step)
        size = np.linalg.norm(difference, axis=1)
        assert (size[done & ~corner] > 1e-6).all()
        error = np.linalg.norm(slope - difference, axis=1) / np.where(corner, 1.0, size)
        assert error[done].max() < 1e-5, (np.flatnonzero(done & (error > 1e-5)), error[done].max())
        np.testing.assert_allclose(slope[on], 0, atol=1e-12)
        assert_same(found, compiled)
        if reversed_too:
            product = sum(float(np.sum(by * part)) for by, part in zip(mine, map(np.asarray, reverse), strict=True))
            assert product == pytest.approx(float(np.sum(weight * slope)), rel=1e-9)
    # A source moves with all microphones.
    for axis in np.eye(2):
        shift = jnp.asarray(np.tile(axis, (9, 1)))
        slope = np.asarray(derivatives((shift, *map(jnp.zeros_like, point[1:])))[0])
        np.testing.assert_allclose(slope[inside], np.broadcast_to(axis, (inside.sum(), 2)), atol=1e-6)
