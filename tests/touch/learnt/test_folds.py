"""Folds of cross-validation: intervals of time that split no group."""

import numpy as np
from scipy.spatial import KDTree

from jeit.touch.learnt.learn_from_presses import time_folds

RNG = np.random.default_rng(0)
FRAMES = RNG.normal(size=(60, 4))


def test_folds_are_intervals_of_time():
    folds, notes = time_folds(FRAMES, positions=RNG.normal(size=(60, 2)))
    np.testing.assert_array_equal(folds, np.repeat(np.arange(5), 12))
    assert notes == ()
    time = RNG.permutation(60).astype(float)
    np.testing.assert_array_equal(time_folds(FRAMES, None, time)[0][np.argsort(time)], np.repeat(np.arange(5), 12))


def test_groups_are_not_split():
    group = RNG.permutation(np.repeat(["a", "b", "c"], 20))
    folds, _ = time_folds(FRAMES, group)
    assert all(len(set(folds[group == one])) == 1 for one in "abc")
    assert len(set(folds)) == 3
    assert "one group" in time_folds(FRAMES, np.repeat("a", 60))[1][0]


def test_copies_are_not_split():
    copied = FRAMES.copy()
    copied[[30, 59]] = copied[0]
    folds, notes = time_folds(copied)
    assert len({folds[0], folds[30], folds[59]}) == 1
    assert "2 frames are copies" in notes[0]


def test_places_pressed_in_sequence_are_in_all_folds():
    """A raster pressed line by line: folds of intervals would hold out whole parts of the skin."""
    places = np.stack(np.meshgrid(np.arange(20.0), np.arange(15.0), indexing="ij"), axis=-1).reshape(-1, 2)
    folds, notes = time_folds(RNG.normal(size=(300, 4)), positions=places)
    apart = [KDTree(places[folds != one]).query(places[folds == one])[0].mean() for one in range(5)]
    assert max(apart) < 1.6  # with intervals of four lines the average would be 2.5 lines
    assert "short intervals" in notes[0]


def test_kinds_pressed_in_sequence_are_in_all_folds():
    kinds = np.repeat(np.arange(4), 15)
    folds, _ = time_folds(FRAMES, kinds=kinds)
    assert all(set(kinds[folds != one]) == {0, 1, 2, 3} for one in range(5))


def test_keys_pressed_in_sequence_are_in_all_folds():
    keys = np.repeat(np.eye(5, dtype=bool), 12, axis=0)
    folds, notes = time_folds(FRAMES, kinds=keys)
    assert all(keys[folds != one].any(axis=0).all() for one in range(5))
    assert "keys were given one after the other" in notes[0]


def test_places_repeated_in_any_order_are_not_taken_for_a_sequence():
    """No press at a held-out place is in the training data, in whatever order they were pressed."""
    places = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    places = places[np.random.default_rng(2).integers(0, 25, 300)]
    folds, notes = time_folds(RNG.normal(size=(300, 4)), positions=places)
    assert all(len({*folds[(places == one).all(axis=1)]}) == 1 for one in np.unique(places, axis=0))
    assert len(notes) == 1
    assert "25 places were repeated" in notes[0]
