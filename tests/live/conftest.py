"""Fixtures of the tests in a browser: a session that serves its page, and windows that open the page."""

import threading

import pytest
from browser_page import CHROMIUM


@pytest.fixture
def serving():
    """Start a session and serve it. Returns the address. It ends after the pages are closed."""
    from jeit.live.server import serve  # needs the extra live

    running = []

    def start(session, **options):
        opened, addresses = threading.Event(), []
        options |= {"opened": lambda address: (addresses.append(address), opened.set())}
        thread = threading.Thread(target=serve, args=(session,), kwargs=options)
        session.__enter__()
        thread.start()
        running.append((session, thread))
        assert opened.wait(10)
        return addresses[0]

    yield start
    for session, thread in running:
        session.stop()
        thread.join(10)
        assert not thread.is_alive()


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright: pip install playwright")
    with playwright.sync_playwright() as driver:
        program = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield program
        program.close()


@pytest.fixture
def open_page(browser, serving):
    """Open an address in a window of its own. Any error on the console fails the test."""
    contexts, faults = [], []

    def opened(address, width=1280, height=800, theme="light"):
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=theme)
        contexts.append(context)
        page = context.new_page()
        page.on(
            "console", lambda message: faults.append(message.text) if message.type in ("error", "warning") else None
        )
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(address)
        return page

    yield opened
    for context in contexts:
        context.close()
    assert faults == []
