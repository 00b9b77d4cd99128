"""Frames that are imaged one after the other against one reference: mesh and calibration are computed once, and the
images equal those that are computed anew."""

import numpy as np
import pytest
from test_chosen_frame import EMPTY, FULL, SETTINGS, tank

from jeit.imaging import image_difference
from jeit.imaging.calibration import keep_last_result


def test_the_calibration_is_kept_for_the_next_frame_and_no_longer():
    frame = tank(2 * EMPTY - FULL)
    first = image_difference(tank(FULL), tank(EMPTY), SETTINGS)
    second = image_difference(frame, tank(EMPTY), SETTINGS)
    assert second.calibration is first.calibration
    other = image_difference(frame, tank(2 * EMPTY), SETTINGS)
    assert abs(other.calibration.conductivity / first.calibration.conductivity - 0.5) < 0.01
    anew = image_difference(frame, tank(EMPTY), SETTINGS)
    assert anew.calibration is not first.calibration
    np.testing.assert_array_equal(anew.change, second.change)


def test_arguments_are_compared_by_value():
    calls = []

    @keep_last_result
    def total(values, scale, name=None):
        calls.append(name)
        return scale * np.sum(values)

    values = np.arange(3.0)
    assert total(values, 2) == total(np.arange(3.0), 2) == 6
    assert len(calls) == 1
    values[0] = 1  # the caller may modify an array in place
    assert total(values, 2) == 8
    assert total(values, 2, name="other") == 8
    assert total(values.astype(np.float32), 2, name="other") == 8
    assert total(values[:2], 2, name="other") == 4
    assert len(calls) == 5
    masked = np.array([np.nan, 1.0])
    assert np.isnan(total(masked, 2))
    assert np.isnan(total(masked.copy(), 2))
    assert len(calls) == 6


def test_an_error_is_raised_again():
    calls = []

    @keep_last_result
    def reciprocal(value):
        calls.append(value)
        return 1 / value

    assert reciprocal(2) == 0.5
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            reciprocal(0)
    assert calls == [2, 0, 0]
