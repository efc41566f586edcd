"""The page in every state of a scene, on a desk and on a phone: its words, no error, no serious finding of axe-core.

`SCAS4D_TEST_PICTURES` names a folder for the screenshots, to look at them.
"""

from __future__ import annotations

from contextlib import contextmanager

import browser_engine
import fakes
from browser_page import SIZES, expect, looked_at, opened, push, shown, start_scene, until
from running import Running, fake_settings
from sending import wait_for
from waiting import HANG_S

from client.sdk import Client


def title(page, words):
    until(page, f"document.querySelector('#curtain:not([hidden]) h2')?.innerText === {words!r}")


@contextmanager
def scene_of(service, **options):
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, **options)
        yield sdk, id
        sdk.delete_scene(id)


def test_none(sized, tmp_path):
    service = Running(fake_settings(tmp_path), core=browser_engine.install)
    try:
        sized.goto(service.url)
        title(sized, "No scene yet")
        looked_at(sized, "none")
        assert [sized.is_disabled(f"#{control}") for control in ("play", "back", "forth", "live")] == [True] * 4
    finally:
        service.stop()


def test_waiting(sized, service):
    with scene_of(service) as (_, id):
        opened(sized, service, id)
        title(sized, "Waiting for the first frame")
        expect(sized.locator("#curtain .detail")).to_contain_text(f"/v1/scenes/{id}/frames/0", use_inner_text=True)
        looked_at(sized, "waiting")


def test_queued(sized, service):
    with scene_of(service) as (sdk, id):
        sdk.pause(id)
        push(sdk, id, 0)
        opened(sized, service, id)
        title(sized, "1 frame waiting")
        looked_at(sized, "queued")
        sized.locator("#curtain .choice").click()  # Resume
        shown(sized, frame="0")


def test_first_frame(sized, service):
    with scene_of(service) as (sdk, id):
        opened(sized, service, id)
        title(sized, "Waiting for the first frame")
        push(sdk, id, 0, red=fakes.LOOKED_AT)
        title(sized, "Reconstructing the first frame")
        looked_at(sized, "first-frame")
        shown(sized, frame="0")


def test_updating(sized, service):
    with scene_of(service) as (sdk, id):
        push(sdk, id, 0)
        sdk.wait(id, 0)
        opened(sized, service, id)
        shown(sized, frame="0")
        push(sdk, id, 1, red=fakes.LOOKED_AT)
        until(sized, "document.getElementById('state').innerText === 'Updating'")
        looked_at(sized, "updating")
        shown(sized, frame="1")
        looked_at(sized, "ready")


def test_degraded(sized, service):
    with scene_of(service) as (sdk, id):
        push(sdk, id, 0)
        push(sdk, id, 1, red=fakes.RAISES)
        opened(sized, service, id)
        until(sized, "document.getElementById('trouble').innerText.includes('Frame 1 failed')")
        shown(sized, frame="0")
        looked_at(sized, "degraded")


def test_failed(sized, service):
    with scene_of(service) as (sdk, id):
        push(sdk, id, 0, red=fakes.RAISES)
        opened(sized, service, id)
        title(sized, "The scene has failed")
        expect(sized.locator("#curtain .detail")).to_contain_text(f"scas4d begin-again {id}", use_inner_text=True)
        assert sized.locator("#curtain p").first.inner_text()
        looked_at(sized, "failed")


def test_asleep(sized, service):
    with scene_of(service, name="tired") as (sdk, id):
        push(sdk, id, 0)
        sdk.wait(id, 0)
        sdk.put_to_sleep(id)
        held = []
        sized.route("**/rig", lambda route: held.append(route))
        opened(sized, service, id)
        title(sized, "Waking the scene")
        expect(sized.locator("#scenes option:checked")).to_contain_text("asleep", use_inner_text=True)
        looked_at(sized, "asleep")
        held[0].continue_()
        shown(sized, frame="0")
        assert not sdk.scene(id).asleep


def test_deleted(sized, service, finished):
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "short")
        opened(sized, service, id)
        title(sized, "Waiting for the first frame")
        sdk.delete_scene(id)
        title(sized, "The scene is gone")
        looked_at(sized, "deleted", faults=("404",))
        sized.locator("#curtain .choice").first.click()  # another one
        shown(sized)


def test_offline(sized, tmp_path):
    service = Running(fake_settings(tmp_path), core=browser_engine.install)
    try:
        with Client(service.url, busy_timeout=HANG_S) as sdk:
            id = start_scene(sdk)
            push(sdk, id, 0)
            sdk.wait(id, 0)
        opened(sized, service, id)
        shown(sized, frame="0")
    finally:
        service.stop()
    sized.wait_for_selector("#banner:not([hidden])")
    looked_at(sized, "offline", faults=("ERR_CONNECTION_REFUSED", "WebSocket"))
    sized.evaluate("location.hash = ''")


