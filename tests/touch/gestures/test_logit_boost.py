"""LogitBoost: a scikit-learn estimator, equal to a computation by hand, whose likelihood never falls."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.utils.estimator_checks import check_estimator

from jeit.touch import LogitBoostClassifier


def made(number=60, features=3, classes=3, seed=0, noise=0.5):
    rng = np.random.default_rng(seed)
    label = np.arange(number) % classes
    return rng.normal(size=(number, features)) * noise + np.eye(features)[label % features], label


def by_hand(x, label, rounds):
    """LogitBoost in plain NumPy with all thresholds: the probabilities after each round."""
    classes = np.unique(label)
    right = (label[:, None] == classes).astype(float)
    score, stages = np.zeros(right.shape), []
    share = (len(classes) - 1) / len(classes)
    for _ in range(rounds):
        p = np.exp(score) / np.exp(score).sum(axis=1, keepdims=True)
        fitted = np.zeros(score.shape)
        for j in range(len(classes)):
            z = np.clip(np.where(right[:, j] == 1, 1 / p[:, j], -1 / (1 - p[:, j])), -3, 3)
            w = (right[:, j] - p[:, j]) / z
            best = np.inf
            for feature in x.T:
                for low, high in zip(np.unique(feature)[:-1], np.unique(feature)[1:], strict=True):
                    below = feature <= (low + high) / 2
                    leaf_means = np.where(below, *(np.sum((w * z)[one]) / np.sum(w[one]) for one in (below, ~below)))
                    error = np.sum(w * (z - leaf_means) ** 2)
                    if error < best - 1e-12:
                        best, fitted[:, j] = error, leaf_means
        score = score + share * (fitted - fitted.mean(axis=1, keepdims=True))
        stages.append(np.exp(score) / np.exp(score).sum(axis=1, keepdims=True))
    return stages


def test_it_is_a_scikit_learn_estimator():
    check_estimator(LogitBoostClassifier(), on_skip=None)


def test_two_samples_computed_by_hand():
    """p = ½, z = ±2, so f = ±2, and F grows by ½ · 2 = 1: p = e / (e + 1/e), then the same once more."""
    model = LogitBoostClassifier(2).fit([[0.0], [1.0]], ["a", "b"])
    first, second = model.staged_predict_proba([[0.0], [1.0]])
    assert first[0, 0] == pytest.approx(np.e / (np.e + 1 / np.e), rel=1e-12)
    p = first[0, 0]
    odds = 2 * (1 + 1 / (2 * p))  # z = 1 / p for one sample, and minus that for the other
    assert second[0, 0] == pytest.approx(1 / (1 + np.exp(-odds)), rel=1e-12)
    assert model.decision_function([[1.0]]) == pytest.approx(odds)
    assert model.step_.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("classes", [2, 3, 5])
def test_result_equals_plain_numpy(classes):
    x, label = made(classes=classes, features=5, seed=classes)
    x = x.astype(np.float32).astype(float)
    model = LogitBoostClassifier(6).fit(x, label)
    stages = by_hand(x, label, 6)
    for found, right in zip(model.staged_predict_proba(x), stages, strict=True):
        np.testing.assert_allclose(found, right, atol=1e-9)
    assert (model.step_ == 1).all()
    np.testing.assert_array_equal(model.predict(x), stages[-1].argmax(axis=1))
    np.testing.assert_allclose(model.predict_proba(x).sum(axis=1), 1)


def test_responses_are_clipped():
    """For a class with a sixth of the samples the first response would be 6. It is clipped to 3, and no leaf's mean
    exceeds that.
    """
    x, label = np.eye(6).repeat(4, axis=0), np.arange(6).repeat(4)
    model = LogitBoostClassifier(1).fit(x, label)
    assert np.maximum(model.above_, model.below_).max() == pytest.approx(3 * 5 / 6)


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    number=st.integers(6, 40),
    classes=st.integers(2, 5),
    rate=st.sampled_from([1.0, 0.5]),
    noise=st.sampled_from([0.0, 0.1, 3.0]),
)
def test_the_likelihood_never_falls(seed, number, classes, rate, noise):
    x, label = made(number, 2, classes, seed, noise)
    model = LogitBoostClassifier(25, learning_rate=rate).fit(x, label)
    assert (np.diff(model.log_likelihood_) >= 0).all()
    chosen = model.predict_proba(x)[np.arange(number), label]
    assert np.mean(np.log(chosen)) == pytest.approx(model.log_likelihood_[-1], abs=1e-6)


def test_an_overlong_step_is_halved(monkeypatch):
    """Without clipped responses misclassified samples shift their leaf too far."""
    from jeit.touch.gestures import logit_boost

    monkeypatch.setattr(logit_boost, "_MAX_RESPONSE", 1e9)
    rng = np.random.default_rng(1)
    x = rng.normal(size=(60, 2))
    label = x[:, 0] > 0
    wrong = rng.choice(60, 3, replace=False)
    label[wrong] = ~label[wrong]
    model = LogitBoostClassifier(40).fit(x, label)
    assert model.step_.min() < 1
    assert (np.diff(model.log_likelihood_) >= 0).all()


def test_importing_jeit_does_not_import_scikit_learn():
    program = "import sys, jeit.touch; assert 'sklearn' not in sys.modules; print(len(jeit.touch.__all__))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_a_constant_feature_adds_no_information():
    model = LogitBoostClassifier().fit(np.zeros((6, 2)), [0, 0, 0, 1, 1, 1])
    np.testing.assert_allclose(model.predict_proba([[5.0, -1.0]]), [[0.5, 0.5]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"y": ["a"] * 4}, "one class only, 'a'"),
        ({"X": [[np.nan], [1.0], [2.0], [3.0]]}, "NaN"),
        ({"y": ["a", "b"]}, "inconsistent numbers of samples"),
        ({"n_estimators": 0}, "n_estimators must be a number of rounds"),
        ({"learning_rate": 1.5}, "learning_rate must be above 0"),
    ],
)
def test_bad_training_data_are_refused(change, message):
    given = {"X": [[0.0], [1.0], [2.0], [3.0]], "y": ["a", "a", "b", "b"]}
    settings = {name: value for name, value in change.items() if name not in given}
    given |= {name: value for name, value in change.items() if name in given}
    with pytest.raises(ValueError, match=message):
        LogitBoostClassifier(**settings).fit(**given)
