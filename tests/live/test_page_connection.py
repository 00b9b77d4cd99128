"""The page of a live session in a real browser while something fails: a recording, frames, the server, the browser."""

import os
import signal
import time
from pathlib import Path

import pytest
from browser_page import IN_BROWSER, drawn, shows, text, until
from stand_in import StandIn

pytest.importorskip("playwright.sync_api", reason="needs Playwright: pip install playwright")
pytest.importorskip("uvicorn", reason="the page needs the extra live")

pytestmark = IN_BROWSER


def resident_memory():
    """Memory of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_a_failed_recording_is_reported_over_the_image(serving, open_page):
    """A recording that cannot begin is named in the banner when it fails, and not again when the page is opened."""
    session = StandIn()
    address = serving(session)
    page = open_page(address)
    page.wait_for_selector("#image[data-number]")
    assert until(lambda: text(page, "connection") == "connected")
    failure = "The recording cannot begin: Read-only file system"
    session.extra["messages"] = [{"second": 3.0, "text": failure}]
    assert until(lambda: text(page, "banner") == failure)
    other = open_page(address)
    assert until(lambda: failure in text(other, "messages"))
    assert other.locator("#banner").is_hidden()


def test_faults_are_shown(serving, open_page):
    """Refused frames with reasons, dead electrodes in colour, a full disk, a disconnected device."""
    session = StandIn(None)
    warned = """() => {
      const canvas = document.getElementById("image");
      const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
      copy.drawImage(canvas, 0, 0);
      const data = copy.getImageData(0, 0, canvas.width - 84, canvas.height).data;
      let count = 0;
      for (let at = 0; at < data.length; at += 4) {
        count += data[at] === 0xb3 && data[at + 1] === 0x40 && data[at + 2] === 0x0a;
      }
      return count;
    }"""
    address = serving(session)
    page = open_page(address)
    session.publish(0, 1.0)
    shows(page, 0)
    assert page.evaluate(warned) == 0
    session.extra = {
        "refused": 3,
        "dropped": 17,
        "reasons": {"half a line": 3},
        "dead": ["4"],
        "drifting": ["2", "7"],
        "connection": "waiting: /dev/ttyUSB0 is unplugged",
        "recording": {"folder": "one", "frames": 5, "bytes": 10, "problem": "The disk is full."},
    }
    assert until(lambda: text(page, "dead") == "4")
    assert text(page, "drifting") == "2, 7"
    assert (text(page, "refused"), text(page, "dropped"), text(page, "reasons")) == ("3", "17", "3 × half a line")
    assert "unplugged" in text(page, "connection")
    assert "The disk is full." in text(page, "recording")
    assert until(lambda: page.evaluate(warned) > 50)
    session.publish(1, 2.0, refused="41 channels, not 40")
    assert until(lambda: text(page, "banner") == "Refused: 41 channels, not 40")
    session.publish(2, 2.1)
    assert until(lambda: page.locator("#banner").is_hidden())


def test_two_browsers_and_a_sleeping_one(serving, open_page):
    """Two pages each draw. One that is busy for seconds is sent nothing meanwhile, and continues with the newest."""
    session = StandIn()
    address = serving(session)
    one, two = open_page(address), open_page(address, 400, 800)
    for page in (one, two):
        assert until(lambda page=page: drawn(page) > 30, 10)
    two.evaluate("() => { const end = performance.now() + 3000; while (performance.now() < end); }")
    newest = session.last
    assert until(lambda: drawn(two) > newest, 2.0)
    assert until(lambda: float(text(one, "drawn").removesuffix(" /s")) > 20, 10)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads memory as Linux has it")
def test_a_browser_suspended_for_1800_frames(browser, serving):
    """A suspended browser costs the session nothing, and shows the newest frame within 3 s after it resumes."""
    session, processes = StandIn(60.0), browser.new_browser_cdp_session()
    page = browser.new_context().new_page()
    page.goto(serving(session))
    assert until(lambda: drawn(page) > 10, 10)
    found = processes.send("SystemInfo.getProcessInfo")["processInfo"]
    renderers = [process["id"] for process in found if process["type"] == "renderer"]
    before = resident_memory()
    for pid in renderers:
        os.kill(pid, signal.SIGSTOP)
    try:
        time.sleep(30)
    finally:
        for pid in renderers:
            os.kill(pid, signal.SIGCONT)
    newest = session.last
    assert newest > 1500
    assert until(lambda: drawn(page) > newest, 3.0)
    assert until(lambda: text(page, "connection") == "connected")
    # The session itself keeps a picture of 64 × 64 for each frame.
    assert resident_memory() - before < 60e6
    page.context.close()


def test_a_lost_server_is_found_again(browser, serving):
    """When the server stops, the page says so, and it draws again when the server is back."""
    session, context = StandIn(), browser.new_context()
    page = context.new_page()
    address = serving(session)
    page.goto(address)
    page.wait_for_selector("#image[data-number]")
    session.stop()
    assert until(lambda: "cannot be reached" in text(page, "banner"))
    port = int(address.rstrip("/").rpartition(":")[2])
    serving(StandIn(), port=port)
    assert until(lambda: page.locator("#banner").is_hidden(), 10)
    assert until(lambda: text(page, "connection") == "connected")
    context.close()
