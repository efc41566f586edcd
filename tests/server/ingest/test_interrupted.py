"""Interruptions: senders that leave, cancelled requests, events that race, folders half lost."""

from __future__ import annotations

import asyncio
import socket
import threading

import pytest
from running import picture, problem
from sending import create, finished, framed, put_camera, put_form, serving, status, wait_for
from sending import put_framed as put
from waiting import HANG_S, wait_for_soon

from client.wire import FRAME_MEDIA_TYPE
from server.ingest import camera_files, receive
from server.scene import scene
from server.storage.events import FrameAccepted, FrameFailed
from server.storage.journal import Journal
from server.storage.layout import SceneFolder
from server.storage.recovery import recover


def test_a_refused_sender_that_goes_in_the_middle_leaves_the_frame_free(http, make, service, monkeypatch):
    monkeypatch.setattr(receive, "BATCH", 1)  # file by file: the first is refused while the third is on its way
    id = make(3)
    body = framed(0, {"c0": picture()[:-9], "c1": picture(), "c2": picture() + bytes(500_000)})
    head = f"PUT /v1/scenes/{id}/frames/0 HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: {FRAME_MEDIA_TYPE}\r\n"
    ingest = service.app.state.scenes[id].ingest
    refused, real = threading.Event(), receive.drain

    async def drain(body):
        refused.set()
        await real(body)

    monkeypatch.setattr(receive, "drain", drain)
    with socket.create_connection(("127.0.0.1", service.port)) as sender:
        sender.sendall(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body[:-400_000])
        assert refused.wait(HANG_S)
    wait_for(lambda: ingest._receiving == {})
    assert http.post(f"/v1/scenes/{id}/frames/0/missing").json()["state"] == "missing"


class HeldJournal:
    """Writes of journals wait, from now on, until `go_on` is set; `writes` is set once one does."""

    def __init__(self, monkeypatch):
        self.writes, self.go_on = threading.Event(), threading.Event()
        real = Journal._write

        def held(journal, data):
            self.writes.set()
            assert self.go_on.wait(HANG_S)
            real(journal, data)

        monkeypatch.setattr(Journal, "_write", held)


def on_the_loop(scene, coroutine):
    return asyncio.run_coroutine_threadsafe(coroutine, scene.updates.worker._process._loop)


@pytest.mark.parametrize("part", [False, True])
def test_a_request_cancelled_while_its_event_is_written_keeps_its_pictures(http, make, service, monkeypatch, part):
    id = make(1)
    http.post(f"/v1/scenes/{id}/pause")
    scene = service.app.state.scenes[id]
    over = threading.Event()

    async def body():
        yield framed(0, {"c0": picture()}, part=part)

    async def taken():
        try:
            await take
        finally:
            over.set()

    journal = HeldJournal(monkeypatch)
    if part:
        take = camera_files.receive_camera(scene.open_frames, 0, "c0", body(), None)
    else:
        take = receive.receive_frame(scene.ingest, 0, body(), None)
    request = on_the_loop(scene, taken())
    assert journal.writes.wait(HANG_S)
    request.cancel()
    on_the_loop(scene, asyncio.sleep(0)).result(HANG_S)  # the cancellation is there
    journal.go_on.set()
    wait_for(lambda: scene.next_frame == 1)
    assert over.wait(HANG_S)
    assert len(list(scene.spec.folder.frames.iterdir())) == 1
    http.post(f"/v1/scenes/{id}/resume")
    assert finished(http, id, 0)["state"] == "committed"


def test_a_frame_accepted_while_the_first_one_fails_does_not_wait_for_ever(http, make, service, monkeypatch):
    id = make(queue_frames=9)
    scene = service.app.state.scenes[id]

    async def race():
        event = FrameFailed(index=0, reason="told to", fatal=True)
        setting = asyncio.ensure_future(scene.updates._record_failure(event))
        await wait_for_soon(journal.writes.is_set)

        async def body():
            yield framed(1)

        taking = asyncio.ensure_future(receive.receive_frame(scene.ingest, 1, body(), None))
        await wait_for_soon(lambda: scene.log.journal._waiting)  # its event waits behind the other
        journal.go_on.set()
        await asyncio.gather(setting, taking)

    http.post(f"/v1/scenes/{id}/pause")
    put(http, id, 0)
    journal = HeldJournal(monkeypatch)
    on_the_loop(scene, race()).result(HANG_S)
    wait_for(lambda: status(http, id)["queued"] == 0)
    assert http.get(f"/v1/scenes/{id}/frames/1").json()["state"] == "failed"


def test_a_scene_that_failed_is_found_with_nothing_waiting(tmp_path):
    async def write():
        journal = Journal(tmp_path / "journal.log")
        taken = [
            FrameAccepted(index=index, time=index / 10, identity="ab" * 32, files=(f"{index:010d}-{0:012x}.frame",))
            for index in (0, 1)
        ]
        await journal.append(taken[0], FrameFailed(index=0, reason="told to", fatal=True), taken[1])
        await journal.close()

    asyncio.run(write())
    found = recover(SceneFolder(tmp_path), "s")
    assert found.ledger.waiting() == []
    assert [(event.index, event.type) for event in found.events] == [(1, "frame_failed")]
    assert "told to" in found.ledger.frames[1].report.error


def test_a_lost_definition_does_not_cost_the_frames(tmp_path):
    with serving(tmp_path) as (http, sdk):
        id, empty = create(http), create(http)
        put_form(http, id, 0)
        sdk.wait(id, 0)
    for name in (id, empty):
        (tmp_path / "scenes" / name / "scene.json").unlink()
    with serving(tmp_path) as (http, sdk):
        after = http.get(f"/v1/scenes/{id}").json()
        assert (after["committed"], after["name"]) == (1, "studio")
        assert "scene.json" in after["damage"][0]
        assert put_form(http, id, 1).status_code == 202
        problem(http.get(f"/v1/scenes/{empty}"), 404)  # a scene that was never acknowledged looks the same


def test_a_whole_frame_whose_head_says_part_is_found_whole_without_a_journal(tmp_path):
    with serving(tmp_path) as (http, _):
        id = create(http)
        http.post(f"/v1/scenes/{id}/pause")
        assert put(http, id, 0, part=True).status_code == 202
    folder = SceneFolder(tmp_path / "scenes" / id)
    folder.journal.unlink()
    assert recover(folder, id).ledger.waiting() == [0]


def test_a_journal_that_cannot_be_written_costs_its_scene_only(tmp_path, monkeypatch):
    with serving(tmp_path) as (http, _):
        bad, good = create(http), create(http)

    def journal(path, *more):
        if bad in path.parts:
            raise PermissionError(13, "Permission denied", str(path))
        return Journal(path, *more)

    monkeypatch.setattr(scene, "Journal", journal)
    with serving(tmp_path) as (http, _):
        assert http.get(f"/v1/scenes/{good}").status_code == 200
        assert "Permission denied" in problem(http.get(f"/v1/scenes/{bad}"), 404)["detail"]


def test_parts_again_after_retention_get_the_same_answer(http, make):
    id = make(2, queue_frames=8, keep_frames={"last": 0})
    first = []
    for index in range(4):
        put_camera(http, id, index, "c0", picture(index))
        first.append(put_camera(http, id, index, "c1", picture(index + 20)).json())
        finished(http, id, index)
    wait_for(lambda: status(http, id)["frames_kept"] == 1)
    assert put_camera(http, id, 0, "c1", picture(20)).json() == first[0]
    assert problem(put_camera(http, id, 0, "c1", picture(9)), 409)["field"] == "c1"
