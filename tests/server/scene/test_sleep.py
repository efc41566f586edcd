"""Idle scenes sleep without processes, and wake when they are asked or sent something; nothing of them is lost."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from fakes import SLOW, WAITS
from running import pictures, problem
from sending import filled, finished, put_form, put_to_sleep, serving_with, status, view, wait_for

from client.stream import Stream, scene_changes
from studies.running import study as of

LONG, SHORT = 3600.0, 1.0


def test_an_idle_scene_falls_asleep_and_says_what_it_is(tmp_path):
    with serving_with(tmp_path, sleep_seconds=SHORT) as (running, http, _):
        id = filled(http)
        before = status(http, id)
        wait_for(lambda: status(http, id)["asleep"])
        assert running.app.state.scenes.awake == {}
        assert status(http, id) == before | {"asleep": True}
        assert http.get("/v1/scenes").json()["scenes"] == [before | {"asleep": True}]
        metrics = http.get("/metrics").text
        assert "scas4d_scenes_asleep 1.0" in metrics
        assert f'scas4d_gaussians{{scene="{id}"}}' not in metrics
        assert running.app.state.scenes.awake == {}  # none of that has woken it


def test_its_processes_end_with_it(tmp_path):
    with serving_with(tmp_path) as (running, http, _):
        id = filled(http)
        scene = running.app.state.scenes.awake[id]
        processes = [scene.updates.worker._process._process, scene.readers.views.process._process]
        put_to_sleep(http, id)
        for process in processes:
            with pytest.raises(ValueError, match="closed"):
                process.is_alive()


def bits(folder, id):
    """A digest of each state: the fake's depend on all frames so far."""
    return of.digests(folder / "scenes" / id / "states")


