"""A trained map: activity, winners, quality, and refused input."""

import jax
import numpy as np
import pytest
from minisom import MiniSom
from ringed_sensors import CHANNELS, REST, drawn_places, frames_at

from jeit.touch import PlacedMap, SelfOrganisingMap
from jeit.touch.kohonen import MapSchedule, drawn_map, fit_maps, map_quality, neuron_shares, read_map, touches_reported


def test_a_neurons_own_frame_activates_it_fully(learnt):
    activity = learnt.activity(learnt.weights[3, 5])
    assert activity.shape == (1, 16, 16)
    assert activity[0, 3, 5] == pytest.approx(1.0, abs=1e-5)
    assert learnt.winners(learnt.weights[3, 5]).tolist() == [[3, 5]]
    assert activity[0].argmax() == 3 * 16 + 5


def test_activity_is_a_half_at_the_scale(learnt):
    off = np.zeros(CHANNELS)
    off[0] = learnt.scale
    assert learnt.activity(learnt.weights[0, 0] + off)[0, 0, 0] == pytest.approx(0.5)


def test_distances_are_euclidean(learnt):
    frames = frames_at(drawn_places(1, 7))
    plain = np.linalg.norm(frames[:, None, None] - learnt.weights, axis=-1)
    np.testing.assert_allclose(learnt.distances(frames), plain, atol=1e-8)


def test_quality_is_that_of_minisom_and_the_order_is_kept(learnt, places):
    frames = frames_at(places)
    quality = map_quality(learnt, frames)
    oracle = MiniSom(16, 16, CHANNELS)
    oracle._weights = learnt.weights.copy()
    assert quality.quantisation_error == pytest.approx(oracle.quantization_error(frames), rel=1e-6)
    assert quality.topographic_error == pytest.approx(oracle.topographic_error(frames), abs=1e-3)
    assert quality.topographic_error < 0.1
    assert quality.trustworthiness > 0.97


def test_an_unordered_map_is_reported(learnt, places):
    random = np.random.default_rng(0)
    shuffled = random.permutation(learnt.weights.reshape(256, CHANNELS)).reshape(16, 16, CHANNELS)
    quality = map_quality(SelfOrganisingMap(shuffled, learnt.scale), frames_at(places))
    assert quality.topographic_error > 0.9
    assert quality.trustworthiness < 0.8


def test_drawn_neighbours_stay_together(learnt):
    drawn = drawn_map(learnt, jax.random.key(0))
    assert drawn.shape == (16, 16, 2)
    sides = np.linalg.norm(np.diff(drawn, axis=0), axis=2), np.linalg.norm(np.diff(drawn, axis=1), axis=2)
    random = np.random.default_rng(0).permutation(drawn.reshape(-1, 2))
    assert np.median(np.concatenate([one.ravel() for one in sides])) < 0.25 * np.median(
        np.linalg.norm(np.diff(random, axis=0), axis=1)
    )
    np.testing.assert_array_equal(drawn, drawn_map(learnt, jax.random.key(0)))


FRAMES = frames_at(drawn_places(2, 40))
KEY = jax.random.key(0)
BROKEN = np.where(np.arange(CHANNELS) == 3, np.nan, FRAMES)
BAD = {
    "NaN": (lambda s: SelfOrganisingMap.fit(BROKEN, KEY), "40 frames of 40 have NaN"),
    "text": (lambda s: SelfOrganisingMap.fit("frames.npz", KEY), "frames"),
    "all the same": (lambda s: SelfOrganisingMap.fit(np.ones((10, 3)), KEY), "all the same"),
    "two frames": (lambda s: SelfOrganisingMap.fit(FRAMES[:2], KEY), "2 frames"),
    "cube": (lambda s: SelfOrganisingMap.fit(np.ones((3, 3, 3)), KEY), "shape"),
    "a seed": (lambda s: SelfOrganisingMap.fit(FRAMES, 0), "key"),
    "one neuron": (lambda s: SelfOrganisingMap.fit(FRAMES, KEY, shape=(1, 1)), "two neurons or more"),
    "one number": (lambda s: SelfOrganisingMap.fit(FRAMES, KEY, shape=16), "rows and columns"),
    "no schedule": (lambda s: SelfOrganisingMap.fit(FRAMES, KEY, schedule=100), "schedule"),
    "no scale": (lambda s: SelfOrganisingMap.fit(FRAMES, KEY, schedule=MapSchedule(10, 0), scale=0.0), "scale"),
    "no keys": (lambda s: fit_maps(FRAMES, []), "one at least"),
    "other lengths": (lambda s: fit_maps(FRAMES, [KEY], schedules=[MapSchedule(9), MapSchedule(8)]), "as many frames"),
    "weights": (lambda s: SelfOrganisingMap(np.full((2, 2, 3), np.nan), 1.0), "weights must be finite"),
    "other channels": (lambda s: s["learnt"].activity(np.ones((2, 207))), "207 channels"),
    "few to compare": (lambda s: map_quality(s["learnt"], FRAMES[:20]), "too few"),
    "no map": (lambda s: map_quality(FRAMES, FRAMES), "learnt"),
    "draw frames": (lambda s: drawn_map(FRAMES, KEY), "learnt"),
    "places of a few": (lambda s: PlacedMap.learn(s["learnt"], FRAMES[:5], np.ones((5, 2))), "10 presses"),
    "places the same": (lambda s: PlacedMap.learn(s["learnt"], FRAMES, np.ones((40, 2))), "different places"),
    "places missing": (lambda s: PlacedMap.learn(s["learnt"], FRAMES, np.ones((39, 2))), "40, d"),
    "locate NaN": (lambda s: s["placed"].locate(BROKEN), "NaN"),
    "touches of many": (lambda s: touches_reported(s["placed"], FRAMES, REST), "one finite frame"),
    "touches of NaN": (lambda s: touches_reported(s["placed"], BROKEN[0], REST), "NaN"),
    "touches, no rest": (lambda s: neuron_shares(s["placed"], FRAMES[0], REST[:5]), "reference"),
    "touches of a map": (lambda s: touches_reported(s["learnt"], FRAMES[0], REST), "placed"),
    "a share": (lambda s: touches_reported(s["placed"], FRAMES[0], REST, least=1.5), "least"),
    "a distance": (lambda s: touches_reported(s["placed"], FRAMES[0], REST, apart=-1.0), "apart"),
    "a file": (lambda s: read_map(__file__), "is no map"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name, learnt, placed):
    call, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        call({"learnt": learnt, "placed": placed})
