"""The localiser: exact data to a micrometre, honest covariances, gradients of everything it depends on."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from microphone_arrays import L_SHAPE, MICROPHONES, OUTLINE, array, hear, inside, models, noisy, same_shape

from jeit.acoustic import Localiser, cramer_rao
from jeit.acoustic.localiser import METHODS

both = pytest.mark.parametrize("method", METHODS)
# Programs take long to compile: of some, one is for the quick suite and the other is not.
quick_likelihood, quick_consistency = (
    pytest.mark.parametrize(
        "method", [pytest.param(one, marks=[] if one == quick else [pytest.mark.slow]) for one in METHODS]
    )
    for quick in METHODS
)


def localise(listeners, power, method="likelihood", **options):
    return same_shape(Localiser.create(listeners, method=method), power, **options)


def distance(found, places):
    return np.linalg.norm(found["position"] - places, axis=1)


@both
@pytest.mark.parametrize(
    "count", [pytest.param(4, marks=pytest.mark.slow), 9, pytest.param(25, marks=pytest.mark.slow)]
)
def test_exact_data_to_a_micrometre(count, method):
    """All over the skin, of four microphones between them; whatever the strength and the unit of intensity."""
    listeners, places = array(count), inside(600, reach=0.6 if count == 4 else 1.0)
    strength = np.exp(np.random.default_rng(1).normal(size=len(places)))
    for scale in (1.0, 1e-12, 1e12):
        found = localise(listeners, hear(listeners, places, scale * strength), method)
        assert distance(found, places).max() < 1e-6
        np.testing.assert_allclose(found["strength"], scale * strength, rtol=1e-6)
        # A few stop at rounding, a step before they are told converged.
        assert found["converged"].mean() > 0.99
        assert (found["freedom"] == count - 3).all()
        assert found["misfit"].max() < 1e-6
        assert (found["excess"] == 0).all()


def explained(listeners, power, places, method):
    """Of one frame at many places in NumPy: the likelihood's misfit at the best strength, or the loss."""
    told = np.log(power) - np.log(hear(listeners, places))  # log strength, as each microphone tells it
    if method == "likelihood":  # all gains are known equally well: their mean is the best
        return np.sum((told - told.mean(axis=1, keepdims=True)) ** 2, axis=1) / float(listeners.noise.relative[0]) ** 2
    told = np.exp(told)
    return np.sum((told - told[:, [power.argmax()]]) ** 2, axis=1)


RASTER = np.stack(np.meshgrid(*2 * [np.linspace(-0.1, 0.1, 101)]), axis=-1).reshape(-1, 2)


@both
@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("count", [pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow), 9])
def test_no_place_on_the_skin_is_better(count, noise, method):
    """A search of the whole skin, its outline too, every 2 mm: nothing is lower than what is found."""
    listeners, places = array(count, relative=max(noise, 1e-3)), inside(150)
    power = hear(listeners, places)
    power = power * np.exp(noise * np.random.default_rng(11).normal(size=power.shape))
    found = localise(listeners, power, method)
    missed = []
    for frame, mine in enumerate(found["position"]):
        cost = explained(listeners, power[frame], np.concatenate([[mine], RASTER]), method)
        if not cost[0] <= cost[1:].min() * (1 + 1e-6) + 1e-9:
            missed.append((places[frame], mine, cost[0], RASTER[cost[1:].argmin()], cost[1:].min()))
    # Noise makes valleys that are narrower than the coarse grid: a few frames may miss the deeper of two.
    assert len(missed) <= ((0.02 if count == 9 else 0.05) * len(places) if noise else 0), (
        f"{len(missed)} of {len(places)}: {missed[:3]}"
    )