def test_a_frame_wakes_it_and_is_updated_from_the_state_before(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        slept, awake = filled(http, red=9), filled(http, red=9)
        put_to_sleep(http, slept)
        for id in (slept, awake):
            assert put_form(http, id, 2, pictures(30)).status_code == 202
            assert finished(http, id, 2)["state"] == "committed"
        assert len(set(bits(tmp_path, slept).values())) == 3
        assert bits(tmp_path, slept) == bits(tmp_path, awake)


def test_a_view_wakes_it_without_a_worker(tmp_path):
    with serving_with(tmp_path) as (running, http, _):
        id = filled(http)
        put_to_sleep(http, id)
        assert view(http, id).status_code == 200
        scene = running.app.state.scenes.awake[id]
        assert scene.readers.views.process is not None
        assert scene.updates.worker._process is None
        assert status(http, id)["asleep"] is False


def test_what_needs_no_process_is_answered_without_a_place(tmp_path):
    with serving_with(tmp_path, max_scenes=1) as (_, http, sdk):
        first = filled(http)
        put_to_sleep(http, first)
        second = filled(http)
        with Stream(str(http.base_url), second) as stream:
            stream.subscribe("scene", scene_changes())
            next(iter(stream))
            refused = problem(view(http, first), 429)
            assert refused["field"] == "SCAS4D_MAX_SCENES"
            assert "none is idle" in refused["detail"]
            assert http.get(f"/v1/scenes/{first}/frames/1").json()["state"] == "committed"
            assert http.get(f"/v1/scenes/{first}/rig").status_code == 200
            assert sdk.edit_scene(first, name="other").name == "other"
            assert sdk.pause(first).paused is True
            assert status(http, first)["asleep"] is True
            problem(http.post(f"/v1/scenes/{second}/sleep"), 409)
        put_to_sleep(http, second)
        assert view(http, first).status_code == 200


def test_the_one_used_least_lately_makes_room(tmp_path, monkeypatch):
    monkeypatch.setattr("server.scene.sleep.GRACE_S", 1e-9)
    with serving_with(tmp_path, max_scenes=2, sleep_seconds=LONG) as (_, http, _sdk):
        first, second = filled(http), filled(http)
        assert view(http, first).status_code == 200
        third = filled(http)
        assert [status(http, id)["asleep"] for id in (first, second, third)] == [False, True, False]
        assert view(http, second).status_code == 200
        assert [status(http, id)["asleep"] for id in (first, second, third)] == [True, False, False]


def test_a_scene_that_was_just_used_does_not_make_room(tmp_path):
    with serving_with(tmp_path, max_scenes=1, sleep_seconds=LONG) as (_, http, _sdk):
        filled(http)
        body = {"rig": http.get(f"/v1/scenes/{http.get('/v1/scenes').json()['scenes'][0]['id']}/rig").json()}
        problem(http.post("/v1/scenes", json=body), 429)


def test_a_scene_at_work_does_not_sleep(tmp_path, monkeypatch):
    go_on = tmp_path / "go on"
    monkeypatch.setenv("FAKE_GO_ON", str(go_on))
    with serving_with(tmp_path, sleep_seconds=SHORT) as (_, http, _sdk):
        id, later = filled(http), filled(http)
        put_form(http, id, 2, pictures(WAITS))
        problem(http.post(f"/v1/scenes/{id}/sleep"), 409)
        assert view(http, later).status_code == 200
        wait_for(lambda: status(http, later)["asleep"])  # used after the other one, and asleep
        assert status(http, id)["asleep"] is False
        go_on.touch()
        assert finished(http, id, 2)["state"] == "committed"


def test_many_at_once_wake_one_scene(tmp_path):
    with serving_with(tmp_path) as (running, http, _):
        id = filled(http)
        put_to_sleep(http, id)
        scenes = running.app.state.scenes
        seen = []
        monitor = threading.Event()

        def look():
            while not monitor.is_set():
                seen.append(id in scenes.awake or id in scenes.asleep)

        watching = threading.Thread(target=look)
        watching.start()
        with ThreadPoolExecutor(8) as pool:
            answers = list(pool.map(lambda _: view(http, id).status_code, range(16)))
        monitor.set()
        watching.join()
        assert answers == [200] * 16
        assert all(seen)


def test_sleeping_and_waking_again_and_again_loses_nothing(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http)
        for index in range(2, 6):
            put_to_sleep(http, id)
            put_form(http, id, index)
            finished(http, id, index)
        found = status(http, id)
        assert (found["committed"], found["next_frame"], found["damage"]) == (6, 6, [])
        assert len(bits(tmp_path, id)) == 6


def test_a_sleeping_scene_is_deleted_without_waking(tmp_path):
    with serving_with(tmp_path) as (running, http, _):
        id = filled(http)
        put_to_sleep(http, id)
        assert http.delete(f"/v1/scenes/{id}").status_code == 204
        problem(http.get(f"/v1/scenes/{id}"), 404)
        problem(view(http, id), 404)
        assert list((tmp_path / "scenes").iterdir()) == []
        assert running.app.state.scenes.awake == {}


def test_a_folder_that_cannot_be_read_when_it_wakes_is_tried_again(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http)
        put_to_sleep(http, id)
        folder = tmp_path / "scenes" / id
        kept = {name: (folder / name).read_bytes() for name in ("scene.json", "journal.log")}
        for name in kept:
            (folder / name).write_bytes(b"damaged")
        for _ in range(2):
            assert "scene.json is damaged" in problem(view(http, id), 503)["detail"]
            assert [one["id"] for one in http.get("/v1/scenes").json()["scenes"]] == [id]
        for name, data in kept.items():
            (folder / name).write_bytes(data)
        assert view(http, id).status_code == 200


def test_scenes_of_long_ago_sleep_from_the_start(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        old, new = filled(http), filled(http)
        before = status(http, old)
    os.utime(tmp_path / "scenes" / old / "journal.log", (0, 0))
    with serving_with(tmp_path) as (running, http, _):
        assert set(running.app.state.scenes.awake) == {new}
        assert status(http, old) == before | {"asleep": True}
        assert view(http, old, 1).status_code == 200


def test_frames_that_wait_wake_a_scene_at_the_start(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http)
        http.post(f"/v1/scenes/{id}/pause")
        put_form(http, id, 2)
    os.utime(tmp_path / "scenes" / id / "journal.log", (0, 0))
    with serving_with(tmp_path) as (_, http, _sdk):
        assert status(http, id)["asleep"] is True  # paused: there is nothing to do yet
        http.post(f"/v1/scenes/{id}/resume")
        assert finished(http, id, 2)["state"] == "committed"
        put_form(http, id, 3, pictures(SLOW))
    os.utime(tmp_path / "scenes" / id / "journal.log", (0, 0))
    with serving_with(tmp_path) as (_, http, _sdk):
        assert finished(http, id, 3)["state"] == "committed"


def test_never_is_never(tmp_path):
    with serving_with(tmp_path, sleep_seconds=0, max_scenes=1) as (_, http, _sdk):
        id = filled(http)
        body = {"rig": http.get(f"/v1/scenes/{id}/rig").json()}
        problem(http.post("/v1/scenes", json=body), 429)


def long_ago(folder):
    os.utime(folder / "journal.log", (0, 0))


def test_a_card_tells_what_sleeps_without_reading_its_folder(tmp_path, monkeypatch):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http)
    folder = tmp_path / "scenes" / id
    long_ago(folder)
    with serving_with(tmp_path) as (_, http, _sdk):  # read, and a card is left
        before = status(http, id)
    with monkeypatch.context() as patched, serving_with(tmp_path, queue_frames=7) as (running, http, _):
        patched.setattr("server.scene.scenes.read_stored_scene", None)
        assert status(http, id) == before | {"queue_limit": 7}
        assert running.app.state.scenes.awake == {}
    with serving_with(tmp_path) as (_, http, _sdk):
        assert view(http, id, 1).status_code == 200
        put_form(http, id, 2)
        assert finished(http, id, 2)["state"] == "committed"


def doubt(folder, how):
    card = folder / "asleep.json"
    if how == "flipped":
        data = bytearray(card.read_bytes())
        data[len(data) // 2] ^= 1
        card.write_bytes(data)
    elif how == "cut":
        card.write_bytes(card.read_bytes()[:-20])
    elif how == "another scene's":
        card.write_text(card.read_text().replace(folder.name, "0" * len(folder.name)))
    elif how == "journal":
        with (folder / "journal.log").open("ab") as journal:
            journal.write(b"torn")
        long_ago(folder)
    elif how == "state":
        (folder / "states" / "frame_000000.npz").rename(folder / "states" / "gone")
    elif how == "points":
        (folder / "points.npz").write_bytes(b"")


@pytest.mark.parametrize("how", ["flipped", "cut", "another scene's", "journal", "state", "points"])
def test_a_card_that_cannot_be_believed_is_left_aside(tmp_path, how):
    from server.scene.status_cache import read_status_cache
    from server.storage.layout import SceneFolder

    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http)
        put_to_sleep(http, id)
    folder = tmp_path / "scenes" / id
    assert read_status_cache(SceneFolder(folder)) is not None
    doubt(folder, how)
    assert read_status_cache(SceneFolder(folder)) is None
    with serving_with(tmp_path) as (_, http, _sdk):
        assert status(http, id)["next_frame"] == 2


def test_a_scene_with_damage_leaves_no_card(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http)
    folder = tmp_path / "scenes" / id
    with (folder / "journal.log").open("ab") as journal:
        journal.write(b"torn")
    long_ago(folder)
    with serving_with(tmp_path) as (_, http, _sdk):
        assert status(http, id)["damage"] != []
    assert not (folder / "asleep.json").exists()
