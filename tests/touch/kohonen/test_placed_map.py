"""Estimates of places by a map: for one touch and for several, and its files."""

import io
import pickle
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from ringed_sensors import CHANNELS, NOISE, REST, changes, drawn_places, frames_at
from scipy.optimize import linear_sum_assignment

from jeit.touch import PlacedMap, SelfOrganisingMap
from jeit.touch.kohonen import read_map, touches_reported, write_map


def test_places_are_interpolated_between_neurons(placed):
    """16 neurons across 170 mm are 11 mm apart. The errors of estimated places are a tenth of that."""
    places = drawn_places(5, 300)
    estimated, spread = placed.locate(frames_at(places))
    off = np.linalg.norm(estimated - places, axis=1)
    assert np.median(off) < 1.2e-3
    assert np.quantile(off, 0.95) < 5e-3
    ratio = np.sqrt(np.mean(off**2) / np.mean(np.sum(spread**2, axis=1)))
    assert 0.5 < ratio < 2.0


def test_many_presses_are_located_by_the_grid_around_the_winner(placed):
    """Six presses for each neuron: the errors are smaller than those of the nearest neuron, in the worst case too."""
    assert placed.fitted is not None
    places = drawn_places(5, 300)
    ways = placed, replace(placed, fitted=None)
    off, other = (np.linalg.norm(one.locate(frames_at(places))[0] - places, axis=1) for one in ways)
    assert np.median(off) < 0.8 * np.median(other)
    assert off.max() < other.max()


def test_a_grid_without_order_does_not_locate(learnt, pressed, places):
    shuffled = np.random.default_rng(0).permutation(learnt.weights.reshape(256, CHANNELS)).reshape(16, 16, CHANNELS)
    assert PlacedMap.learn(SelfOrganisingMap(shuffled, learnt.scale), pressed, places).fitted is None


def test_places_stay_on_the_skin_for_any_reading(placed):
    random = np.random.default_rng(0)
    estimated, _ = placed.locate(REST + random.normal(0, 1e-3, (200, CHANNELS)))
    assert np.linalg.norm(estimated, axis=1).max() < 0.2


def test_neurons_that_never_win_have_no_place(learnt, places):
    few = PlacedMap.learn(learnt, frames_at(places[:30]), places[:30])
    assert few.placed.sum() <= 30
    assert np.isnan(few.places[~few.placed]).all()
    estimated, _ = few.locate(frames_at(places[:30]))
    assert np.median(np.linalg.norm(estimated - places[:30], axis=1)) < 0.01


@pytest.mark.parametrize("strengths", [(1.0,), (1.0, 0.5), (1.0, 0.5, 0.2)])
def test_simultaneous_touches_are_distinguished(placed, strengths):
    random, right = np.random.default_rng(1), 0
    for _ in range(20):
        where = _apart(random, len(strengths))
        frame = REST + np.array(strengths) @ changes(where) + random.normal(0, NOISE, CHANNELS)
        found = touches_reported(placed, frame, REST)
        if len(found) != len(strengths):
            continue
        distance = np.linalg.norm(where[:, None] - np.array([one.place for one in found]), axis=-1)
        rows, columns = linear_sum_assignment(distance)
        estimated = np.array([found[one].strength for one in columns])
        right += bool((distance[rows, columns] < 0.02).all() and (np.abs(estimated / strengths - 1) < 0.5).all())
    assert right >= (19, 18, 15)[len(strengths) - 1]


def _apart(random, number):
    while True:
        where = drawn_places(int(random.integers(2**31)), number, 0.08)
        if all(np.linalg.norm(where[i] - where[j]) > 0.07 for i in range(number) for j in range(i)):
            return where


def test_no_touch_is_reported_on_an_untouched_skin(placed):
    random = np.random.default_rng(2)
    assert touches_reported(placed, REST, REST) == []
    noisy = [touches_reported(placed, REST + random.normal(0, NOISE, CHANNELS), REST) for _ in range(50)]
    assert sum(map(bool, noisy)) == 0


def test_files_are_complete(learnt, placed, tmp_path):
    write_map(placed, tmp_path / "placed.npz")
    write_map(learnt, tmp_path / "learnt")
    again, plain = read_map(tmp_path / "placed.npz"), read_map(tmp_path / "learnt")
    assert isinstance(again, PlacedMap)
    assert isinstance(plain, SelfOrganisingMap)
    frames = frames_at(drawn_places(6, 5))
    np.testing.assert_array_equal(again.locate(frames)[0], placed.locate(frames)[0])
    np.testing.assert_array_equal(again.locate(frames)[1], placed.locate(frames)[1])
    np.testing.assert_array_equal(plain.activity(frames), learnt.activity(frames))
    fitted = replace(placed, fitted=placed.places + 1e-3)
    write_map(fitted, tmp_path / "fitted.npz")
    np.testing.assert_array_equal(read_map(tmp_path / "fitted.npz").locate(frames)[0], fitted.locate(frames)[0])


class _Payload:
    def __reduce__(self):
        return (exec, ("raise SystemError('it ran')",))


def test_files_execute_nothing(tmp_path):
    """An array of objects in a map's place is refused before it is opened."""
    held = io.BytesIO()
    np.save(held, np.array([_Payload()], dtype=object), allow_pickle=True)
    assert b"exec" in held.getvalue()
    with zipfile.ZipFile(tmp_path / "map.npz", "w") as file:
        file.writestr("weights.npy", held.getvalue())
    with pytest.raises(ValueError, match="is no map"):
        read_map(tmp_path / "map.npz")
    (tmp_path / "pickled.npz").write_bytes(pickle.dumps({"weights": 1}))
    with pytest.raises(ValueError, match="is no map"):
        read_map(tmp_path / "pickled.npz")


def test_missing_and_folders(placed, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_map(tmp_path / "absent.npz")
    with pytest.raises(ValueError, match="is a folder"):
        read_map(tmp_path)
    with pytest.raises(ValueError, match="is a folder"):
        write_map(placed, tmp_path)
    with pytest.raises(ValueError, match="learnt"):
        write_map(np.ones(3), tmp_path / "map.npz")
    np.savez(tmp_path / "other.npz", weights=np.ones((2, 2, 3)))
    with pytest.raises(ValueError, match="no array 'scale'"):
        read_map(tmp_path / "other.npz")
