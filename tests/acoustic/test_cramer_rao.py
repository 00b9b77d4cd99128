"""The Cramér-Rao bound against Fisher's matrix by differences of NumPy formulas, and its properties."""

import jax.numpy as jnp
import numpy as np
import pytest
from microphone_arrays import MICROPHONES, array, inside, received_power, variance

from jeit.acoustic import cramer_rao
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.surface import make_surface

PLACES, STRENGTH = inside(6), np.array([0.05, 0.3, 1.0, 3.0, 10.0, 100.0])


def fisher(microphone_array, place, strength):
    """Σ ∇m ∇mᵀ / v + ½ ∇log v ∇log vᵀ in (x, y, log strength), by central differences."""

    def terms(x):
        received = received_power(microphone_array, [x[:2]], np.exp(x[2]))[0]
        total = received + np.asarray(microphone_array.noise.floor)
        return np.stack([np.log(total), np.log(np.asarray(variance(microphone_array.noise, received)) / total**2)])

    at, step = np.array([*place, np.log(strength)]), 1e-6
    slopes = np.stack([(terms(at + step * e) - terms(at - step * e)) / (2 * step) for e in np.eye(3)], axis=-1)
    weight = np.exp(-terms(at)[1])
    return np.einsum("m,mi,mj->ij", weight, slopes[0], slopes[0]) + 0.5 * slopes[1].T @ slopes[1]


def test_the_bound_is_the_inverse_of_fishers_matrix():
    microphone_array = array(9, relative=0.1, floor=0.05, freedom=30.0)
    bound = cramer_rao(microphone_array, jnp.asarray(PLACES), jnp.asarray(STRENGTH))
    for place, strength, mine in zip(PLACES, STRENGTH, bound, strict=True):
        expected = np.linalg.inv(fisher(microphone_array, place, strength))[:2, :2]
        np.testing.assert_allclose(mine, expected, rtol=1e-6, atol=1e-7 * np.trace(expected))


def test_microphones_that_are_left_out_add_no_information():
    """The bound for the used microphones is that of an array without the others, and larger than that of all."""
    whole = array(9, relative=0.1)
    use = np.ones(9, bool)
    use[[2, 3]] = False
    part = MicrophoneArray(
        whole.microphones[use],
        whole.surface,
        type(whole.decay)(whole.decay.a[use], whole.decay.b[use]),
        array(9, relative=0.1).noise.create(7, relative=0.1),
    )
    without = cramer_rao(whole, jnp.asarray(PLACES), use=use)
    np.testing.assert_allclose(without, cramer_rao(part, jnp.asarray(PLACES)), rtol=1e-9)
    more = np.asarray(without) - np.asarray(cramer_rao(whole, jnp.asarray(PLACES)))
    assert (np.linalg.eigvalsh(more) > 0).all()


def test_relative_noise_has_no_scale():
    """Without a floor the bound is the same at any strength, and proportional to the noise variance where that is
    small.
    """
    place = jnp.asarray(PLACES)
    plain = np.asarray(cramer_rao(array(9, relative=0.01), place, 1.0))
    np.testing.assert_allclose(cramer_rao(array(9, relative=0.01), place, 1e12), plain, rtol=1e-9)
    np.testing.assert_allclose(cramer_rao(array(9, relative=0.02), place, 1.0), 4 * plain, rtol=1e-9)


def test_louder_is_better_until_the_relative_error_dominates():
    microphone_array = array(9, relative=0.05, floor=0.1, freedom=20.0)
    place = jnp.asarray(np.repeat(PLACES[:1], 6, axis=0))
    spread = np.trace(cramer_rao(microphone_array, place, jnp.asarray(10.0 ** np.arange(-1, 5))), axis1=1, axis2=2)
    assert (np.diff(spread) < 0).all()
    assert spread[-1] == pytest.approx(np.trace(cramer_rao(array(9, relative=0.05), place)[0]), rel=0.01)


def test_on_a_skin_in_space():
    """In a rotated plane in space the bound is that of the plane, rotated, with zero variance across the plane."""
    flat = array(9, relative=0.1)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0][:, :2]
    corners = flat.surface.outline.vertices @ turn.T
    curved = MicrophoneArray(
        jnp.asarray(MICROPHONES[9] @ turn.T), make_surface(np.asarray(corners)), flat.decay, flat.noise
    )
    expected = turn @ np.asarray(cramer_rao(flat, jnp.asarray(PLACES))) @ turn.T
    found = np.asarray(cramer_rao(curved, jnp.asarray(PLACES @ turn.T)))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def test_one_strength_for_all():
    microphone_array = array(9, relative=0.1, floor=0.05, freedom=30.0)
    np.testing.assert_allclose(
        cramer_rao(microphone_array, jnp.asarray(PLACES), 2.0),
        cramer_rao(microphone_array, jnp.asarray(PLACES), jnp.full(6, 2.0)),
    )
