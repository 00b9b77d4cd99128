"""The page of a live session in a real browser, Debian's Chromium, driven by Playwright: what it shows."""

import shutil
import time

import numpy as np
import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
IN_BROWSER = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: apt-get install chromium"),
]
"""Marks of the tests in a browser."""

# Where the image is strongest, and the box of the electrodes, which are dark, and of which one is at each end of both
# axes: pixels of the canvas; and how many pixels have strong colours.
LOOK = """() => {
  const canvas = document.getElementById("image");
  const { width, height } = canvas;
  const copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0);
  const data = copy.getImageData(0, 0, width, height).data;
  const right = width - (width < 520 ? 62 : 84);
  const columns = new Int32Array(width), rows = new Int32Array(height);
  let x = 0, y = 0, sum = 0, count = 0;
  for (let row = 0; row < height; row += 1) {
    for (let column = 0; column < right; column += 1) {
      const at = 4 * (row * width + column);
      const [red, green, blue] = [data[at], data[at + 1], data[at + 2]];
      const dark = Math.max(red, green, blue) < 80 && row > 30 && row < height - 30;
      columns[column] += dark;
      rows[row] += dark;
      const weight = Math.max(0, blue - red - 60);
      x += weight * (column + 0.5); y += weight * (row + 0.5); sum += weight; count += weight > 0;
    }
  }
  const ends = (counts) => [counts.findIndex((one) => one > 12), counts.findLastIndex((one) => one > 12) + 1];
  const box = [...ends(columns), ...ends(rows)];
  return { x: x / sum, y: y / sum, box, count };
}"""


def until(condition, seconds=5.0):
    """Wait for a condition, and return whether it was met."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def drawn(page):
    """Number of the frame whose picture is drawn, or -1 before the first."""
    return int(page.get_attribute("#image", "data-number") or -1)


def shows(page, number):
    """Wait until the picture of a frame is drawn."""
    assert until(lambda: drawn(page) == number, 10), (number, drawn(page))


def place(look, radius=0.1):
    """Place of the strongest colour, metres, by the box of the electrodes."""
    left, right, top, bottom = look["box"]
    scale = 2 * radius / (right - left)
    assert abs((bottom - top) - (right - left)) < 4
    return np.array([look["x"] - (left + right) / 2, (top + bottom) / 2 - look["y"]]) * scale


def text(page, name):
    return page.inner_text(f"#{name}")
