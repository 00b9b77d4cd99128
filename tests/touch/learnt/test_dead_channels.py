"""What channels do together: dead ones are found and replaced, frames unlike any are told."""

import numpy as np
import pytest

from jeit.touch.learnt.channel_choice import choose_channels
from jeit.touch.learnt.channels import Channels


def changes(number, seed, *, noise=0.01):
    """Of 20 channels with three patterns."""
    rng = np.random.default_rng(seed)
    patterns = np.random.default_rng(5).normal(size=(3, 20))
    return rng.normal(size=(number, 3)) @ patterns + noise * rng.normal(size=(number, 20))


def test_dead_channels_are_found_and_replaced():
    channels, fresh = Channels.learn(changes(200, 0)), changes(50, 1)
    broken = fresh.copy()
    broken[:, 4], broken[:, 11] = 0.0, 3.0
    whole, alive, novelty = channels.complete(broken)
    assert np.mean(~alive[:, [4, 11]]) > 0.9
    assert np.delete(alive, [4, 11], axis=1).mean() > 0.99
    found = ~alive
    np.testing.assert_allclose(whole[found], fresh[found], atol=0.1)
    assert novelty.max() < 2


def test_readings_that_are_missing_are_foretold():
    channels, fresh = Channels.learn(changes(200, 0)), changes(50, 1)
    holed = np.where(np.random.default_rng(0).random(fresh.shape) < 0.1, np.nan, fresh)
    whole, alive, _ = channels.complete(holed)
    assert not alive[np.isnan(holed)].any()
    np.testing.assert_allclose(whole, fresh, atol=0.06)


def test_frames_of_another_kind_are_told():
    channels = Channels.learn(changes(200, 0))
    *_, usual = channels.complete(changes(300, 2))
    *_, strange = channels.complete(np.random.default_rng(3).normal(size=(30, 20)) * 3)
    *_, great = channels.complete(100 * changes(30, 2))
    assert np.mean(usual > 2) == 0
    assert (great > 2).all()
    assert (strange > 2).mean() > 0.9


def test_channels_that_say_nothing_are_not_used():
    given = np.column_stack([changes(60, 0), np.full(60, 3.0), np.full(60, np.nan)])
    channels = Channels.learn(given)
    np.testing.assert_array_equal(np.flatnonzero(~channels.used), [20, 21])
    assert channels.complete(given)[0].shape == (60, 20)
    with pytest.raises(ValueError, match="no channel changes"):
        Channels.learn(np.ones((20, 4)))


def test_the_channels_that_tell_most_are_chosen():
    rng = np.random.default_rng(0)
    answers = rng.normal(size=(100, 2))
    scaled = rng.normal(size=(100, 12))
    scaled[:, 7] = answers[:, 0] + 0.1 * scaled[:, 7]
    scaled[:, 2] = answers[:, 1] + 0.2 * scaled[:, 2]
    scaled[:, 3] = scaled[:, 7] + 1e-6 * scaled[:, 3]  # says again what 7 says
    chosen = choose_channels(scaled, answers, 2)
    assert set(chosen) in ({7, 2}, {3, 2})
