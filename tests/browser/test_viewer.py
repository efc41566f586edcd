"""The page in a real browser: what a person does, and what they then see."""

from __future__ import annotations

import base64
import io

import browser_engine
import numpy as np
import pytest
from browser_page import FRAMES, canvas, expect, opened, push, shown, start_scene, until
from PIL import Image
from running import Running, fake_settings
from waiting import HANG_S

from client.sdk import Client
from client.wire import part_colour


def rests(page, **wanted):
    """The same, when the picture that was asked for last is shown and nothing more is asked for."""
    shown(page, **wanted)
    before = None
    for _ in range(100):
        page.wait_for_timeout(300)
        tag, asked = page.evaluate("(({ tag, asked }) => [tag, asked])(document.getElementById('view').dataset)")
        if tag == asked == before:
            return canvas(page)
        before = tag
    raise AssertionError("pictures go on coming")


def middle(page):
    box = page.locator("#overlay").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def drag(page, dx, dy):
    x, y = middle(page)
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 6):
        page.mouse.move(x + dx * step / 5, y + dy * step / 5)
    page.mouse.up()


def differs(one, other):
    return one.shape != other.shape or np.abs(one - other).mean() > 0.5


def test_a_scene_is_picked_and_shown_with_its_figures(page, service, finished):
    page.goto(service.url)
    page.select_option("#scenes", finished)
    picture = shown(page, frame=str(FRAMES - 1), mode="colour")
    assert picture[..., :3].max() > 100  # discs on black
    expect(page.locator("#state")).to_have_text("Ready", use_inner_text=True)
    expect(page.locator("#facts")).to_contain_text(f"{FRAMES} committed", use_inner_text=True)
    expect(page.locator("#psnr .dot")).to_have_count(FRAMES)
    expect(page.locator("#seconds .bar")).to_have_count(FRAMES - 1)
    expect(page.locator("#queue-words")).to_contain_text("frame 7 is next", use_inner_text=True)
    expect(page.locator("#curtain")).to_be_hidden()
    assert page.faults == []


def test_the_effects_are_listed_with_what_switched_them(page, service):
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, settings={"effects": {"static_colour": "off"}})
        push(sdk, id, 0)
        sdk.wait(id, 0)
        opened(page, service, id)
        page.locator("#effects li").wait_for()
        expect(page.locator("#effects li")).to_have_text(["Static colour: pinned off"], use_inner_text=True)
        usual, idle = page.locator("#effects-words").inner_text().split("Not needed here: ")
        assert usual.startswith("In every update: ")
        assert "rigidity" in usual
        assert "floor" in idle
        assert "static colour" not in usual + idle
        sdk.delete_scene(id)


def test_dragging_turns_the_wheel_zooms_and_home_goes_back(page, service, finished):
    opened(page, service, finished)
    first = rests(page)
    drag(page, 150, 0)
    turned = rests(page)
    assert differs(first, turned)
    page.mouse.wheel(0, 400)
    zoomed = rests(page)
    assert (zoomed[..., :3].sum(-1) > 0).mean() < 0.8 * (turned[..., :3].sum(-1) > 0).mean()  # farther away: smaller
    page.focus("#overlay")
    page.keyboard.press("Shift+ArrowLeft")
    assert differs(zoomed, rests(page))
    page.keyboard.press("Home")
    assert not differs(first, rests(page))
    page.select_option("#from", "3")  # the other side of the ring
    assert differs(first, rests(page))
    assert page.faults == []


