"""The player, one HTML file, opened from the disk without a network: what a person does, and what they then see."""

from __future__ import annotations

import io
import struct

import browser_engine
import numpy as np
import pytest
from browser_page import canvas, expect, read_until, until
from export_cases import bent
from PIL import Image
from waiting import HANG_S

from client.exports.player import VIEWER, export_player, write_player


@pytest.fixture(scope="module")
def player(tmp_path_factory):
    folder = tmp_path_factory.mktemp("player")
    file = bent.write(folder / "bent.s4d", browser_engine.make_rig())
    export_player(str(file), folder / "out.html", url="http://127.0.0.1:9", token=None)
    return folder / "out.html"


@pytest.fixture
def offline(chromium):
    """A page without a network, on which nothing may go wrong unseen."""
    context = chromium.new_context(viewport={"width": 900, "height": 600}, offline=True)
    page = context.new_page()
    page.set_default_timeout(1000 * HANG_S)
    page.faults = []
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.on("console", lambda message: page.faults.append(message.text) if message.type == "error" else None)
    page.on("request", lambda request: page.faults.append(request.url) if request.url.startswith("http") else None)
    yield page
    context.close()


def opened(page, player):
    page.goto(player.as_uri())
    page.wait_for_selector("#curtain", state="hidden")
    return seen(page)


def seen(page, pause=300):
    """The picture in the middle of the page, without what lies over it."""
    page.wait_for_timeout(pause)
    box = page.locator("#picture").bounding_box()
    clip = {"x": box["x"] + 8, "y": box["y"] + 60, "width": box["width"] - 16, "height": box["height"] - 160}
    return np.array(Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")).astype(int)


def differ(one, other):
    return np.abs(one - other).mean() > 0.3


def changed(page, before):
    """Waits until another picture is shown; the picture."""
    return read_until(page, lambda: seen(page), lambda picture: differ(before, picture))


def restored(page, before):
    """Waits until an earlier picture is shown again; the picture."""
    return read_until(page, lambda: seen(page), lambda picture: not differ(before, picture))


def test_it_plays_without_a_network(offline, player):
    first = opened(offline, player)
    assert first.std() > 10
    assert offline.title() == "bent"
    assert player.stat().st_size - 4 / 3 * (player.with_name("bent.s4d")).stat().st_size < 300_000  # the code
    offline.select_option("#speed", "0.1")
    offline.click("#play")
    until(offline, "Number(document.body.dataset.place) > 0.3")
    places = [
        float(offline.evaluate("document.body.dataset.place")) for _ in range(4) if not offline.wait_for_timeout(60)
    ]
    assert any(place % 1 for place in places)  # in between: slow motion
    until(offline, "Number(document.body.dataset.place) > 1.5")
    offline.click("#play")
    changed(offline, first)
    offline.locator("#time").fill("0.4")  # the time of the first frame
    until(offline, "document.body.dataset.place === '0.000'")
    restored(offline, first)
    offline.focus("#overlay")
    offline.keyboard.press(".")
    until(offline, "document.getElementById('moment').innerText.startsWith('frame 12')")
    assert offline.faults == []


def test_it_turns_and_shows_depth_and_parts(offline, player):
    first = opened(offline, player)
    offline.mouse.move(450, 300)
    offline.mouse.down()
    offline.mouse.move(650, 320, steps=4)
    offline.mouse.up()
    changed(offline, first)
    offline.focus("#overlay")
    offline.keyboard.press("Home")
    restored(offline, first)
    offline.keyboard.press("2")
    depth = changed(offline, first)
    near, far = (float(offline.locator(f"#{id}").inner_text()) for id in ("near", "far"))
    assert 1 < near < far < 6
    offline.click("#modes [data-mode=parts]")
    changed(offline, depth)
    expect(offline.locator("#legend")).to_be_hidden()
    offline.click("#parts-box summary")
    expect(offline.locator("#parts li")).to_have_count(bent.PARTS + 1)
    whole = seen(offline, 700)
    offline.get_by_label("Show part 2 alone").click()
    changed(offline, whole)
    expect(offline.locator("#parts-words")).to_contain_text("3 of 4 hidden", use_inner_text=True)
    offline.get_by_label("Show part 2 alone").click()
    restored(offline, whole)
    assert offline.faults == []


def test_a_gaussian_is_followed_and_trails_are_drawn(offline, player):
    picture = opened(offline, player)
    box = offline.locator("#overlay").bounding_box()
    rows, columns = np.nonzero(np.abs(picture - picture[0, 0]).max(axis=-1) > 90)  # what covers the background
    middle = np.argsort(np.hypot(rows - rows.mean(), columns - columns.mean()))[0]
    offline.mouse.click(box["x"] + 8 + columns[middle] + 0.5, box["y"] + 60 + rows[middle] + 0.5)
    until(offline, "document.getElementById('followed-words').innerText.startsWith('Gaussian')")
    before = seen(offline)
    offline.select_option("#trails", "200")
    offline.locator("#time").fill("0.88")
    changed(offline, before)
    assert (canvas(offline, "overlay")[..., 3] > 0).sum() > 50  # its track
    offline.mouse.click(box["x"] + 4, box["y"] + 4)
    until(offline, "document.getElementById('note').innerText.includes('nothing at that point')")
    offline.focus("#overlay")
    offline.keyboard.press("Escape")
    expect(offline.locator("#followed")).to_be_hidden()
    assert offline.faults == []


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_it_fits_the_window_and_names_its_controls(offline, player, width, height):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="pip install axe-playwright-python")
    offline.set_viewport_size({"width": width, "height": height})
    opened(offline, player)
    assert offline.evaluate("document.documentElement.scrollWidth") <= width
    assert offline.evaluate("document.documentElement.scrollHeight") <= height
    assert offline.locator("#picture").bounding_box()["height"] > 0.6 * height
    found = axe.Axe().run(offline).response["violations"]
    assert [one["id"] for one in found if one["impact"] in ("serious", "critical")] == []


