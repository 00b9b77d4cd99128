"""The server of a live session's page, over real sockets: what it sends, whom it admits, what it refuses.

Pictures are decoded here as by the page, and compared with the arrays that they were made from.
"""

import contextlib
import http.client
import json
import socket
import struct
import threading
import time
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from stand_in import StandIn

from jeit.live.page.application import is_host_allowed
from jeit.live.page.hub import PageHub, Viewer
from jeit.live.page.wire import (
    MAX_COMMAND_LENGTH,
    OUTSIDE_PIXEL_VALUE,
    Mark,
    picture_message,
    read_command,
    to_json,
    to_json_types,
)
from jeit.live.pictures import LiveFrame, Marker, Picture

pytest.importorskip("uvicorn", reason="the page needs the extra live")
client = pytest.importorskip("websockets.sync.client", reason="the page needs the extra live")

from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402, after it was found

from jeit.live.server import serve  # noqa: E402, after its server was found

HOSTILE = [
    "",
    "null",
    "[]",
    "{",
    "reference",
    '{"do": "erase"}',
    '{"do": "reference", "count": 0}',
    '{"do": "reference", "count": 1e9}',
    '{"do": "reference", "count": "30"}',
    '{"do": "reference", "count": true}',
    '{"do": "reference"}',
    '{"do": "record", "on": true, "path": "/etc/passwd"}',
    '{"do": "record", "on": 1}',
    '{"do": "mark", "label": ""}',
    '{"do": "mark", "label": "\\u0000\\n"}',
    json.dumps({"do": "mark", "label": "x" * 201}),
    '{"do": "show", "number": -1}',
    '{"do": "show", "number": 1e400}',
    '{"do": "drawn", "number": 99999999999999999999}',
    b"\xff\xfe\x00",
]


def decoded(message: bytes) -> Any:
    """Header, channels and pixels of a picture's bytes."""
    length = struct.unpack_from("<I", message)[0]
    header = json.loads(message[4 : 4 + length])
    start = 4 + length
    values = np.frombuffer(message, "<f4", header["channels"], start)
    if header["shape"] is None:
        return header, values, None
    whole = np.frombuffer(message, "<i2", offset=start + 4 * values.size).reshape(header["shape"])
    return header, values, np.where(whole == OUTSIDE_PIXEL_VALUE, np.nan, whole * header["scale"])


@pytest.fixture
def served():
    """Start to serve a session on a free port. Returns (host, port) and the address, and ends with the test."""
    running = []

    def start(session, **options):
        opened, addresses = threading.Event(), []
        options |= {"opened": lambda address: (addresses.append(address), opened.set())}
        thread = threading.Thread(target=serve, args=(session,), kwargs=options)
        thread.start()
        running.append((session, thread))
        assert opened.wait(5)
        return urlsplit(addresses[0])

    yield start
    for session, thread in running:
        session.stop()
        thread.join(10)
        assert not thread.is_alive()


def idle() -> Any:
    """A session without pictures."""
    return StandIn(None)


def answer(address, path="/", method="GET", **headers):
    """Status, headers and text that the server answers."""
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", address.port, timeout=5)) as connection:
        connection.request(method, path, headers={name.title(): value for name, value in headers.items()})
        response = connection.getresponse()
        return response.status, response.headers, response.read().decode()


def page(address, *, host=None, origin=None, query=""):
    """A page's connection."""
    host = host or f"127.0.0.1:{address.port}"
    sock = socket.create_connection(("127.0.0.1", address.port), 5)
    return client.connect(f"ws://{host}/socket{query}", sock=sock, origin=origin or f"http://{host}", compression=None)


def until(connection, kind, seconds=5.0) -> Any:
    """The next message of a kind: "picture", or a kind of JSON."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        message = connection.recv(left)
        if isinstance(message, bytes):
            if kind == "picture":
                return decoded(message)
        elif (content := json.loads(message))["kind"] == kind:
            return content
    raise TimeoutError(kind)


def test_picture_keeps_values_pixels_and_marks():
    """Pixels are equal within half of a 32,767th of the largest, with NaN outside. A NaN radius is null."""
    pixels = np.array([[np.nan, 1e-3, -2e-3], [0.0, 5e-4, np.inf]], np.float32)
    frame = LiveFrame(7, 1.5, 0.0, np.array([1.0, np.nan, 3.0]))
    message = picture_message(frame, Picture(pixels, (Marker(0.01, -0.02, "1 N"),)), latency=0.004)
    header, values, back = decoded(message)
    assert (header["number"], header["second"], header["status"], header["past"]) == (7, 1.5, "imaged", False)
    assert header["markers"] == [[0.01, -0.02, "1 N", None, None]]
    np.testing.assert_array_equal(values, [1.0, np.nan, 3.0])
    np.testing.assert_allclose(back, np.where(np.isfinite(pixels), pixels, np.nan), rtol=0, atol=0.51 * 2e-3 / 32767)


@pytest.mark.parametrize("pixels", [None, np.zeros((2, 3), np.float32), np.full((2, 3), np.nan, np.float32)])
def test_picture_without_content(pixels):
    """No image, an image of zeros and one of NaN are decoded unchanged, without a warning."""
    _, values, back = decoded(picture_message(LiveFrame(0, 0.0, 0.0, "no frame"), Picture(pixels), latency=0.0))
    assert values.size == 0
    np.testing.assert_array_equal(back, pixels)


def test_json_of_values_that_python_cannot_write():
    """NaN, infinity, NumPy's numbers and unknown objects become JSON that a browser reads."""
    content = {"a": np.float64("nan"), "b": np.int64(3), "c": (1.0, float("inf")), 4: np.bool_(True), "p": b"x"}
    assert json.loads(to_json("state", content)) == {
        "kind": "state",
        "a": None,
        "b": 3,
        "c": [1.0, None],
        "4": True,
        "p": "b'x'",
    }
    assert to_json_types(np.array([1.0, np.nan])) == [1.0, None]


