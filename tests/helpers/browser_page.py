"""What the tests of the page look at, and how."""

from __future__ import annotations

import base64
import io
import os
from pathlib import Path

import numpy as np
import pytest
from browser_engine import colours, make_rig, positions
from PIL import Image
from running import picture
from waiting import HANG_S

from scas4d_core.captures import InitialPoints

FRAMES = 7
SIZES = {"desk": {"width": 1440, "height": 900}, "phone": {"width": 390, "height": 844}}
SERIOUS = ("serious", "critical")


def start_scene(sdk, name="ring", settings=None, ingest=None):
    """A scene of the ring of cameras around the spiral."""
    status = sdk.create_scene(make_rig(), name=name, settings=settings, frames_per_second=10, ingest=ingest)
    sdk.put_points(status.id, InitialPoints(positions(), colours().astype("float32"), None))
    return status.id


def push(sdk, id, index, red=0):
    """One frame; `red` tells the fake what to do."""
    sdk.put_frame(id, index, {name: picture(red, (32, 24)) for name in make_rig().names})


def opened(page, service, scene, frame=None):
    page.goto(f"{service.url}/#scene={scene}" + ("" if frame is None else f"&frame={frame}"))
    return page


def shown(page, **wanted):
    """Waits until the picture that is shown has these properties; the picture."""
    tests = " && ".join(f"d.{name} === {value!r}" for name, value in wanted.items()) or "true"
    until(page, f"{{ const d = document.getElementById('view').dataset; return d.tag && ({tests}); }}")
    return canvas(page)


def until(page, condition):
    """Waits until an expression is true; as a function, because the page's policy forbids to evaluate text."""
    from playwright.sync_api import TimeoutError  # without it the tests of the page are skipped

    try:
        page.wait_for_function(f"() => {condition}")
    except TimeoutError as error:
        raise AssertionError(f"not within the time: {condition}; the page shows {_text(page)!r}") from error


def read_until(page, read, condition, pause=200):
    """Reads a value of the page, with pauses in milliseconds, until it meets a condition; the value."""
    for _ in range(int(HANG_S)):
        found = read()
        if condition(found):
            return found
        page.wait_for_timeout(pause)
    raise AssertionError(f"the page did not come to be as expected; it shows {_text(page)!r}")


def expect(locator):
    """Playwright's assertions on a locator, which wait: the page shows parts of one event at different times."""
    from playwright.sync_api import expect as waiting_expect  # without it the tests of the page are skipped

    waiting_expect.set_options(timeout=1000 * HANG_S)
    return waiting_expect(locator)


def _text(page):
    return page.evaluate("() => document.body.innerText")[:1500]


def canvas(page, id="picture"):
    data = page.evaluate(f"document.getElementById({id!r}).toDataURL('image/png').split(',')[1]")
    return np.array(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGBA")).astype(int)


def looked_at(page, name, faults=()):
    """Keeps a screenshot, and checks what holds in every state."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="pip install axe-playwright-python")
    if folder := os.environ.get("SCAS4D_TEST_PICTURES"):
        page.screenshot(path=str(Path(folder) / f"{name}-{page.size}.png"))
    found = axe.Axe().run(page).response["violations"]
    serious = [(one["id"], [node["html"][:200] for node in one["nodes"]]) for one in found if one["impact"] in SERIOUS]
    assert serious == []
    assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[page.size]["width"]
    assert [fault for fault in page.faults if not any(part in fault for part in faults)] == []
