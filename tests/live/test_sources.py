"""Sources against simulated devices: a pseudo-terminal, a server, a pipe, a folder, also when reconnected."""

import contextlib
import os
import socket
import threading
import time

import numpy as np
import pytest
from small_sensor import CHANNELS, measured, noisy

from jeit.data import write_table
from jeit.data.formats.lines import LineParser
from jeit.live import frame_connection, preparation
from jeit.live.frame_connection import LineSource, ReadAhead, SerialPort, StandardInput, TcpServer, open_connection
from jeit.live.preparation import first_frames
from jeit.live.sources import AbstractSource, PlayedRecording, WatchedFolder, open_source

FRAMES = noisy(12)
posix = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals and pipes of POSIX")


def line(values):
    return (", ".join(map(repr, values.tolist())) + "\n").encode()


class Reading:
    """A source read by a thread, which keeps the frames."""

    def __init__(self, source):
        self.source, self.frames = source, []
        self.thread = threading.Thread(target=self._read, daemon=True)

    def _read(self):
        for one in self.source:
            self.frames.append(one)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.source.close()
        self.thread.join(5)
        assert not self.thread.is_alive()

    def wait(self, condition, seconds=5.0):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, (len(self.frames), self.source.connection, list(self.source.messages))
            time.sleep(0.005)

    def reported(self, word):
        return any(word in text for _, text in self.source.messages)

    @property
    def numbers(self):
        return [one.values for one in self.frames if not isinstance(one.values, str)]

    @property
    def texts(self):
        return [one.values for one in self.frames if isinstance(one.values, str)]


def are_due(seconds, expected):
    """Whether frames come when they should: none early, and most of them soon, despite other load of the machine."""
    late = np.asarray(seconds) - expected
    return late.min() > -1e-3 and np.median(late) < 0.05


@pytest.fixture(autouse=True)
def _soon(monkeypatch):
    monkeypatch.setattr(frame_connection, "_INITIAL_DELAY", 0.02)
    monkeypatch.setattr(frame_connection, "_READ_TIMEOUT", 0.02)


@posix
def test_lines_of_a_pipe_with_garbage_between_them():
    read, write = os.pipe()
    with Reading(LineSource("-", StandardInput(read), LineParser(None, measured()))) as reading:
        content = line(FRAMES[0])
        os.write(write, content[:50])
        time.sleep(0.05)
        assert reading.frames == []
        os.write(write, content[50:] + b"\xff\xfe garbage\n# ready\n" + line(FRAMES[1])[:-30] + b"\n" + line(FRAMES[2]))
        os.write(write, line(FRAMES[3]).strip())
        os.close(write)
        reading.wait(lambda: reading.source.connection == "ended")
    np.testing.assert_array_equal([reading.numbers[one] for one in (0, 2, 3)], FRAMES[[0, 2, 3]])
    assert len(reading.numbers[1]) < CHANNELS
    assert reading.texts == ["\ufffd\ufffd garbage"]
    assert [one.number for one in reading.frames] == list(range(5))
    assert reading.reported("The device sends: # ready")
    os.close(read)


class Scheduled(AbstractSource):
    """Frames that arrive at given times, without waiting."""

    def __init__(self, seconds):
        super().__init__("scheduled")
        self.seconds = seconds

    def __iter__(self):
        for number, second in enumerate(self.seconds):
            yield self.frame(np.array([number, 0.0]), self.begun + second)


@pytest.mark.parametrize("rate", [None, 20.0])
def test_frames_that_were_sent_before_the_program_could_read_count_into_the_reference(rate):
    """Sixteen lines wait in the pipe; the following ones arrive at 20 frames/s. The first second has 20 frames."""
    source = Scheduled([*np.linspace(0, 1e-3, 16), *(0.05 * np.arange(1, 60))])
    still, following = first_frames(source, 1.0, rate=rate)
    assert list(still[:, 0]) == list(range(20))
    assert [frame.number for frame in following] == list(range(20, 75))


