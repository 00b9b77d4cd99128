"""The page of a live session in a real browser, Debian's Chromium, driven by Playwright.

Drawn pictures are read from the canvas: the known place of a Gaussian or of a rod is compared with the place of the
strongest colour. Each button, key and field is tested by its effect. Skipped where there is no browser or no
Playwright.
"""

import time

import numpy as np
import pytest
from browser_page import IN_BROWSER, LOOK, drawn, place, shows, text, until
from stand_in import StandIn

pytest.importorskip("playwright.sync_api", reason="needs Playwright: pip install playwright")
pytest.importorskip("uvicorn", reason="the page needs the extra live")

pytestmark = IN_BROWSER


@pytest.mark.parametrize("width", [400, 1280, 2000])
def test_gaussian_appears_where_it_is(serving, open_page, width):
    """The strongest colour is within 4 mm of the Gaussian, part of which its label hides, at each width and time."""
    session = StandIn(None)
    address = serving(session)
    page = open_page(address, width, 1000)
    for number, second in enumerate((0.7, 2.9, 4.8, 7.1)):
        session.publish(number, second)
        shows(page, number)
        found = place(page.evaluate(LOOK))
        assert np.linalg.norm(found - session.place(second)) < 4e-3, (second, found)


def test_rod_of_the_demonstration_appears_where_it_is(serving, open_page):
    """The strongest colour is within 10 mm of the simulated rod in a picture of `jeit live demo`."""
    from jeit.live.session import Session
    from jeit.live.simulated import simulated_tank
    from jeit.live.views.conductivity import ConductivityView

    source = simulated_tank(30.0)
    address = serving(Session(source, ConductivityView.prepare(source.reference)))
    page = open_page(address)
    assert until(lambda: drawn(page) > 5, 10)
    first = drawn(page)
    for _ in range(3):
        page.click("#pause")
        time.sleep(0.3)
        second = float(page.get_attribute("#image", "data-second"))
        found = place(page.evaluate(LOOK))
        assert np.linalg.norm(found - source.truth(second)) < 10e-3, (second, found, source.truth(second))
        page.click("#pause")
        time.sleep(0.7)
    assert drawn(page) > first + 10


def test_measurement_buttons(serving, open_page):
    """Reference, event and recording reach the session, with the typed text, and the page shows the results."""
    session = StandIn()
    address = serving(session)
    page = open_page(address)
    page.wait_for_selector("#image[data-number]")
    page.press("#count", "ControlOrMeta+a")
    page.type("#count", "12")
    page.click("#reference")
    page.type("#label", "<i>rod</i> in")
    page.press("#label", "Enter")
    assert until(lambda: len(session.asked) == 2)
    page.press("#label", "ControlOrMeta+a")
    page.press("#label", "Delete")
    page.click("#image")
    page.keyboard.press("m")
    page.click("#record")
    assert until(lambda: text(page, "recording") == "12 frames, 34.6 kB")
    assert (text(page, "record"), page.get_attribute("#recording", "title")) == ("Stop recording", "recordings/one")
    page.click("#record")
    assert until(lambda: text(page, "recording") == "not recording")
    assert session.asked == [
        ("reference", 12),
        ("mark", "<i>rod</i> in"),
        ("mark", "event"),
        ("record", True),
        ("record", False),
    ]
    assert until(lambda: "Event: <i>rod</i> in" in text(page, "messages"))
    assert page.locator("#messages i").count() == 0
    page.fill("#count", "0")
    page.click("#reference")
    assert until(lambda: "whole number" in text(page, "banner"))
    assert len(session.asked) == 5


def test_pause_and_steps(serving, open_page):
    """Pause stops the picture, steps show adjacent frames, the slider goes back, and resuming shows the newest."""
    session = StandIn(30.0)
    address = serving(session)
    page = open_page(address)
    assert until(lambda: drawn(page) > 60, 10)
    page.click("#pause")
    time.sleep(0.3)
    number = drawn(page)
    time.sleep(0.3)
    assert drawn(page) == number
    assert text(page, "pause") == "Go on"
    for action, by in (("#back", -1), ("#back", -2), ("#on", -1)):
        page.click(action)
        shows(page, number + by)
    assert text(page, "ago").startswith("−0.0")
    page.click("#readout")
    page.keyboard.press("Shift+ArrowLeft")
    shows(page, number - 11)
    page.keyboard.press("ArrowRight")
    shows(page, number - 10)
    page.evaluate("when => { when.value = -1; when.dispatchEvent(new Event('input')); }", page.query_selector("#when"))
    assert until(lambda: abs(drawn(page) - (number - 30)) <= 6)
    page.keyboard.press(" ")
    assert until(lambda: drawn(page) > number + 20)
    assert (text(page, "pause"), text(page, "ago")) == ("Pause", "now")


