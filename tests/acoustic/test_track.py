"""Tracks against a textbook's Kalman filter and smoother, and against the truth of simulated touches."""

import numpy as np
import pytest
from scipy.stats import chi2

from jeit.acoustic import track
from jeit.acoustic.localisation.locations import Locations

NUMBER = 60


def locations(times, position, deviation, located=None, overlap=1.0):
    """Locations with the same standard deviation at every place."""
    frames, d = position.shape
    there = np.ones(frames, bool) if located is None else located
    nothing = np.full(frames, np.nan)
    return Locations(
        times=np.asarray(times, float),
        position=np.where(there[:, None], position, np.nan),
        covariance=np.where(there[:, None, None], deviation**2 * np.eye(d), np.nan),
        strength=np.where(there, 1.0, np.nan),
        status=np.where(there, "touch", "no touch"),
        misfit=nothing,
        freedom=np.zeros(frames, int),
        used=np.ones((frames, 3), bool),
        second=np.full((frames, d), np.nan),
        second_strength=nothing,
        overlap=overlap,
        faults=("", "", ""),
        notes=(),
        name="test",
    )


def textbook(times, measured, covariance, located, density):
    """Kalman filter and Rauch-Tung-Striebel smoother for a random acceleration, step by step."""
    d = measured.shape[1]
    state = np.concatenate([measured[0], np.zeros(d)])
    error = np.diag([1e4 * np.trace(covariance[0])] * d + [0.5**2] * d)
    observe = np.eye(d, 2 * d)
    filtered, predicted, believed = [], [], np.zeros(len(times), bool)
    for k in range(len(times)):
        step = times[k] - times[k - 1] if k else 0.0
        move = np.kron([[1, step], [0, 1]], np.eye(d))
        noise = density * np.kron([[step**3 / 3, step**2 / 2], [step**2 / 2, step]], np.eye(d))
        state, error = move @ state, move @ error @ move.T + noise
        predicted.append((state, error))
        if located[k]:
            inner = observe @ error @ observe.T + covariance[k]
            off = measured[k] - observe @ state
            believed[k] = off @ np.linalg.solve(inner, off) < chi2.isf(1e-4, d)
            if believed[k]:
                gain = error @ observe.T @ np.linalg.inv(inner)
                state, error = state + gain @ off, error - gain @ inner @ gain.T
        filtered.append((state, error))
    smoothed = [filtered[-1]]
    for k in reversed(range(len(times) - 1)):
        move = np.kron([[1, times[k + 1] - times[k]], [0, 1]], np.eye(d))
        gain = filtered[k][1] @ move.T @ np.linalg.inv(predicted[k + 1][1])
        later, later_error = smoothed[0]
        smoothed.insert(
            0,
            (
                filtered[k][0] + gain @ (later - predicted[k + 1][0]),
                filtered[k][1] + gain @ (later_error - predicted[k + 1][1]) @ gain.T,
            ),
        )
    return np.array([one for one, _ in smoothed]), np.array([one for _, one in smoothed]), believed


def moving(d=2, seed=0, deviation=0.003, number=NUMBER, speed=0.2):
    """A straight stroke, every 12.5 ms, with noise."""
    rng = np.random.default_rng(seed)
    times = 1.0 + 0.0125 * np.arange(number)
    heading = rng.normal(size=d)
    truth = (times - times[0])[:, None] * speed * heading / np.linalg.norm(heading) - 0.03
    return times, truth, truth + deviation * rng.normal(size=truth.shape)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("overlap", [1.0, 4.0])
def test_the_textbooks_smoother(d, overlap):
    """Irregular times, missing places, and anisotropic covariances: equal to rounding."""
    rng = np.random.default_rng(1)
    times, _, measured = moving(d)
    times = times + 0.004 * rng.random(NUMBER)
    located = rng.random(NUMBER) > 0.2
    located[[0, -1]] = True
    found = locations(times, measured, 0.003, located, overlap)
    root = 0.003 * rng.normal(size=(NUMBER, d, d))
    covariance = root @ root.transpose(0, 2, 1) + 1e-6 * np.eye(d)
    found.covariance[located] = covariance[located]
    result = track(found, acceleration=0.05)
    wide = overlap * covariance + 1e-14 * np.eye(d)
    states, errors, believed = textbook(times, measured, wide, located, 0.05)
    np.testing.assert_allclose(result.position, states[:, :d], atol=1e-8 * np.abs(states[:, :d]).max())
    np.testing.assert_allclose(result.velocity, states[:, d:], atol=1e-8 * np.abs(states[:, d:]).max())
    np.testing.assert_allclose(result.covariance, errors[:, :d, :d], atol=1e-8 * np.abs(errors[:, :d, :d]).max())
    np.testing.assert_array_equal(result.rejected, located & ~believed)
    assert len(result.touches) == 1


