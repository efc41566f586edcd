"""The view in a headset, with a fake one: its pictures against the CPU rasterizer, and its controls."""

from __future__ import annotations

from pathlib import Path

import browser_engine
import fakes
import numpy as np
import pytest
from browser_page import FRAMES, expect, opened, read_until, shown, until
from export_cases import bent
from scipy.spatial.transform import Rotation
from splat_pictures import psnr, rendered

from client.exports.player import export_player
from scas4d_core.compact import CompactReader

WIDTH, HEIGHT = 160, 120
REACH = 1.5
PROJECTIONS = {  # off-centre, as in real headsets
    "left": [[1.3, 0, -0.2, 0], [0, 1.7, 0.1, 0], [0, 0, -1, -0.1], [0, 0, -1, 0]],
    "right": [[1.3, 0, 0.2, 0], [0, 1.7, 0.1, 0], [0, 0, -1, -0.1], [0, 0, -1, 0]],
}


def pose(place, yaw, pitch):
    """Pose [4, 4] in the room (metres, y up, looking along -z) of a head, in degrees."""
    found = np.eye(4)
    found[:3, :3] = Rotation.from_euler("YX", [yaw, pitch], degrees=True).as_matrix()
    found[:3, 3] = place
    return found


def columns(matrix):
    """A matrix with its columns as rows, as WebGL and WebXR store it."""
    return np.asarray(matrix).T.tolist()


def eyes_of(head):
    return {name: head @ pose([x, 0, 0], 0, 0) for name, x in (("left", -0.032), ("right", 0.032))}


def sent(head):
    """The poses that the fake headset reports."""

    def both(matrix):
        return {"matrix": columns(matrix), "inverse": columns(np.linalg.inv(matrix))}

    eyes = [
        {"eye": name, "projection": columns(PROJECTIONS[name]), **both(eye)} for name, eye in eyes_of(head).items()
    ]  # fmt: skip
    return {"head": both(head), "eyes": eyes}


def expected_camera(name, head, start):
    """Camera of an eye in the service's format. The page looks from camera c0 of the ring to the origin, with z up."""
    eye = browser_engine.make_rig().cameras[0]
    centre = -eye.world_to_camera[:3, :3].T @ eye.world_to_camera[:3, 3]
    size = np.linalg.norm(centre) / REACH
    back = np.array([centre[0], centre[1], 0]) / np.hypot(*centre[:2])
    scene = np.stack([np.cross([0, 0, 1], back), [0, 0, 1], back], axis=1)  # right, up, back
    level = np.array([start[0, 2], 0, start[2, 2]]) / np.hypot(start[0, 2], start[2, 2])
    room = np.stack([np.cross([0, 1, 0], level), [0, 1, 0], level], axis=1)
    room_to_scene = np.eye(4)
    room_to_scene[:3, :3] = size * scene @ room.T
    room_to_scene[:3, 3] = centre - room_to_scene[:3, :3] @ start[:3, 3]
    opengl = np.linalg.inv(room_to_scene @ eyes_of(head)[name])
    to_camera = np.diag([1, -1, -1, 1]) @ opengl * size  # OpenCV axes, in units of the scene
    to_camera[3] = [0, 0, 0, 1]
    p = np.array(PROJECTIONS[name])
    intrinsics = [
        [p[0, 0] * WIDTH / 2, 0, (1 - p[0, 2]) * WIDTH / 2],
        [0, p[1, 1] * HEIGHT / 2, (1 + p[1, 2]) * HEIGHT / 2],
        [0, 0, 1],
    ]
    return {"intrinsics": intrinsics, "world_to_camera": to_camera.tolist(), "width": WIDTH, "height": HEIGHT}


def pictures(page):
    """Pictures [H, W, 3] of both eyes, of which the headset has drawn several since."""
    page.evaluate("() => (window.session.frames = 0)")
    until(page, "window.session.frames > 5")
    rgba = np.array(page.evaluate("() => window.session.picture()")).reshape(HEIGHT, 2, WIDTH, 4)[::-1]
    return {"left": rgba[:, 0, :, :3] / 255, "right": rgba[:, 1, :, :3] / 255}


def pictures_when(page, condition):
    """Waits until the pictures meet a condition, because the worker sorts meanwhile; the pictures."""
    return read_until(page, lambda: pictures(page), condition)


def at_rest(page):
    """Waits until the pictures no longer change; the picture of the left eye."""
    last = pictures(page)["left"]
    return pictures_when(page, lambda found: np.array_equal(found["left"], last))["left"]


@pytest.fixture
def headset(page):
    """A page in a browser with a headset; returns the pose of the head when the session begins."""
    head = pose([0.3, 1.4, -0.2], 50, -12)
    page.add_init_script(path=Path(fakes.__file__).with_name("fake_headset.js"))
    page.add_init_script(f"window.headsetPoses = {sent(head)}")
    return head


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return bent.write(tmp_path_factory.mktemp("headset") / "bent.s4d", browser_engine.make_rig())


@pytest.fixture(scope="module")
def player(file):
    export_player(str(file), file.with_name("out.html"), url="http://127.0.0.1:9", token=None)
    return file.with_name("out.html")


def worn(page, player):
    page.goto(player.as_uri())
    page.wait_for_selector("#curtain", state="hidden")
    page.click("#headset")
    until(page, "window.session?.frames > 3")


