"""The network on the time course of a touch: it learns what features of the whole touch do not contain, and has the
same outputs in NumPy.
"""

import numpy as np
import pytest
from made_touches import KINDS, touch, touches

from jeit.touch.gestures import GestureModel, touch_features
from jeit.touch.gestures.features import (
    COURSE_FEATURES,
    NUM_SEQUENCE_INSTANTS,
    SEQUENCE_FEATURES,
    SEQUENCE_VALUES,
    course_features,
    sequence_features,
)
from jeit.touch.gestures.gesture_classifiers import feature_forms
from jeit.touch.learnt import neural_networks
from jeit.touch.learnt.neural_networks import TemporalNetwork


def test_the_sequence_is_the_time_course():
    made = [touch(kind, np.random.default_rng(3)) for kind in KINDS]
    found = sequence_features(made)
    assert found.names == SEQUENCE_FEATURES
    assert len(found.units) == found.values.shape[1] == len(found.names)
    whole = len(COURSE_FEATURES)
    np.testing.assert_array_equal(found.values[:, :whole], course_features(made).values)
    places = found.values[:, whole:].reshape(len(made), NUM_SEQUENCE_INSTANTS, len(SEQUENCE_VALUES))
    course = made[2].course  # a stroke, 0.1 m along
    own = dict(zip(SEQUENCE_VALUES, places[2].T, strict=True))
    assert own["change"][[0, -1]] == pytest.approx(course.peak[[0, -1]])
    assert own["share"].max() <= 1
    moved = np.linalg.norm(course.centroid[-1] - course.centroid[0])
    assert own["distance"][-1] == pytest.approx(moved)
    assert own["along"][-1] == pytest.approx(moved, rel=1e-3)
    assert own["along"][0] == 0
    duration = touch_features(made).values[2, 4]
    assert own["speed"].mean() * duration == pytest.approx(moved, rel=0.2)


@pytest.mark.slow
def test_an_order_in_time_is_learnt(monkeypatch):
    """Classes with the same values in rising or falling order: no mean or maximum distinguishes them."""
    rng = np.random.default_rng(0)
    monkeypatch.setattr(neural_networks, "_NUM_COURSE_EPOCHS", 20)
    label = rng.integers(0, 2, 400)
    course = np.sort(rng.normal(size=(400, 8, 2)), axis=1)
    course[label == 1] = course[label == 1, ::-1]
    features = np.hstack([rng.normal(size=(400, 3)), course.reshape(400, -1)])
    network = TemporalNetwork.fit(features[:300], label[:300], whole=3, values=2)
    predicted = network.predict_proba(features[300:])
    np.testing.assert_allclose(predicted.sum(axis=1), 1)
    assert np.mean(predicted.argmax(axis=1) == label[300:]) > 0.95
    again = TemporalNetwork.fit(features[:300], label[:300], whole=3, values=2)
    np.testing.assert_array_equal(network.last, again.last)


def test_convolution_in_numpy_equals_that_of_jax():
    import jax
    import jax.numpy as jnp

    rng = np.random.default_rng(0)
    features = rng.normal(size=(70, 3 + 8 * 2))
    sizes = {"first": (4, 10), "second": (4, 20), "dense": (6, 11), "last": (3, 6)}
    weights = {name: rng.normal(size=(1, *size)) for name, size in sizes.items()}
    weights |= {f"{name}_bias": rng.normal(size=(1, size[0])) for name, size in sizes.items()}
    network = TemporalNetwork(**weights, whole=3, classes_=np.arange(3))

    @jax.jit
    def probabilities(features, first, second):
        kernel = first.reshape(len(first), 5, 2).transpose(0, 2, 1)  # outputs, values, places
        course = features[:, 3:].reshape(70, 8, 2).transpose(0, 2, 1)
        hidden = jax.nn.relu(jax.lax.conv(course, kernel, (1,), "SAME") + network.first_bias[0][:, None])
        kernel = second.reshape(len(second), 5, -1).transpose(0, 2, 1)
        hidden = jax.nn.relu(jax.lax.conv(hidden, kernel, (1,), "SAME") + network.second_bias[0][:, None])
        pooled = jnp.hstack([features[:, :3], hidden.mean(axis=2), hidden.max(axis=2)])
        dense = jax.nn.relu(pooled @ network.dense[0].T + network.dense_bias[0])
        return jax.nn.softmax(dense @ network.last[0].T + network.last_bias[0])

    right = probabilities(features, network.first[0], network.second[0])
    np.testing.assert_allclose(network.predict_proba(features), right, atol=1e-12)


def untrained(features, label, *, whole, values):
    """In place of `TemporalNetwork.fit`: the network as initialised, of the size that training would have."""
    rng, classes = np.random.default_rng(0), np.unique(label)
    sizes = {"first": (4, 5 * values), "second": (4, 20), "dense": (6, whole + 8), "last": (len(classes), 6)}
    weights = {name: 0.1 * rng.normal(size=(2, *size)) for name, size in sizes.items()}
    weights |= {f"{name}_bias": rng.normal(size=(2, size[0])) for name, size in sizes.items()}
    return TemporalNetwork(**weights, whole=whole, classes_=classes)


def test_a_model_with_a_network_is_saved(tmp_path, monkeypatch):
    """Without its training, which `test_an_order_in_time_is_learnt` covers."""
    monkeypatch.setattr(TemporalNetwork, "fit", untrained)
    made, labels, people = touches(people=2)
    model = GestureModel.fit(made, labels, people=people, method="temporal-network")
    assert (model.method, model.form) == ("temporal-network", "sequence")
    model.write(tmp_path / "gestures.skops")
    asked = touches(people=2, seed=5)
    predicted, right = (one.predict(asked[0]) for one in (GestureModel.read(tmp_path / "gestures.skops"), model))
    np.testing.assert_array_equal(predicted.probabilities, right.probabilities)
    assert np.ptp(predicted.probabilities, axis=0).min() > 0


@pytest.mark.slow
def test_gestures_of_people_are_classified():
    made, labels, people = touches(people=2)
    model = GestureModel.fit(made, labels, people=people, method="temporal-network")
    asked = touches(people=3, seed=5)
    assert np.mean(model.predict(asked[0]).gesture == asked[1]) > 0.85


def test_forms():
    made, labels, _ = touches(people=2)
    assert feature_forms("temporal-network") == ("sequence",)
    with pytest.raises(ValueError, match="form: 'temporal-network' takes sequence; 'seven' was requested"):
        GestureModel.fit(made, labels, method="temporal-network", form="seven")
    with pytest.raises(ValueError, match="takes seven or course; 'sequence'"):
        GestureModel.fit(made, labels, method="nearest", form="sequence")
