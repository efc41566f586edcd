"""What a service finds again in its data folder: everything, or a sentence about it."""

from __future__ import annotations

import json
import shutil
import threading
import time

import fakes
import httpx
import numpy as np
import pytest
from blake3 import blake3
from running import Running, fake_settings, make_rig, picture, pictures, problem
from sending import create, lasting_report, serving, settled
from sending import put_form as put
from waiting import HANG_S

from client.wire import RigModel
from scas4d_core.captures import InitialPoints
from scas4d_core.storage.npz import write_npz
from server.storage import recovery
from server.storage.definition import FORMAT
from server.storage.frame_table import RECORD_LOST


def without(document, *names):
    return {name: value for name, value in document.items() if name not in names}


def test_everything_is_found_again(tmp_path):
    with serving(tmp_path) as (http, sdk):
        id = create(http, queue_frames=9, open_frame_seconds=3600)
        sdk.put_points(id, InitialPoints(np.zeros((3, 3)), np.zeros((3, 3), np.float32)))
        receipts = [put(http, id, index, pictures(index)).json() for index in range(3)]
        sdk.wait(id, 2)
        http.post(f"/v1/scenes/{id}/frames/3/missing", json={"reason": "cable"})
        assert put(http, id, 4, pictures(fakes.RAISES)).status_code == 202
        sdk.wait(id, 4)
        http.post(f"/v1/scenes/{id}/pause")
        receipts.append(put(http, id, 5).json())
        part = http.put(f"/v1/scenes/{id}/frames/6/cameras/c0", content=picture(6)).json()
        before = http.get(f"/v1/scenes/{id}").json()
        reports = [lasting_report(http, id, index) for index in range(7)]
    with serving(tmp_path) as (http, sdk):
        after = http.get(f"/v1/scenes/{id}").json()
        assert before["behind_seconds"] > 0 == after["behind_seconds"]  # only known of frames received since the start
        unstored = ("error", "gaussians", "behind_seconds")
        assert without(after, *unstored) == without(before, *unstored)
        assert after["damage"] == []
        again = [lasting_report(http, id, index) for index in range(7)]
        assert again == reports
        assert put(http, id, 2, pictures(2)).json() == receipts[2]
        assert problem(put(http, id, 2, pictures(9)), 409)["expected"] == 6
        assert http.put(f"/v1/scenes/{id}/frames/6/cameras/c0", content=picture(6)).json() == part
        assert http.put(f"/v1/scenes/{id}/frames/6/cameras/c1", content=picture(7)).json()["absent"] == []
        assert sdk.render(id, "c0", 1)[0, 0, 0] == round(255 * 0.1)
        http.post(f"/v1/scenes/{id}/resume")
        sdk.wait(id, 6)
        assert settled(http, id)["last_committed"] == 6
        assert http.get(f"/v1/scenes/{id}").json()["gaussians"] == 3


def test_warnings_of_points_are_found_again(tmp_path):
    """The cameras see points 3 before them; given the wrong way round, the rig has them out of view."""
    rig = RigModel.of(make_rig()).model_dump(mode="json")
    quarter = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    for camera in rig["cameras"]:
        camera["world_to_camera"] = np.linalg.inv(np.array(camera["world_to_camera"]) @ quarter).tolist()
    cloud = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
    with serving(tmp_path) as (http, sdk):
        id = http.post("/v1/scenes", json={"rig": rig}).json()["id"]
        assert sdk.scene(id).warnings == []
        sdk.put_points(id, InitialPoints(cloud, np.zeros((50, 3), np.float32)))
        (said,) = sdk.scene(id).warnings
        assert "the poses seem to be inverted" in said
    with serving(tmp_path) as (_, sdk):
        assert sdk.scene(id).warnings == [said]


def test_a_frame_0_that_is_a_guess_is_a_warning_and_is_one_again(tmp_path):
    with serving(tmp_path) as (http, sdk):
        id = create(http)
        put(http, id, 0, pictures(fakes.GUESSED))
        sdk.wait(id, 0)
        said = sdk.scene(id).warnings
        assert said[0].startswith("frame 0 is a guess")
        assert "restart the reconstruction with points" in said[0]
        assert said[1].startswith("frame 0 did not have enough time: no stereo; ")
        assert said[2].startswith("grayscale cameras among colour ones: c1; ")
        assert len(said) == 3
        assert sdk.frame(id, 0).grey == ["c1"]
        assert sdk.frame(id, 0).shortened == ["no stereo"]
        put(http, id, 1)
        sdk.wait(id, 1)
        assert sdk.scene(id).warnings == said
    with serving(tmp_path) as (http, sdk):
        put(http, id, 2)
        sdk.wait(id, 2)  # the worker has said by then what it found
        deadline = time.monotonic() + HANG_S
        while sdk.scene(id).warnings != said and time.monotonic() < deadline:
            time.sleep(0.02)
        assert sdk.scene(id).warnings == said