def test_the_dialog_of_a_scene(sized, service):
    with scene_of(service, name="old name") as (sdk, id):
        push(sdk, id, 0)
        sdk.wait(id, 0)
        opened(sized, service, id)
        shown(sized, frame="0")
        sized.click("#manage-open")
        looked_at(sized, "manage")
        sized.fill("#manage-name", "new name")
        sized.fill("#manage-frames", "5")
        sized.click("#manage-save")
        until(sized, "document.getElementById('manage-words').innerText === 'Saved.'")
        assert (sdk.scene(id).name, sdk.scene(id).ingest.keep_frames.last) == ("new name", 5)
        sized.click("#manage-pause")
        until(sized, "document.getElementById('manage-pause').innerText === 'Resume'")
        assert sdk.scene(id).paused
        sized.click("#manage-pause")
        until(sized, "document.getElementById('manage-pause').innerText === 'Pause'")
        sized.click("#manage-archive")
        until(sized, "document.getElementById('manage-archive').innerText === 'Restore'")
        assert sdk.scene(id).archived
        sized.click("#manage-archive")
        until(sized, "document.getElementById('manage-archive').innerText === 'Archive'")
        sized.click("#manage-delete")
        assert sdk.scene(id).committed == 1  # the first press only asks
        expect(sized.locator("#manage-delete")).to_have_text("Delete for good", use_inner_text=True)
        sized.click("#manage-close")
        sized.click("#manage-open")
        expect(sized.locator("#manage-delete")).to_have_text("Delete", use_inner_text=True)


def test_a_scene_is_put_to_sleep_by_the_page_that_shows_it(sized, service):
    with scene_of(service, name="tired") as (sdk, id):
        push(sdk, id, 0)
        sdk.wait(id, 0)
        opened(sized, service, id)
        shown(sized, frame="0")
        sized.click("#manage-open")
        sized.click("#manage-sleep")
        title(sized, "tired is asleep")
        assert sdk.scene(id).asleep
        looked_at(sized, "put-to-sleep", faults=("409",))
        sized.locator("#curtain .choice").first.click()
        shown(sized, frame="0")


def test_a_deletion_that_fails_is_told(sized, service):
    def answer(route):
        if route.request.method == "DELETE":
            route.fulfill(status=503, json={"detail": "the disk does not do", "status": 503})
        else:
            route.continue_()

    with scene_of(service) as (sdk, id):
        push(sdk, id, 0)
        sdk.wait(id, 0)
        opened(sized, service, id)
        shown(sized, frame="0")
        sized.route(f"**/v1/scenes/{id}", answer)
        sized.click("#manage-open")
        for _ in range(2):
            sized.click("#manage-delete")
        until(sized, "document.getElementById('manage-words').innerText.includes('disk does not do')")
        expect(sized.locator("#manage[open]")).to_have_count(1)


def test_a_scene_is_begun_again_and_deleted_by_hand(sized, service):
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "by hand")
        for index in range(2):
            push(sdk, id, index)
        sdk.wait(id, 1)
        opened(sized, service, id)
        shown(sized, frame="1")
        sized.click("#manage-open")
        for _ in range(2):
            sized.click("#manage-again")
        wait_for(lambda: sdk.scene(id).reconstruction == 1)  # the frames of before stood there as committed, too
        sdk.wait(id, 1)
        until(sized, "document.getElementById('facts').innerText.includes('2 committed')")
        if not sized.locator("#manage[open]").count():
            sized.click("#manage-open")
        for _ in range(2):
            sized.click("#manage-delete")
        title(sized, "The scene is gone")
        assert id not in [scene.id for scene in sdk.scenes()]


def test_fingers_find_every_control(chromium, service, finished):
    context = chromium.new_context(viewport=SIZES["phone"], has_touch=True, is_mobile=True)
    page = context.new_page()
    page.goto(f"{service.url}/#scene={finished}")
    shown(page)
    small = page.evaluate(
        """() => [...document.querySelectorAll('button, select, input, summary, header a')]
        .filter((one) => one.checkVisibility() && !one.closest('dialog') && one.type !== 'checkbox')
        .map((one) => [one.id || one.innerText, one.getBoundingClientRect()])
        .filter(([, box]) => Math.min(box.height, box.width) < 43.5)
        .map(([name, box]) => [name, box.width, box.height])"""
    )
    assert small == []
    context.close()
