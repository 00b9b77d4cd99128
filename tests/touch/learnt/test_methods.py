"""Methods: those that predict one frame in microseconds equal scikit-learn's, to rounding, and all of them learn."""

import numpy as np
import pytest

from jeit.touch.learnt.array_models import NearestNeighbours
from jeit.touch.learnt.methods import (
    CLASSIFIERS,
    REGRESSORS,
    GaussianProcess,
    _estimate_length_and_noise,
    fit_sharpness,
    log_odds,
    probabilities,
)
from jeit.touch.learnt.neural_networks import _draw_batches

RNG = np.random.default_rng(0)
FEATURES = RNG.normal(size=(220, 6)) * np.linspace(2, 0.5, 6)
TARGETS = np.stack([np.tanh(FEATURES[:, 0]), np.sin(FEATURES[:, 1])], axis=1) + 0.03 * RNG.normal(size=(220, 2))
LABEL = (FEATURES[:, 0] > 0) + 2 * (FEATURES[:, 1] > 0)
ASKED = RNG.normal(size=(50, 6)) * np.linspace(2, 0.5, 6)


@pytest.mark.parametrize("name", sorted(REGRESSORS))
def test_numbers_are_learnt(name, monkeypatch):
    monkeypatch.setattr(
        "jeit.touch.learnt.methods._MAX_PRESENTATIONS_PER_PRESS", 8
    )  # a map with few presses, each presented this often
    predicted = np.asarray(REGRESSORS[name](FEATURES, TARGETS).predict(ASKED))
    right = np.stack([np.tanh(ASKED[:, 0]), np.sin(ASKED[:, 1])], axis=1)
    guess = np.abs(right - right.mean(axis=0)).mean()
    assert np.abs(predicted - right).mean() < {"ridge": 0.75, "forest": 0.85}.get(name, 0.55) * guess


@pytest.mark.parametrize("name", sorted(CLASSIFIERS))
def test_labels_are_learnt(name):
    model = CLASSIFIERS[name](FEATURES, LABEL)
    odds = log_odds(model, ASKED)
    right = (ASKED[:, 0] > 0) + 2 * (ASKED[:, 1] > 0)
    assert odds.shape == (50, 4)
    assert np.mean(odds.argmax(axis=1) == right) > 0.75
    np.testing.assert_allclose(probabilities(odds, 2.0).sum(axis=1), 1)


@pytest.mark.parametrize("name", sorted(CLASSIFIERS))
def test_two_classes_are_learnt(name):
    label = (FEATURES[:, 0] > 0).astype(int)
    odds = log_odds(CLASSIFIERS[name](FEATURES, label), FEATURES)
    assert odds.shape == (220, 2)
    assert np.mean(odds.argmax(axis=1) == label) > 0.9


def test_trees_are_scikit_learns():
    from sklearn.ensemble import (
        AdaBoostClassifier,
        BaggingClassifier,
        ExtraTreesRegressor,
        HistGradientBoostingRegressor,
    )
    from sklearn.tree import DecisionTreeClassifier

    options = {"max_iter": 100, "max_leaf_nodes": 15, "min_samples_leaf": 8, "l2_regularization": 1.0}
    boosted = HistGradientBoostingRegressor(random_state=0, **options).fit(FEATURES, TARGETS[:, 1])
    np.testing.assert_allclose(REGRESSORS["trees"](FEATURES, TARGETS).predict(ASKED)[:, 1], boosted.predict(ASKED))
    forest = ExtraTreesRegressor(100, max_features=0.3, min_samples_leaf=2, random_state=0).fit(FEATURES, TARGETS)
    np.testing.assert_allclose(REGRESSORS["forest"](FEATURES, TARGETS).predict(ASKED), forest.predict(ASKED))
    bagged = BaggingClassifier(DecisionTreeClassifier(random_state=0), 30, random_state=0).fit(FEATURES, LABEL)
    output = CLASSIFIERS["bagged-trees"](FEATURES, LABEL).decision_function(ASKED)
    np.testing.assert_allclose(output, bagged.predict_proba(ASKED))
    one = DecisionTreeClassifier(max_leaf_nodes=21, random_state=0)
    ada = AdaBoostClassifier(one, n_estimators=30, random_state=0).fit(FEATURES, LABEL)
    output = CLASSIFIERS["boosted-trees"](FEATURES, LABEL).decision_function(ASKED)
    np.testing.assert_array_equal(output.argmax(axis=1), ada.predict(ASKED))


