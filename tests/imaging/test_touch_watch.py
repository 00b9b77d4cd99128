"""Gestures of a small simulated skin, learnt and classified on a live stream, and errors in streams.

The skin is linear, since the tests are of streams, not of methods. A test with a pressed skin is in the slow suite.
"""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from gesture_skin import RATE, TOML, gestures_and_stream, linear_gestures_and_stream

from jeit.data.description import parse_description
from jeit.layout import perimeter
from jeit.mesh import Rectangle
from jeit.touch import GestureModel, TouchImages, TouchWatch, learn_gestures
from jeit.touch.gestures.touch_images import TOUCH_IMAGES

DESCRIPTION = parse_description(tomllib.loads(TOML), "skin.toml")


@pytest.fixture(scope="module", autouse=True)
def coarse_images():
    """Learning has no option for the mesh of its images."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jeit.imaging.stream_preparation.DEFAULT_STREAM_NUM_POINTS", 250)
        yield


@pytest.fixture(scope="module")
def made():
    return linear_gestures_and_stream()


@pytest.fixture(scope="module")
def learnt(made, coarse_images):
    return learn_gestures(DESCRIPTION, made[0], method="linear-discriminant", form="course")


@pytest.fixture(scope="module")
def watch(made, learnt):
    still = made[1].voltages[:60]
    return TouchWatch.create(TouchImages.prepare(DESCRIPTION, still), learnt.model, still, rate=RATE)


def followed(watch, seconds, frames):
    """The events of a stream: all of them, and the touches that ended."""
    watched = list(watch.follow(zip(np.asarray(seconds).tolist(), frames, strict=True)))
    return watched, [touch for one in watched for touch in one.ended]


def test_a_model_is_learnt_from_a_set(made, learnt):
    model = learnt.model
    assert model.reading.sign == 1
    assert model.reading.rate == pytest.approx(RATE)
    assert (model.reading.num_channels, model.reading.protocol) == (48, DESCRIPTION.protocol("skin.toml").name)
    right = model.standing.held_out == model.standing.right
    assert right.mean() > 0.8  # of three
    assert len(right) + len(learnt.without_touch) == len(made[0])


@pytest.mark.slow
def test_a_model_is_learnt_from_a_pressed_skin():
    made, stream = gestures_and_stream()
    learnt = learn_gestures(DESCRIPTION, made, method="linear-discriminant", form="course")
    right = learnt.model.standing.held_out == learnt.model.standing.right
    assert right.mean() > 0.5  # of six
    still = stream.voltages[:60]
    watch = TouchWatch.create(TouchImages.prepare(DESCRIPTION, still), learnt.model, still, rate=RATE)
    onset = np.array([one.touch.onset for one in followed(watch, stream.seconds, stream.voltages)[1]])
    for start in stream.onset:
        assert np.count_nonzero(np.abs(onset - start) < 0.2) == 1


def test_every_touch_is_reported_once_and_soon(made, watch):
    stream = made[1]
    watched, touches = followed(watch, stream.seconds, stream.voltages)
    assert len([one for one in watched if one.image is not None]) == len(stream.seconds)
    onset = np.array([one.touch.onset for one in touches])
    for start in stream.onset:
        assert np.count_nonzero(np.abs(onset - start) < 0.2) == 1
    assert [one.number for one in touches] == list(range(1, len(touches) + 1))
    for one in touches:
        assert one.named - one.touch.offset == pytest.approx(1 / RATE)  # with the first frame below the level
        assert one.probability == one.probabilities.max()
        assert one.latency > 0
    predicted = [watch.model.predict([one.touch]).gesture[0] for one in touches]
    assert predicted == [one.gesture for one in touches]


def test_touches_that_reduce_voltages_are_reported_too(made):
    """A skin that conducts less where touched: the voltages mirrored about those at rest."""
    gestures, stream = made
    mirrored = replace(
        gestures,
        voltages=2 * gestures.reference - gestures.voltages,
        untouched=2 * gestures.reference - gestures.untouched,
    )
    learnt = learn_gestures(DESCRIPTION, mirrored, method="nearest", form="seven")
    assert learnt.model.reading.sign == -1
    frames = 2 * stream.voltages[:60].mean(axis=0) - stream.voltages
    images = TouchImages.prepare(DESCRIPTION, frames[:60])
    other = TouchWatch.create(images, learnt.model, frames[:60], rate=RATE)
    assert len(followed(other, stream.seconds, frames)[1]) >= 6


def test_the_reference_follows_drift(made, watch):
    """The whole skin conducts one per cent better every hundred seconds. Nobody touches it."""
    seconds = np.arange(1800) / RATE
    still = made[1].voltages[:60].mean(axis=0)
    noise = made[1].voltages[:60].std(axis=0) * np.random.default_rng(0).normal(size=(1800, len(still)))
    frames = still * (1 - 0.0001 * seconds[:, None]) + noise
    watched, touches = followed(watch, seconds, frames)
    assert not touches
    kept = watch.images.changes(frames[-60:])
    assert np.nanmax(kept) > watch.level.level  # without following the drift there was one
    assert not watched[-1].touched


def push(made):
    """The longest touch of the stream, with some frames of the untouched skin before it."""
    stream = made[1]
    one = int(np.argmax(stream.offset - stream.onset))
    first, last = (round(RATE * second) for second in (stream.onset[one], stream.offset[one]))
    return stream.voltages[:60], stream.voltages[first : last + 1]


def test_a_touch_during_the_last_frame_is_cut_off(made, watch):
    still, frames = push(made)
    run = np.vstack([still, frames[: len(frames) // 2]])
    _, (touch,) = followed(watch, np.arange(len(run)) / RATE, run)
    assert touch.touch.cut_off
    assert touch.touch.offset == (len(run) - 1) / RATE


def test_a_gap_in_time_separates_touches(made, watch):
    still, frames = push(made)
    run = np.vstack([still, frames, still])
    seconds = np.arange(len(run)) / RATE
    half = 60 + len(frames) // 2
    _, touches = followed(watch, np.where(np.arange(len(run)) < half, seconds, seconds + 1.0), run)
    assert [one.touch.cut_off for one in touches[:2]] == [True, False]
    assert touches[1].touch.begun_before


def test_repeated_and_faulty_frames_are_lost_and_not_reported(made, watch):
    still, frames = push(made)
    run = np.vstack([still, frames, still])
    seconds = np.arange(len(run)) / RATE
    broken = [np.full(len(one), np.nan) if number % 9 == 5 else one for number, one in enumerate(run)]
    broken[70] = "no numbers"
    (whole,) = followed(watch, seconds, run)[1][:1]
    watched, (touch, *_) = followed(watch, seconds, broken)
    assert touch.touch.lost > 3
    assert abs(touch.touch.offset - whole.touch.offset) < 0.1
    assert sum(not one.image.imaged for one in watched if one.image is not None) == len(
        {number for number in range(len(run)) if number % 9 == 5} | {70}
    )
    doubled = np.repeat(seconds, 2), np.repeat(run, 2, axis=0)
    (twice,) = followed(watch, *doubled)[1][:1]
    assert len(twice.touch.course) == len(whole.touch.course)
    assert twice.gesture == whole.gesture


def test_an_electrode_that_fails_in_a_touch_is_left_out(made, watch):
    """Its channels are left out from then on, the touch ends, and the next is reported."""
    still, frames = push(made)
    run = np.vstack([still, frames, still, still, frames, still])
    protocol = watch.images.calibration.model.protocol
    run[60 + len(frames) // 2 :, np.asarray(protocol.channels_touching(2))] = 0.0
    watched, touches = followed(watch, np.arange(len(run)) / RATE, run)
    imaged = [one.image for one in watched if one.image is not None]
    assert "Electrode 3 seems to be dead" in imaged[-1].reason
    assert len(touches) >= 2
    assert touches[-1].touch.onset == pytest.approx((180 + len(frames)) / RATE, abs=0.2)


def test_a_lasting_load_is_reported_and_becomes_the_reference(made, watch):
    still, frames = push(made)
    strongest = frames[np.argmax(np.abs(frames - still.mean(axis=0)).sum(axis=1))]
    noise = still - still.mean(axis=0)
    held = strongest + np.vstack([noise, noise, noise])
    impatient = replace(watch, patience=2.0)
    run = np.vstack([still, held, held])
    watched, touches = followed(impatient, np.arange(len(run)) / RATE, run)
    assert [one.held for one in touches] == [True]
    assert touches[0].touch.offset - touches[0].touch.onset == pytest.approx(2.0, abs=0.1)
    assert not watched[-1].touched


def test_a_skin_loaded_from_the_first_frame_is_recognised_when_released(made, learnt):
    """The reference is taken during a push. The push is released, and applied again."""
    still, frames = push(made)
    strongest = frames[np.argmax(np.abs(frames - still.mean(axis=0)).sum(axis=1))]
    held = strongest + np.vstack([still - still.mean(axis=0)] * 2)
    run = np.vstack([held, still, still, still, frames, still])
    own = TouchWatch.create(TouchImages.prepare(DESCRIPTION, held[:60]), learnt.model, held[:60], rate=RATE)
    watched, touches = followed(own, np.arange(len(run)) / RATE, run)
    (note,) = [one.note for one in watched if one.note]
    assert "more at rest than when its rest was read" in note
    assert touches[-1].touch.onset == pytest.approx(300 / RATE, abs=0.2)
    assert not watched[-1].touched or watched[-1].second - touches[-1].touch.onset > 1


def test_without_frames_nothing_is_reported(watch):
    assert list(watch.follow([])) == []


def test_a_stream_noisier_than_the_training_data_is_reported(made, learnt):
    still = made[1].voltages[:60]
    rng = np.random.default_rng(0)
    rough = still + 50 * still.std(axis=0) * rng.normal(size=still.shape)
    watch = TouchWatch.create(TouchImages.prepare(DESCRIPTION, rough), learnt.model, rough, rate=RATE)
    assert watch.level.level > learnt.model.reading.level
    assert "weak touches are missed" in watch.notes[0]


def test_bad_arguments(made, learnt, watch):
    still = made[1].voltages[:60]
    images = watch.images
    with pytest.raises(ValueError, match="seconds must not fall"):
        followed(watch, [0.1, 0.0], still[:2])
    with pytest.raises(ValueError, match="patience must be positive"):
        TouchWatch.create(images, learnt.model, still, rate=RATE, patience=0)
    with pytest.raises(ValueError, match="does not say how its skin was read"):
        TouchWatch.create(images, replace(learnt.model, reading=None), still, rate=RATE)
    other = replace(learnt.model, reading=replace(learnt.model.reading, num_channels=7))
    with pytest.raises(ValueError, match="of 7 channels, and this skin has 48"):
        TouchWatch.create(images, other, still, rate=RATE)
    bulk = replace(learnt.model, reading=replace(learnt.model.reading, background=1e3 * images.background))
    with pytest.raises(ValueError, match=r"has 0\.001 times the conductivity"):
        TouchWatch.create(images, bulk, still, rate=RATE)
    with pytest.raises(ValueError, match=r"\[geometry\]"):
        TouchImages.prepare(replace(DESCRIPTION, domain=None), still)
    silent = replace(made[0], voltages=np.tile(made[0].reference, (len(made[0].voltages), 1)))
    with pytest.raises(ValueError, match="have no touch"):
        learn_gestures(DESCRIPTION, silent)
    slow = TouchWatch.create(images, learnt.model, still, rate=10.0)
    assert "learnt at 60 frames/s" in slow.notes[0]
    assert slow.gap == 0.25


@pytest.mark.slow
def test_a_dead_electrode_of_many_leaves_an_image():
    """The part that only excluded channels determine has no inverse. With sixteen electrodes and a common one it was
    NaN.
    """
    places = np.vstack([perimeter(Rectangle(0.3, 0.18), 16, start=0.03), [[0.0, 0.0]]])
    table = tomllib.loads(TOML)
    table["electrodes"]["positions"] = places.tolist()
    description = parse_description(table, "skin.toml")
    model = description.model("skin.toml", num_points=300)
    rest = np.asarray(model.voltages(0.0125))
    images = TouchImages.prepare(description, rest[None], replace(TOUCH_IMAGES, num_points=300))
    dead = rest.copy()
    dead[np.asarray(model.protocol.channels_touching(5))] = 0.0
    (found,) = images.stream([dead])
    assert "Electrode 6 seems to be dead" in found[0].reason
    assert np.isfinite(found[1]).all()


def test_a_file_keeps_the_reading_settings_of_the_skin(learnt, tmp_path):
    learnt.model.write(tmp_path / "gestures.skops")
    assert GestureModel.read(tmp_path).reading == learnt.model.reading
