"""Places: recovered from exact data, optimal on the skin, on any outline and surface, with both losses."""

from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest
from microphone_arrays import (
    L_SHAPE,
    MICROPHONES,
    OUTLINE,
    array,
    both,
    distance,
    inside,
    localise,
    models,
    received_power,
)

from jeit.acoustic.localisation.localiser import METHODS


@both
@pytest.mark.parametrize(
    "count", [pytest.param(4, marks=pytest.mark.slow), 9, pytest.param(25, marks=pytest.mark.slow)]
)
def test_exact_data_to_a_micrometre(count, method):
    """At places all over the skin, between its microphones, for every strength and unit of intensity."""
    microphone_array, places = array(count), inside(600, reach=0.6 if count == 4 else 1.0)
    strength = np.exp(np.random.default_rng(1).normal(size=len(places)))
    for scale in (1.0, 1e-12, 1e12):
        found = localise(microphone_array, received_power(microphone_array, places, scale * strength), method)
        assert distance(found, places).max() < 1e-6
        np.testing.assert_allclose(found["strength"], scale * strength, rtol=1e-6)
        # A few stop at rounding, one step before they are reported as converged.
        assert found["converged"].mean() > 0.99
        assert (found["freedom"] == count - 3).all()
        assert found["misfit"].max() < 1e-6
        assert (found["excess"] == 0).all()


def explained(microphone_array, power, places, method):
    """The misfit of one frame at many places in NumPy: the likelihood's misfit at the best strength, or the loss."""
    log_strength = np.log(power) - np.log(
        received_power(microphone_array, places)
    )  # log strength, as estimated from each microphone
    if method == "likelihood":  # all gains are known equally well, so that their mean is the best
        return (
            np.sum((log_strength - log_strength.mean(axis=1, keepdims=True)) ** 2, axis=1)
            / float(microphone_array.noise.relative[0]) ** 2
        )
    log_strength = np.exp(log_strength)
    return np.sum((log_strength - log_strength[:, [power.argmax()]]) ** 2, axis=1)


