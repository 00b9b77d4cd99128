"""Noise measured from repeated frames."""

import numpy as np
import pytest

from jeit.inverse.channels import repeated_noise

TRUE = np.geomspace(1e-6, 1e-3, 30)


def draw(count, seed=0):
    return 0.1 + TRUE * np.random.default_rng(seed).normal(size=(count, TRUE.size))


def test_many_frames_determine_the_noise_of_every_channel():
    np.testing.assert_allclose(repeated_noise(draw(4000), prior_frames=1.0), TRUE, rtol=0.05, atol=2e-6)


def test_few_frames_are_shrunk_towards_the_typical_noise():
    found = np.stack([repeated_noise(draw(3, seed)) for seed in range(200)])
    plain = np.stack([draw(3, seed).std(axis=0, ddof=1) for seed in range(200)])
    middle = slice(12, 18)  # where the typical value is about right
    assert np.log(found[:, middle]).std() < 0.6 * np.log(plain[:, middle]).std()


def test_masked_voltages_do_not_count():
    frames = draw(50)
    mask = np.ones(frames.shape, bool)
    mask[10, 3] = mask[1:, 4] = False
    frames[~mask] = np.nan
    found = repeated_noise(frames, mask)
    assert found[4] == 1
    assert np.isfinite(found).all()
    kept = np.delete(draw(50)[:, 3], 10)
    np.testing.assert_allclose(repeated_noise(frames, mask, prior_frames=0.0)[3], kept.std(ddof=1), rtol=1e-9)


@pytest.mark.parametrize(
    ("frames", "mask", "message"),
    [
        (np.ones(5), None, "two repeated"),
        (np.ones((1, 5)), None, "two repeated"),
        (np.ones((3, 5)), None, "alike"),
        (np.full((3, 5), np.nan), None, "NaN"),
        (np.ones((3, 5)), np.ones(4, bool), "booleans"),
        (1j * np.ones((3, 5)), None, "complex"),
        (np.ones((3, 5)), np.zeros(5, bool), "leaves no channel"),
    ],
)
def test_bad_input(frames, mask, message):
    with pytest.raises(ValueError, match=message):
        repeated_noise(frames, mask)


@pytest.mark.parametrize("prior_frames", [-5.0, np.nan, np.inf])
def test_invalid_numbers_of_previous_frames(prior_frames):
    with pytest.raises(ValueError, match="prior_frames"):
        repeated_noise(draw(5), prior_frames=prior_frames)
