"""Overlays: brightness of maps, and fading of older maps."""

import numpy as np
import pytest

from jeit.acoustic.localisation.pixels import map_brightness, overlay_images


def maps():
    values = np.random.default_rng(0).random((3, 5, 6)) + 7
    values[:, 0, 0] = np.nan
    return values


def test_brightness_of_a_likelihood_is_relative_to_the_best_pixel():
    values = maps()
    shown = map_brightness(values)
    best = np.nanmin(values, axis=(1, 2))
    expected = np.nan_to_num(np.exp(-(values - best[:, None, None])))
    np.testing.assert_allclose(shown, expected, rtol=1e-13)
    np.testing.assert_allclose(shown.max(axis=(1, 2)), 1)
    assert (shown[:, 0, 0] == 0).all()


def test_brightness_of_the_papers_loss_falls_to_1_in_e_at_its_fraction():
    """In any unit of the loss: twenty pixels of a hundred are brighter than 1/e."""
    values = np.random.default_rng(1).permutation(100.0 + np.arange(100)).reshape(1, 10, 10)
    for scale in (1e-20, 1.0, 1e20):
        shown = map_brightness(scale * values, method="consistency", share=0.2)
        assert (shown > np.exp(-1) * (1 + 1e-9)).sum() == 20
        np.testing.assert_allclose(shown[0], np.exp(-(values[0] - 100) / 20), rtol=1e-9)


def test_brightness_of_maps_without_contrast():
    """A frame without a map is dark. A constant map is bright everywhere."""
    values = np.stack([np.full((4, 4), np.nan), np.full((4, 4), 3.0)])
    for method in ("likelihood", "consistency"):
        shown = map_brightness(values, method=method)
        assert (shown[0] == 0).all()
        assert (shown[1] == 1).all()


@pytest.mark.parametrize(
    ("values", "options", "message"),
    [
        (np.ones((3, 3)), {}, "frames, rows, columns"),
        (np.ones((1, 3, 3)), {"method": "magic"}, "likelihood or consistency"),
        (np.ones((1, 3, 3)), {"share": 0.0}, "share"),
        (np.ones((1, 3, 3)), {"share": 1.0}, "share"),
    ],
)
def test_bad_maps(values, options, message):
    with pytest.raises(ValueError, match=message):
        map_brightness(values, **options)


def test_overlay_fades_with_age():
    """One bright pixel after another: each has the brightness exp(-age / time constant)."""
    times = np.array([0.0, 0.1, 0.15, 1.0])
    images = np.zeros((4, 2, 2))
    for number in range(4):
        images[number, number // 2, number % 2] = 1.0 - 0.1 * number
    seen = overlay_images(images, times, time_constant=0.2)
    for number in range(4):
        for other in range(4):
            age = times[number] - times[other]
            expected = (1 - 0.1 * other) * np.exp(-age / 0.2) if age >= 0 else 0.0
            assert seen[number, other // 2, other % 2] == pytest.approx(expected, rel=1e-12)


def test_a_stationary_source_does_not_accumulate():
    images = np.full((5, 2, 3), 0.6)
    np.testing.assert_allclose(overlay_images(images, np.arange(5.0)), images)
    brighter = images * np.array([1, 0.1, 0.1, 1.2, 0.1])[:, None, None]
    expected = [0.6, 0.6 * np.exp(-1), 0.6 * np.exp(-2), 0.72, 0.72 * np.exp(-1)]
    np.testing.assert_allclose(
        overlay_images(brighter, np.arange(5.0), time_constant=1.0)[:, 1, 1], expected, rtol=1e-12
    )


def test_frames_without_a_map_are_dark_and_older_ones_fade():
    images = np.stack([np.full((2, 2), 0.8), np.full((2, 2), np.nan)])
    kept = images.copy()
    np.testing.assert_allclose(overlay_images(images, [1.0, 2.0], time_constant=0.5)[1], 0.8 * np.exp(-2), rtol=1e-12)
    np.testing.assert_array_equal(images, kept)


def test_irregular_times_do_not_matter():
    """An intermediate dark frame changes nothing later."""
    image = np.random.default_rng(2).random((1, 3, 3))
    direct = overlay_images(np.concatenate([image, 0 * image]), [0.0, 0.7])[-1]
    through = overlay_images(np.concatenate([image, 0 * image, 0 * image]), [0.0, 0.11, 0.7])[-1]
    np.testing.assert_allclose(direct, through, rtol=1e-12)


@pytest.mark.parametrize(
    ("images", "times", "constant", "message"),
    [
        (np.ones((2, 3)), [0, 1], 0.3, "rows, columns"),
        (np.ones((2, 3, 3)), [0, 1, 2], 0.3, r"\(F,\)"),
        (np.ones((0, 3, 3)), [], 0.3, r"\(F,\)"),
        (np.ones((2, 3, 3)), [0, 0], 0.3, "increase"),
        (np.ones((2, 3, 3)), [1, 0], 0.3, "increase"),
        (np.ones((2, 3, 3)), [0, np.nan], 0.3, "increase"),
        (np.ones((2, 3, 3)), [0, 1], 0.0, "time_constant"),
        (np.ones((2, 3, 3)), [0, 1], np.inf, "time_constant"),
    ],
)
def test_bad_overlays(images, times, constant, message):
    with pytest.raises(ValueError, match=message):
        overlay_images(images, times, time_constant=constant)
