"""A headless browser of this machine: tests of the page are skipped, with the reason, where there is none."""

from __future__ import annotations

import browser_engine
import pytest
from browser_page import FRAMES, SIZES, push, start_scene
from running import Running, fake_settings
from waiting import HANG_S

from client.sdk import Client
from studies.machine import browser_path

SIZE = {"width": 1280, "height": 800}


@pytest.fixture(scope="module")  # its event loop must not outlive these tests: others run their own
def chromium():
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright for the tests of the page")
    path = browser_path()
    if path is None:
        pytest.skip("no chromium here: apt-get install chromium, or name one in SCAS4D_TEST_BROWSER")
    with playwright.sync_playwright() as started:
        # As root, which containers often are, Chromium runs only without its own sandbox; it opens this service alone.
        browser = started.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def page(chromium):
    """A page on which nothing may go wrong unseen."""
    opened = chromium.new_page(viewport=SIZE)
    opened.set_default_timeout(1000 * HANG_S)
    opened.faults = []
    opened.on("pageerror", lambda error: opened.faults.append(str(error)))
    opened.on("console", lambda message: opened.faults.append(message.text) if message.type == "error" else None)
    yield opened
    opened.close()


@pytest.fixture(params=SIZES)
def sized(request, chromium):
    """A page of a size, with a finger on the phone; faults that the test does not expect fail it."""
    phone = request.param == "phone"
    context = chromium.new_context(viewport=SIZES[request.param], has_touch=phone, is_mobile=phone)
    page = context.new_page()
    page.set_default_timeout(1000 * HANG_S)
    page.size, page.faults = request.param, []
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.on("console", lambda message: page.faults.append(message.text) if message.type == "error" else None)
    yield page
    context.close()


@pytest.fixture(scope="session")
def service(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewer")
    running = Running(fake_settings(folder), core=browser_engine.install)
    yield running
    running.stop()


@pytest.fixture(scope="session")
def finished(service):
    """A scene whose frames are all committed."""
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk)
        for index in range(FRAMES):
            push(sdk, id, index)
        sdk.wait(id, FRAMES - 1)
        yield id
