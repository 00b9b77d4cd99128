"""Correlations between channels: dead channels are detected and replaced, and unusual frames are reported."""

import numpy as np
import pytest

from jeit.touch.learnt.channels import (
    _CANDIDATE_DIAGONAL_TERMS,
    Channels,
    _leave_one_out_errors,
    _principal_variances,
    choose_channels,
)


def changes(number, seed, *, noise=0.01):
    """Changes of 20 channels with three patterns."""
    rng = np.random.default_rng(seed)
    patterns = np.random.default_rng(5).normal(size=(3, 20))
    return rng.normal(size=(number, 3)) @ patterns + noise * rng.normal(size=(number, 20))


def test_dead_channels_are_found_and_replaced():
    channels, fresh = Channels.learn(changes(200, 0)), changes(50, 1)
    broken = fresh.copy()
    broken[:, 4], broken[:, 11] = 0.0, 3.0
    whole, alive, novelty, _ = channels.complete(broken)
    assert np.mean(~alive[:, [4, 11]]) > 0.9
    assert np.delete(alive, [4, 11], axis=1).mean() > 0.99
    found = ~alive
    np.testing.assert_allclose(whole[found], fresh[found], atol=0.1)
    assert novelty.max() < 2


def test_healthy_channels_excluded_beside_a_dead_one_are_restored():
    """A dead channel distorts the predictions of other channels until it is excluded."""
    rng, mixed = np.random.default_rng(1), np.random.default_rng(7).normal(size=(5, 12))
    given, fresh = (rng.normal(size=(number, 5)) @ mixed for number in (400, 200))
    channels = Channels.learn(given + 0.01 * rng.normal(size=given.shape))
    dead = rng.integers(0, 12, len(fresh))
    fresh[np.arange(len(fresh)), dead] += 3 * given.std(axis=0)[dead]
    _, alive, *_ = channels.complete(fresh)
    assert not alive[np.arange(len(fresh)), dead].any()
    assert np.count_nonzero(~alive) < 1.05 * len(fresh)


def test_missing_readings_are_predicted():
    channels, fresh = Channels.learn(changes(200, 0)), changes(50, 1)
    holed = np.where(np.random.default_rng(0).random(fresh.shape) < 0.1, np.nan, fresh)
    whole, alive, *_ = channels.complete(holed)
    assert not alive[np.isnan(holed)].any()
    np.testing.assert_allclose(whole, fresh, atol=0.06)


def twins(number, seed):
    """Changes of ten channels that depend nonlinearly on six numbers, and of ten duplicates, as reciprocal channels
    are.
    """
    rng = np.random.default_rng(seed)
    mixed = np.tanh(rng.normal(size=(number, 6)) @ np.random.default_rng(6).normal(size=(6, 10)))
    return np.hstack([mixed, mixed]) + 1e-3 * rng.normal(size=(number, 20))


@pytest.mark.parametrize("reading", [np.nan, 9.0, -9.0])
def test_a_channel_is_predicted_by_its_duplicate(reading):
    """Whatever the other patterns predict. The duplicate is not reported as dead, although no other channel confirms
    its reading.
    """
    channels, fresh = Channels.learn(twins(300, 0)), twins(60, 1)
    for channel in range(20):
        broken = fresh.copy()
        broken[:, channel] = reading
        whole, alive, *_ = channels.complete(broken)
        assert not alive[:, channel].any()
        assert np.delete(alive, channel, axis=1).mean() > 0.995
        assert np.abs(whole - fresh)[:, channel].max() < 0.02


def test_healthy_channels_are_not_reported_as_dead_beside_four_dead_ones():
    channels, fresh = Channels.learn(changes(200, 0)), changes(200, 1)
    broken = fresh.copy()
    broken[:, [4, 11, 7, 15]] = [8.0, -8.0, 8.0, 8.0]
    _, alive, *_ = channels.complete(broken)
    assert not alive[:, [4, 11, 7, 15]].any()
    assert np.delete(alive, [4, 11, 7, 15], axis=1).mean() > 0.99


def test_residuals_are_those_of_prediction_by_the_other_channels():
    learnt, other = changes(60, 0, noise=0.3)[:, :6], changes(40, 1, noise=0.3)[:, :6]
    variance, directions = _principal_variances(learnt)
    covariance = (directions * variance) @ directions.T + _CANDIDATE_DIAGONAL_TERMS[8] * np.eye(6)
    left = []
    for one in range(6):
        rest = np.arange(6) != one
        predicted = other[:, rest] @ np.linalg.solve(covariance[np.ix_(rest, rest)], covariance[rest, one])
        left.append(other[:, one] - predicted)
    missed, unpredicted = _leave_one_out_errors(other, variance, directions)[:, 8]
    np.testing.assert_allclose(missed, np.mean(np.square(left), axis=1), rtol=1e-9)
    # The second, divided by the channel's diagonal entry of the precision matrix, is the first.
    np.testing.assert_allclose(
        unpredicted * np.diag(np.linalg.inv(covariance)) ** -1 / _CANDIDATE_DIAGONAL_TERMS[8], missed, rtol=1e-9
    )


def test_frames_with_different_missing_channels_are_completed_as_each_alone():
    channels, fresh = Channels.learn(changes(200, 0)), changes(60, 1)
    fresh[:30, 4], fresh[20:40, 7], fresh[45, 1], fresh[50:, 12] = np.nan, 3.0, np.nan, -4.0
    together = channels.complete(fresh)
    alone = [np.concatenate(parts) for parts in zip(*(channels.complete(one[None]) for one in fresh), strict=True)]
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_unusual_frames_are_reported():
    channels = Channels.learn(changes(200, 0))
    frames = changes(300, 2), np.random.default_rng(3).normal(size=(30, 20)) * 3, 100 * changes(30, 2)
    usual, strange, great = (channels.complete(one)[2] for one in frames)
    assert np.mean(usual > 2) == 0
    assert (great > 2).all()
    assert (strange > 2).mean() > 0.9


def test_uninformative_channels_are_not_used():
    given = np.column_stack([changes(60, 0), np.full(60, 3.0), np.full(60, np.nan)])
    channels = Channels.learn(given)
    np.testing.assert_array_equal(np.flatnonzero(~channels.used), [20, 21])
    assert channels.complete(given)[0].shape == (60, 20)
    with pytest.raises(ValueError, match="no channel changes"):
        Channels.learn(np.ones((20, 4)))


def test_the_most_informative_channels_are_chosen():
    rng = np.random.default_rng(0)
    answers = rng.normal(size=(100, 2))
    scaled = rng.normal(size=(100, 12))
    scaled[:, 7] = answers[:, 0] + 0.1 * scaled[:, 7]
    scaled[:, 2] = answers[:, 1] + 0.2 * scaled[:, 2]
    scaled[:, 3] = scaled[:, 7] + 1e-6 * scaled[:, 3]  # repeats the information of 7
    chosen = choose_channels(scaled, answers, 2)
    assert set(chosen) in ({7, 2}, {3, 2})