def test_colours(serving, open_page):
    """Scale fitted and kept, its limit typed, values hidden, pixels smoothed, light and dark: each has its effect."""
    session = StandIn(None)
    address = serving(session)
    page = open_page(address)
    session.publish(0, 1.0)
    shows(page, 0)
    assert page.input_value("#limit") == "4.00"
    assert text(page, "limit-unit") == "mS/m"
    fitted = page.evaluate(LOOK)
    page.press("#limit", "ControlOrMeta+a")
    page.type("#limit", "40")
    page.press("#limit", "Enter")
    assert page.get_attribute("#fit", "aria-pressed") == "false"
    assert until(lambda: page.evaluate(LOOK)["count"] < 0.2 * fitted["count"])
    page.fill("#limit", "nonsense")
    page.press("#limit", "Enter")
    assert until(lambda: "type a number" in text(page, "banner"))
    assert page.input_value("#limit") == "40.0"
    page.click("#fit")
    assert until(lambda: page.input_value("#limit") == "4.00")
    page.keyboard.press("f")
    assert page.get_attribute("#fit", "aria-pressed") == "false"
    page.click("#fit")
    for _ in range(16):
        page.keyboard.press("]")
    assert text(page, "threshold-value") == "80 %"
    assert until(lambda: page.evaluate(LOOK)["count"] < 0.5 * fitted["count"])
    for _ in range(16):
        page.keyboard.press("[")
    picture = "() => document.getElementById('image').toDataURL()"
    seen = set()
    for choice in ("pixels", "0", "1", "2"):
        page.select_option("#smoothing", choice)
        time.sleep(0.2)
        seen.add(page.evaluate(picture))
    assert len(seen) == 4
    paper = "() => getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(paper)
    page.click("#theme")
    assert page.evaluate(paper) != light
    page.keyboard.press("l")
    assert page.evaluate(paper) == light


def test_pictures_and_films_are_saved(serving, open_page):
    """The picture is a PNG of the canvas' size, the film a video. Both are downloads with names of their own."""
    session = StandIn()
    address = serving(session)
    page = open_page(address)
    page.wait_for_selector("#image[data-number]")
    with page.expect_download() as download:
        page.click("#save")
    content = download.value.path().read_bytes()
    assert download.value.suggested_filename.endswith(".png")
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    size = page.evaluate("() => { const c = document.getElementById('image'); return [c.width, c.height]; }")
    assert [int.from_bytes(content[at : at + 4], "big") for at in (16, 20)] == size
    page.click("#film")
    assert text(page, "film") == "Stop film"
    time.sleep(1.5)
    with page.expect_download() as download:
        page.click("#film")
    content = download.value.path().read_bytes()
    assert download.value.suggested_filename.endswith((".webm", ".mp4"))
    assert content[:4] == b"\x1aE\xdf\xa3" or content[4:8] == b"ftyp"
    assert len(content) > 5000


def test_regions_and_channels_are_followed(serving, open_page):
    """A region drawn with the mouse, one set by keys, and a channel get a line each, and can be removed again."""
    session = StandIn()
    address = serving(session)
    page = open_page(address)
    page.wait_for_selector("#image[data-number]")
    box = page.locator("#image").bounding_box()
    x, y = box["x"] + box["width"] * 0.45, box["y"] + box["height"] * 0.5
    page.mouse.move(x, y)
    page.mouse.down()
    for right, down in ((60, 0), (60, 60), (0, 60)):
        page.mouse.move(x + right, y + down, steps=3)
    page.mouse.up()
    assert until(lambda: text(page, "regions") == "A\n×")
    page.focus("#image")
    page.keyboard.press("Shift+ArrowRight")
    assert until(lambda: text(page, "readout").startswith("x 20.0 mm, y 0.0 mm: "))
    page.keyboard.press("Enter")
    assert until(lambda: "B" in text(page, "regions"))
    page.type("#channel", "2-3")
    page.press("#channel", "Enter")
    page.fill("#channel", "7")
    page.press("#channel", "Enter")
    assert until(lambda: text(page, "channels").split() == ["2-3", "×", "7-8", "×"])
    page.fill("#channel", "41")
    page.press("#channel", "Enter")
    assert until(lambda: "from 1 to 40" in text(page, "banner"))
    coloured = """(name) => {
      const canvas = document.getElementById(name);
      const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
      copy.drawImage(canvas, 0, 0);
      const data = copy.getImageData(0, 0, canvas.width, canvas.height).data;
      let count = 0;
      for (let at = 0; at < data.length; at += 4) count += Math.abs(data[at] - data[at + 2]) > 90;
      return count;
    }"""
    for name in ("regions-trace", "channels-trace"):
        assert until(lambda name=name: page.evaluate(coloured, name) > 40), name
    page.click("[aria-label='Stop following A']")
    page.click("[aria-label='Stop following B']")
    page.click("[aria-label='Stop following 2-3']")
    assert until(lambda: text(page, "channels").split() == ["7-8", "×"])
    assert page.locator("#regions-trace").is_hidden()


