"""Segmentation of streams into touches: levels, gaps, unusable frames and ends, with equal results frame by frame and
at once.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jeit.mesh import Rectangle, centroids
from jeit.touch.gestures import TouchLevel, TouchStream, course_features, find_touches, touch_features

MESH = Rectangle(0.32, 0.2).mesh(num_points=60)
CENTRES = np.asarray(centroids(MESH))
LEVEL = TouchLevel(MESH, 1.0)


def images(peaks, place=(0.0, 0.0)):
    """A bump at one place, or at one for each frame, of these heights (F,)."""
    place = np.broadcast_to(place, (len(peaks), 2))
    apart = np.linalg.norm(CENTRES - place[:, None], axis=2)
    bump = np.exp(-((apart / 0.05) ** 2))
    return np.asarray(peaks, float)[:, None] * bump / bump.max(axis=1, keepdims=True) - 0.1


def followed(seconds, frames, **options):
    stream = TouchStream(LEVEL, **options)
    for second, frame in zip(seconds, frames, strict=True):
        stream = stream.follow(float(second), frame)
    return stream.touches


def same(one, other):
    assert len(one) == len(other)
    for left, right in zip(one, other, strict=True):
        assert (left.lost, left.begun_before, left.cut_off) == (right.lost, right.begun_before, right.cut_off)
        assert left.longest_gap == right.longest_gap
        for name in ("seconds", "peak", "least", "half_share", "mean", "area", "centroid"):
            np.testing.assert_allclose(getattr(left.course, name), getattr(right.course, name), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(touch_features(one).values, touch_features(other).values, rtol=1e-12, atol=1e-15)


def found(peaks, seconds=None, **options):
    """Touches found at once, which equal those found frame by frame. 100 frames/s by default."""
    seconds = np.arange(len(peaks)) / 100 if seconds is None else np.asarray(seconds)
    frames = images(peaks)
    frames[np.isnan(peaks)] = np.nan
    touches = find_touches(LEVEL, seconds, frames, **options)
    same(touches, followed(seconds, frames, **options))
    return touches


def test_a_touch_is_where_the_level_is_exceeded():
    (touch,) = found([0, 0, 2, 3, 2, 0, 0])
    assert (touch.onset, touch.offset, touch.whole) == (0.02, 0.04, True)
    assert touch.course.peak.max() == pytest.approx(2.9)


def test_short_gaps_are_bridged_and_longer_ones_separate():
    short = [0, 2, 2, *[0] * 9, 2, 2, *[0] * 20]  # 100 ms between frames above the level: not less than 100
    assert len(found([0, 2, 2, *[0] * 8, 2, 2, *[0] * 20])) == 1
    assert [len(one.course) for one in found(short)] == [2, 2]
    assert [len(one.course) for one in found(short, gap=0.15)] == [13]


def test_no_frames_and_no_touches():
    assert found(np.zeros(0)) == []
    assert found(np.zeros(20)) == []
    assert found(np.full(20, np.nan)) == []
    assert touch_features([]).values.shape == (0, 7)
    assert course_features([]).values.shape[0] == 0


def test_single_frames_are_not_reported():
    peaks = [0, 3, *[0] * 20]
    assert found(peaks) == []
    assert len(found(peaks, least=1)) == 1


@pytest.mark.parametrize(
    ("peaks", "begun_before", "cut_off"),
    [([2, 2, 0, 0], True, False), ([0, 2, 2], False, True), ([2, 2, 2], True, True), ([0, 2, 2, 0], False, False)],
)
def test_touches_cut_off_by_the_streams_ends_are_flagged(peaks, begun_before, cut_off):
    (touch,) = found(peaks)
    assert (touch.begun_before, touch.cut_off, touch.whole) == (begun_before, cut_off, not (begun_before or cut_off))


def test_missing_frames_separate_a_touch_that_may_have_ended():
    seconds = np.concatenate([np.arange(10), np.arange(40, 50)]) / 100
    first, second = found([0, *[2] * 18, 0], seconds)
    assert (first.begun_before, first.cut_off) == (False, True)
    assert (second.begun_before, second.cut_off) == (True, False)


def test_few_missing_frames_are_bridged_and_reported():
    seconds = np.concatenate([np.arange(10), np.arange(15, 25)]) / 100
    (touch,) = found([0, *[2] * 18, 0], seconds)
    assert touch.whole
    assert touch.longest_gap == pytest.approx(0.06)


def test_unusable_frames_are_left_out_and_counted():
    peaks = [0, 2, np.nan, 2, 2, np.nan, 0, np.nan, 0]
    (touch,) = found(peaks)
    assert (touch.lost, len(touch.course)) == (1, 3)
    seconds = [0, 0.01, 0.01, 0.02, 0.03, 0.04]
    (touch,) = found([0, 2, 9, 2, 0, 0], seconds)
    assert (touch.lost, touch.course.peak.max()) == (1, pytest.approx(1.9))


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_frame_by_frame_equals_at_once(data):
    number = data.draw(st.integers(1, 40))
    value = st.sampled_from([0.0, 0.5, 1.6, 3.0, np.nan])
    peaks = np.array(data.draw(st.lists(value, min_size=number, max_size=number)))
    step = st.sampled_from([0.0, 0.01, 0.01, 0.01, 0.03, 0.1, 0.4])
    steps = data.draw(st.lists(step, min_size=number, max_size=number))
    before = data.draw(st.sampled_from([0.0, 2.0]))
    seconds = np.concatenate([np.arange(50) / 100, 0.5 + np.cumsum(steps)])
    found(np.concatenate([np.full(50, before), peaks]), seconds, least=data.draw(st.integers(1, 3)))


def test_a_stream_is_immutable():
    start = TouchStream(LEVEL)
    start.follow(0.0, images([2.0])[0])
    assert start.open == ()


def test_the_level_is_five_deviations_above_untouched_peaks():
    noise = np.random.default_rng(0).normal(0, 0.1, (200, MESH.num_cells))
    level = TouchLevel.of_untouched(MESH, noise).level
    peaks = noise.max(axis=1)
    assert level == pytest.approx(peaks.mean() + 5 * peaks.std(ddof=1))
    holed = noise.copy()
    holed[::2] = np.nan
    assert TouchLevel.of_untouched(MESH, holed).level == TouchLevel.of_untouched(MESH, noise[1::2]).level


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (lambda: TouchLevel(MESH, 0.0), "level must be positive"),
        (lambda: TouchLevel(None, 1.0), "mesh must be a Mesh"),
        (lambda: TouchLevel.of_untouched(MESH, images(np.zeros(3))), "give 10 frames"),
        (lambda: TouchLevel.of_untouched(MESH, images(np.zeros(20))), "all the same"),
        (lambda: find_touches(LEVEL, np.arange(3.0), images(np.zeros(3))[:, 1:]), "images have shape"),
        (lambda: find_touches(LEVEL, np.array([0.0, 2.0, 1.0]), images(np.zeros(3))), "must not fall"),
        (lambda: find_touches(LEVEL, np.array([0.0, np.nan, 1.0]), images(np.zeros(3))), "must be finite"),
        (lambda: find_touches(LEVEL, np.arange(2.0), images(np.zeros(3))), "one for each of the 3 frames"),
        (lambda: find_touches(LEVEL, np.arange(3.0), images(np.zeros(3))), "Give a greater gap"),
        (lambda: TouchStream(LEVEL, gap=0), "gap must be positive"),
        (lambda: TouchStream(LEVEL, least=0), "least must be a number of frames"),
        (lambda: TouchStream(LEVEL).follow(1.0, images([0.0])[0]).follow(0.5, images([0.0])[0]), "before the last"),
        (lambda: TouchStream(LEVEL).follow(1.0, np.zeros(3)), "images have shape"),
        (lambda: LEVEL.course(np.zeros(1), images([0.0]) * np.nan), "NaN or infinite"),
        (lambda: touch_features([1.0]), "must be a StreamTouch"),
        (lambda: course_features(None), "touches must be a list"),
    ],
)
def test_bad_arguments(action, message):
    with pytest.raises(ValueError, match=message):
        action()