def test_smoothing_reduces_noise():
    """For strokes at constant speed the error is less than half, and the 95 % ellipses contain the truth."""
    raw, smooth, held, speeds = [], [], [], []
    for seed in range(25):
        times, truth, measured = moving(seed=seed)
        result = track(locations(times, measured, 0.003))
        error = result.position - truth
        raw.append(np.mean(np.sum((measured - truth) ** 2, axis=1)))
        smooth.append(np.mean(np.sum(error**2, axis=1)))
        square = np.einsum("fi,fij,fj->f", error, np.linalg.inv(result.covariance), error)
        held.append(np.mean(square < 5.991))
        speeds.append(np.linalg.norm(result.velocity, axis=1).mean())
    assert np.sqrt(np.mean(smooth)) < 0.5 * np.sqrt(np.mean(raw))
    # Errors of adjacent frames are correlated: 25 strokes are 100 or 200 independent places.
    assert 0.9 < np.mean(held) <= 0.995
    assert np.mean(speeds) == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize(
    "density", [pytest.param(1e-3, marks=pytest.mark.slow), 0.1, pytest.param(3.0, marks=pytest.mark.slow)]
)
def test_covariance_is_calibrated_for_random_walks(density):
    """Truths drawn from the model itself, its density known or not."""
    rng = np.random.default_rng(2)
    held = {"known": [], "unknown": []}
    step = 0.0125
    block = np.linalg.cholesky(np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]]))
    for _ in range(20):
        kicks = np.sqrt(density) * np.einsum("ij,fjd->fid", block, rng.normal(size=(NUMBER, 2, 2)))
        place, velocity, truth = np.zeros(2), 0.1 * rng.normal(size=2), []
        for kick in kicks:
            place, velocity = place + step * velocity + kick[0], velocity + kick[1]
            truth.append(place)
        truth = np.array(truth)
        found = locations(step * np.arange(NUMBER), truth + 0.003 * rng.normal(size=truth.shape), 0.003)
        for key, acceleration in (("known", density), ("unknown", None)):
            result = track(found, acceleration=acceleration)
            error = result.position - truth
            held[key].append(np.einsum("fi,fij,fj->f", error, np.linalg.inv(result.covariance), error) < 5.991)
    assert 0.92 < np.mean(held["known"]) < 0.98
    assert 0.88 < np.mean(held["unknown"]) < 0.99


def test_touches_have_their_onset_and_offset():
    """To a frame, and gaps separate touches: three of them, one a single frame."""
    times, truth, measured = moving()
    located = np.zeros(NUMBER, bool)
    located[5:20] = located[35:50] = located[58] = True
    located[[8, 9, 40]] = False  # short pauses do not
    result = track(locations(times, measured, 0.003, located), gap=0.1)
    assert [(one.first, one.last) for one in result.touches] == [(5, 19), (35, 49), (58, 58)]
    for one in result.touches:
        assert (one.onset, one.offset) == (times[one.first], times[one.last])
        part = slice(one.first, one.last + 1)
        assert one.length == pytest.approx(np.linalg.norm(np.diff(result.position[part], axis=0), axis=1).sum())
    covered = np.zeros(NUMBER, bool)
    covered[5:20] = covered[35:50] = covered[58] = True
    for values in (result.position, result.velocity):
        np.testing.assert_array_equal(np.isfinite(values).all(axis=1), covered)
    np.testing.assert_array_equal(np.isfinite(result.covariance).all(axis=(1, 2)), covered)
    # During a pause the track continues.
    assert np.linalg.norm(result.position[[8, 9, 40]] - truth[[8, 9, 40]], axis=1).max() < 0.006
    assert result.touches[-1].length == 0


def test_the_gap_is_a_duration():
    times, _, measured = moving()
    located = np.ones(NUMBER, bool)
    located[20:28] = False  # 0.1125 s from place to place
    found = locations(times, measured, 0.003, located)
    assert len(track(found, gap=0.113).touches) == 1
    assert len(track(found, gap=0.112).touches) == 2


def test_the_length_of_a_stroke():
    """0.2 m/s for 59 frames of 12.5 ms, where noise does not lengthen it."""
    times, truth, _ = moving()
    result = track(locations(times, truth, 1e-4))
    assert result.touches[0].length == pytest.approx(0.2 * 0.0125 * 59, rel=1e-3)
    np.testing.assert_allclose(np.linalg.norm(result.velocity, axis=1), 0.2, rtol=0.01)