def test_each_eye_sees_what_the_cpu_rasterizer_renders(page, headset, player, file):
    worn(page, player)
    with CompactReader(file) as reader:
        first = reader.frames[0]
    moved = pose([0.4, 1.5, -0.5], 35, -20)
    for head in (headset, moved):
        page.evaluate("(poses) => (window.session.poses = poses)", sent(head))
        true = {name: rendered(file, first, expected_camera(name, head, headset)) for name in ("left", "right")}
        assert min(picture.std() for picture in true.values()) > 0.05  # they show something
        found = pictures_when(page, lambda found, true=true: min(psnr(found[eye], true[eye]) for eye in true) > 44)
    assert psnr(found["left"], found["right"]) < 30
    assert page.faults == []


def test_frames_that_the_page_has_dropped_are_sent_again(page, headset, player, file):
    worn(page, player)
    with CompactReader(file) as reader:
        indices, times = reader.frames, reader.times
    for place in (1.5, 2.5, 0.5, 3.0):
        low = int(place)
        seconds = times[low] + (place - low) * (times[min(low + 1, len(times) - 1)] - times[low])
        page.locator("#time").evaluate(
            "(slider, seconds) => { slider.value = seconds; slider.dispatchEvent(new Event('input')); }", float(seconds)
        )
        pictures(page)
    true = rendered(file, indices[3], expected_camera("left", headset, headset))
    pictures_when(page, lambda found: psnr(found["left"], true) > 40)
    assert page.faults == []


def test_the_trigger_plays_and_the_thumbstick_turns_and_zooms(page, headset, player):
    worn(page, player)
    last = at_rest(page)
    for axes in ([0, 0, 1, 0], [0, 0, 0, -1]):
        page.evaluate("(axes) => (window.session.inputSources = [{ gamepad: { axes } }, {}])", axes)
        page.wait_for_timeout(300)
        page.evaluate("() => (window.session.inputSources = [{ gamepad: { axes: [0, 0, 0.1, 0] } }])")
        now = at_rest(page)
        assert psnr(now, last) < 30
        last = now
    page.evaluate("() => window.session.dispatchEvent(new Event('select'))")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Pause")
    before = page.locator("#moment").inner_text()
    pictures_when(page, lambda found: psnr(found["left"], last) < 60)  # other frames
    page.click("#headset")
    until(page, "window.session.ended")
    until(page, f"document.getElementById('moment').innerText !== {before!r}")  # the page draws again
    assert page.faults == []


def test_the_viewer_shows_the_chosen_frame_in_a_headset(page, service, headset, finished):
    opened(page, service, finished)
    shown(page, frame=str(FRAMES - 1))
    page.click("#headset")
    until(page, "window.session?.frames > 3")
    until(page, "Math.max(...window.session.picture().filter((_, k) => k % 4 < 3)) > 40")
    newest = at_rest(page)
    page.locator("#time").fill("0")
    pictures_when(page, lambda found: psnr(found["left"], newest) < 40)
    page.evaluate("() => window.session.dispatchEvent(new Event('select'))")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Pause")
    page.click("#headset")
    until(page, "window.session.ended")
    page.click("#play")
    shown(page)
    assert page.faults == []


def test_a_session_that_is_permitted_after_the_scene_was_closed_ends(page, service, headset, finished):
    page.add_init_script("window.permission = new Promise((allow) => { window.allow = allow; })")
    opened(page, service, finished)
    shown(page)
    page.click("#headset")
    page.focus("#overlay")
    page.keyboard.press("ArrowLeft")
    until(page, "document.getElementById('view').dataset.drawn === 'here'")  # the page still draws
    page.evaluate("location.hash = '#scene=other'")
    until(page, "document.querySelector('#curtain h2').innerText === 'There is no such scene'")
    page.evaluate("window.allow()")
    until(page, "window.session?.ended")
    page.click("#headset")  # nothing to show
    assert [fault for fault in page.faults if "404" not in fault] == []


def test_states_that_cannot_be_fetched_are_not_asked_for_again_at_once(page, service, headset, finished):
    asked = []

    def refuse(route):
        asked.append(route.request.url)
        route.fulfill(status=503, body="{}", content_type="application/json")

    page.route("**/states.s4d**", refuse)
    opened(page, service, finished)
    shown(page)
    page.click("#headset")
    until(page, "window.session?.frames > 100")
    assert 1 <= len(asked) <= 2


def test_without_a_headset_there_is_no_button(page, service, finished, player):
    opened(page, service, finished)
    shown(page)
    expect(page.locator("#headset")).to_be_hidden()
    page.goto(player.as_uri())
    page.wait_for_selector("#curtain", state="hidden")
    expect(page.locator("#headset")).to_be_hidden()


def test_a_headset_that_refuses_is_reported(page, service, headset, finished, player):
    page.add_init_script("window.headsetRefuses = 'it is in use'")
    opened(page, service, finished)
    shown(page)
    page.click("#headset")
    expect(page.locator("#note")).to_contain_text("The headset cannot be used: it is in use")
    page.goto(player.as_uri())
    page.wait_for_selector("#curtain", state="hidden")
    page.click("#headset")
    expect(page.locator("#note")).to_contain_text("The headset cannot be used: it is in use")