def test_a_camera_out_of_step_is_a_warning_for_as_long_as_it_is(tmp_path):
    with serving(tmp_path) as (http, sdk):
        id = create(http)
        for index, red in enumerate((0, fakes.LATE)):
            put(http, id, index, pictures(red))
            sdk.wait(id, index)
        (said,) = sdk.scene(id).warnings
        assert said.startswith("cameras are out of step: 'c1' is late")
        assert [name for name, one in sdk.frame(id, 1).timing.items() if one.out_of_step] == ["c1"]
        assert sdk.frame(id, 1).alarms == []
    with serving(tmp_path) as (http, sdk):
        deadline = time.monotonic() + HANG_S
        while sdk.scene(id).warnings != [said] and time.monotonic() < deadline:
            time.sleep(0.02)  # the worker says what it found
        assert sdk.scene(id).warnings == [said]
        put(http, id, 2)
        sdk.wait(id, 2)
        assert sdk.scene(id).warnings == []


def test_a_first_frame_that_failed_stays_failed(tmp_path):
    with serving(tmp_path) as (http, sdk):
        id = create(http)
        put(http, id, 0, pictures(fakes.RAISES))
        sdk.wait(id, 0)
    with serving(tmp_path) as (http, _):
        status = http.get(f"/v1/scenes/{id}").json()
        assert status["state"] == "failed"
        assert "told to raise" in status["error"]


def test_deaths_at_a_frame_are_counted_over_restarts(tmp_path):
    with serving(tmp_path) as (http, sdk):
        id = create(http)
        put(http, id, 0)
        sdk.wait(id, 0)
        put(http, id, 1, pictures(fakes.DIES))
        until = time.monotonic() + HANG_S
        while not http.get(f"/v1/scenes/{id}/frames/1").json()["worker_deaths"]:
            assert time.monotonic() < until
            time.sleep(0.02)
    with serving(tmp_path) as (http, sdk):
        report = sdk.wait(id, 1)
        assert (report.state, report.worker_deaths) == ("failed", 2)


def test_a_deletion_that_was_cut_short_is_finished_and_half_a_scene_is_none(tmp_path):
    with serving(tmp_path) as (http, _):
        kept, gone = create(http), create(http)
        assert http.delete(f"/v1/scenes/{gone}").status_code == 204
        assert list((tmp_path / "deleted").iterdir()) == []
    shutil.copytree(tmp_path / "scenes" / kept, tmp_path / "deleted" / "abc")  # renamed, not yet removed
    (tmp_path / "scenes" / "half" / "frames").mkdir(parents=True)  # made, never acknowledged
    with serving(tmp_path) as (http, _):
        assert [scene["id"] for scene in http.get("/v1/scenes").json()["scenes"]] == [kept]
        until = time.monotonic() + HANG_S
        while list((tmp_path / "deleted").iterdir()):  # behind the service that answers already
            assert time.monotonic() < until
            time.sleep(0.02)
        assert sorted(path.name for path in (tmp_path / "scenes").iterdir()) == [kept]


def test_a_damaged_definition_comes_back_from_the_journal_and_without_it_is_left_alone(tmp_path):
    with serving(tmp_path) as (http, _):
        id = create(http)
        before = http.get(f"/v1/scenes/{id}").json()
    file = tmp_path / "scenes" / id / "scene.json"
    text = file.read_text()
    assert "studio" in text
    file.write_text(text.replace("studio", "studia"))
    with serving(tmp_path) as (http, _):
        after = http.get(f"/v1/scenes/{id}").json()
        assert without(after, "damage") == without(before, "damage")
        assert "read from the journal instead" in after["damage"][0]
    assert file.read_text() == text
    file.write_text("{")
    (tmp_path / "scenes" / id / "journal.log").write_bytes(b"")
    with serving(tmp_path) as (http, _):
        assert "scene.json is damaged" in problem(http.get(f"/v1/scenes/{id}"), 404)["detail"]
    assert file.read_text() == "{"  # whoever knows more may still repair it


def test_a_scene_of_another_format_is_refused_by_name_and_left_as_it_is(tmp_path):
    with serving(tmp_path) as (http, _):
        id = create(http)
        put(http, id, 0)
        settled(http, id)
    folder = tmp_path / "scenes" / id
    written = json.loads((folder / "scene.json").read_text())["scene"] | {"format": FORMAT + 1}
    digest = blake3(json.dumps(written, indent=1).encode()).hexdigest()
    (folder / "scene.json").write_text(json.dumps({"blake3": digest, "scene": written}, indent=1))
    before = contents(folder)
    with serving(tmp_path) as (http, _):
        document = problem(http.get(f"/v1/scenes/{id}"), 404)
        assert f"format {FORMAT + 1}" in document["detail"]
        assert "open it with the version that wrote it" in document["detail"]
        assert http.get("/v1/scenes").json()["scenes"] == []
    assert contents(folder) == before