def test_time_is_scrubbed_by_slider_keys_and_chart_and_followed_live(page, service, finished):
    opened(page, service, finished)
    newest = rests(page, frame=str(FRAMES - 1))
    page.locator("#time").fill("0")
    first = rests(page, frame="0")
    assert differs(newest, first)
    assert page.locator("#moment").inner_text().startswith("frame 0")
    expect(page.locator("#live")).to_have_attribute("aria-pressed", "false")
    page.focus("#overlay")
    page.keyboard.press(".")
    shown(page, frame="1")
    box = page.locator("#psnr").bounding_box()
    page.mouse.click(box["x"] + 40 + 3.5 / 8 * (box["width"] - 46), box["y"] + 40)
    shown(page, frame="3")
    assert page.url.endswith("frame=3")
    page.keyboard.press("l")
    assert not differs(newest, rests(page, frame=str(FRAMES - 1)))
    assert page.faults == []


def test_depth_parts_and_coverage(page, service, finished):
    opened(page, service, finished)
    colour = rests(page, mode="colour")
    page.click("#modes [data-mode=depth]")
    depth = rests(page, mode="depth")
    assert differs(colour, depth)
    near, far = (float(page.locator(f"#{id}").inner_text()) for id in ("near", "far"))
    assert 1.2 < near < far < 5  # the ring is three units wide
    page.keyboard.press("3")
    parts = rests(page, mode="parts")
    assert len(np.unique(parts[..., :3].reshape(-1, 3), axis=0)) == 1 + 3  # the fake's rule
    page.select_option("#part-count select", "5")
    page.wait_for_timeout(300)
    five = rests(page, mode="parts")
    shades = {tuple(shade) for shade in np.unique(five[..., :3].reshape(-1, 3), axis=0).tolist()}
    assert shades == {(0, 0, 0), *map(part_colour, range(5))}  # as the service says, everywhere
    page.focus("#overlay")
    page.keyboard.press("4")
    alpha = rests(page, mode="alpha")
    assert set(np.unique(alpha[..., :3])) == {0, 255}
    assert page.faults == []


def test_a_click_follows_a_point_and_nothing_is_said_where_there_is_none(page, service, finished):
    opened(page, service, finished)
    picture = rests(page)
    rows, columns = np.nonzero(picture[..., :3].sum(-1) > 150)
    pick = np.argsort(np.hypot(rows - rows.mean(), columns - columns.mean()))[0]
    box = page.locator("#overlay").bounding_box()
    at = [(columns[pick] + 0.5) / picture.shape[1], (rows[pick] + 0.5) / picture.shape[0]]
    assert canvas(page, "overlay")[..., 3].max() == 0
    page.mouse.click(box["x"] + at[0] * box["width"], box["y"] + at[1] * box["height"])
    until(page, "document.getElementById('tracks').innerText.includes('7 frames')")
    drawn = canvas(page, "overlay")[..., 3] > 0
    assert drawn.sum() > 50
    ys, xs = np.nonzero(drawn)
    assert abs(xs - at[0] * drawn.shape[1]).min() < 6  # it begins where the click was
    assert abs(ys - at[1] * drawn.shape[0]).min() < 6
    page.mouse.click(box["x"] + 5, box["y"] + box["height"] - 5)  # the background
    until(page, "document.getElementById('note').innerText.includes('no surface')")
    expect(page.locator("#tracks li")).to_have_count(1)
    page.click("#tracks button")
    expect(page.locator("#tracks li")).to_have_count(0)
    assert canvas(page, "overlay")[..., 3].max() == 0
    page.check("#frusta")
    page.focus("#overlay")
    for _ in range(8):
        page.keyboard.press("-")
    rests(page)
    assert (canvas(page, "overlay")[..., 3] > 0).sum() > 200  # the rig
    assert page.faults == []


def test_a_bumped_camera_shows(page, service, finished):
    opened(page, service, finished)
    shown(page, frame=str(FRAMES - 1))
    until(page, "document.getElementById('camera-summary').innerText.includes('c2')")
    row = page.locator("#cameras tr.bad")
    expect(row).to_have_count(1)
    assert row.locator("th").inner_text() == "c2"
    words = "Camera c2: its picture fits 11.0 dB worse: moved? The pictures are 1.3 times as bright."
    expect(page.locator("#camera-summary")).to_have_text(words, use_inner_text=True)
    assert row.locator("td.words").get_attribute("title") == "its picture fits 11.0 dB worse: moved?"
    page.locator("#time").fill("3")  # before it was bumped
    until(page, "document.querySelectorAll('#cameras tr.bad').length === 0")
    assert page.faults == []


