"""Layout scores, against dense linear algebra, exact touches and central differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies import linear_changes

from jeit.design import Bell, TouchPrior, layout_scores, touch_grid
from jeit.design.skin.sheet_touches import sheet_touches
from jeit.design.skin.touched_cells import touched_cells
from jeit.electrodes import SheetDiscs
from jeit.forward import ForwardModel
from jeit.mesh import Rectangle, box, rectangle
from jeit.protocol import two_terminal

SKIN = Rectangle(0.1, 0.08)
THICKNESS, CONDUCTANCE, NOISE = 0.01, 2e-3, 1e-4
MESH = rectangle(0.1, 0.08, num_points=220)
PLACES = touch_grid(SKIN, 6, 5).places
CENTRES = np.array([[-0.035, -0.028], [0.034, -0.026], [0.036, 0.025], [-0.033, 0.027], [0.004, 0.003], [0.001, -0.03]])
DISCS = SheetDiscs(CENTRES, 5e-3, 1e-4)
MODEL = ForwardModel(MESH, DISCS, two_terminal(len(CENTRES)))
BELL = Bell(deviation=12e-3)
TOUCHES = sheet_touches(MESH, BELL, PLACES, thickness=THICKNESS)
WARM = 0.1
PRIOR = TouchPrior.create(PLACES, correlation=0.02)
NAMES = ("soft_worst", "mean_variance", "log_information", "largest_variance", "localisation")


def scores_of(electrodes, temperature=WARM):
    moved = MODEL.with_electrodes(electrodes)
    return layout_scores(moved, CONDUCTANCE, TOUCHES, prior=PRIOR, noise=NOISE, temperature=temperature)


def figures(electrodes):
    """The scores with gradients, as logarithms: (5,)."""
    scores = scores_of(electrodes)
    localisation = jnp.mean(scores.localisation_error)
    values = scores.soft_worst, scores.mean_variance, scores.log_information, scores.largest_variance, localisation
    return jnp.log(jnp.stack(values))


@jax.jit
def figures_and_gradient(electrodes, weights):
    """`figures`, and the gradient of their sum with `weights` (5,)."""
    values, pull = jax.vjp(figures, electrodes)
    return values, pull(weights)[0]


@pytest.fixture(scope="module")
def scores():
    return scores_of(DISCS)


@pytest.fixture(scope="module")
def changes():
    return linear_changes(MODEL, CONDUCTANCE, TOUCHES.touched)


def test_sensitivity_equals_that_of_linear_touches(scores, changes):
    np.testing.assert_allclose(scores.sensitivity, np.linalg.norm(changes, axis=1), rtol=1e-9)
    np.testing.assert_allclose(scores.worst, np.linalg.norm(changes, axis=1).min(), rtol=1e-9)
    assert scores.worst < scores.soft_worst < scores.mean
    np.testing.assert_allclose(scores_of(DISCS, 1e-3).soft_worst, scores.worst, rtol=5e-3)  # n^T - 1
    assert 0 < scores.uniformity < 1


def test_optimality_equals_that_of_dense_matrices(scores, changes):
    squared = np.sum((PLACES[:, None] - PLACES) ** 2, axis=-1)
    prior = np.exp(-squared / (2 * 0.02**2))
    # In data space: another derivation of the same covariance. What the prior's factor leaves out is below a millionth.
    data = changes.T @ prior @ changes + NOISE**2 * np.eye(changes.shape[1])
    covariance = prior - prior @ changes @ np.linalg.solve(data, changes.T @ prior)
    np.testing.assert_allclose(scores.variance, np.diag(covariance), atol=1e-4)
    np.testing.assert_allclose(scores.mean_variance, np.trace(covariance) / len(PLACES), rtol=1e-3)
    np.testing.assert_allclose(scores.log_information, np.linalg.slogdet(data / NOISE**2)[1], rtol=1e-3)
    np.testing.assert_allclose(scores.largest_variance, np.linalg.eigvalsh(covariance)[-1], rtol=1e-3)


def test_slopes_are_those_of_shifted_touches():
    step = 1e-6
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        blank = np.zeros((2, len(PLACES), MESH.num_cells))
        for one, sign in zip(blank, (1, -1), strict=True):
            moved = touched_cells(MESH, BELL, PLACES + sign * shift, thickness=THICKNESS)
            np.add.at(one, (np.arange(len(PLACES))[:, None], np.asarray(moved.cells)), np.asarray(moved.change))
        wanted = (blank[0] - blank[1]) / (2 * step)
        slope = np.asarray(TOUCHES.weights(np.ones(MESH.num_cells))[1][axis])
        # Cells that enter or leave the reach during the step change by a hundredth of the depth.
        same = (blank[0] != 0) == (blank[1] != 0)
        np.testing.assert_allclose(slope[same], wanted[same], atol=1e-6 * np.abs(slope).max())


def test_localisation_error_equals_that_of_the_inverse_information(scores, changes):
    slopes = TOUCHES.weights(np.full(MESH.num_cells, CONDUCTANCE))[1]
    jacobian = np.asarray(MODEL.jacobian(CONDUCTANCE)).T
    x, y = np.asarray(slopes) @ jacobian
    for k in range(len(PLACES)):
        directions = np.stack([1e-2 * x[k], 1e-2 * y[k], changes[k]]) / NOISE  # centimetres, for the condition number
        variance = np.diag(np.linalg.inv(directions @ directions.T))
        np.testing.assert_allclose(scores.localisation_error[k], 1e-2 * np.sqrt(variance[:2].sum()), rtol=1e-6)


def test_estimates_of_a_place_attain_the_bound(scores):
    """The Gauss-Newton estimate of (x, y, a) from noisy voltages has the bound's error at low noise."""
    k = int(np.argmin(np.linalg.norm(PLACES, axis=1)))
    weights, slopes = TOUCHES.weights(np.full(MESH.num_cells, CONDUCTANCE))
    jacobian = np.asarray(MODEL.jacobian(CONDUCTANCE)).T
    design = np.stack([*(np.asarray(slopes[:, k]) @ jacobian), np.asarray(weights[k]) @ jacobian], axis=1)
    noise = NOISE * np.random.default_rng(1).normal(size=(len(jacobian.T), 4000))
    estimate = np.linalg.lstsq(design, noise, rcond=None)[0][:2]
    error = np.sqrt(np.mean(np.sum(estimate**2, axis=0)))
    np.testing.assert_allclose(error, scores.localisation_error[k], rtol=0.05)