@pytest.mark.parametrize("message", HOSTILE)
def test_messages_that_are_no_commands_are_refused(message):
    """Anything else that a page sends raises `ValueError`, with a message of one line."""
    with pytest.raises(ValueError, match=r"\w") as error:
        read_command(message)
    assert "\n" not in str(error.value)


def test_label_becomes_one_line():
    """Control characters and repeated spaces of a label are removed. Other scripts stay."""
    command = read_command('{"do": "mark", "label": "  a\\u0007\\tß  声\\n"}')
    assert command == Mark(do="mark", label="a ß 声")


@pytest.mark.parametrize(
    ("header", "listening", "allowed"),
    [
        ("127.0.0.1:8000", "127.0.0.1", True),
        ("localhost:9999", "127.0.0.1", True),
        ("[::1]:80", "127.0.0.1", True),
        ("LOCALHOST", "127.0.0.1", True),
        ("evil.example:8000", "127.0.0.1", False),
        ("127.0.0.1.evil.example", "127.0.0.1", False),
        ("localhost.evil.example", "127.0.0.1", False),
        ("evil@127.0.0.1:1", "127.0.0.1", True),  # a browser sends no such header; its host is this machine
        ("192.168.1.5", "127.0.0.1", False),
        ("", "127.0.0.1", False),
        ("[", "127.0.0.1", False),
        ("192.168.1.5:8000", "0.0.0.0", True),
        ("evil.example", "0.0.0.0", False),
        (socket.gethostname(), "0.0.0.0", True),
        ("robot.lab", "robot.lab", True),
    ],
)
def test_hosts(header, listening, allowed):
    """This machine's names and addresses are admitted. Names that another site can direct here are not."""
    assert is_host_allowed(header, listening) == allowed


def test_strangers_get_nothing(served):
    """Other hosts, other origins, other methods and other paths are refused. Pages carry headers that restrict more."""
    address = served(StandIn(None))
    status, headers, text = answer(address)
    assert (status, "<title>jeit live</title>" in text) == (200, True)
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert answer(address, host="evil.example")[0] == 403
    assert answer(address, origin="http://evil.example")[0] == 403
    assert answer(address, method="POST")[0] == 405
    for path in ("/../wire.py", "/%2e%2e/wire.py", "/static/live.js", "/wire.py", "/etc/passwd", "//etc/passwd"):
        assert answer(address, path)[0] == 404, path
    for origin in ("http://evil.example", "null", f"http://localhost:{address.port}"):
        with pytest.raises(InvalidStatus, match="403"):
            page(address, origin=origin)
    with pytest.raises(InvalidStatus, match="403"):
        page(address, host="evil.example")


def test_token(served):
    """A server that other machines can reach requires the token of its address. A wrong one opens nothing."""
    address = served(StandIn(None), host="0.0.0.0")
    assert len(address.query) > len("token=") + 30
    here = {"host": f"127.0.0.1:{address.port}"}
    assert answer(address, "/?" + address.query, **here)[0] == 200
    for query in ("", "?token=", "?token=wrong", "?" + address.query[:-1], "?token=%ff"):
        assert answer(address, "/" + query, **here)[0] == 403
        with pytest.raises(InvalidStatus, match="403"):
            page(address, query=query)
    with page(address, query="?" + address.query) as connection:
        assert until(connection, "scene")["title"].startswith("A <b>")


def test_commands_reach_the_session(served):
    """Each command has its effect. A refused one changes nothing and is answered."""
    session = StandIn(None)
    address = served(session)
    with page(address) as connection:
        scene = until(connection, "scene")
        assert (len(scene["electrodes"]), scene["unit"], scene["notes"]) == (8, "S/m", ["made for tests"])
        for command in (
            {"do": "reference", "count": 25},
            {"do": "mark", "label": "rod in"},
            {"do": "record", "on": True},
        ):
            connection.send(json.dumps(command))
            assert until(connection, "answer") == {"kind": "answer", "to": command["do"], "problem": None}
        assert session.asked == [("reference", 25), ("mark", "rod in"), ("record", True)]
        connection.send(HOSTILE[6])
        assert "count" in until(connection, "answer")["problem"]
        session.record = lambda on: (_ for _ in ()).throw(OSError("the disk is full"))
        connection.send('{"do": "record", "on": true}')
        assert until(connection, "answer")["problem"] == "the disk is full"
        connection.send('{"do": "seen"}')
        assert until(connection, "state")["reciprocity"] is None
        assert len(session.asked) == 3


