"""k-means against Lloyd's algorithm in NumPy step by step, against scikit-learn's inertia, and by properties of
clusterings."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit_solvers import kmeans
from jeit_solvers.clustering import _kmeans_plus_plus, _lloyd_iterations


def blobs(seed=0, count=30, number=400, d=24):
    """Points round `count` corners whose distances are 100 times the spread of a cluster."""
    rng = np.random.default_rng(seed)
    truth = rng.permutation(np.arange(number) % count)
    corners = 100 * np.concatenate([np.eye(d), -np.eye(d)])[:count]
    return corners[truth] + rng.uniform(-1, 1, (number, d)), truth


def skin(side=20, sensors=24, seed=1):
    """Responses (side², sensors) of sensors scattered on a square to nearby touches: vectors along a smooth surface."""
    rng = np.random.default_rng(seed)
    places = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, side)]), axis=-1).reshape(-1, 2)
    square = np.sum((places[:, None] - rng.random((sensors, 2))) ** 2, axis=2)
    return np.exp(-square / 0.03)


def squared_distances(points, centres):
    return np.sum((points[:, None] - centres) ** 2, axis=2)


def lloyd(points, centres, steps):
    """Textbook Lloyd; empty clusters take the farthest points, farthest first. Labels and centres after `steps`."""
    for _ in range(steps):
        square = squared_distances(points, centres)
        labels, distance = square.argmin(axis=1), square.min(axis=1)
        counts = np.bincount(labels, minlength=len(centres))
        distance[counts[labels] == 1] = -1
        for cluster, index in zip(np.flatnonzero(counts == 0), np.argsort(-distance, kind="stable"), strict=False):
            labels[index] = cluster
        centres = np.stack([points[labels == k].mean(axis=0) for k in range(len(centres))])
    return squared_distances(points, centres).argmin(axis=1), centres


# One program for any number of steps.
_descent = jax.jit(_lloyd_iterations)


def descend(points, start, steps):
    middle = points.mean(axis=0)
    centred = points - middle
    ended = _descent(start - middle, centred, np.sum(centred**2, axis=1), (steps, 0.0))
    return ended, np.asarray(ended.centres) + middle


@pytest.fixture(scope="module")
def found():
    return kmeans(skin(), 30, jax.random.key(0))


SETS, KEYS = np.stack([skin(seed=seed) for seed in (1, 2, 3)]), (0, 6, 7)


@pytest.fixture(scope="module")
def together():
    """Clusters of three sets in a batch, and the derivatives of their inertias, in one program, which takes long to
    compile."""

    def inertia(points, key):
        found = kmeans(points, 30, key)
        return found.inertia, found

    both = jax.jit(jax.vmap(jax.grad(inertia, has_aux=True)))
    return jax.tree.map(np.asarray, both(SETS, jnp.stack([jax.random.key(seed) for seed in KEYS])))


def plus_plus(points, draws):
    """Textbook greedy k-means++: of a few points drawn in proportion to the squared distance from the nearest centre,
    the one that leaves the least sum of them."""
    centres = [points[int(draws[0, 0] * len(points))]]
    for numbers in draws[1:]:
        square = squared_distances(points, np.array(centres)).min(axis=1)
        drawn = points[np.searchsorted(np.cumsum(square), numbers * square.sum(), side="right")]
        left = [np.minimum(square, np.sum((points - one) ** 2, axis=1)).sum() for one in drawn]
        centres.append(drawn[int(np.argmin(left))])
    return np.array(centres)


def test_starts_equal_greedy_kmeans_plus_plus():
    random, start = np.random.default_rng(0), jax.jit(_kmeans_plus_plus)
    for points in (blobs()[0], skin()):
        points, draws = points - points.mean(axis=0), random.random((30, 5))
        found = np.asarray(start(points, np.sum(points**2, axis=1), draws))
        np.testing.assert_array_equal(found, plus_plus(points, draws))


@pytest.mark.parametrize("steps", [1, 2, 5, 9])
def test_every_step_equals_lloyd(steps):
    """Also the later steps, in which only the centres that moved are examined."""
    points = skin()
    start = points[np.random.default_rng(2).choice(len(points), 30, replace=False)]
    ended, centres = descend(points, start, steps)
    labels, expected = lloyd(points, start, steps)
    assert int(ended.num_steps) == steps
    np.testing.assert_array_equal(ended.labels, labels)
    np.testing.assert_allclose(centres, expected, rtol=1e-10, atol=1e-12)
    assert float(ended.inertia) == pytest.approx(squared_distances(points, expected).min(axis=1).sum(), rel=1e-10)


def test_empty_clusters_take_the_farthest_points():
    """No point is nearest to two of the centres: they jump to the two points farthest from their centres."""
    points = skin()
    rng = np.random.default_rng(3)
    start = points[rng.choice(len(points), 10, replace=False)]
    start[[4, 7]] = 50.0
    square = squared_distances(points, start).min(axis=1)
    ended, centres = descend(points, start, 1)
    np.testing.assert_allclose(centres[[4, 7]], points[np.argsort(-square)[:2]], atol=1e-14)
    assert ended.inertia < square.sum()
    for steps in (2, 300):
        ended, centres = descend(points, start, steps)
        labels, expected = lloyd(points, start, int(ended.num_steps))
        np.testing.assert_array_equal(ended.labels, labels)
        np.testing.assert_allclose(centres, expected, rtol=1e-10, atol=1e-12)
    assert ended.is_converged
    assert set(np.asarray(ended.labels)) == set(range(10))


def test_inertia_never_increases():
    points = skin()
    start = points[np.random.default_rng(4).choice(len(points), 30, replace=False)]
    inertia = [float(descend(points, start, steps)[0].inertia) for steps in range(1, 12)]
    assert np.all(np.diff(inertia) <= 0)
    assert inertia[-1] < 0.95 * inertia[0]


def test_blobs_are_recovered():
    points, truth = blobs()
    found = kmeans(points, 30, jax.random.key(1))
    labels = np.asarray(found.labels)
    assert found.converged
    assert len(set(zip(labels, truth, strict=True))) == 30
    means = np.stack([points[labels == k].mean(axis=0) for k in range(30)])
    np.testing.assert_allclose(found.centres, means, rtol=1e-12, atol=1e-12)
    assert float(found.inertia) == pytest.approx(np.sum((points - means[labels]) ** 2), rel=1e-12)


def test_converged_centres_are_a_fixed_point(found):
    points = skin()
    assert found.converged
    labels, centres = lloyd(points, np.asarray(found.centres), 1)
    np.testing.assert_array_equal(found.labels, labels)
    np.testing.assert_allclose(found.centres, centres, rtol=1e-10, atol=1e-13)


def test_inertia_is_no_worse_than_in_numpy(found):
    """Compared with the best of ten simple random starts, and clearly better than most of them."""
    points, rng = skin(), np.random.default_rng(5)
    inertia = []
    for _ in range(10):
        _, centres = lloyd(points, points[rng.choice(len(points), 30, replace=False)], 15)
        inertia.append(squared_distances(points, centres).min(axis=1).sum())
    assert found.inertia <= min(inertia)
    assert found.inertia < 0.97 * np.median(inertia)


def test_inertia_equals_scikit_learn():
    """Within 1 % with as many restarts: the median of a few keys and seeds, whose scatter is of this size."""
    reason = "scikit-learn, of the extra test, is not installed"
    cluster = pytest.importorskip("sklearn.cluster", reason=reason)
    # Its threads would wait for those of XLA.
    threads = pytest.importorskip("threadpoolctl", reason=reason)
    points = skin()
    with threads.threadpool_limits(1):
        theirs = [cluster.KMeans(30, n_init=10, tol=0, random_state=seed).fit(points).inertia_ for seed in range(3)]
    mine = [float(kmeans(points, 30, jax.random.key(seed)).inertia) for seed in range(3)]
    assert np.median(mine) == pytest.approx(np.median(theirs), rel=0.01)


def test_translation_does_not_matter():
    points = skin()
    near, far = (kmeans(points + shift, 30, jax.random.key(2)) for shift in (0.0, 1e6))
    np.testing.assert_array_equal(far.labels, near.labels)
    # The relative offset of 1e12 removes as many digits from the points themselves.
    assert float(far.inertia) == pytest.approx(float(near.inertia), rel=1e-6)


def test_results_depend_on_the_key_alone():
    points = skin()
    first, again, other = (kmeans(points, 30, jax.random.key(seed)) for seed in (3, 3, 4))
    for mine, same in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(mine, same)
    assert first.inertia != other.inertia


def test_batches_equal_loops(together):
    _, batch = together
    for index, seed in enumerate(KEYS):
        alone = kmeans(SETS[index], 30, jax.random.key(seed))
        np.testing.assert_array_equal(batch.labels[index], alone.labels)
        np.testing.assert_allclose(batch.centres[index], alone.centres, rtol=1e-12, atol=1e-15)
        assert batch.steps[index] == alone.steps
        assert bool(batch.converged[index]) == bool(alone.converged)


def test_a_larger_tolerance_takes_fewer_steps():
    points = skin()
    whole = kmeans(points, 30, jax.random.key(6))
    sooner = kmeans(points, 30, jax.random.key(6), tolerance=0.02)
    cut = kmeans(points, 30, jax.random.key(6), max_steps=1)
    assert sooner.converged
    assert not cut.converged
    assert int(cut.steps) == 1 <= int(sooner.steps) < int(whole.steps)
    assert whole.inertia <= sooner.inertia <= 1.1 * whole.inertia


@pytest.mark.slow
def test_as_many_clusters_as_points():
    points = skin(side=4)
    found = kmeans(points, 16, jax.random.key(7), restarts=1)
    assert sorted(np.asarray(found.labels)) == list(range(16))
    assert float(found.inertia) == pytest.approx(0, abs=1e-20)


@pytest.mark.slow
def test_one_cluster_is_at_the_mean():
    points = skin(side=4)
    one = kmeans(points, 1, jax.random.key(7), restarts=1)
    np.testing.assert_allclose(one.centres[0], points.mean(axis=0))


def test_more_clusters_than_distinct_points():
    """Every point is at its centre, and the iteration ends although duplicate points could be exchanged for ever."""
    points = np.repeat(skin(side=4), 25, axis=0)
    found = kmeans(points, 30, jax.random.key(8))
    assert found.converged
    assert np.isfinite(found.centres).all()
    assert float(found.inertia) == pytest.approx(0, abs=1e-20)


def test_inertia_is_differentiable(together):
    """dI/dx = 2 (x - c): at the means, the derivative in the centres is zero."""
    slopes, found = together
    nearest = np.stack([centres[labels] for centres, labels in zip(found.centres, found.labels, strict=True)])
    np.testing.assert_allclose(slopes, 2 * (SETS - nearest), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("match", "change"),
    [
        ("points has shape", {"points": np.ones(4)}),
        ("points has shape", {"points": np.ones((0, 3))}),
        ("points are complex", {"points": np.ones((9, 2)) * 1j}),
        ("2 of 9 are NaN or infinite", {"points": np.array([[np.nan], [np.inf], *([[1.0]] * 7)])}),
        ("only 9 points", {"num_clusters": 10}),
        ("num_clusters must be", {"num_clusters": 0}),
        ("num_clusters must be", {"num_clusters": 2.0}),
        ("restarts must be", {"restarts": 0}),
        ("max_steps must be", {"max_steps": -1}),
        ("tolerance must be", {"tolerance": -1e-3}),
        ("tolerance must be", {"tolerance": np.nan}),
        (r"jax.random.key\(0\)", {"key": 0}),
    ],
)
def test_invalid_input_is_refused(match, change):
    arguments = {"points": np.arange(18.0).reshape(9, 2), "num_clusters": 3, "key": jax.random.key(0)} | change
    with pytest.raises(ValueError, match=match):
        kmeans(**arguments)