def test_two_frames_of_one_time_have_a_place(offline):
    clock = (VIEWER / "player" / "clock.js").read_text(encoding="utf-8").replace("export class", "class")
    at = "const clock = new Clock([0, 1, 1]); clock.set(1); return clock.place;"
    assert offline.evaluate(f"() => {{ {clock}\n{at} }}") == 2


def test_a_file_that_was_cut_says_so(offline, player, tmp_path):
    file = tmp_path / "cut.s4d"
    file.write_bytes(player.with_name("bent.s4d").read_bytes()[:300])
    write_player(tmp_path / "cut.html", "<b>cut & run</b>", [file])
    offline.goto((tmp_path / "cut.html").as_uri())
    until(offline, "document.getElementById('curtain-words').innerText.includes('damaged or truncated')")
    assert offline.title() == "<b>cut & run</b>"


def damaged(data, frame):
    """A compact file in which the body of the record of a frame is wrong."""
    at = 0
    while True:
        kind, index, size = data[at + 4], *struct.unpack_from("<q8xI", data, at + 8)
        if kind in (3, 4) and index == frame:
            middle = at + 36 + size // 2
            return data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :]
        at += 36 + size


def test_a_damaged_frame_costs_its_own_pictures_alone(offline, player, tmp_path):
    file = tmp_path / "damaged.s4d"
    file.write_bytes(damaged(player.with_name("bent.s4d").read_bytes(), 18))  # 20 is told by it, 22 is a key frame
    write_player(tmp_path / "damaged.html", "damaged", [file])
    first = opened(offline, tmp_path / "damaged.html")
    offline.select_option("#trails", "200")  # meets it in the background
    until(offline, "document.getElementById('note').innerText.includes('frame 18')")
    offline.click("#play")  # decodes ahead
    until(offline, "Number(document.body.dataset.place) > 2")
    until(offline, "document.body.dataset.place === '6.000'")
    offline.click("#play")
    expect(offline.locator("#curtain")).to_be_hidden()
    offline.locator("#time").fill("0.88")
    until(offline, "document.body.dataset.place === '6.000'")
    changed(offline, first)
    assert offline.faults == []