def _ask_often(connection, message, most):
    for _ in range(most):
        connection.send(message)
        until(connection, "answer")


def test_a_flood_is_cut_off(served):
    """A page that sends invalid or overlong messages is disconnected. Another continues."""
    address = served(StandIn(None))
    with page(address) as good:
        for rubbish, most in (("rubbish", 30), ("x" * (MAX_COMMAND_LENGTH + 1), 1)):
            with page(address) as bad, pytest.raises(ConnectionClosed):
                _ask_often(bad, rubbish, most)
        good.send('{"do": "mark", "label": "here"}')
        assert until(good, "answer")["problem"] is None


def test_a_slow_page_gets_two_pictures_and_then_the_newest(served):
    """Pictures that a page has not drawn do not accumulate: it is sent two, and after its report, the newest."""
    session = StandIn(None)
    address = served(session)
    with page(address) as connection:
        until(connection, "scene")
        until(connection, "state")
        for number in range(2):
            session.publish(number, number / 60)
            # No other state is sent before the page reports that it has read the first.
            assert decoded(connection.recv(5))[0]["number"] == number
        for number in range(2, 20):
            session.publish(number, number / 60)
        with pytest.raises(TimeoutError):
            until(connection, "picture", 0.3)
        connection.send('{"do": "drawn", "number": 1}')
        assert until(connection, "picture")[0]["number"] == 19
        connection.send('{"do": "seen"}')
        assert until(connection, "state")["drawn"]["latency_median"] > 0.2


def test_pause_and_steps_through_the_past(served):
    """A paused page is sent nothing. A requested picture is sent, or its neighbour, or the reason why there is none."""
    session = StandIn(None)
    address = served(session)
    for number in (0, 1, 2, 5):
        session.publish(number, number / 60, refused="half a frame" if number == 1 else "")
    with page(address) as connection:
        assert until(connection, "picture")[0]["number"] == 5
        connection.send('{"do": "follow", "on": false}')
        for asked, direction, found in ((2, -1, 2), (4, -1, 2), (3, 1, 5), (1, 1, 1), (0, -1, 0)):
            connection.send(json.dumps({"do": "show", "number": asked, "direction": direction}))
            header, _, pixels = until(connection, "picture")
            assert (header["number"], header["past"], pixels is None) == (found, True, found == 1)
        connection.send('{"do": "show", "number": 9, "direction": 1}')
        assert "no longer kept" in until(connection, "answer")["problem"]
        session.publish(6, 0.1)
        with pytest.raises(TimeoutError):
            until(connection, "picture", 0.2)
        connection.send('{"do": "follow", "on": true}')
        assert until(connection, "picture")[0]["number"] == 6


def test_latency_is_of_displayed_pictures():
    """Latency is from a frame's last byte to the report. Skipped and hidden pictures do not count."""
    import asyncio

    async def judged():
        viewer = Viewer()
        now = time.monotonic()
        for number, ago in ((1, 90.0), (2, 30.0)):
            viewer.record_sent(number, now - ago)
        assert not viewer.is_ready_for(3)
        viewer.record_drawn(2, hidden=False)
        viewer.record_sent(3, now - 600)
        viewer.record_drawn(3, hidden=True)
        viewer.record_drawn(77, hidden=False)
        return viewer.summary()

    assert asyncio.run(judged())["latency_99"] == pytest.approx(30, abs=5)


def test_the_end(served):
    """The server ends with the session, unless it is configured to stay. The state says that the session has ended."""
    session = StandIn(None)
    address = served(session)
    session.stop()
    end = time.monotonic() + 5
    while time.monotonic() < end:
        try:
            answer(address)
        except OSError:
            break
        time.sleep(0.05)
    else:
        pytest.fail("the server goes on")


def test_taken_port_and_unknown_host():
    """A port in use, and a host that is not this machine's, are errors that say so."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(OSError, match=rf"port {port}.*choose another"):
            serve(idle(), port=port)
    with pytest.raises(OSError, match="no such host"):
        serve(idle(), host="no such host", port=1)
    with pytest.raises(OSError, match="70000"):
        serve(idle(), port=70000)


def test_hub_outlives_a_closed_loop():
    """The thread that waits for pictures ends when its server is gone."""
    import asyncio

    session: Any = StandIn(200.0)
    hub = PageHub(session)

    async def begin():
        hub.start()

    with session:
        asyncio.run(begin())
        hub._watch_thread.join(5)
        assert not hub._watch_thread.is_alive()
