"""Segmentation of rasters into background, resistive and conductive regions."""

import numpy as np
import pytest

from jeit.image import segment

Y, X = np.mgrid[-1:1:200j, -1:1:200j]
INSIDE = X**2 + Y**2 < 1


def blob(x, y, radius, blur=0.05):
    """A disc whose edge has half the height at `radius`."""
    return 0.5 - 0.5 * np.tanh((np.hypot(X - x, Y - y) - radius) / (2 * blur))


def image_of(*blobs):
    return np.where(INSIDE, sum(height * blob(*where) for height, where in blobs), np.nan)


def test_two_discs_of_either_sign():
    labels = segment(image_of((1.0, (0.4, 0, 0.25)), (-2.0, (-0.4, 0.1, 0.2))))
    assert labels.dtype == np.uint8
    conductive, resistive = np.hypot(X - 0.4, Y) < 0.25, np.hypot(X + 0.4, Y - 0.1) < 0.2
    assert ((labels == 2) != conductive).mean() < 0.003
    assert ((labels == 1) != resistive).mean() < 0.003


def test_weak_signs_and_small_islands_are_artefacts():
    labels = segment(image_of((1.0, (0.3, 0, 0.3)), (-0.2, (-0.4, 0, 0.2)), (1.0, (-0.5, 0.5, 0.02, 0.001))))
    assert set(np.unique(labels)) == {0, 2}
    assert not labels[(X < -0.3)].any()


def test_a_zero_image_is_background():
    assert not segment(np.where(INSIDE, 0.0, np.nan)).any()


def test_outside_is_background():
    assert not segment(image_of((1.0, (0.9, 0, 0.4))))[~INSIDE].any()


@pytest.mark.parametrize(
    ("image", "options", "message"),
    [
        (np.zeros(5), {}, "rows, columns"),
        (np.full((4, 4), np.nan), {}, "no pixel"),
        (np.ones((4, 4)) * 1j, {}, "real"),
        (np.ones((4, 4)), {"level": 1.0}, "shares"),
        (np.ones((4, 4)), {"least_peak": -0.1}, "shares"),
    ],
)
def test_bad_input(image, options, message):
    with pytest.raises(ValueError, match=message):
        segment(image, **options)