def test_a_scene_from_its_first_frame_to_its_deletion(page, service, finished):
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "newborn")
        opened(page, service, id)
        until(page, "document.querySelector('#curtain h2').innerText === 'Waiting for the first frame'")
        expect(page.locator("#time")).to_be_disabled()
        push(sdk, id, 0)
        shown(page, frame="0")
        push(sdk, id, 1)
        shown(page, frame="1")  # followed live
        push(sdk, id, 2, red=250)  # the fake raises: the frame is set aside
        until(page, "document.getElementById('trouble').innerText.includes('Frame 2 failed')")
        expect(page.locator("#state")).to_have_text("Degraded", use_inner_text=True)
        expect(page.locator("#psnr .fault")).to_have_count(1)
        sdk.delete_scene(id)
        until(page, "document.querySelector('#curtain h2').innerText === 'The scene is gone'")
        expect(page.locator("#curtain")).to_be_visible()
        page.select_option("#scenes", finished)
        shown(page, frame=str(FRAMES - 1))
    assert [fault for fault in page.faults if "404" not in fault] == []


def test_it_connects_again_when_the_service_restarts(page, tmp_path):
    settings = fake_settings(tmp_path)
    service = Running(settings, core=browser_engine.install)
    try:
        with Client(service.url, busy_timeout=HANG_S) as sdk:
            id = start_scene(sdk)
            push(sdk, id, 0)
            sdk.wait(id, 0)
        opened(page, service, id)
        shown(page, frame="0")
        service.stop()
        page.wait_for_selector("#banner:not([hidden])")
        expect(page.locator("#banner")).to_contain_text("connection to the service was lost", use_inner_text=True)
        expect(page.locator("#curtain")).to_be_hidden()  # the last picture stays
        service = Running(settings, service.port, core=browser_engine.install)
        page.wait_for_selector("#banner[hidden]", state="attached")
        with Client(service.url, busy_timeout=HANG_S) as sdk:
            push(sdk, id, 1)
        shown(page, frame="1")
    finally:
        service.stop()


def test_an_address_of_no_scene_is_told_and_the_others_are_offered(page, service, finished):
    opened(page, service, "nope")
    until(page, "document.querySelector('#curtain').innerText.includes('There is no such scene')")
    assert "nope" in page.locator("#curtain p").first.inner_text()
    page.wait_for_timeout(300)
    assert page.evaluate("document.getElementById('view').dataset.tag") is None  # nothing else in its place
    page.locator("#curtain .choice").first.click()
    shown(page)
    assert finished in page.url
    page.evaluate("location.hash = '#scene=gone'")  # by hand, in a page that shows a scene
    until(page, "document.querySelector('#curtain').innerText.includes('There is no such scene')")
    page.go_back()
    assert page.faults == []


def test_without_a_scene_it_says_what_to_do(page, tmp_path):
    service = Running(fake_settings(tmp_path), core=browser_engine.install)
    try:
        page.goto(service.url)
        until(page, "document.querySelector('#curtain').innerText.includes('scas4d push')")
        assert page.faults == []
    finally:
        service.stop()


def test_a_token_is_asked_for_and_the_stream_opens_with_a_ticket(page, tmp_path):
    token = "a-token-that-is-long-enough"
    service = Running(fake_settings(tmp_path, token=token), core=browser_engine.install)
    try:
        with Client(service.url, token=token, busy_timeout=HANG_S) as sdk:
            id = start_scene(sdk)
            push(sdk, id, 0)
            sdk.wait(id, 0)
        opened(page, service, id)
        page.wait_for_selector("#door[open]")
        page.fill("#token", "a-token-that-is-another-one")
        page.click("#door button")
        until(page, "document.getElementById('door-words').innerText.includes('The token is wrong')")
        page.fill("#token", token)
        page.click("#door button")
        shown(page, frame="0")
        assert token not in page.url
    finally:
        service.stop()