@pytest.mark.slow
def test_gradients_equal_central_differences():
    random, unit = np.random.default_rng(0), np.eye(len(NAMES))
    slopes = [jax.tree.map(np.asarray, figures_and_gradient(DISCS, one)[1]) for one in unit]
    for field, step in (("position", 1e-6), ("radius", 1e-6), ("contact_impedance", 1e-7)):
        values = np.asarray(getattr(DISCS, field))
        direction = random.normal(size=values.shape)
        ends = []
        for sign in (1, -1):
            moved = eqx.tree_at(lambda discs, f=field: getattr(discs, f), DISCS, values + sign * step * direction)
            ends.append(np.asarray(figures_and_gradient(moved, unit[0])[0]))
        wanted = (ends[0] - ends[1]) / (2 * step)
        found = [np.sum(getattr(slope, field) * direction) for slope in slopes]
        np.testing.assert_allclose(found, wanted, rtol=1e-4, err_msg=f"{field}: {NAMES}")


def test_figures_of_a_batch_equal_those_of_each_layout(scores):
    """For scores with a leading axis of layouts, as from `jax.vmap`. Tests of studies show that the results agree."""
    other = scores_of(SheetDiscs(CENTRES + 1e-3, 5e-3, 1e-4))
    batch = jax.tree.map(lambda *one: np.stack(one), scores, other)
    for name in ("worst", "mean", "uniformity", "mean_variance"):
        np.testing.assert_allclose(getattr(batch, name), [getattr(one, name) for one in (scores, other)], rtol=1e-12)


def test_error_messages():
    keywords = {"prior": PRIOR, "noise": NOISE}
    with pytest.raises(ValueError, match="noise must be positive"):
        layout_scores(MODEL, CONDUCTANCE, TOUCHES, prior=PRIOR, noise=0.0)
    with pytest.raises(ValueError, match="one for each of 15 channels"):
        layout_scores(MODEL, CONDUCTANCE, TOUCHES, prior=PRIOR, noise=np.ones(3))
    with pytest.raises(ValueError, match="temperature must be positive"):
        layout_scores(MODEL, CONDUCTANCE, TOUCHES, temperature=0.0, **keywords)
    with pytest.raises(ValueError, match="real, scalar"):
        layout_scores(MODEL, CONDUCTANCE + 1j, TOUCHES, **keywords)
    with pytest.raises(ValueError, match=r"prior is of 2 places and there are 30 touches"):
        layout_scores(MODEL, CONDUCTANCE, TOUCHES, prior=TouchPrior.create(PLACES[:2], correlation=0.02), noise=NOISE)
    with pytest.raises(ValueError, match="correlation"):
        TouchPrior.create(PLACES, correlation=0.0)
    with pytest.raises(ValueError, match="equivalent sheet"):
        sheet_touches(box(0.1, 0.08, 0.01, cell_size=0.02), BELL, PLACES, thickness=THICKNESS)