RASTER = np.stack(np.meshgrid(*2 * [np.linspace(-0.1, 0.1, 101)]), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(
    ("count", "noise", "method"),
    [
        pytest.param(*one, marks=[] if one in ((9, 0.1, "likelihood"), (9, 0.0, "consistency")) else pytest.mark.slow)
        for one in product((3, 4, 9), (0.0, 0.1), METHODS)
    ],
)
def test_no_place_on_the_skin_is_better(count, noise, method):
    """In a search of the whole skin with its outline, every 2 mm, nothing is lower than the result."""
    microphone_array, places = array(count, relative=max(noise, 1e-3)), inside(150)
    power = received_power(microphone_array, places)
    power = power * np.exp(noise * np.random.default_rng(11).normal(size=power.shape))
    found = localise(microphone_array, power, method)
    missed = []
    for frame, mine in enumerate(found["position"]):
        cost = explained(microphone_array, power[frame], np.concatenate([[mine], RASTER]), method)
        if not cost[0] <= cost[1:].min() * (1 + 1e-6) + 1e-9:
            missed.append((places[frame], mine, cost[0], RASTER[cost[1:].argmin()], cost[1:].min()))
    # Noise makes valleys that are narrower than the coarse grid: a few frames may end in the shallower of two.
    assert len(missed) <= ((0.02 if count == 9 else 0.05) * len(places) if noise else 0), (
        f"{len(missed)} of {len(places)}: {missed[:3]}"
    )


def both_places(place, power, a, b, microphones):
    """The two sources in the plane that three microphones do not distinguish, one of them at `place`.

    |x − x_i|² = S c_i − b_i with c = a / I: differences are linear in x and S, which leaves a quadratic equation in S.
    """
    c = a / power
    matrix = 2 * (microphones[0] - microphones[1:])
    offset, slope = [], []
    for i in (1, 2):
        square = microphones[0] @ microphones[0] - microphones[i] @ microphones[i]
        offset.append(square - (b[i] - b[0]))
        slope.append(c[i] - c[0])
    base, along = np.linalg.solve(matrix, offset), np.linalg.solve(matrix, slope)
    # x = base + S along, in the first equation.
    off = base - microphones[0]
    roots = np.roots([along @ along, 2 * off @ along - c[0], off @ off + b[0]])
    places = np.array([base + root.real * along for root in roots])
    return places[np.argsort(np.linalg.norm(places - place, axis=1))]


@pytest.mark.slow
@both
def test_three_microphones(method):
    """Three microphones suffice where the other possible place is off the skin. Otherwise that place fits equally
    well.
    """
    microphone_array, places = array(3), inside(300)
    power = received_power(microphone_array, places)
    found = localise(microphone_array, power, method)
    a, b = models(3)
    pairs = [both_places(*args, a, b, MICROPHONES[3]) for args in zip(places, power, strict=True)]
    np.testing.assert_allclose([pair[0] for pair in pairs], places, atol=1e-9)
    other = np.array([pair[1] for pair in pairs])
    apart = np.linalg.norm(other - places, axis=1)
    alone = (np.abs(other) > 0.11).any(axis=1)
    assert alone.sum() > 100
    assert distance(found, places)[alone].max() < 1e-6
    # Two places closer than one pixel are not distinguished by the coarse grid.
    nearest = np.minimum(distance(found, places), distance(found, other))
    assert nearest[apart > 0.03].max() < 1e-6
    assert (found["freedom"] == 0).all()


@pytest.mark.slow
@both
def test_an_outline_that_is_no_rectangle(method):
    """Inside an L-shaped outline to a micrometre. A source in its notch is located on the outline."""
    microphone_array, places = array(9, outline=L_SHAPE), inside(300, outline=L_SHAPE)
    notch = np.array([[0.05, 0.06], [0.03, 0.09], [0.08, 0.03]])
    found = localise(microphone_array, received_power(microphone_array, np.concatenate([places, notch])), method)
    assert distance(found, np.concatenate([places, notch]))[:300].max() < 1e-6
    x, y = found["position"][300:].T
    on_edge = (np.abs(x) < 1e-9) & (y >= 0.01 - 1e-9) | (np.abs(y - 0.01) < 1e-9) & (x >= -1e-9)
    assert on_edge.all()
    assert (found["excess"][300:] > 0).all()
    assert found["converged"].all()


@pytest.fixture(scope="module")
def cylinder():
    """A cylinder of radius 0.15 m, 0.2 m by 0.2 m, with nine microphones 10 mm beneath it."""

    def on(chart, depth=0.0):
        angle, radius = chart[:, 0] / 0.15, 0.15 - depth
        return np.stack([radius * np.sin(angle), chart[:, 1], radius * np.cos(angle) - 0.15], axis=1)

    rim = np.concatenate([np.linspace(OUTLINE[k], OUTLINE[(k + 1) % 4], 5)[:-1] for k in range(4)])
    taps = np.stack(np.meshgrid(*2 * [np.linspace(-0.09, 0.09, 9)]), axis=-1).reshape(-1, 2)
    return array(9, outline=on(rim), points=on(taps), microphones=on(MICROPHONES[9], 0.01), relative=0.02)


@pytest.mark.slow
@both
def test_on_a_curved_skin(cylinder, method):
    places = np.asarray(cylinder.surface.place(jnp.asarray(inside(200, reach=0.9).T))).T
    found = localise(cylinder, received_power(cylinder, places), method)
    assert distance(found, places).max() < 1e-6
    # The covariance is singular, tangent to the skin.
    values = np.linalg.eigvalsh(found["covariance"])
    assert (np.abs(values[:, 0]) < 1e-9 * values[:, 1]).all()
    assert (values[:, 1] > 0).all()


@both
def test_sources_outside_are_located_on_the_outline(method):
    """At the best place on the outline, or at a better one inside: none of a thousand places along the outline is
    lower.
    """
    microphone_array = array(9, relative=0.05)
    beyond = np.array([[0.13, 0.02], [-0.12, 0.05], [0.03, -0.15], [0.115, 0.12]])
    power = received_power(microphone_array, beyond)
    found = localise(microphone_array, power, method)
    assert np.abs(found["position"]).max() <= 0.1 + 1e-12
    on_outline = np.abs(np.abs(found["position"]).max(axis=1) - 0.1) < 1e-9
    # The loss may have another minimum inside.
    assert on_outline.all() if method == "likelihood" else on_outline.any()
    assert (found["excess"][on_outline] > (9 if method == "likelihood" else 0)).all()
    along = np.linspace(0, 1, 250, endpoint=False)[:, None]
    edge = np.concatenate([OUTLINE[k] + along * (OUTLINE[(k + 1) % 4] - OUTLINE[k]) for k in range(4)])
    for frame in range(4):
        cost = explained(microphone_array, power[frame], np.concatenate([found["position"][[frame]], edge]), method)
        assert cost[0] <= cost[1:].min() * (1 + 1e-9)