@pytest.mark.parametrize(("width", "height"), [(1600, 950), (700, 900), (420, 800)])
def test_it_fits_the_window(page, service, finished, width, height):
    page.set_viewport_size({"width": width, "height": height})
    opened(page, service, finished)
    shown(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    box = page.locator("#view").bounding_box()
    assert box["width"] > 0.5 * width
    assert box["height"] > 0.4 * height
    picture = rests(page)
    assert picture.shape[1] / picture.shape[0] == pytest.approx(box["width"] / box["height"], rel=0.05)
    assert page.faults == []


def test_nothing_comes_from_elsewhere(page, service, finished):
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    response = page.goto(f"{service.url}/#scene={finished}")
    policy = response.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    shown(page)
    assert all(url.startswith((service.url, service.url.replace("http", "ws"), "blob:")) for url in asked)
    assert page.faults == []


def test_a_scene_that_begins_again_is_shown_anew(page, service):
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk)
        for index in range(5):
            push(sdk, id, index)
        sdk.wait(id, 4)
        opened(page, service, id)
        shown(page, frame="4")
        sdk.begin_again(id, 1, frame=3, discard=True)
        sdk.wait(id, 4)
        until(page, "document.querySelectorAll('#psnr .dot').length === 2")
        shown(page, frame="4")
        assert page.locator("#facts").inner_text().count("2 committed") == 1
        sdk.delete_scene(id)


def test_the_page_as_a_tool(page, service, finished):
    """Fit, background, snapshot, and one camera's picture beside the view."""
    opened(page, service, finished)
    first = rests(page)
    page.keyboard.press("f")
    fitted = rests(page)
    rows, columns = np.nonzero(fitted[..., :3].sum(-1) > 60)
    height, width = fitted.shape[:2]
    filled = max((rows.max() - rows.min()) / height, (columns.max() - columns.min()) / width)
    assert 0.7 < filled < 1
    assert abs((rows.max() + rows.min()) / 2 - height / 2) < 0.1 * height
    page.select_option("#background", "[1,1,1]")
    white = rests(page)
    assert white[2, 2, :3].tolist() == [255, 255, 255]
    with page.expect_download() as download:
        page.keyboard.press("s")
    assert download.value.suggested_filename == f"ring-frame-{FRAMES - 1}-colour.png"
    saved = np.array(Image.open(download.value.path()).convert("RGB")).astype(int)
    assert np.abs(saved - white[..., :3]).mean() < 3  # a JPEG is on the page, a PNG was saved
    page.select_option("#background", "")
    page.keyboard.press("Home")
    assert not differs(first, rests(page))
    for _ in range(20):
        page.keyboard.press("-")
    far = rests(page)
    assert (far[..., :3].sum(-1) > 60).sum() > 10  # it does not vanish
    assert page.faults == []


def test_a_camera_s_picture_beside_the_view(page, service, finished):
    opened(page, service, finished)
    rests(page)
    page.select_option("#beside-what", "picture")
    page.select_option("#beside-camera", "2")
    box = "document.getElementById('beside').dataset"
    until(page, f"{box}.camera === 'c2' && {box}.what === 'picture' && {box}.frame === '{FRAMES - 1}'")
    sent = page.evaluate("document.querySelector('#beside canvas').toDataURL('image/png').split(',')[1]")
    sent = np.array(Image.open(io.BytesIO(base64.b64decode(sent))).convert("RGB"))
    assert sent.shape == (24, 32, 3)
    assert sent[0, 0].tolist() == [0, 10, 20]  # as `push` sends it
    for what in ("render", "difference", "heat"):
        page.select_option("#beside-what", what)
        until(page, f"{box}.what === '{what}'")
    page.locator("#time").fill("0")
    until(page, f"{box}.frame === '0'")
    page.select_option("#beside-what", "")
    expect(page.locator("#beside")).to_be_hidden()
    assert page.faults == []