def both_places(place, power, a, b, microphones):
    """The two sources in the plane that three microphones cannot tell apart, one of them at `place`.

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
    """Three are enough where the other place that they allow is off the skin; else that one is as good."""
    listeners, places = array(3), inside(300)
    power = hear(listeners, places)
    found = localise(listeners, power, method)
    a, b = models(3)
    pairs = [both_places(*args, a, b, MICROPHONES[3]) for args in zip(places, power, strict=True)]
    np.testing.assert_allclose([pair[0] for pair in pairs], places, atol=1e-9)
    other = np.array([pair[1] for pair in pairs])
    apart = np.linalg.norm(other - places, axis=1)
    alone = (np.abs(other) > 0.11).any(axis=1)
    assert alone.sum() > 100
    assert distance(found, places)[alone].max() < 1e-6
    # Two places that are nearer to each other are in one pixel of the coarse grid, which tells one from the other.
    nearest = np.minimum(distance(found, places), distance(found, other))
    assert nearest[apart > 0.03].max() < 1e-6
    assert (found["freedom"] == 0).all()


@pytest.mark.slow
@both
def test_an_outline_that_is_no_rectangle(method):
    """Inside an L to a micrometre; what sounds from its notch is held on its edge."""
    listeners, places = array(9, outline=L_SHAPE), inside(300, outline=L_SHAPE)
    notch = np.array([[0.05, 0.06], [0.03, 0.09], [0.08, 0.03]])
    found = localise(listeners, hear(listeners, np.concatenate([places, notch])), method)
    assert distance(found, np.concatenate([places, notch]))[:300].max() < 1e-6
    x, y = found["position"][300:].T
    on_edge = (np.abs(x) < 1e-9) & (y >= 0.01 - 1e-9) | (np.abs(y - 0.01) < 1e-9) & (x >= -1e-9)
    assert on_edge.all()
    assert (found["excess"][300:] > 0).all()
    assert found["converged"].all()


@pytest.fixture(scope="module")
def cylinder():
    """A cylinder of radius 0.15 m, 0.2 m by 0.2 m along it, with nine microphones 10 mm beneath."""

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
    found = localise(cylinder, hear(cylinder, places), method, number=256)
    assert distance(found, places).max() < 1e-6
    # The covariance is a sheet, tangent to the skin.
    values = np.linalg.eigvalsh(found["covariance"])
    assert (np.abs(values[:, 0]) < 1e-9 * values[:, 1]).all()
    assert (values[:, 1] > 0).all()


@both
def test_what_lies_beyond_is_held_on_the_skin(method):
    """At the best place on the outline, or at one inside that is better: none of a thousand along it is lower."""
    listeners = array(9, relative=0.05)
    beyond = np.array([[0.13, 0.02], [-0.12, 0.05], [0.03, -0.15], [0.115, 0.12]])
    power = hear(listeners, beyond)
    found = localise(listeners, power, method)
    assert np.abs(found["position"]).max() <= 0.1 + 1e-12
    on_outline = np.abs(np.abs(found["position"]).max(axis=1) - 0.1) < 1e-9
    # The loss may have another valley inside.
    assert on_outline.all() if method == "likelihood" else on_outline.any()
    assert (found["excess"][on_outline] > (9 if method == "likelihood" else 0)).all()
    along = np.linspace(0, 1, 250, endpoint=False)[:, None]
    edge = np.concatenate([OUTLINE[k] + along * (OUTLINE[(k + 1) % 4] - OUTLINE[k]) for k in range(4)])
    for frame in range(4):
        cost = explained(listeners, power[frame], np.concatenate([found["position"][[frame]], edge]), method)
        assert cost[0] <= cost[1:].min() * (1 + 1e-9)


# Gradients. Frames with 10 % noise, so that residuals curve the cost: inside, on the outline, and in a corner.
@pytest.fixture(scope="module")
def moving():
    """Listeners, power, a direction in which all of them are moved, and what is found as a function of them."""
    listeners = array(9, relative=0.1, floor=1e-4, freedom=100.0)
    beyond = [[0.14, 0.02], [0.15, -0.05], [-0.14, 0.03], [0.01, 0.15], [-0.04, -0.14], [0.05, 0.16]]
    places = np.concatenate([inside(20, reach=0.8), beyond, [[0.16, 0.16], [-0.17, 0.15]]])
    rng = np.random.default_rng(0)
    power = noisy(listeners.noise, hear(listeners, places, np.exp(rng.normal(size=len(places)))), rng)
    point = (listeners.microphones, jnp.log(listeners.decay.a), jnp.log(listeners.decay.b), jnp.asarray(power))
    direction = (
        0.01 * rng.normal(size=(9, 2)),
        rng.normal(size=9),
        rng.normal(size=9),
        power * rng.normal(size=power.shape),
    )

    made = {method: Localiser.create(listeners, method=method) for method in METHODS}

    def located(method, microphones, log_a, log_b, power):
        moved = eqx.tree_at(
            lambda one: (one.listeners.microphones, one.listeners.decay.a, one.listeners.decay.b),
            made[method],
            (microphones, jnp.exp(log_a), jnp.exp(log_b)),
        )
        return moved(power)

    return point, tuple(jnp.asarray(part) for part in direction), located


def stepped(point, direction, step):
    return [at + step * by for at, by in zip(point, direction, strict=True)]


PARTS = {"microphones": [0], "a": [1], "b": [2], "power": [3], "all": [0, 1, 2, 3]}


@quick_likelihood
def test_gradients(method, moving):
    """Forward mode, reverse mode and central differences agree, in each of what positions depend on."""
    point, direction, located = moving
    found = located(method, *point)
    # What needs more steps is said not to have converged, and its slopes are as far off as its place.
    done = np.asarray(found.converged)
    assert done.mean() > 0.9
    weight = jnp.asarray(np.where(done[:, None], np.random.default_rng(2).normal(size=(28, 2)), 0.0))
    forward = jax.jit(lambda tangent: jax.jvp(lambda *x: located(method, *x).position, point, tangent)[1])
    reverse = jax.jit(jax.grad(lambda x: jnp.sum(weight * located(method, *x).position)))(tuple(point))
    # Frames on a side of the outline move along it, those in a corner stay in it.
    on = np.abs(np.abs(np.asarray(found.position)) - 0.1) < 1e-9
    corner = on.all(axis=1)
    assert (on.sum(axis=1) == 0).sum() >= 20
    assert (on.sum(axis=1) == 1).sum() >= 2
    assert corner.any() or method == "consistency"
    for parts in PARTS.values():
        mine = tuple(by if k in parts else jnp.zeros_like(by) for k, by in enumerate(direction))
        slope = np.asarray(forward(mine))
        step = 3e-6
        ahead, behind = (np.asarray(located(method, *stepped(point, mine, sign * step)).position) for sign in (1, -1))
        difference = (ahead - behind) / (2 * step)
        size = np.linalg.norm(difference, axis=1)
        assert (size[done & ~corner] > 1e-6).all()
        error = np.linalg.norm(slope - difference, axis=1) / np.where(corner, 1.0, size)
        assert error[done].max() < 1e-5, (np.flatnonzero(done & (error > 1e-5)), error[done].max())
        np.testing.assert_allclose(slope[on], 0, atol=1e-12)
        product = sum(float(jnp.sum(by * gradient)) for by, gradient in zip(mine, reverse, strict=True))
        # Two programs, whose descents end where rounding lets them.
        assert product == pytest.approx(float(np.sum(np.asarray(weight) * slope)), rel=1e-6)


@pytest.mark.slow
@both
def test_the_gradient_of_exact_data_is_the_place_itself(method):
    """Moved together with all microphones, the source moves along: the Jacobian in them adds up to the identity."""
    listeners = array(9)
    power = jnp.asarray(hear(listeners, inside(28, reach=0.8)))
    localiser = Localiser.create(listeners, method=method)

    def positions(shift):
        moved = listeners.microphones + shift
        return eqx.tree_at(lambda one: one.listeners.microphones, localiser, moved)(power).position

    jacobian = jax.jacfwd(positions)(jnp.zeros(2))
    np.testing.assert_allclose(jacobian, np.broadcast_to(np.eye(2), (28, 2, 2)), atol=1e-6)


# Honesty of the covariance.
NOISES = {
    "gains only": {"relative": 0.1},
    "with a floor": {"relative": 0.05, "floor": 0.05, "freedom": 100.0},
    "additive": {"relative": 0.03, "deviation": 0.02},
}
SOURCES = [([0.01, 0.02], 1.0), ([0.05, -0.04], 5.0), ([-0.06, 0.0], 2.0), ([0.02, 0.06], 20.0)]


@pytest.mark.parametrize("noise", NOISES)
def test_the_covariance_is_honest(noise):
    """1,000 draws a place: the 95 % ellipse holds the truth in 92 to 98 %."""
    listeners = array(9, **NOISES[noise])
    localiser, rng = Localiser.create(listeners), np.random.default_rng(3)
    for place, strength in SOURCES:
        received = np.repeat(hear(listeners, [place], strength), 1000, axis=0)
        found = same_shape(localiser, noisy(listeners.noise, received, rng))
        error = found["position"] - place
        square = np.einsum("fi,fij,fj->f", error, np.linalg.inv(found["covariance"]), error)
        assert 0.92 <= np.mean(square < 5.991) <= 0.98, (place, np.mean(square < 5.991))
        # What is left over is chi-square with 6 degrees of freedom: 1,000 means are good to 2 % or so.
        assert found["misfit"].mean() == pytest.approx(6, rel=0.1)
        assert (found["freedom"] == 6).all()


def test_noise_of_windows_with_a_floor():
    """Not drawn from the model: powers of signal and noise in 100 degrees of freedom, noncentral chi-square, and gains
    off by 5 %."""
    floor, freedom = 0.05, 100.0
    listeners = array(9, relative=0.05, floor=floor, freedom=freedom)
    localiser, rng = Localiser.create(listeners), np.random.default_rng(4)
    for place, strength in SOURCES:
        received = np.repeat(hear(listeners, [place], strength), 1000, axis=0)
        received = received * np.exp(0.05 * rng.normal(size=received.shape))
        power = floor / freedom * rng.noncentral_chisquare(freedom, freedom * received / floor) - floor
        found = same_shape(localiser, power)
        error = found["position"] - place
        square = np.einsum("fi,fij,fj->f", error, np.linalg.inv(found["covariance"]), error)
        assert 0.92 <= np.mean(square < 5.991) <= 0.98, (place, np.mean(square < 5.991))


def test_the_error_is_the_cramer_rao_bound():
    """Where noise is low: 2 % in gain. Mean squares of 1,024 draws are good to 4.4 % a direction, 3.1 % in all."""
    listeners = array(9, relative=0.02)
    localiser, rng = Localiser.create(listeners), np.random.default_rng(5)
    bound = cramer_rao(listeners, jnp.asarray([place for place, _ in SOURCES]))
    ratio = []
    for (place, strength), least in zip(SOURCES, bound, strict=True):
        found = same_shape(
            localiser, noisy(listeners.noise, np.repeat(hear(listeners, [place], strength), 1024, axis=0), rng)
        )
        error = found["position"] - place
        assert np.linalg.norm(error.mean(axis=0)) < 0.1 * np.sqrt(np.trace(least))
        ratio.append(np.mean(np.sum(error**2, axis=1)) / float(jnp.trace(least)))
        np.testing.assert_allclose(found["covariance"].mean(axis=0), least, atol=0.05 * float(jnp.trace(least)))
    assert np.mean(ratio) == pytest.approx(1, abs=0.05)
    assert max(abs(np.array(ratio) - 1)) < 0.12


def test_the_likelihood_beats_the_papers_loss():
    """Where far microphones hear little but noise, which the loss multiplies by the distance."""
    listeners = array(9, relative=0.05, floor=0.05, freedom=30.0)
    places, rng = inside(1000, reach=0.5), np.random.default_rng(6)
    power = noisy(listeners.noise, hear(listeners, places), rng)
    errors = [np.mean(distance(localise(listeners, power, method), places)) for method in METHODS]
    assert errors[0] < 0.9 * errors[1]


# Frames and batches.
@pytest.fixture(scope="module")
def mixed():
    """Noisy frames inside and beyond, some with readings missing."""
    listeners = array(9, relative=0.1)
    rng = np.random.default_rng(7)
    places = np.concatenate([inside(40), inside(10, seed=1) + np.array([0.2, 0.0])])
    power = noisy(listeners.noise, hear(listeners, places), rng)
    power[rng.random(power.shape) < 0.1] = np.nan
    return listeners, power


@pytest.mark.slow
@both
def test_frames_do_not_see_each_other(method, mixed):
    """One by one, in another order, or padded with others: the same to rounding."""
    listeners, power = mixed
    localiser = Localiser.create(listeners, method=method)
    together = same_shape(localiser, power)
    for frame in range(0, 50, 7):
        alone = localiser(power[frame : frame + 1])
        for key, values in together.items():
            np.testing.assert_allclose(getattr(alone, key)[0], values[frame], rtol=1e-6, atol=1e-9)
    order = np.random.default_rng(8).permutation(50)
    shuffled = same_shape(localiser, power[order])
    for key in ("position", "covariance", "strength", "excess", "misfit"):
        np.testing.assert_allclose(shuffled[key], together[key][order], rtol=1e-9, atol=1e-15)


@pytest.mark.slow
@both
def test_many_frames_are_worked_on_in_chunks(method, mixed):
    listeners, power = mixed
    localiser = Localiser.create(listeners, method=method)
    many = localiser(power[np.arange(2500) % 50])
    np.testing.assert_allclose(many.position, localiser(power).position[np.arange(2500) % 50], rtol=1e-7, atol=1e-10)


@pytest.mark.slow
@both
def test_compiled_or_not(method, mixed):
    listeners, power = mixed
    localiser = Localiser.create(listeners, method=method)
    with jax.disable_jit():
        eager = localiser(power[:3])
    for key, values in same_shape(localiser, power[:3]).items():
        np.testing.assert_allclose(getattr(eager, key), values, rtol=1e-6, atol=1e-9)


@both
def test_missing_readings(method):
    """NaN, not used, or used and infinite are one; exact data stay exact with up to five of nine gone."""
    exact, places = array(9), inside(200, reach=0.6)
    power = hear(exact, places)
    rng = np.random.default_rng(9)
    use = np.ones(power.shape, bool)
    for frame in range(200):
        use[frame, rng.choice(9, frame % 5 + 1, replace=False)] = False
    found = localise(exact, np.where(use, power, np.nan), method)
    several = use.sum(axis=1) >= 5
    assert distance(found, places)[several].max() < 1e-6
    # Four leave one degree of freedom, and now and then a second place that is nearly as good.
    assert np.mean(distance(found, places) < 1e-6) > 0.97
    np.testing.assert_array_equal(found["freedom"], use.sum(axis=1) - 3)
    localiser = Localiser.create(exact, method=method)
    rubbish = np.where(use, power, 1e9)
    padded = np.arange(1024) % 200
    np.testing.assert_array_equal(localiser(rubbish[padded], use[padded]).position[:200], found["position"])
    infinite = np.where(use, power, np.inf)
    np.testing.assert_array_equal(localise(exact, infinite, method)["position"], found["position"])


@both
def test_too_few_readings_give_nan(method, mixed):
    listeners, power = mixed
    power = np.where(np.isnan(power), 1.0, power)
    power[0, 2:] = np.nan
    power[1] = np.nan
    power[2, 3:] = np.nan
    found = localise(listeners, power, method)
    for key in ("position", "covariance", "strength", "misfit"):
        assert np.isnan(found[key][:2]).all()
        assert np.isfinite(found[key][2:]).all()
    assert not found["converged"][:2].any()
    np.testing.assert_array_equal(found["freedom"][:4], [0, 0, 0, 6])


@pytest.mark.slow
@both
def test_maps(method):
    """Least where the source is found, to a pixel; blank beyond the outline; bottom row first."""
    listeners, places = array(9, outline=L_SHAPE, relative=0.02), inside(20, outline=L_SHAPE, reach=0.9)
    localiser = Localiser.create(listeners, method=method, map_shape=(40, 30))
    power = noisy(listeners.noise, hear(listeners, places), np.random.default_rng(10))
    found, maps = localiser.with_maps(power[np.arange(32) % 20])
    assert maps.shape == (32, 40, 30)
    x, y = -0.1 + 0.2 * (np.arange(30) + 0.5) / 30, -0.1 + 0.2 * (np.arange(40) + 0.5) / 40
    np.testing.assert_array_equal(np.isnan(maps[0]), (x > 0) & (y[:, None] > 0.01))
    for one, place in zip(np.asarray(maps), np.asarray(found.position), strict=True):
        row, column = np.unravel_index(np.nanargmin(one), one.shape)
        assert np.hypot(x[column] - place[0], y[row] - place[1]) < 0.009
    coarse = same_shape(Localiser.create(listeners, method=method), power)
    np.testing.assert_allclose(found.position[:20], coarse["position"], atol=1e-8)


@pytest.mark.slow
@both
def test_the_papers_raster(method):
    """200 × 200 pixels of a millimetre: the map of the loss is the formula's, and its minimum the place."""
    listeners, places = array(9, relative=0.02), inside(5, reach=0.9)
    power = hear(listeners, places)
    found, maps = Localiser.create(listeners, method=method, map_shape=(200, 200)).with_maps(power)
    np.testing.assert_allclose(found.position, places, atol=1e-6)
    for one, place in zip(np.asarray(maps), places, strict=True):
        row, column = np.unravel_index(np.nanargmin(one), one.shape)
        assert np.abs(-0.1 + 1e-3 * (np.array([column, row]) + 0.5) - place).max() < 1e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "magic"}, "likelihood, consistency"),
        ({"map_shape": (10,)}, "rows, columns"),
        ({"map_shape": (1, 10)}, "at least two"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        Localiser.create(array(9), **options)


def test_bad_frames():
    localiser = Localiser.create(array(9))
    for power, use in ((np.ones(9), None), (np.ones((4, 8)), None), (np.ones((4, 9)), np.ones((4, 8), bool))):
        with pytest.raises((ValueError, TypeError), match=r"frames, microphones|broadcast|shape"):
            localiser(power, use)
    with pytest.raises(ValueError, match="map_shape"):
        localiser.with_maps(np.ones((4, 9)))
