"""Frames with missing channels, and frames that no touch produces."""

import numpy as np
import pytest

from jeit.touch.networks.image_network import fill_missing
from jeit.touch.simulate import DiscIndenter, Indent, relative_changes

PLACE = (0.012, -0.02)


@pytest.fixture(scope="module")
def change(small_skin, resting):
    return relative_changes(small_skin, [[Indent(DiscIndenter(0.02), 5e-3, PLACE)]], resting)


def test_missing_channels_are_replaced_by_their_expectation():
    """The mean of a normal distribution, conditional on some of its components, computed from the inverse of its
    covariance.
    """
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(6, 6))
    covariance, noise = factor @ factor.T, 0.3
    values = rng.normal(size=(3, 6))
    values[0, [1, 4]] = values[2, 0] = np.nan
    found = fill_missing(values, covariance, noise)
    whole = np.linalg.inv(covariance + noise**2 * np.eye(6))
    for row, given in zip(found, values, strict=True):
        lost = np.isnan(given)
        np.testing.assert_array_equal(row[~lost], given[~lost])
        # Λ₂₂ (x₂ − µ₂) + Λ₂₁ x₁ = 0 at the mean.
        np.testing.assert_allclose(whole[lost] @ row, 0, atol=1e-9)


def test_a_missing_electrode(small_skin, imaging, change):
    """All channels of one electrode are missing: the touch stays at its place, whereas zeros shift it."""
    network, protocol = imaging[1], small_skin.model.protocol
    drive, measured = np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement)
    for electrode in (5, 10):
        lost = (drive[:, electrode] != 0) | (measured[:, electrode] != 0)
        frame = np.where(lost, np.nan, 1 + change[0])
        whole, without = (network.depth(one, np.ones(94)) for one in (1 + change[0], frame))
        assert np.isfinite(without).all()
        zeros = network.depth(np.where(lost, 1.0, frame), np.ones(94))
        assert np.linalg.norm(without - whole) < 0.7 * np.linalg.norm(zeros - whole)


def test_frames_that_no_touch_produces(imaging, change):
    """Reversed signs and other units are reported. A touch is not doubted, nor is an untouched frame."""
    network = imaging[1]

    def doubted(frames):
        return network.doubts(frames, network.share(frames))

    assert doubted(np.concatenate([change, 0 * change])) == ["", ""]
    assert "not that of a touch" in doubted(-change)[0]
    deep = float(network.share(40 * change).max()) * 10
    assert doubted(40 * change)[0].startswith(f"{deep:.3g} mm deep, and the skin is 10 mm thick")
    # A map that is indented more than it bulges is not one of a skin pushed outwards.
    share = np.zeros((2, *network.share(change).shape[1:]))
    share[0, 2, 3], share[0, 5, 5] = 0.4, -0.3
    share[1] = -share[0]
    indented, pushed = network.doubts(np.concatenate([-change, -change]), share)
    assert indented == ""
    assert "a skin pushed outwards" in pushed
    with pytest.raises(ValueError, match="times those of the reference; are units the same"):
        network.depth(1e3 * np.ones(94), np.ones(94))


def test_noise_alone_is_not_deep(imaging, change):
    network = imaging[1]
    noise = network.noise * np.random.default_rng(3).normal(size=(20, 94))
    assert network.thickness * network.share(noise).max() < 1.5 * network.floor
    assert network.thickness * network.share(change).max() > 3 * network.floor