def test_keys_work_whatever_was_used_last(page, service, finished):
    opened(page, service, finished)
    rests(page)
    uses = (
        lambda: page.locator("#time").fill("2"),
        lambda: page.select_option("#from", "1"),
        lambda: page.check("#frusta"),
        lambda: page.click("#back"),
        lambda: page.select_option("#scenes", finished),
        lambda: page.click("#psnr"),
    )
    for use in uses:
        use()
        page.keyboard.press("4")
        shown(page, mode="alpha")
        page.keyboard.press("1")
        shown(page, mode="colour")
        page.keyboard.press(",")
    page.click("#play")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Pause")
    page.keyboard.press(" ")  # not the button again
    expect(page.locator("#play")).to_have_attribute("aria-label", "Play")
    page.locator("#from").focus()
    page.keyboard.press("2")
    shown(page, mode="depth")
    expect(page.locator("#from")).to_have_value("1")
    assert page.faults == []


def test_another_kind_of_picture_is_not_taken_for_what_was_chosen(page, service, finished):
    opened(page, service, finished)
    rests(page)
    page.click("#modes [data-mode=depth]")
    rests(page, mode="depth")
    page.evaluate("document.getElementById('overlay')")
    stale = page.evaluate(
        """() => {
        document.querySelector('#modes [data-mode=parts]').click();
        return [document.getElementById('view').classList.contains('stale'), document.getElementById('legend').hidden];
        }"""
    )
    assert stale == [True, True]
    shown(page, mode="parts")
    assert not page.evaluate("document.getElementById('view').classList.contains('stale')")
    assert page.faults == []


def test_it_plays_at_the_recorded_rate(page, service, finished):
    opened(page, service, finished, frame=0)
    rests(page, frame="0")
    took = page.evaluate(
        """() => new Promise((done) => {
        const began = performance.now();
        const look = setInterval(() => {
            if (!document.getElementById('moment').innerText.startsWith('frame 6')) return;
            clearInterval(look);
            done(performance.now() - began);
        }, 5);
        document.getElementById('play').click();
        })"""
    )
    assert took > 550  # six frames of a tenth of a second: never faster than they were taken
    page.click("#play")
    assert page.faults == []


def test_a_link_shows_one_scene_and_changes_nothing(page, tmp_path):
    token = "a-token-that-is-long-enough"
    service = Running(fake_settings(tmp_path, token=token), core=browser_engine.install)
    try:
        with Client(service.url, token=token, busy_timeout=HANG_S) as sdk:
            id, other = start_scene(sdk, "shown"), start_scene(sdk, "hidden")
            push(sdk, id, 0)
            sdk.wait(id, 0)
            link = sdk.share(id)
        page.goto(service.url)
        page.wait_for_selector("#door[open]")
        page.goto(service.url + link.address)  # in the same tab
        shown(page, frame="0")
        assert "token" not in page.url
        expect(page.locator("#scenes option")).to_have_count(1)
        expect(page.locator("#manage-open")).to_be_hidden()
        expect(page.locator("#budget-box")).to_be_hidden()
        page.select_option("#beside-what", "picture")
        until(page, "document.getElementById('beside').dataset.frame === '0'")
        page.reload()
        shown(page, frame="0")
        assert [fault for fault in page.faults if "401" not in fault] == []  # before the link was opened
        page.goto(f"{service.url}/#scene={other}")
        page.reload()
        until(page, "document.querySelector('#curtain h2').innerText === 'There is no such scene'")
    finally:
        service.stop()