def test_lines_that_have_all_arrived_are_the_reference_as_far_as_a_second_reads_them():
    source = Scheduled([*np.linspace(0, 1e-3, 16), 2.0, 2.1])
    still, following = first_frames(source, 1.0)
    assert (len(still), [frame.number for frame in following]) == (16, [16, 17])
    assert "The sensor changed by 80 % in the first 1 s" in source.messages[-1][1]


@posix
def test_frames_that_wait_for_the_program_keep_the_time_of_their_arrival():
    read, write = os.pipe()
    source = ReadAhead(LineSource("-", StandardInput(read), LineParser()))
    for values in FRAMES[:3]:
        os.write(write, line(values))
        time.sleep(0.1)
    os.close(write)
    frames = list(source)
    np.testing.assert_array_equal([frame.values for frame in frames], FRAMES[:3])
    assert np.diff([frame.arrived for frame in frames]).min() > 0.05
    os.close(read)


@posix
def test_a_source_is_closed_if_what_is_prepared_for_it_fails(monkeypatch):
    """Too few lines for a reference; and no description, so that nothing is known of the sensor."""
    read, write = os.pipe()
    os.write(write, line(FRAMES[0]))
    os.close(write)
    sources = []

    def opened(*_, **__):
        sources.append(ReadAhead(LineSource("-", StandardInput(read), LineParser())))
        return sources[-1]

    monkeypatch.setattr(preparation, "open_source", opened)
    with pytest.raises(ValueError, match="1 frame of numbers; 3 are needed"):
        preparation.prepare("-", description="tank6cm")
    with pytest.raises(ValueError, match="reference is missing"):
        preparation.prepare("-")
    assert all(source.closing.is_set() for source in sources)
    while any(source.connection != "ended" for source in sources):  # their threads may still read the pipe
        time.sleep(0.005)
    os.close(read)


@posix
def test_frames_beyond_those_that_can_wait_are_counted(monkeypatch):
    monkeypatch.setattr(frame_connection, "_MAX_WAITING_FRAMES", 4)
    read, write = os.pipe()
    os.write(write, b"".join(map(line, FRAMES)))
    lines = LineSource("-", StandardInput(read), LineParser())
    source = ReadAhead(lines)
    while lines._num_frames < len(FRAMES):
        time.sleep(0.005)
    time.sleep(0.05)
    frames = iter(source)
    numbers = [next(frames).number for _ in range(4)]
    os.write(write, line(FRAMES[0]))
    os.close(write)
    assert [*numbers, *(frame.number for frame in frames)] == [0, 1, 2, 3, 12]
    assert any("8 frames were lost" in text for _, text in source.messages)
    os.close(read)


@posix
def test_a_loss_at_the_end_is_reported_too(monkeypatch):
    monkeypatch.setattr(frame_connection, "_MAX_WAITING_FRAMES", 4)
    read, write = os.pipe()
    os.write(write, b"".join(map(line, FRAMES)))
    os.close(write)
    source = ReadAhead(LineSource("-", StandardInput(read), LineParser()))
    while source.connection != "ended":
        time.sleep(0.005)
    assert [frame.number for frame in source] == [0, 1, 2, 3]
    assert any("8 frames were lost" in text for _, text in source.messages)
    os.close(read)


@posix
def test_available_lines_are_replayed_at_a_rate():
    read, write = os.pipe()
    os.write(write, b"".join(map(line, FRAMES)))
    os.close(write)
    source = LineSource("-", StandardInput(read), LineParser(), rate=100)
    seconds = [one.second for one in source]
    assert are_due(seconds, np.arange(12) / 100)
    os.close(read)


