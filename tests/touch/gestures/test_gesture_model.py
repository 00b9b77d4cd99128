"""Gesture models: selected on held-out people, applied, saved in files, and tested on touches that are no gesture."""

import dataclasses
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
from made_touches import KINDS, touch, touches

from jeit.touch.gestures import GestureModel, touch_features
from jeit.touch.gestures.gesture_classifiers import (
    GESTURE_CLASSIFIERS,
    feature_forms,
    fit_logit_boost,
    held_out_odds,
    person_folds,
    random_folds,
)
from jeit.touch.gestures.logit_boost import LogitBoostClassifier
from jeit.touch.reports.touch_watch import draw_gestures


@pytest.fixture(scope="module")
def model():
    made, labels, people = touches()
    return GestureModel.fit(made, labels, people=people, method="quadratic-svm")


def test_unseen_people_are_classified_correctly(model):
    made, labels, _ = touches(people=3, each=6, seed=7)
    predicted = model.predict(made)
    assert np.mean(predicted.gesture == labels) > 0.9
    assert predicted.names == tuple(sorted(KINDS))
    np.testing.assert_allclose(predicted.probabilities.sum(axis=1), 1)
    np.testing.assert_array_equal(predicted.probability, predicted.probabilities.max(axis=1))
    assert np.mean(predicted.unlike) < 0.1
    assert len(model.predict([])) == 0


def test_a_touch_that_is_no_gesture_is_unlike_any(model):
    """A failing electrode changes the image for good: a change a thousand times as strong that does not end."""
    rng = np.random.default_rng(3)
    assert model.predict([touch("push", rng, scale=1000.0)]).unlike.tolist() == [True]
    assert model.predict([touch("push", rng)]).unlike.tolist() == [False]


def test_the_share_of_right_gestures_is_drawn_in_percent(model, monkeypatch):
    titles = []
    monkeypatch.setattr("jeit.touch.plots.plot_confusion", lambda _, *, title, ax: titles.append(title))
    monkeypatch.setattr("jeit.touch.plots.plot_tried", lambda *_, **__: None)
    right = model.standing.right
    wrong = np.where(np.arange(len(right)) % 4 == 0, "none", right)
    drawn = dataclasses.replace(model, standing=dataclasses.replace(model.standing, held_out=wrong))
    draw_gestures(SimpleNamespace(model=drawn))
    assert titles == [f"Gestures: {100 * np.mean(wrong == right):.1f} % right of touches held out"]


@pytest.fixture
def quick_network(monkeypatch):
    """A linear discriminant of whole time courses in place of the network, which `test_temporal_network` covers."""
    monkeypatch.setitem(GESTURE_CLASSIFIERS, "temporal-network", GESTURE_CLASSIFIERS["linear-discriminant"])


@pytest.mark.usefixtures("quick_network")
def test_the_best_method_on_held_out_people_is_selected():
    made, labels, people = touches(people=2, each=3)
    model = GestureModel.fit(made, labels, people=people)
    assert model.standing is not None
    errors = [error for _, error in model.standing.tried]
    assert len(errors) == sum(len(feature_forms(one)) for one in GESTURE_CLASSIFIERS)
    assert errors == sorted(errors)
    assert model.standing.method == f"{model.method} on {model.form}" == model.standing.tried[0][0]
    assert np.mean(model.standing.held_out != model.standing.right) == errors[0]
    assert model.notes == ()


def test_data_of_one_person_are_reported_as_such():
    made, labels, _ = touches(people=1, each=6)
    (note,) = GestureModel.fit(made, labels, people=["a"] * len(made), method="nearest", form="seven").notes
    assert "not on people" in note


@pytest.mark.slow
@pytest.mark.usefixtures("quick_network")
def test_a_class_that_one_person_never_made():
    """Folds without it do not fail, and a class that never occurs is never predicted."""
    made, labels, people = touches(people=3, each=2)
    kept = (labels != "slap") | (people == 0)
    some = [one for one, there in zip(made, kept, strict=True) if there]
    for method in GESTURE_CLASSIFIERS:
        model = GestureModel.fit(some, labels[kept], people=people[kept], method=method, form=feature_forms(method)[0])
        assert "slap" in model.names
        assert not (model.standing.held_out[people[kept] == 0] == "slap").any()


def test_a_forest_of_stumps_is_logit_boost():
    made, labels, _ = touches()
    values = touch_features(made).values
    forest, plain = fit_logit_boost(values, labels), LogitBoostClassifier().fit(values, labels)
    np.testing.assert_allclose(forest.decision_function(values), plain.decision_function(values), atol=1e-9)
    assert forest.classes_.tolist() == plain.classes_.tolist()