def test_states_of_another_format_are_no_damage(tmp_path):
    with serving(tmp_path) as (http, _):
        id = create(http)
        put(http, id, 0)
        settled(http, id)
    folder = tmp_path / "scenes" / id
    for name in ("fixed.npz", "fixed.copy.npz"):
        with np.load(folder / "states" / name) as file:
            arrays = {key: file[key] for key in file.files}
        write_npz(folder / "states" / name, {**arrays, "format": np.int64(99)})
    before = contents(folder)
    with serving(tmp_path) as (http, _):
        document = problem(http.get(f"/v1/scenes/{id}"), 404)
        assert "state folder states has format 99" in document["detail"]
        assert http.get("/v1/scenes").json()["scenes"] == []
    assert contents(folder) == before


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_lost_journal_costs_the_events_and_no_state(tmp_path):
    with serving(tmp_path) as (http, sdk):
        id = create(http, keep_frames={"last": 0})
        for index in range(4):
            put(http, id, index)
            sdk.wait(id, index)
    (tmp_path / "scenes" / id / "journal.log").write_bytes(b"\0" * 100)
    with serving(tmp_path) as (http, sdk):
        status = http.get(f"/v1/scenes/{id}").json()
        assert (status["committed"], status["next_frame"]) == (4, 4)
        assert status["damage"]
        assert RECORD_LOST in problem(put(http, id, 0), 409)["detail"]
        assert sdk.render(id, "c0", 0).shape
        put(http, id, 4)
        assert sdk.wait(id, 4).state == "committed"


def test_it_answers_while_scenes_are_recovered(tmp_path, monkeypatch):
    with serving(tmp_path) as (http, _):
        first, second = create(http), create(http)
        put(http, first, 0)
    go_on = threading.Semaphore(0)

    def recover(*given):
        assert go_on.acquire(timeout=HANG_S)
        return recovery.recover(*given)

    monkeypatch.setattr("server.scene.stored_scene.recover", recover)
    running = Running(fake_settings(tmp_path), ready=False)
    try:
        with httpx.Client(base_url=running.url, timeout=HANG_S) as http:
            assert http.get("/health/live").json()["status"] == "live"
            answer = http.get("/health/ready")
            assert "recovered 0 of 2 scenes" in problem(answer, 503)["detail"]
            assert answer.headers["Retry-After"]
            for call in (http.get(f"/v1/scenes/{first}"), http.get("/v1/scenes"), http.delete(f"/v1/scenes/{second}")):
                assert "recovered" in problem(call, 503)["detail"]
            assert problem(put(http, second, 0), 503)["value"] == second
            problem(http.get("/v1/scenes/none"), 404)
            problem(http.post("/v1/scenes", json={"rig": RigModel.of(make_rig()).model_dump(mode="json")}), 503)
            go_on.release()
            until = time.monotonic() + HANG_S
            while not (found := [id for id in (first, second) if http.get(f"/v1/scenes/{id}").status_code == 200]):
                assert time.monotonic() < until
                time.sleep(0.02)
            assert len(found) == 1
            assert problem(http.get("/health/ready"), 503)["recovering"] == [({first, second} - set(found)).pop()]
            go_on.release()
            while http.get("/health/ready").status_code != 200:
                assert time.monotonic() < until
                time.sleep(0.02)
            assert [scene["id"] for scene in http.get("/v1/scenes").json()["scenes"]] == [first, second]
    finally:
        go_on.release(5)
        running.stop()


def test_a_service_that_ends_while_scenes_are_recovered_leaves_them_as_they_are(tmp_path, monkeypatch):
    with serving(tmp_path) as (http, _):
        id = create(http)
    go_on = threading.Semaphore(0)
    monkeypatch.setattr(
        "server.scene.stored_scene.recover", lambda *given: go_on.acquire(timeout=HANG_S) and recovery.recover(*given)
    )
    running = Running(fake_settings(tmp_path), ready=False)
    threading.Timer(0.5, go_on.release).start()
    running.stop()
    monkeypatch.undo()
    with serving(tmp_path) as (http, _):
        assert http.get(f"/v1/scenes/{id}").json()["damage"] == []


def test_two_services_do_not_share_a_folder(tmp_path):
    with serving(tmp_path), pytest.raises(RuntimeError, match="another service"):
        _start_second(tmp_path)


def _start_second(folder):
    import asyncio

    from server.hub import Hub
    from server.processes.placement import Placement
    from server.scene.scenes import Scenes

    asyncio.run(Scenes(fake_settings(folder), Placement(), Hub(1)).open())
