"""Latency from a frame's last byte to the picture in a browser: a simulated tank, imaged and drawn by Chromium.

The page reports each picture once it is painted, and the server records the arrival of the report. Latency includes the
transfer of the report, so that only one clock is used. Simulation, imaging, server and browser share the machine's
cores. The browser has no window, and paints without a graphics card.
"""

from __future__ import annotations

import shutil
import threading
import time
from contextlib import contextmanager

import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say
from jeit.imaging.stream_preparation import StreamSettings
from jeit.live.server import serve
from jeit.live.session import Session
from jeit.live.simulated import simulated_tank
from jeit.live.views.conductivity import ConductivityView

RATE, WINDOW = 60.0, 10.0
"""Frames a second, and seconds over which the page's latency is computed."""
MEDIAN, HIGH, PICTURES = 0.05, 0.1, 20.0
"""Limits of the median and 99th percentile of latency, seconds, and the least number of pictures drawn per second."""
SIZES = ((1280, 800), (2000, 1100))
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def run(options: Options) -> Result:
    """Measure linear images and Gauss-Newton images, in browser windows of two sizes."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        return Result([], notes=["Playwright is needed: pip install playwright."])
    if program is None:
        return Result([], notes=[f"A browser is needed: {', '.join(BROWSERS)}."])
    rows, asked = [], []
    window, samples = (1.0, 1) if options.quick else (WINDOW, 6)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        for name, solver in (("linear", "one-step"), ("Gauss-Newton", "gauss-newton")):
            tank = simulated_tank(RATE)
            view = ConductivityView.prepare(tank.reference, StreamSettings(solver=solver))
            with _served(Session(tank, view)) as (session, address):
                for width, height in SIZES[: 1 if options.quick else None]:
                    page = browser.new_page(viewport={"width": width, "height": height})
                    page.goto(address)
                    found = np.array([_sample(page, window) for _ in range(samples)])
                    page.close()
                    median, high = np.median(found[:, 0]), np.max(found[:, 1])
                    drawn, state = np.mean(found[:, 2]), session.state()
                    left_out = f"{state['dropped']:,} of {state['read']:,}"
                    row = [name, f"{width} × {height}", duration(median), duration(high), f"{drawn:.1f}", left_out]
                    say(" | ".join(row))
                    rows.append(row)
                    met = bool(median <= MEDIAN and high <= HIGH and drawn >= PICTURES)
                    what = f"{name}, {width} px: ≤ {1e3 * MEDIAN:.0f} ms, 99 % ≤ {1e3 * HIGH:.0f} ms, ≥ 20 a second"
                    asked.append(judged(what, f"{row[2]}, {row[3]}, {row[4]}", met))
        browser.close()
    header = ["images", "window", "latency: median", "worst 99 % of 10 s", "drawn a second", "not shown"]
    return Result([Table(header, rows, f"16 electrodes, 208 voltages, {RATE:g} frames/s")], asked)


def _sample(page, window: float) -> list[float]:
    """Median and 99th percentile of latency, and pictures drawn per second, of the next `window` ≤ 10 seconds."""
    time.sleep(window + 1.0)
    latency = page.locator("#latency")
    times = [float(latency.get_attribute(f"data-{name}")) for name in ("median", "worst")]
    return [*times, float(page.inner_text("#drawn").split()[0])]


@contextmanager
def _served(session: Session):
    opened, addresses = threading.Event(), []
    options = {"opened": lambda address: (addresses.append(address), opened.set())}
    thread = threading.Thread(target=serve, args=(session,), kwargs=options)
    with session:
        thread.start()
        opened.wait(10)
        yield session, addresses[0]
    thread.join(10)


CASE = Case("live_page", "a device's frames drawn in a browser: latency, and pictures a second", run, 6)
