"""Changes whitened by the variation between frames of one press."""

import numpy as np

from jeit.touch import LearntSkin, Presses
from jeit.touch.learnt.features import WhitenedChanges, are_repeated


def record(number, seed):
    """Presses at 36 places on 12 channels, with a varying temperature whose effect on the changes is ten times as
    large.
    """
    rng, skin = np.random.default_rng(seed), np.random.default_rng(7)
    grid = np.stack(np.meshgrid(np.linspace(-0.04, 0.04, 6), np.linspace(-0.04, 0.04, 6)), axis=-1).reshape(-1, 2)
    centres, temperature = skin.uniform(-0.05, 0.05, (12, 2)), skin.normal(size=(2, 12))
    place = grid[rng.integers(0, 36, number)]
    response = np.exp(-np.sum((place[:, None] - centres) ** 2, axis=-1) / 0.05**2)
    return response + 10 * rng.normal(size=(number, 2)) @ temperature + 1e-3 * rng.normal(size=(number, 12)), place


def test_variation_between_repeated_frames_is_scaled_to_one():
    rng = np.random.default_rng(0)
    group, mixed = rng.integers(0, 36, 4000), rng.normal(size=(6, 6)) * [1, 2, 3, 1, 2, 3]
    changes = 5 * rng.normal(size=(36, 6))[group] + rng.normal(size=(4000, 6)) @ mixed
    white = WhitenedChanges.learn(changes, group[:, None].astype(float))(changes)
    left = white - np.stack([white[group == one].mean(axis=0) for one in range(36)])[group]
    np.testing.assert_allclose(left.T @ left / (4000 - 36), np.eye(6), atol=0.15)
    few = WhitenedChanges.learn(changes[:40], group[:40, None].astype(float))  # fewer repeated frames than channels
    assert np.isfinite(few.root).all()


def test_frames_without_repetitions_are_only_scaled():
    changes, _ = record(30, 0)
    root = WhitenedChanges.learn(changes, np.arange(30.0)[:, None]).root
    np.testing.assert_allclose(root, np.diag(1 / changes.std(axis=0)))
    assert not are_repeated(np.arange(30.0)[:, None])
    assert are_repeated(np.repeat(np.arange(20.0), 2)[:, None])
    assert not are_repeated(np.append(np.repeat(np.arange(19.0), 2), [50.0, 51.0])[:, None])


def test_places_under_a_varying_temperature():
    """They are lost for nearest neighbours in the changes, but not after whitening."""
    changes, place = record(400, 0)
    skin = LearntSkin.fit(Presses.create(changes, positions=place), method="neighbours")
    assert skin.standing["place"].method == "neighbours on whitened"
    tried = dict(skin.standing["place"].tried)
    assert tried["neighbours on whitened"] < 0.5 * min(
        tried[f"neighbours on {form}"] for form in ("differences", "shapes")
    )
    fresh, right = record(100, 1)
    assert np.nanmean(np.linalg.norm(skin.predict(fresh).position - right, axis=1)) < 0.012
