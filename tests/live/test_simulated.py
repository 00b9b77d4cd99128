"""Simulated sources: their places are where images of their frames show the change, and other commands image their
recordings.
"""

import csv
import itertools

import numpy as np
import pytest
from small_sensor import Blank

from jeit.cli import main
from jeit.imaging.stream_preparation import StreamSettings, prepare_imager
from jeit.inverse import stream
from jeit.live.pictures import LiveFrame
from jeit.live.quality import QualityWatch
from jeit.live.recording import Recorder
from jeit.live.session import Session
from jeit.live.simulated import open_simulated, simulated_skin, simulated_tank
from jeit.mesh import centroids


@pytest.fixture(scope="module", params=["tank", pytest.param("skin", marks=pytest.mark.slow)])
def source(request):
    return {"tank": simulated_tank, "skin": simulated_skin}[request.param]()


@pytest.mark.slow
def test_the_change_in_an_image_is_at_the_place_of_the_source(source):
    imager, calibration = prepare_imager(source.reference, StreamSettings(solver="one-step", num_points=500))
    cells, sign = np.asarray(centroids(calibration.model.mesh)), -1.0 if "tank" in source.name else 1.0
    seconds = np.arange(0.01, source.period, source.period / 97)
    frames = [source.states[source._state_index(one)] for one in seconds]
    images = stream(imager, [source.reference.filled()[0], *frames])
    touched, background = 0, np.asarray(next(images).conductivity)
    for second, image in zip(seconds, images, strict=True):
        place = source.truth(second)
        if place is None:
            continue
        touched += 1
        change = sign * (np.asarray(image.conductivity) - background)
        strong = np.where(change > change.max() / 2, change, 0)
        assert np.hypot(*(strong @ cells / strong.sum() - place)) < 0.006
    assert touched > 40


def test_none_of_its_electrodes_is_dead_or_drifts(source):
    watch = QualityWatch(source.reference)
    for second in np.arange(0, 30, 0.5):
        for number in range(32):
            watch.add(LiveFrame(number, 0.0, 0.0, source.states[source._state_index(second + number / 60)]))
        quality = watch.assess()
        assert not [*quality.dead, *quality.drifting]


def test_it_is_periodic(source):
    assert source.truth(0.3) == source.truth(0.3 + source.period)
    assert source.reference.num_frames == 50


def test_the_channels_that_change_most_are_those_of_the_nearest_electrodes():
    """The rod passes the electrodes one after another: electrode 1 is at the top, the others follow clockwise."""
    tank = simulated_tank()
    reference, pitch = tank.reference, 2 * np.pi / 16
    rest = np.asarray(reference.voltages).mean(axis=0)
    for electrode in range(16):
        angle = (np.pi / 2 - electrode * pitch) % (2 * np.pi)
        second = tank.period * angle / (2 * np.pi) + 0.01
        change = np.abs(tank.states[tank._state_index(second)] / rest - 1)
        own = [change[reference.protocol.channels_touching(one)].mean() for one in range(16)]
        assert int(np.argmax(own)) == electrode
        x, y = tank.truth(second) or (np.nan, np.nan)
        assert np.hypot(x - 0.05 * np.cos(angle), y - 0.05 * np.sin(angle)) < 2e-3


def test_the_finger_is_nearest_to_the_electrodes_whose_channels_change_most(monkeypatch):
    """At the middle of each stroke, 15 mm from the centre, in whichever direction the skin is stroked."""
    monkeypatch.setattr("jeit.live.simulated._NUM_STROKE_STATES", 5)
    monkeypatch.setattr("jeit.live.simulated._NUM_NODES", 400)
    skin = simulated_skin()
    reference, rest = skin.reference, skin.states[-1]
    assert len(skin.states) == 16 * (5 + 24)
    for stroke in range(16):
        second = (stroke + 2.5 / 29) * skin.period / 16
        x, y = skin.truth(second) or (np.nan, np.nan)
        assert np.hypot(x, y) == pytest.approx(0.015)
        assert skin.truth((stroke + 20 / 29) * skin.period / 16) is None
        change = np.abs(skin.states[skin._state_index(second)] / rest - 1)
        own = [change[reference.protocol.channels_touching(one)].mean() for one in range(16)]
        # Electrode 1 is at the top, the others follow clockwise.
        assert np.argmax(own) == round((np.pi / 2 - np.arctan2(y, x)) / (2 * np.pi / 16)) % 16


def test_frames_come_at_their_rate_and_end_at_the_limit():
    seconds = [one.second for one in simulated_tank(rate=200, limit=20)]
    assert len(seconds) == 20
    late = np.array(seconds) - np.arange(20) / 200
    assert late.min() > -1e-3
    assert np.median(late) < 0.05
    endless = iter(open_simulated("demo", 500))
    assert [one.number for one in itertools.islice(endless, 5)] == list(range(5))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Folder with a recording of the simulated skin: 150 frames with two strokes, at 60 frames/s."""
    source = simulated_skin(rate=60, limit=150)
    recorder = Recorder(tmp_path_factory.mktemp("live"), reference=source.reference)
    session = Session(source, Blank(), recorder=recorder)
    session.record(True)
    state = recorder.state()
    assert state is not None
    with session:
        session.wait()
    return state["folder"]


@pytest.mark.slow
def test_other_commands_image_a_recording(recorded, tmp_path):
    given = [f"{recorded}/frames.csv", "--reference", f"{recorded}/reference.npz"]
    main(["stream", *given, "--method", "one-step", "--film", "none", "-o", str(tmp_path / "stream"), "--quiet"])
    with (tmp_path / "stream" / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 150
    assert {one["status"] for one in rows} == {"imaged", "unchanged"}
    seconds = np.array([float(one["second"]) for one in rows]) if "second" in rows[0] else None
    assert seconds is None or abs(seconds[-1] - 149 / 60) < 0.1
    main(["series", *given, "-o", str(tmp_path / "series"), "--quiet"])
    assert (tmp_path / "series").is_dir()