def test_folds():
    right = np.repeat([0, 1, 2], [30, 31, 4])
    fold = random_folds(right, 15)
    assert np.bincount(fold).max() - np.bincount(fold).min() <= 1
    assert all(
        np.bincount(fold[right == one], minlength=15).max() <= len(right[right == one]) // 15 + 1 for one in range(3)
    )
    people = np.repeat(["a", "b", "c"], 4)
    assert person_folds(people).tolist() == [*[0] * 4, *[1] * 4, *[2] * 4]
    assert person_folds(people, 2).max() == 1


def test_held_out_touches_are_not_used_for_training():
    """With random labels a valid accuracy is that of chance. A model that had seen the held-out touches would always be
    right.
    """
    rng = np.random.default_rng(0)
    values, right = rng.normal(size=(200, 3)), rng.integers(0, 2, 200)
    odds = held_out_odds("nearest", values, right, random_folds(right, 10))
    assert np.mean(odds.argmax(axis=1) == right) < 0.65


@pytest.mark.parametrize("method", ["logit-boost", "linear-discriminant", "quadratic-svm"])
def test_a_model_is_saved_and_read(method, tmp_path):
    made, labels, people = touches(people=2)
    model = GestureModel.fit(made, labels, people=people, method=method)
    model.write(tmp_path / "gestures.skops")
    again = GestureModel.read(tmp_path / "gestures.skops")
    asked = touches(seed=5)[0]
    one, other = model.predict(asked), again.predict(asked)
    assert again.standing is None
    assert (again.names, again.method, again.form, again.notes) == (model.names, method, model.form, model.notes)
    np.testing.assert_array_equal(one.probabilities, other.probabilities)
    np.testing.assert_array_equal(one.unlike, other.unlike)


def test_other_files_are_refused(model, tmp_path):
    from skops.io import dump

    path = tmp_path / "gestures.skops"
    with pytest.raises(FileNotFoundError, match="no such file"):
        GestureModel.read(path)
    path.write_text("no zip")
    with pytest.raises(ValueError, match="not a gesture model"):
        GestureModel.read(path)
    dump({"kind": "another"}, path)
    with pytest.raises(ValueError, match="another kind"):
        GestureModel.read(path)
    dump({"kind": "a jeit gesture model", "version": 1, "skin": np.random.default_rng}, path)
    with pytest.raises(ValueError, match="which no gesture model does"):
        GestureModel.read(path)
    with pytest.raises(ValueError, match="is a folder"):
        model.write(tmp_path)
    model.write(path)
    assert not [name for name in zipfile.ZipFile(path).namelist() if name.endswith((".pkl", ".pickle"))]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"labels": ["tap"]}, "names of 16 gestures"),
        ({"labels": range(16)}, "names of 16 gestures"),
        ({"labels": ["tap"] * 16}, "two gestures, or more"),
        ({"labels": ["tap"] * 15 + ["pat"]}, "only one touch of 'pat'"),
        ({"people": [1, 2]}, "people must be 16"),
        ({"people": [0] * 8 + [1] * 8, "labels": ["tap"] * 8 + ["pat"] * 8}, "only one gesture"),
        ({"method": "logitboost"}, "did you mean 'logit-boost'"),
        ({"form": "eight"}, "form must be one of"),
        ({"touches": "tap"}, "touches must be a list"),
    ],
)
def test_bad_training_data_are_refused(change, message):
    made, labels, _ = touches(people=2, each=2)
    given = {"touches": made, "labels": labels, "method": "nearest"} | change
    with pytest.raises(ValueError, match=message):
        GestureModel.fit(**given)


def test_probabilities_of_a_support_vector_machine_differ_between_touches():
    """Votes of pairs are nearly the same for all touches. Distances from decision boundaries differ, and are wrong less
    often.
    """
    from sklearn.svm import SVC

    from jeit.touch.learnt.array_models import SupportVectorMachine
    from jeit.touch.learnt.methods import log_odds

    rng = np.random.default_rng(0)
    right = rng.integers(0, 4, 600)
    values = 1.5 * np.eye(4)[right] + rng.normal(size=(600, 4))
    machine = SupportVectorMachine.from_scikit_learn(
        SVC(kernel="poly", degree=2, coef0=1.0).fit(values[:300], right[:300])
    )
    odds = log_odds(machine, values[300:])
    predicted = np.exp(odds - np.logaddexp.reduce(odds, axis=1, keepdims=True))
    sure = predicted.max(axis=1)
    assert np.quantile(sure, 0.9) - np.quantile(sure, 0.1) > 0.2
    correct = predicted.argmax(axis=1) == right[300:]
    assert correct[sure > np.median(sure)].mean() > correct[sure <= np.median(sure)].mean() + 0.1
    voted = machine.decision_function(values[300:]).argmax(axis=1)
    assert np.mean(voted == odds.argmax(axis=1)) > 0.9