@posix
def test_a_serial_device_unplugged_and_plugged_in_again(tmp_path):
    """A link names the device, as those of udev do: it disappears, and then names another pseudo-terminal."""
    pytest.importorskip("serial")
    name = tmp_path / "device"

    def plug():
        leader, follower = os.openpty()
        import tty

        tty.setraw(follower)
        name.unlink(missing_ok=True)
        name.symlink_to(os.ttyname(follower))
        return leader, follower

    source = open_source(f"serial:{name}@115200", reference=measured())
    with Reading(source) as reading:
        reading.wait(lambda: source.connection.startswith("waiting"))
        assert reading.reported(f"Not connected: could not open port {name} (serial devices here: ")
        leader, follower = plug()
        reading.wait(lambda: source.connection == "connected")
        os.write(leader, line(FRAMES[4])[4:] + line(FRAMES[0]) + line(FRAMES[1]) + line(FRAMES[2])[:40])
        reading.wait(lambda: len(reading.frames) == 3)
        os.close(follower)
        name.unlink()
        os.close(leader)
        reading.wait(lambda: source.connection.startswith("waiting"))
        leader, follower = plug()
        reading.wait(lambda: source.connection == "connected")
        os.write(leader, line(FRAMES[3]))
        reading.wait(lambda: len(reading.numbers) == 3)
        assert reading.reported("Connection lost")
        assert reading.reported("Connected")
    np.testing.assert_array_equal(reading.numbers, FRAMES[[0, 1, 3]])
    begun, cut = reading.texts
    assert begun.startswith("begun before connecting: ")
    assert cut.startswith("cut off: ")
    os.close(leader)
    os.close(follower)


def test_a_server_that_disconnects_and_returns():
    listening = socket.create_server(("127.0.0.1", 0))
    port = listening.getsockname()[1]
    source = open_source(f"tcp:127.0.0.1:{port}", reference=measured())
    with Reading(source) as reading:
        for sent in (FRAMES[:5], FRAMES[5:]):
            peer, _ = listening.accept()
            with peer:
                for one in sent:
                    peer.sendall(line(one))
                reading.wait(lambda sent=sent: len(reading.frames) >= (5 if len(sent) == 5 else 12))
        assert reading.reported("the other side has closed the connection")
    listening.close()
    np.testing.assert_array_equal(reading.numbers, FRAMES)


def test_a_source_ends_with_its_server_on_request():
    listening = socket.create_server(("127.0.0.1", 0))
    source = open_source(f"tcp:127.0.0.1:{listening.getsockname()[1]}")
    source.end_when_lost()
    with Reading(source) as reading:
        peer, _ = listening.accept()
        peer.sendall(line(FRAMES[0]))
        peer.close()
        reading.thread.join(5)
        assert not reading.thread.is_alive()
    listening.close()
    np.testing.assert_array_equal(reading.numbers, FRAMES[:1])


def test_a_missing_server_is_awaited_and_can_be_cancelled():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with Reading(LineSource("tcp", TcpServer("127.0.0.1", port), LineParser())) as reading:
        reading.wait(lambda: reading.source.connection.startswith("waiting"))
    assert sum("Not connected" in text for _, text in reading.source.messages) == 1


def test_a_silent_device_is_reported(monkeypatch):
    monkeypatch.setattr(frame_connection, "_SILENCE_TIMEOUT", 0.05)
    listening = socket.create_server(("127.0.0.1", 0))
    source = LineSource("tcp", TcpServer("127.0.0.1", listening.getsockname()[1]), LineParser())
    with Reading(source) as reading:
        peer, _ = listening.accept()
        reading.wait(lambda: source.connection == "waiting: the device sends nothing")
        peer.sendall(line(FRAMES[0]))
        reading.wait(lambda: source.connection == "connected")
        peer.close()
    listening.close()


