"""Quality of a live stream, against frames with known noise, dead and drifting electrodes."""

import numpy as np
import pytest
from small_sensor import CHANNELS, NOISE, PROTOCOL, measured, noisy, rest

from jeit.live.pictures import LiveFrame
from jeit.live.quality import Quality, QualityWatch, RateWatch, change_during


def looked(frames, watch=None, times=1):
    watch = QualityWatch(measured()) if watch is None else watch
    quality = watch.assess()
    for _ in range(times):
        for number, values in enumerate(frames):
            watch.add(LiveFrame(number, 0.0, 0.0, values))
        quality = watch.assess()
    return quality


def reciprocity_of(frames):
    found = looked(frames).reciprocity
    assert found is not None
    return found


def test_noise_equals_that_of_the_frames_also_during_motion():
    random = np.random.default_rng(0)
    moving = 0.2 * np.sin(0.05 * np.arange(32))[:, None] * random.uniform(size=CHANNELS) * rest()
    for frames in (noisy(32), noisy(32) + moving):
        assert looked(frames).noise == pytest.approx(NOISE, rel=0.25)


def test_reciprocity_equals_that_of_the_mean_frame():
    assert 0 < reciprocity_of(noisy(32)) < 1e-4
    scaled = noisy(32) * np.where(np.arange(CHANNELS) < CHANNELS // 2, 1.1, 1.0)
    assert reciprocity_of(scaled) > 0.02


@pytest.mark.parametrize("lost", [np.nan, 0.0, 5.0])
@pytest.mark.parametrize("dead", [[2], [1, 6]])
def test_dead_electrodes_are_named_and_their_neighbours_are_not(lost, dead):
    frames = noisy(32)
    frames[:, PROTOCOL.channels_touching(dead)] = lost
    assert list(looked(frames).dead) == dead


def test_a_strong_touch_is_not_a_dead_electrode():
    frames = noisy(32)
    frames[:, np.random.default_rng(1).permutation(CHANNELS) < 0.45 * CHANNELS] *= 1.8
    assert list(looked(frames).dead) == []


def test_an_electrode_drifts_if_its_channels_stay_changed():
    frames = noisy(32)
    frames[:, PROTOCOL.channels_touching([4])] *= 1.12
    watch = QualityWatch(measured())
    assert list(looked(frames, watch, times=5).drifting) == []
    assert list(looked(frames, watch, times=20).drifting) == [4]
    assert list(looked(frames, watch).dead) == []
    watch.replace_reference(frames)
    assert list(looked(frames, watch, times=30).drifting) == []


def test_a_touch_that_ends_is_not_drift():
    touched, still = noisy(32), noisy(32)
    touched[:, PROTOCOL.channels_touching([4])] *= 1.3
    watch, quality = QualityWatch(measured()), Quality()
    for _ in range(10):
        looked(still, watch, times=2)
        quality = looked(touched, watch, times=1)
    assert list(quality.drifting) == []


def test_few_frames_text_and_other_sensors_give_no_result():
    watch = QualityWatch(measured())
    for values in (*["text"] * 20, *np.zeros((20, 3)), *noisy(3)):
        watch.add(LiveFrame(0, 0.0, 0.0, values))
    assert watch.assess().noise is None
    alone = QualityWatch(None)
    assert looked(noisy(32), alone).noise == pytest.approx(NOISE, rel=0.25)
    assert looked(noisy(32), alone).reciprocity is None
    assert looked(np.full((32, CHANNELS), np.nan)).noise is None
    assert looked(np.full((32, CHANNELS), np.inf)).noise is None
    assert looked(np.random.default_rng(0).uniform(-1e300, 1e300, (32, CHANNELS))).noise is None


def test_a_rate_that_doubles_is_reported_once():
    watch = RateWatch()
    reported = [watch(rate) for rate in (0, 59, 61, 60, 60, 90, 60, 119, 120, 121, 120, 118, 0)]
    assert [one for one in reported if one] == ["The frame rate has changed from 60 to 121 frames a second."]


def test_a_steady_change_during_eight_frames_is_detected():
    """Eight frames are the fewest: four pairs, of which the first and the last differ by three steps from the mean."""
    usual, step = 1 + np.arange(CHANNELS) / CHANNELS, np.where(np.arange(CHANNELS) < 5, 0.01, 0.0)
    frames = usual + (np.arange(8) - 3.5)[:, None] * step
    assert change_during(frames) == pytest.approx(3 * np.linalg.norm(step) / np.linalg.norm(usual), rel=1e-12)
    lost = np.where(np.arange(CHANNELS) == 2, np.nan, frames)  # one channel is left out
    known = np.arange(CHANNELS) != 2
    change = 3 * np.linalg.norm(step[known]) / np.linalg.norm(usual[known])
    assert change_during(lost) == pytest.approx(change, rel=1e-12)
    assert change_during(frames[:7]) is None
    assert change_during(np.full((8, CHANNELS), np.nan)) is None


@pytest.mark.parametrize("number", [8, 30, 300])
def test_noise_is_not_reported_as_change(number):
    """None of a hundred references. A motion of ten times the noise is detected, and its size is that of its
    components.
    """
    random = np.random.default_rng(number)
    usual = 1 + random.random(CHANNELS)
    for _ in range(100):
        assert change_during(usual * (1 + 1e-3 * random.normal(size=(number, CHANNELS)))) is None
    if number == 8:
        return
    course = np.sin(2 * np.pi * np.arange(number) / number)[:, None] * (np.arange(CHANNELS) < 5)
    moved = usual * (1 + 1e-3 * random.normal(size=(number, CHANNELS)) + 0.05 * course)
    found = change_during(moved)
    assert found is not None
    assert 0.3 < found / (0.05 * np.linalg.norm(usual[:5]) / np.linalg.norm(usual)) < 1
    assert change_during(moved[:7]) is None
    drifted = usual * (1 + 1e-3 * random.normal(size=(3000, CHANNELS)) + 2e-3 * np.linspace(0, 1, 3000)[:, None])
    assert change_during(drifted) is None
