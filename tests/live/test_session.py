"""A live session: the recording is complete, late frames are not displayed, and everything is reported."""

import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from small_sensor import CHANNELS, Blank, measured, noisy

from jeit.data import read
from jeit.inverse.streaming.stream import FrameStatus
from jeit.live import session as session_module
from jeit.live.pictures import Picture
from jeit.live.recording import Recorder
from jeit.live.session import Session, frames
from jeit.live.sources import ENDED, AbstractSource


class Given(AbstractSource):
    """A source of given values, each after a delay of `pause` seconds, which waits at the numbers in `gates`."""

    def __init__(self, values, pause=0.0, gates=()):
        super().__init__("given")
        self.values, self.pause = values, pause
        self.gates = {number: threading.Event() for number in gates}

    def __iter__(self):
        self.begun = time.monotonic()
        for number, one in enumerate(self.values):
            if number in self.gates:
                self.gates[number].wait(5)
            if self.closing.wait(self.pause):
                break
            yield self.frame(one)
        self.connection = ENDED


@pytest.fixture(autouse=True)
def _patience(monkeypatch):
    """No frame is late because the machine is busy otherwise."""
    monkeypatch.setattr(session_module, "_MAX_WAIT", 5.0)


def wait_for(condition, seconds=5.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


def number_of(result):
    assert result is not None
    return result.frame.number


def texts(session):
    return [one["text"] for one in session.state()["messages"]]


def test_all_frames_are_imaged_in_their_order_and_counted():
    view = Blank()
    with Session(Given(noisy(50), pause=1e-3), view) as session:
        session.wait()
        state = session.state()
    assert view.seen == list(range(50))
    assert (state["read"], state["imaged"], state["dropped"], state["refused"]) == (50, 50, 0, 0)
    assert state["connection"] == "ended"
    assert 0 < state["latency_median"] <= state["latency_99"] < 2.0
    json.dumps(state)


def test_a_slow_view_misses_frames_and_the_recording_none(tmp_path, monkeypatch):
    monkeypatch.setattr(session_module, "_MAX_WAIT", 0.05)

    def slow(frame):
        time.sleep(0.03)
        return Picture(None)

    view, recorder = Blank(slow), Recorder(tmp_path, reference=measured())
    values = noisy(300)
    session = Session(Given(values, pause=1e-3), view, recorder=recorder)
    session.record(True)
    folder = session.state()["recording"]["folder"]
    with session:
        session.wait()
        state = session.state()
    assert state["read"] == 300
    assert state["imaged"] + state["dropped"] == 300
    assert state["imaged"] == len(view.seen) < 150
    assert view.seen[-1] == 299
    assert view.seen == sorted(view.seen)
    assert state["latency_99"] < 1.0
    np.testing.assert_array_equal(read(f"{folder}/frames.csv").voltages, values)


def test_a_delay_shorter_than_the_patience_misses_nothing():
    def hiccup(frame):
        time.sleep(0.03 if frame.number == 5 else 0)
        return Picture(None)

    view = Blank(hiccup)
    with Session(Given(noisy(40), pause=4e-3), view) as session:
        session.wait()
    assert view.seen == list(range(40))


def test_reasons_that_differ_in_numbers_are_one_and_the_number_of_kinds_is_bounded():
    def refuse(frame):
        word = "a" * (frame.number // 2 + 1)
        return Picture(None, status=FrameStatus.REFUSED, reason=f"It differs by {frame.number * 1.5} %: {word}.")

    with Session(Given(noisy(200), pause=1e-4), Blank(refuse)) as session:
        session.wait()
        state = session.state()
    assert state["refused"] == sum(state["reasons"].values()) == 200 - state["dropped"]
    assert len(state["reasons"]) <= 31
    assert state["reasons"]["It differs by 0.0 %: a."] == 2
    assert state["reasons"]["other reasons"] > 100


def test_a_view_that_fails_refuses_the_frame_and_continues():
    def fail(frame):
        if frame.number == 2:
            raise ZeroDivisionError("by zero")
        return Picture(None)

    with Session(Given(noisy(5)), Blank(fail)) as session:
        session.wait()
        state = session.state()
    assert (state["imaged"], state["refused"]) == (4, 1)
    assert state["reasons"] == {"ZeroDivisionError: by zero": 1}


def test_a_source_that_fails_ends_the_session_with_the_reason():
    def broken():
        yield noisy(1)[0]
        raise RuntimeError("the driver is gone")

    with Session(Given(broken()), Blank()) as session:
        session.wait()
        assert session.state()["read"] == 1
        assert any("the driver is gone" in one for one in texts(session))
        assert session.newest(10, 0.1) is None


def test_newest_waits_for_a_result_and_times_out():
    source = Given(noisy(3), gates=(2,))
    with Session(source, Blank()) as session:
        wait_for(lambda: session.state()["imaged"] == 2)
        assert number_of(session.newest(0, 1.0)) == 1
        start = time.monotonic()
        assert session.newest(1, 0.1) is None
        assert time.monotonic() - start >= 0.1
        source.gates[2].set()
        assert number_of(session.newest(1, 5.0)) == 2
        assert session.newest(2, 5.0) is None
        assert number_of(session.result(1)) == 1
        assert number_of(session.result(7)) == 2


def test_results_are_kept_for_a_time_within_their_memory(monkeypatch):
    pixels = np.zeros((10, 10), np.float32)
    with Session(Given(noisy(60), pause=5e-3), Blank(lambda frame: Picture(pixels)), history=0.1) as session:
        session.wait()
        kept = [one.frame.number for one in session._stored_results]
    assert 10 < len(kept) < 30
    assert kept[-1] == 59
    assert session.result(0) is None
    monkeypatch.setattr(session_module, "_MAX_BYTES", 12_000)
    with Session(Given(noisy(60)), Blank(lambda frame: Picture(pixels))) as session:
        session.wait()
        assert 5 < len(session._stored_results) <= 12
    monkeypatch.setattr(session_module, "_MAX_BYTES", 10)
    with Session(Given(noisy(5)), Blank(lambda frame: Picture(pixels))) as session:
        session.wait()
        assert [one.frame.number for one in session._stored_results] == [4]


def test_a_new_reference_is_of_the_next_frames_and_is_recorded(tmp_path):
    values = [*noisy(10), "garbage", np.zeros(CHANNELS - 1), *noisy(30, seed=5)]
    source, view = Given(values, gates=(10, 25)), Blank()
    recorder = Recorder(tmp_path, reference=measured())
    with Session(source, view, recorder=recorder) as session:
        session.record(True)
        folder = session.state()["recording"]["folder"]
        wait_for(lambda: session.state()["imaged"] == 10)
        session.take_reference(8)
        source.gates[10].set()
        wait_for(lambda: view.references)
        session.mark("  rod\n out ")
        source.gates[25].set()
        session.wait()
    np.testing.assert_array_equal(view.references, [noisy(30, seed=5)[:8]])
    assert "New reference: mean of 8 frames." in texts(session)
    events = Path(folder, "events.csv").read_text()
    assert "rod out" in events
    assert "new reference" in events


def test_a_reference_that_a_view_refuses_is_reported():
    view = Blank()
    view.set_reference = lambda frames: (_ for _ in ()).throw(ValueError("all zero"))
    with Session(Given(noisy(30), pause=1e-3), view) as session:
        session.take_reference(3)
        session.wait()
        assert "The old reference stays: all zero" in texts(session)
        with pytest.raises(ValueError, match="between 1 and 10,000"):
            session.take_reference(0)


def test_a_reference_taken_while_the_sensor_changes_is_refused():
    moved = noisy(30) * (1 + 0.02 * np.linspace(0, 1, 30)[:, None])
    source, view = Given(list(moved), gates=(1,)), Blank()
    with Session(source, view) as session:
        session.take_reference(20)
        source.gates[1].set()
        session.wait()
        assert view.references == []
        assert any("The old reference stays: the sensor changed by 0.5" in one for one in texts(session))


def test_frames_of_another_number_of_channels_are_reported_once():
    values = [*noisy(5), *(np.zeros(CHANNELS + 3) for _ in range(9)), np.zeros(3), *noisy(5)]
    with Session(Given(values), Blank(), reference=measured()) as session:
        session.wait()
        messages = [one for one in texts(session) if "channels" in one]
    assert messages == [
        f"Frames now have {CHANNELS + 3} channels; they had {CHANNELS}.",
        "Frames now have 40 channels; they had 43.",
    ]


def test_a_recording_that_cannot_begin_is_reported(tmp_path):
    (tmp_path / "file").write_text("")
    with Session(Given(noisy(2)), Blank(), recorder=Recorder(tmp_path / "file" / "below")) as session:
        session.record(True)
        assert session.state()["recording"] is None
        assert any("cannot begin" in one for one in texts(session))


def test_stopping_ends_a_source_that_waits():
    source = Given(noisy(2), pause=60.0)
    start = time.monotonic()
    with Session(source, Blank()):
        pass
    assert time.monotonic() - start < 10.0


def test_a_program_gets_the_newest_results_and_every_event(tmp_path):
    def name(frame):
        return Picture(None, events=(f"gesture {frame.number}",) if frame.number % 7 == 3 else ())

    numbers, events = [], []
    for result in frames(Given(noisy(80), pause=2e-3), Blank(name), recorder=Recorder(tmp_path)):
        numbers.append(result.frame.number)
        events += result.picture.events
        time.sleep(0.02)
    assert numbers == sorted(set(numbers))
    assert len(numbers) < 40
    assert numbers[-1] == 79
    assert events == [f"gesture {one}" for one in range(3, 80, 7)]
    (recorded,) = tmp_path.glob("*/frames.csv")
    assert len(recorded.read_text().splitlines()) == 81