@pytest.mark.parametrize("acceleration", [None, 0.1])
def test_an_outlier_is_rejected(acceleration):
    times, truth, measured = moving()
    measured[[15, 40]] += [0.08, -0.06]
    result = track(locations(times, measured, 0.003), acceleration=acceleration)
    np.testing.assert_array_equal(np.flatnonzero(result.rejected), [15, 40])
    assert np.linalg.norm(result.position - truth, axis=1).max() < 0.006


def test_rest_and_fast_motion_are_distinguished():
    """By the most likely density: a finger at rest is smoothed far more than one that changes direction."""
    rng = np.random.default_rng(3)
    times = 0.0125 * np.arange(NUMBER)
    noise = 0.003 * rng.normal(size=(NUMBER, 2))
    circle = 0.03 * np.stack([np.cos(12 * times), np.sin(12 * times)], axis=1)
    rest, turning = (track(locations(times, truth + noise, 0.003)) for truth in (0 * circle, circle))
    middle = slice(10, 50)
    assert np.sqrt(np.mean(rest.position[middle] ** 2)) < 0.0012
    assert np.sqrt(np.mean((turning.position - circle)[middle] ** 2)) < 0.002
    assert np.trace(rest.covariance[30]) < 0.5 * np.trace(turning.covariance[30])


def test_units_and_places_do_not_matter_to_a_given_density():
    """Shifted by a metre, the track is the same, shifted."""
    times, _, measured = moving()
    here = track(locations(times, measured, 0.003), acceleration=0.1)
    there = track(locations(times + 100, measured + np.array([1.0, -2.0]), 0.003), acceleration=0.1)
    np.testing.assert_allclose(there.position - [1.0, -2.0], here.position, atol=1e-9)
    np.testing.assert_allclose(there.velocity, here.velocity, atol=1e-8)


@pytest.mark.parametrize("deviation", [3e-5, 1e-6])
def test_places_of_high_precision(deviation):
    """For strong, steady touches, with different precision along and across: no density loses the covariance to
    rounding.
    """
    times, truth, measured = moving(deviation=deviation, number=200)
    found = locations(times, measured, deviation)
    lean = np.random.default_rng(4).uniform(-0.9, 0.9, 200)
    found.covariance[:, 0, 1] = found.covariance[:, 1, 0] = lean * deviation**2
    result = track(found)
    assert np.linalg.norm(result.position - truth, axis=1).max() < 5 * deviation
    assert (np.linalg.eigvalsh(result.covariance) > 0).all()
    assert np.isfinite(result.touches[0].length)


def test_a_covariance_may_be_singular():
    """On a curved skin it is zero along the normal."""
    times, truth, measured = moving(3)
    normal = np.array([0.0, 0.6, 0.8])
    flat = np.eye(3) - np.outer(normal, normal)
    found = locations(times, truth + (measured - truth) @ flat, 0.003)
    found.covariance[:] = 0.003**2 * flat
    result = track(found)
    assert np.isfinite(result.position).all()
    assert not result.rejected.any()
    raw, smooth = (np.sqrt(np.mean((one - truth) ** 2)) for one in (found.position, result.position))
    assert smooth < 0.6 * raw


def test_no_touch():
    times, _, measured = moving()
    result = track(locations(times, measured, 0.003, np.zeros(NUMBER, bool)))
    assert result.touches == ()
    assert np.isnan(result.position).all()
    assert not result.rejected.any()
    np.testing.assert_array_equal(result.times, times)


def test_one_frame():
    """A tap: the place itself, and an undetermined velocity."""
    result = track(locations([2.0], np.array([[0.01, 0.02]]), 0.003))
    np.testing.assert_allclose(result.position, [[0.01, 0.02]], atol=1e-12)
    np.testing.assert_allclose(np.sqrt(result.covariance[0, 0, 0]), 0.003, rtol=1e-3)
    assert (result.touches[0].onset, result.touches[0].offset, result.touches[0].length) == (2.0, 2.0, 0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gap": 0.0}, "gap"),
        ({"gap": np.nan}, "gap"),
        ({"gap": np.inf}, "gap"),
        ({"acceleration": 0.0}, "acceleration"),
        ({"acceleration": -1.0}, "acceleration"),
        ({"acceleration": np.nan}, "acceleration"),
    ],
)
def test_bad_arguments(options, message):
    times, _, measured = moving()
    with pytest.raises(ValueError, match=message):
        track(locations(times, measured, 0.003), **options)