@pytest.mark.parametrize("number", [2, 4])
def test_subspace_discriminants_are_scikit_learns(number):
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    from sklearn.ensemble import BaggingClassifier

    one = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
    bagged = BaggingClassifier(one, 30, bootstrap=False, max_features=0.5, random_state=0)
    label = LABEL % number
    output = CLASSIFIERS["subspace-discriminant"](FEATURES, label).predict_proba(ASKED)
    np.testing.assert_allclose(output, bagged.fit(FEATURES, label).predict_proba(ASKED), atol=1e-12)


@pytest.mark.parametrize("number", [2, 4])
@pytest.mark.parametrize(("name", "kernel"), [("linear-svm", "linear"), ("quadratic-svm", "poly")])
def test_machines_are_scikit_learns(name, kernel, number):
    from sklearn.svm import SVC

    label = LABEL % number
    theirs = SVC(kernel=kernel, degree=2, coef0=1.0).fit(FEATURES, label)
    output = CLASSIFIERS[name](FEATURES, label).decision_function(ASKED)
    np.testing.assert_array_equal(output.argmax(axis=1), theirs.predict(ASKED))
    if number > 2:
        np.testing.assert_allclose(output, theirs.decision_function(ASKED), rtol=1e-9)


def test_nearest_neighbours_are_scikit_learns():
    from sklearn.neighbors import KNeighborsRegressor

    ours = NearestNeighbours.fit_regressor(FEATURES, TARGETS)
    theirs = KNeighborsRegressor(ours.count, weights="distance").fit(FEATURES, TARGETS)
    np.testing.assert_allclose(ours.predict(ASKED), theirs.predict(ASKED), rtol=1e-9)
    np.testing.assert_allclose(ours.predict(FEATURES), TARGETS, atol=1e-6)


def test_the_gaussian_process_is_scikit_learns():
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import Matern

    length, noise = _estimate_length_and_noise(FEATURES, TARGETS)
    theirs = GaussianProcessRegressor(Matern(length, nu=1.5), alpha=noise, optimizer=None).fit(FEATURES, TARGETS)
    np.testing.assert_allclose(GaussianProcess.fit(FEATURES, TARGETS).predict(ASKED), theirs.predict(ASKED), atol=1e-7)


def test_few_inducing_points_predict_nearly_the_same(monkeypatch):
    whole = GaussianProcess.fit(FEATURES, TARGETS).predict(ASKED)
    monkeypatch.setattr("jeit.touch.learnt.methods._MAX_CENTRES", 150)
    few = GaussianProcess.fit(FEATURES, TARGETS)
    assert len(few.centres) == 150
    assert np.abs(few.predict(ASKED) - whole).mean() < 0.05


def test_the_most_likely_sharpness_is_found():
    right = RNG.integers(0, 3, 4000)
    odds = RNG.normal(size=(4000, 3))
    odds = np.log(probabilities(odds, 1.0))
    drawn = (probabilities(odds, 1.0).cumsum(axis=1) > RNG.random((4000, 1))).argmax(axis=1)
    assert 0.8 < fit_sharpness(odds, drawn) < 1.25
    assert fit_sharpness(odds, right) < 0.1


@pytest.mark.parametrize("num_rows", [7, 220])
def test_an_epoch_of_a_network_draws_every_row_once(num_rows):
    rows = _draw_batches(num_rows, 3).ravel()
    epochs = rows[: 3 * num_rows].reshape(3, num_rows)
    np.testing.assert_array_equal(np.sort(epochs, axis=1), np.tile(np.arange(num_rows), (3, 1)))
    assert not np.array_equal(epochs[0], epochs[1])