@pytest.mark.parametrize("width", [400, 1280])
def test_picture_is_saved_after_the_cross_was_moved(serving, open_page, width):
    """The text under the image changes as the cross moves, but no button moves from under the mouse."""
    session = StandIn()
    page = open_page(serving(session), width)
    page.wait_for_selector("#image[data-number]")
    page.click("#pause")
    page.focus("#image")
    page.keyboard.press("ArrowLeft")
    assert until(lambda: text(page, "readout").startswith("x −2.0 mm"))
    with page.expect_download(timeout=10_000):
        page.click("#save")
    assert until(lambda: "Saved jeit-" in text(page, "banner"))


def test_straight_drags_and_clicks(serving, open_page):
    """A straight drag adds a rectangle, a click beside the body nothing. After Escape the arrows step again."""
    session = StandIn()
    page = open_page(serving(session))
    page.wait_for_selector("#image[data-number]")
    box = page.locator("#image").bounding_box()
    x, y = box["x"] + box["width"] * 0.45, box["y"] + box["height"] * 0.5
    for right, down in ((60, 40), (60, 0), (0, -60)):
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + right, y + down, steps=5)
        page.mouse.up()
    assert until(lambda: text(page, "regions").split() == ["A", "×", "B", "×", "C", "×"])
    page.mouse.click(box["x"] + 12, box["y"] + 60)
    assert until(lambda: text(page, "banner").startswith("No region"))
    assert text(page, "regions").split() == ["A", "×", "B", "×", "C", "×"]
    page.keyboard.press("ArrowLeft")
    assert text(page, "pause") == "Pause"
    page.keyboard.press("Escape")
    page.keyboard.press("ArrowLeft")
    assert text(page, "pause") == "Go on"


def test_numbers_have_no_caret(serving, open_page):
    """Small and large numbers have an exponent as programs write it, with the true minus sign."""
    page = open_page(serving(StandIn()))
    numbers = [-6.97e-4, 1.234e7, -0.5, 1e-7]
    read = """async (numbers) => {
      const { short, round } = await import(new URL("numbers.js", location.href));
      return numbers.map((number) => [short(number), round(number)]).flat();
    }"""
    assert page.evaluate(read, numbers) == [
        "−6.97e−4", "−0.000697", "1.23e7", "12300000", "−0.500", "−0.5", "1.00e−7", "1e−7",
    ]  # fmt: skip


def test_no_page_scrolls_sideways(serving, open_page):
    """Nothing is wider than the window, from 400 to 2,000 pixels, and a wide one needs no scrolling at all."""
    session = StandIn()
    address = serving(session)
    for width, height in ((400, 850), (600, 900), (900, 700), (1280, 800), (2000, 1100)):
        page = open_page(address, width, height)
        page.wait_for_selector("#image[data-number]")
        size = page.evaluate("() => [document.body.scrollWidth, document.body.scrollHeight]")
        assert size[0] <= width
        assert size[1] <= height or width <= 860


def lightness(colours):
    """CIE lightness of sRGB colours (n, 3), and the colours as a person without green cones sees them.

    Matrix of Machado, Oliveira and Fernandes, IEEE Trans. Vis. Comput. Graph. 15 (2009), for deuteranopia.
    """
    part = np.asarray(colours) / 255
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    matrix = np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]])
    return 116 * np.cbrt(luminance) - 16, linear @ matrix.T


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_colour_maps_are_even_and_readable(serving, open_page, theme):
    """Lightness is monotone from end to end, or from the middle. The ends remain distinct for viewers without green
    cones.
    """
    address = serving(StandIn())
    page = open_page(address)
    read = """async ([diverging, theme]) =>
      Array.from((await import(new URL("colours.js", location.href))).colourMap(diverging, theme))"""
    sequential = np.reshape(page.evaluate(read, [False, theme]), (256, 3))
    diverging = np.reshape(page.evaluate(read, [True, theme]), (256, 3))
    light, _ = lightness(sequential)
    assert np.all(np.diff(light) > -0.3)
    assert np.ptp(light) > 60
    light, seen = lightness(diverging)
    outward = np.sign(np.diff(light)) * (1 if theme == "dark" else -1)
    assert np.mean(outward[:126] <= 0) > 0.98
    assert np.mean(outward[129:] >= 0) > 0.98
    assert np.abs(light[0] - light[-1]) < 12
    assert np.linalg.norm(seen[0] - seen[-1]) > 0.25
