"""Views of learnt skins, depth and gestures against `LearntSkin.predict`, `stream_depths` and `TouchWatch` on the same
frames.
"""

import tomllib
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from gesture_skin import RATE, TOML, linear_gestures_and_stream
from made_skins import record
from small_networks import SHAPE
from thread_limits import libraries_found_once

from jeit.data.description import parse_description
from jeit.design import Skin
from jeit.layout import named_layout
from jeit.live import LiveFrame
from jeit.live.views.contacts import GestureView
from jeit.live.views.learnt import DepthView, LearntSkinView, _key_text, _label_text
from jeit.mesh import Rectangle
from jeit.touch import LearntSkin, Presses, TouchImages, TouchWatch, learn_gestures
from jeit.touch.networks import ImageNetwork, stream_depths
from jeit.touch.networks.linear_channels import LinearChannels, depth_centroids
from jeit.touch.networks.unrolled_network import Unrolled
from jeit.touch.simulate.contact.indent_sets import image_places, pixel_places

DESCRIPTION = parse_description(tomllib.loads(TOML), "skin.toml")


@pytest.fixture(scope="module", autouse=True)
def _quick():
    """Images for gestures are coarse: learning has no option for their mesh."""
    with libraries_found_once(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("jeit.imaging.stream_preparation.DEFAULT_STREAM_NUM_POINTS", 250)
        yield


def pictures(view, frames, seconds=None):
    seconds = np.arange(len(frames)) / RATE if seconds is None else seconds
    rows = zip(seconds.tolist(), frames, strict=True)
    return [view.picture(LiveFrame(number, second, 0.0, one)) for number, (second, one) in enumerate(rows)]


@pytest.fixture(scope="module")
def skin():
    return LearntSkin.fit(Presses.create(**record(80)), method="neighbours")


@pytest.fixture(scope="module")
def presses():
    return record(12, seed=5, untouched=3)


def test_places_and_forces_equal_the_predictions(skin, presses):
    """One frame at a time against all at once. A ring contains 68 % of an isotropic normal distribution of that
    deviation.
    """
    still = presses["reference"][:1]
    found = skin.predict(presses["frames"], still[0])
    made = pictures(LearntSkinView(skin, still), presses["frames"])
    draws = np.random.default_rng(0).normal(size=(20_000, 2))
    for number, picture in enumerate(made):
        assert (picture.status == "refused") == found.unlike[number]
        if not np.isfinite(found.position[number]).all():
            assert not picture.markers
            continue
        (marker,) = picture.markers
        np.testing.assert_allclose((marker.x, marker.y), found.position[number], rtol=1e-9)
        deviation = np.sqrt(np.mean(found.position_std[number] ** 2))
        assert np.mean(np.linalg.norm(deviation * draws, axis=1) < marker.radius) == pytest.approx(0.68, abs=0.01)
        assert marker.label == f"{found.force[number]:.2g} ± {found.force_std[number]:.2g} N"
    assert [one.status for one in made].count("imaged") >= 7
    assert made[-1].status == "unchanged"


@pytest.mark.parametrize(
    ("values", "message"), [("half a li", "text"), (np.ones(39), "39 channels"), (np.ones(0), "0")]
)
def test_invalid_frames_are_refused(skin, presses, values, message):
    view = LearntSkinView(skin, presses["reference"][:1])
    picture = view.picture(LiveFrame(0, 0.0, 0.0, values))
    assert picture.status == "refused"
    assert message in picture.reason
    assert view.picture(LiveFrame(1, 0.1, 0.0, presses["frames"][0])).markers


def test_a_learnt_skin_accepts_a_new_reference_of_its_own_kind(skin, presses):
    view = LearntSkinView(skin, presses["reference"][:1])
    view.set_reference(1.05 * presses["reference"])
    found = skin.predict(presses["frames"][:1], 1.05 * presses["reference"][0])
    (picture,) = pictures(view, presses["frames"][:1])
    assert [one.x for one in picture.markers] == pytest.approx(found.position[0, :1].tolist())
    with pytest.raises(ValueError, match="reference is unlike"):
        view.set_reference(-presses["reference"])
    assert view.reference[0] == pytest.approx(1.05 * presses["reference"][0, 0])


def test_labels_and_keys_are_events_once_they_last():
    """A label of a single frame is no event. The first that lasts is reported once."""
    rng = np.random.default_rng(0)
    centres = {"none": 0.0, "palm": 1.0, "finger": -1.0}
    label = np.array(list(centres))[np.arange(90) % 3]
    shape = rng.normal(size=12)
    frames = np.array([centres[one] for one in label])[:, None] * shape + 0.01 * rng.normal(size=(90, 12))
    learnt = LearntSkin.fit(Presses.create(frames, label=label), method="nearest")
    view = LearntSkinView(learnt)
    which = [0, 0, 1, 0, 1, 1, 1, 2, 2, 0, 0]
    events = [one.events for one in pictures(view, frames[which])]
    reported = [(number, *(word.split()[0] for word in one)) for number, one in enumerate(events) if one]
    assert reported == [(5, "palm"), (8, "finger"), (10, "none")]
    with pytest.raises(ValueError, match="without a reference"):
        view.set_reference(frames[:3])


def test_probabilities_are_percentages_and_keys_are_numbered_from_one():
    touches = SimpleNamespace(label=["palm"], probability=[0.125], touched=np.array([[True, False, True]]))
    assert (_label_text(touches), _key_text(touches)) == ("palm 12 %", "keys 1, 3")


def test_a_skin_learnt_by_sessions_is_refused():
    given = record(60)
    learnt = LearntSkin.fit(Presses.create(**given, group=np.arange(60) // 20), method="neighbours", per_session=True)
    with pytest.raises(ValueError, match="--per-session"):
        LearntSkinView(learnt, given["reference"])


def test_the_box_of_a_skin_without_a_description_contains_its_places(skin, presses):
    scene = LearntSkinView(skin, presses["reference"]).scene
    x_min, x_max, y_min, y_max = scene.extent
    assert -0.05 <= x_min < -0.04 < 0.04 < x_max <= 0.05
    assert -0.05 <= y_min < -0.04 < 0.04 < y_max <= 0.05
    assert any("box" in note for note in scene.notes)
    described = LearntSkinView(skin, presses["reference"], description=DESCRIPTION).scene
    assert described.extent == pytest.approx((-0.16, 0.16, -0.1, 0.1))
    assert len(described.electrodes) == 9


@pytest.fixture(scope="module")
def network():
    """An untrained network, whose maps are linear images, and frames of its skin."""
    skin = Skin.create(named_layout("grid-4x4", Rectangle(0.1, 0.1)), num_layers=0, cell_size=8e-3)
    plain = Unrolled(skin.model.protocol.num_measurements, SHAPE, key=jax.random.key(0))
    places, sensed = image_places(skin, SHAPE[1], SHAPE[0]), LinearChannels.from_skin(skin, SHAPE)
    linear = plain.adapted_to_skin(sensed, places, skin.layout.centres, 1.5e-3)
    near = np.linalg.norm(places - [0.02, 0.03], axis=-1).ravel() < 0.012
    change = np.stack([share * sensed.operator @ near for share in (0.0, 0.3, 0.6)])
    return ImageNetwork.from_skin(linear, skin, 1.5e-3, SHAPE), 1.0 + change


def test_depths_equal_those_of_the_stream(network):
    imaging, frames = network
    rest = frames[0]
    given = [*frames, frames[1][:-1], np.where(np.arange(len(rest)) == 3, np.nan, frames[2]), 200 * frames[1]]
    view = DepthView(imaging, rest[None])
    made = [view.picture(LiveFrame(0, 0.0, 0.0, one)) for one in given]
    assert view.scene.notes == (f"Depths below {1e3 * imaging.floor:.2g} mm are noise.",)
    for picture, one in zip(made, stream_depths(imaging, given, rest), strict=True):
        assert (picture.status == "refused", picture.reason) == (one.depth is None, one.reason)
        if one.depth is None:
            continue
        np.testing.assert_array_equal(picture.pixels, (1e3 * one.depth[::-1]).astype(np.float32))
        deep = one.depth.max() > imaging.floor
        assert len(picture.markers) == deep
        if deep:
            middle = depth_centroids(one.depth[None], pixel_places(imaging.extent, imaging.shape))[0]
            np.testing.assert_allclose((picture.markers[0].x, picture.markers[0].y), middle)
            assert picture.markers[0].label == f"{1e3 * one.depth.max():.2f} mm"
    assert [one.status for one in made] == ["unchanged", "imaged", "imaged", "refused", "imaged", "refused"]
    assert np.linalg.norm(np.array((made[2].markers[0].x, made[2].markers[0].y)) - [0.02, 0.03]) < 0.01
    assert view.picture(LiveFrame(0, 0.0, 0.0, "text")).status == "refused"
    with pytest.raises(ValueError, match="channels"):
        view.set_reference(rest[None, :-1])


@pytest.fixture(scope="module")
def gestures():
    made, stream = linear_gestures_and_stream()
    return learn_gestures(DESCRIPTION, made, method="linear-discriminant", form="course").model, stream


def test_gestures_equal_those_of_the_watch(gestures):
    """Every event is at the frame at which `TouchWatch` classifies a touch, with its gesture and probability."""
    model, stream = gestures
    still = stream.voltages[:60]
    watch = TouchWatch.create(TouchImages.prepare(DESCRIPTION, still), model, still, rate=RATE)
    frames = stream.voltages[: round(stream.onset[3] * RATE)]
    seconds = stream.seconds[: len(frames)]
    view = GestureView(DESCRIPTION, model, still)
    made = pictures(view, frames, seconds)
    watched = list(watch.follow(zip(seconds.tolist(), frames, strict=True)))[: len(frames)]
    for picture, one in zip(made, watched, strict=True):
        assert [text.split(" at ")[0] for text in picture.events] == (
            [f"{one.named.gesture} {100 * one.named.probability:.0f} %"] if one.named else []
        )
        assert picture.status == one.image.status
        change = one.image.conductivity - watch.images.background
        np.testing.assert_array_equal(picture.pixels, view.grid(change))
        assert bool(picture.markers and picture.markers[0].track is not None) == one.touched
        if one.touched:
            place = watch.level.course(np.array([one.second]), change[None]).centroid[0]
            assert (picture.markers[0].x, picture.markers[0].y) == tuple(place)
    assert sum(len(one.events) for one in made) >= 3
    named = next(number for number, one in enumerate(made) if one.events)
    assert made[named].markers[0].label == made[named].events[0].split(" at ")[0]


def test_gestures_continue_after_faulty_frames_and_a_new_reference(gestures):
    model, stream = gestures
    view = GestureView(DESCRIPTION, model, stream.voltages[:60])
    wrong = [stream.voltages[0], "text", stream.voltages[0][:-1], np.full(48, np.nan)]
    made = pictures(view, wrong)
    assert [one.status == "refused" for one in made] == [False, True, True, True]
    assert all(one.reason for one in made[1:])
    view.set_reference(stream.voltages[:30])
    begin, end = (round(one * RATE) for one in (stream.onset[1] - 0.3, stream.offset[1] + 0.5))
    later = pictures(view, stream.voltages[begin:end], stream.seconds[begin:end])
    assert sum(len(one.events) for one in later) == 1
    course = SimpleNamespace(centroid=np.array([[0.0, 0.0], [0.012, -0.034]]), peak=np.array([1.0, 2.0]))
    touch = SimpleNamespace(course=course, onset=1.0, offset=1.5)
    named = SimpleNamespace(number=1, touch=touch, unlike=False, gesture="push", probability=0.8)
    assert view._classified_sentence(named) == "push 80 % at (+12, -34) mm, 0.50 s long"
    with pytest.raises(ValueError, match="reference"):
        view.set_reference(-stream.voltages[:30])