def test_files_that_appear_in_a_folder_are_frames(tmp_path, monkeypatch):
    monkeypatch.setattr("jeit.live.sources._READ_TIMEOUT", 0.1)
    reference = measured()
    (tmp_path / "old.csv").write_bytes(line(FRAMES[0]))
    source = open_source(str(tmp_path), reference=reference)
    assert isinstance(source, WatchedFolder)
    with Reading(source) as reading:
        time.sleep(0.05)
        for number in (1, 2):
            (tmp_path / f"frame{number}.csv").write_bytes(line(FRAMES[number]))
            reading.wait(lambda number=number: len(reading.frames) == number)
        with (tmp_path / "frame3.csv").open("wb") as file:  # written in two parts
            file.write(line(FRAMES[3])[:100])
            file.flush()
            time.sleep(0.06)
            file.write(line(FRAMES[3])[100:])
        reading.wait(lambda: len(reading.frames) == 3)
        (tmp_path / ".hidden.csv").write_bytes(line(FRAMES[4]))
        (tmp_path / "broken.csv").write_bytes(b"no numbers\n")
        reading.wait(lambda: len(reading.frames) == 4)
        write_table(reference.frames(slice(0, 2)), tmp_path / "many.npz")
        reading.wait(lambda: len(reading.frames) == 6)
    assert reading.reported("Left out: 1 file")
    np.testing.assert_array_equal(reading.numbers, [*FRAMES[1:4], *np.asarray(reference.voltages)[:2]])
    assert "broken.csv" in reading.texts[0]


def test_existing_files_are_replayed_at_a_rate(tmp_path):
    for number in range(3):
        (tmp_path / f"frame{number}.csv").write_bytes(line(FRAMES[number]))
    with Reading(open_source(str(tmp_path), reference=measured(), rate=1000)) as reading:
        reading.wait(lambda: len(reading.frames) == 3)
    np.testing.assert_array_equal(reading.numbers, FRAMES[:3])


def test_a_file_is_read_once_its_size_is_constant(tmp_path):
    source = open_source(str(tmp_path), reference=measured())
    assert isinstance(source, WatchedFolder)
    path = tmp_path / "frame.csv"
    path.write_bytes(line(FRAMES[0]))
    assert list(source._read_file(path.name, path.stat().st_size)) == []
    path.write_bytes(line(FRAMES[0]) + line(FRAMES[1]))
    assert list(source._read_file(path.name, path.stat().st_size)) == []
    assert len(list(source._read_file(path.name, path.stat().st_size))) == 2


def test_a_recording_is_replayed_at_its_own_rate_or_another():
    frames, times = noisy(10), 7.0 + np.arange(10) / 50
    for rate, expected in ((None, 50), (200, 200)):
        seconds = [one.second for one in PlayedRecording("made", frames, times, rate)]
        assert are_due(seconds, np.arange(10) / expected)
    untimed = PlayedRecording("made", frames[:3])
    assert "no times" in untimed.messages[0][1]
    assert [len(one.values) for one in untimed] == [CHANNELS] * 3


def test_a_file_is_opened_as_a_recording(tmp_path):
    path, _ = write_table(measured(4), tmp_path / "tank.npz")
    found = [one.values for one in open_source(str(path), rate=1000)]
    np.testing.assert_array_equal(found, measured(4).voltages)


WRONG = ["serial:", "serial:@9600", "serial:/dev/x@fast", "serial:/dev/x@0", "tcp:host", "tcp::80", "tcp:h:99999"]


@pytest.mark.parametrize("text", [*WRONG, "demo:cat", "/no/such/file", "http:example", ""])
def test_a_text_that_names_no_source_is_refused_with_advice(text):
    with pytest.raises(ValueError, match=r"give|Give|there is no|demo"):
        open_source(text)


def test_addresses_are_parsed():
    server = open_connection("tcp:[::1]:5000")
    assert isinstance(server, TcpServer)
    assert (server.host, server.port) == ("::1", 5000)
    with contextlib.suppress(ImportError):
        device = open_connection("serial:/dev/serial/by-id/usb-A@B@57600")
        assert isinstance(device, SerialPort)
        assert (device.port, device.baud) == ("/dev/serial/by-id/usb-A@B", 57600)
        other = open_connection("serial:COM3")
        assert isinstance(other, SerialPort)
        assert other.baud == 115200


@pytest.mark.parametrize("rate", [0, -1, float("nan"), float("inf")])
def test_a_rate_is_positive(rate):
    with pytest.raises(ValueError, match="rate must be positive"):
        open_source("-", rate=rate)
