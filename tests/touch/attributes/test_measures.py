"""Attributes of touch from recordings with known attributes."""

import numpy as np
import pytest

from jeit.touch.attributes import contact_area, detection_threshold, point_localisation, response_times, weber_ratio


@pytest.mark.parametrize("sign", [1, -1])
def test_weber_ratio_of_a_linear_skin_falls_with_the_load(sign):
    """Response s L + noise of deviation d: d / (s L)."""
    random = np.random.default_rng(0)
    loads = np.repeat([1.0, 2.0, 4.0, 8.0], 4000)
    levels, ratio = weber_ratio(loads, sign * 3.0 * loads + random.normal(0, 0.3, len(loads)))
    np.testing.assert_array_equal(levels, [1, 2, 4, 8])
    np.testing.assert_allclose(ratio, 0.1 / levels, rtol=0.05)


def test_a_saturated_response_adds_no_information():
    loads = np.repeat([1.0, 2.0, 3.0, 4.0], 5)
    response = np.minimum(loads, 2.0) + np.tile([-0.1, 0.0, 0.1, 0.0, 0.0], 4)
    assert np.isinf(weber_ratio(loads, response)[1][-1])
    assert np.isfinite(weber_ratio(loads, response)[1][:2]).all()


def test_localisation():
    place = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1], [0.1, 0.1]])
    found = place + np.array([[0.003, 0.004], [0.0, 0.001], [np.nan, np.nan], [0.0, 0.0]])
    result = point_localisation(place, found)
    assert result.mean == pytest.approx(2e-3)
    assert result.most == pytest.approx(5e-3)
    assert result.missed == 0.25


def test_least_detected_amount_is_where_half_of_the_trials_detect():
    amount = np.repeat([0.01, 0.02, 0.03, 0.04], 10)
    result = np.concatenate([np.arange(10) < number for number in (0, 2, 8, 10)])
    assert detection_threshold(amount, result) == pytest.approx(0.025)
    assert detection_threshold(amount, np.ones(40, bool)) == 0.01
    assert detection_threshold(amount, np.zeros(40, bool)) == np.inf
    # The fraction rises with the amount. One failed trial does not change that.
    odd = np.concatenate([np.arange(10) < number for number in (0, 2, 10, 9)])
    assert 0.02 < detection_threshold(amount, odd) < 0.03


def test_areas_and_blur():
    area = np.linspace(1e-4, 1e-3, 7)
    result = contact_area(area, 3e-4 + 0.5 * area)
    assert result == pytest.approx((0.5, 3e-4, 1.0))
    assert contact_area(area, np.full(7, 3e-4)).correlation == 0.0


def test_response_times():
    seconds = np.arange(0.0, 3.0, 0.01)
    rising = np.where(seconds < 1, 1 - np.exp(-seconds / 0.1), 0.0)
    falling = np.where(seconds >= 1, np.exp(-(seconds - 1) / 0.2), 0.0)
    rise, fall = response_times(seconds, rising + falling)
    assert rise == pytest.approx(0.1 * np.log(9), abs=0.02)
    assert fall == pytest.approx(0.2 * np.log(9), abs=0.03)
    assert response_times(seconds, np.minimum(seconds, 1.0))[1] == np.inf


BAD = {
    "loads of zero": (lambda: weber_ratio(np.zeros(9), np.ones(9)), "load must be positive"),
    "few loads": (lambda: weber_ratio([1.0, 2.0] * 3, np.ones(6)), "give 3 loads or more"),
    "once each": (lambda: weber_ratio([1.0, 2.0, 3.0], np.ones(3)), "each 3 times"),
    "NaN": (lambda: weber_ratio([1.0] * 9, [np.nan] * 9), "NaN"),
    "other lengths": (lambda: weber_ratio([1.0] * 9, [1.0] * 8), "as many"),
    "text": (lambda: weber_ratio("a", "b"), "load"),
    "places": (lambda: point_localisation(np.ones((3, 2)), np.ones((2, 2))), "shapes"),
    "nothing found": (lambda: point_localisation(np.ones((3, 2)), np.full((3, 2), np.nan)), "no touch was found"),
    "numbers as detections": (lambda: detection_threshold([1.0, 2.0], [0, 2]), "true or false"),
    "one area": (lambda: contact_area(np.ones(4), np.ones(4)), "two different areas"),
    "times": (lambda: response_times([0.0, 0.0, 1.0], np.ones(3)), "must increase"),
    "nothing touches": (lambda: response_times([0.0, 1.0, 2.0], np.zeros(3)), "nowhere positive"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    call, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        call()
