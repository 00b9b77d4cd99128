"""The challenge's score against its definition with explicit convolutions."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

from jeit.image.rasters import challenge_score


def by_convolution(first, second):
    axis = np.arange(-160, 161)
    window = np.exp(-(axis[:, None] ** 2 + axis**2) / (2 * 80**2))
    ones = fftconvolve(np.ones((256, 256)), window, mode="same")

    def mean(image):
        return fftconvolve(image, window, mode="same") / ones

    a, b = mean(first), mean(second)
    covariance = mean(first * second) - a * b
    variances = mean(first**2) - a**2 + mean(second**2) - b**2
    return np.mean((2 * a * b + 1e-4) * (2 * covariance + 9e-4) / ((a**2 + b**2 + 1e-4) * (variances + 9e-4)))


def test_equals_its_definition():
    generator = np.random.default_rng(0)
    labels, truth = np.zeros((2, 256, 256), np.uint8)
    labels[40:90, 100:180], labels[150:220, 30:90] = 1, 2
    truth[50:100, 110:200], truth[140:200, 40:100] = 1, 2
    truth[generator.random((256, 256)) < 0.02] = 1
    expected = np.mean([by_convolution((labels == k).astype(float), (truth == k).astype(float)) for k in (1, 2)])
    assert challenge_score(labels, truth) == pytest.approx(expected, abs=1e-9)


def test_perfect_and_absent_classes_score_one():
    empty = np.zeros((256, 256), np.uint8)
    assert challenge_score(empty, empty) == pytest.approx(1)
    one = empty.copy()
    one[100:150, 60:120] = 2
    assert challenge_score(one, one) == pytest.approx(1)
    assert 0.4 < challenge_score(empty, one) < 0.8  # half of it is the resistive class, absent from both


@pytest.mark.parametrize("bad", [np.zeros((128, 128), int), np.full((256, 256), 3), np.full((256, 256), 0.5)])
def test_other_images_are_refused(bad):
    with pytest.raises(ValueError, match="256 × 256"):
        challenge_score(bad, np.zeros((256, 256), int))
