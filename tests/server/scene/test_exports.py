"""Exports that the service makes: their files, progress, limits, and what ends them."""

from __future__ import annotations

import io
import os
import signal
import time
import zipfile
from typing import get_args

import numpy as np
import pytest
from running import Running, fake_settings, make_rig, pictures, problem
from waiting import HANG_S

from client.errors import Conflict, NotFound
from client.sdk import Client
from client.wire import Retention
from client.wire.exports import SUFFIXES, WITH_IDS, ExportFormat
from scas4d_core.compact import CompactReader
from scas4d_core.exports import FORMATS
from scas4d_core.exports.formats import formats_with_ids
from scas4d_core.query.ply import read_ply
from server.processes import exporter
from server.scene import exports as rules


def push(sdk, id, indices):
    for index in indices:
        sdk.put_frame(id, index, pictures(index))
        sdk.wait(id, index, every=0.05)


def over(sdk, id, export):
    until = time.monotonic() + HANG_S
    while (found := sdk.export(id, export)).state in ("waiting", "running"):
        assert time.monotonic() < until
        time.sleep(0.03)
    return found


@pytest.fixture(scope="module")
def ran(service):
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = sdk.create_scene(make_rig(), name="Robot / 1", frames_per_second=10).id
        push(sdk, id, range(4))
        yield sdk, id
        sdk.delete_scene(id)


def test_the_wire_names_the_formats_and_their_files():
    assert get_args(ExportFormat) == tuple(FORMATS) == tuple(SUFFIXES)
    assert list(WITH_IDS) == formats_with_ids()
    assert dict(SUFFIXES) == {name: ".zip" if one.numbered else one.suffixes[0] for name, one in FORMATS.items()}


def test_an_export_is_made_beside_the_scene_and_read_back(ran, http, tmp_path):
    sdk, id = ran
    answer = http.post(f"/v1/scenes/{id}/exports", json={"format": "ply", "first": 1, "last": 2})
    assert answer.status_code == 202
    begun = answer.json()
    place = answer.headers["location"]
    assert (begun["frames"], begun["first"], begun["last"], begun["file"]) == (2, 1, 2, None)
    assert begun["name"] == "Robot-1-000001-000002-ply.zip"
    found = over(sdk, id, begun["id"])
    assert (found.state, found.done, found.error) == ("done", 2, None)
    assert http.get(place).json() == found.model_dump(mode="json")
    data = http.get(found.file)
    assert (data.headers["content-type"], len(data.content)) == ("application/zip", found.bytes)
    assert found.name in data.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(data.content)) as archive:
        assert archive.namelist() == ["frame_000001.ply", "frame_000002.ply"]
        means = [read_ply(archive.extract(name, tmp_path)).means for name in archive.namelist()]
    assert np.allclose(means[1] - means[0], [0.125, 0, 0])
    tag = {"If-None-Match": data.headers["etag"]}
    assert http.get(found.file, headers=tag).status_code == 304
    part = http.get(found.file, headers={"Range": "bytes=3-9"})
    assert (part.status_code, part.content) == (206, data.content[3:10])
    assert part.headers["content-range"] == f"bytes 3-9/{found.bytes}"
    assert sdk.export_file(id, found.id, begin=found.bytes - 5) == data.content[-5:]
    problem(http.get(found.file, headers={"Range": f"bytes={found.bytes}-"}), 416)
    head = http.head(found.file)
    assert (int(head.headers["content-length"]), head.content) == (found.bytes, b"")
    assert [one.id for one in sdk.exports(id).exports] == [found.id]
    sdk.delete_export(id, found.id)
    problem(http.get(found.file), 404)
    assert sdk.exports(id).exports == []


def test_one_file_holds_a_sequence_with_its_rig_and_parts(ran, tmp_path):
    sdk, id = ran
    begun = [sdk.begin_export(id, "s4d"), sdk.begin_export(id, "tracks", ids=[1])]
    states, tracks = (over(sdk, id, one.id) for one in begun)
    assert (states.state, states.done) == (tracks.state, tracks.done) == ("done", 4), (states, tracks)
    lines = sdk.export_file(id, tracks.id).splitlines()
    assert [line.split(b",")[2] for line in lines] == [b"id"] + [b"1"] * 4
    file = tmp_path / "a.s4d"
    file.write_bytes(sdk.export_file(id, states.id))
    with CompactReader(file) as reader:
        assert list(reader.frames) == [0, 1, 2, 3]
        assert reader.head.rig.names == make_rig().names
        assert reader.parts().tolist() == [0, 1]
    unknown = over(sdk, id, sdk.begin_export(id, "tracks", ids=[1, 10**9]).id)
    assert (unknown.state, unknown.done) == ("failed", 0)  # before a frame is written
    assert unknown.error.startswith(f"unknown Gaussian ids [{10**9}]; use ids of the scene's")
    for one in (*begun, unknown):
        sdk.delete_export(id, one.id)


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({}, "format"),
        ({"format": "obj"}, "format"),
        ({"format": "ply", "first": 9}, "first"),
        ({"format": "ply", "first": 3, "last": 2}, "first"),
        ({"format": "ply", "first": -1}, "first"),
        ({"format": "ply", "ids": [1]}, "ids"),
        ({"format": "tracks", "ids": []}, "ids"),
        ({"format": "ply", "frames": 3}, "frames"),
    ],
)
def test_what_cannot_be_exported_is_refused_with_its_field(ran, http, body, field):
    _, id = ran
    document = problem(http.post(f"/v1/scenes/{id}/exports", json=body), 422)
    assert document["field"].endswith(field)
    assert document["remedy"]


def test_exports_that_are_not_there_are_404(ran, http, scene):
    sdk, id = ran
    problem(http.get(f"/v1/scenes/{id}/exports/none"), 404)
    problem(http.delete(f"/v1/scenes/{id}/exports/none"), 404)
    problem(http.get("/v1/scenes/none/exports"), 404)
    problem(http.post(f"/v1/scenes/{scene}/exports", json={"format": "ply"}), 409)  # no frame is committed
    begun = sdk.begin_export(id, "ply").id
    problem(http.get(f"/v1/scenes/{scene}/exports/{begun}"), 404)  # of another scene
    sdk.delete_export(id, begun)


def test_exports_wait_for_each_other_and_can_be_cancelled(ran, http, service):
    sdk, id = ran
    manager = service.app.state.exports
    first = sdk.begin_export(id, "ply")
    until = time.monotonic() + HANG_S
    while sdk.export(id, first.id).state == "waiting":
        assert time.monotonic() < until
    second, third = sdk.begin_export(id, "ply"), sdk.begin_export(id, "splat")
    assert sdk.export(id, second.id).state == "waiting"
    sdk.delete_export(id, first.id)
    sdk.delete_export(id, second.id)
    assert over(sdk, id, third.id).state == "done"
    for one in (first, second):
        found = sdk.export(id, one.id)
        assert found.state in ("cancelled", "done")  # the first may have been quicker
        if found.state == "cancelled":
            assert found.error == "the export was cancelled"
            assert problem(http.get(f"/v1/scenes/{id}/exports/{one.id}/file"), 409)["detail"].endswith("cancelled")
            assert not manager.get(id, one.id).spec.file.parent.exists()
    assert sdk.export(id, second.id).state == "cancelled"
    for one in sdk.exports(id).exports:
        sdk.delete_export(id, one.id)


def test_exports_go_with_the_reconstruction_they_are_of(sdk, service):
    id = sdk.create_scene(make_rig(), frames_per_second=10).id
    push(sdk, id, range(2))
    export = over(sdk, id, sdk.begin_export(id, "ply").id)
    assert export.state == "done"
    begun = sdk.begin_again(id, 1, discard=True)
    assert sdk.exports(id).exports == []
    export = over(sdk, id, sdk.begin_export(id, "ply").id) if begun.committed else None
    assert sdk.begin_again(id, 1, discard=True).reconstruction == 1  # the same request again takes nothing away
    assert len(sdk.exports(id).exports) == (0 if export is None else 1)
    sdk.delete_scene(id)


def test_a_process_that_dies_leaves_words_and_no_file(ran, service, monkeypatch):
    sdk, id = ran
    manager = service.app.state.exports
    begin, started = manager._placement.start, []
    monkeypatch.setattr(manager._placement, "start", lambda *given: started.append(begin(*given)) or started[-1])
    export = sdk.begin_export(id, "ply")
    until = time.monotonic() + HANG_S
    while not started:
        assert time.monotonic() < until
        time.sleep(0.001)
    os.kill(started[0].pid, signal.SIGKILL)
    found = over(sdk, id, export.id)
    assert found.state == "failed"
    assert "exit code -9" in found.error
    assert not manager.get(id, export.id).spec.file.parent.exists()
    assert not sdk.scene(id).degraded
    assert over(sdk, id, sdk.begin_export(id, "ply").id).state == "done"
    for one in sdk.exports(id).exports:
        sdk.delete_export(id, one.id)


def test_a_damaged_state_is_named_and_mended(ran, service):
    sdk, id = ran
    file = service.app.state.settings.data / "scenes" / id / "states" / "frame_000002.npz"
    whole = file.read_bytes()
    file.write_bytes(whole[:200] + bytes(64) + whole[264:])
    found = over(sdk, id, sdk.begin_export(id, "ply").id)
    assert found.state == "failed"
    assert "frame_000002" in found.error
    assert "again later" in found.error
    assert "/" not in found.error
    until = time.monotonic() + HANG_S
    while file.read_bytes() != whole:  # it was told to the worker, which has it in memory
        assert time.monotonic() < until
        time.sleep(0.02)
    sdk.delete_export(id, found.id)


def test_limits_are_told(ran, service, monkeypatch, http):
    sdk, id = ran
    monkeypatch.setattr(rules, "MAX_PER_SCENE", 1)
    done = over(sdk, id, sdk.begin_export(id, "ply").id)
    with pytest.raises(Conflict, match="the maximum of 1 export"):
        sdk.begin_export(id, "ply")
    monkeypatch.setattr(rules, "MAX_WAITING", 0)
    assert problem(http.post(f"/v1/scenes/{id}/exports", json={"format": "ply"}), 429)["remedy"]
    monkeypatch.undo()
    monkeypatch.setattr(rules, "free_bytes", lambda path: exporter.RESERVE_BYTES + 100)
    assert "the disk has" in problem(http.post(f"/v1/scenes/{id}/exports", json={"format": "usd"}), 507)["detail"]
    assert "the disk has" in problem(http.post(f"/v1/scenes/{id}/exports", json={"format": "tapvid-mv"}), 507)["detail"]
    monkeypatch.undo()
    manager = service.app.state.exports
    kept = manager.get(id, done.id)
    file = kept.spec.file
    assert file.exists()
    assert done.expires is not None
    kept.task.get_loop().call_soon_threadsafe(manager._expire, kept)  # its timer would, after a day
    until = time.monotonic() + HANG_S
    while file.parent.exists():
        assert time.monotonic() < until
        time.sleep(0.02)
    assert sdk.exports(id).exports == []


def test_frames_that_retention_deletes_meanwhile_are_named(sdk, service):
    id = sdk.create_scene(make_rig(), frames_per_second=10).id
    push(sdk, id, range(5))
    states = service.app.state.settings.data / "scenes" / id / "states"
    manager = service.app.state.exports
    blocked = sdk.begin_export(id, "ply")  # so that the next one waits
    export = sdk.begin_export(id, "ply", first=1)
    sdk.edit_scene(id, keep_states=Retention(last=1))
    until = time.monotonic() + HANG_S
    while (states / "frame_000001.npz").exists():
        assert time.monotonic() < until
        time.sleep(0.01)
    found = over(sdk, id, export.id)
    if found.state == "done":  # the machine was quicker than the retention
        pytest.skip("the export was over before the states were deleted")
    assert found.state == "failed"
    assert "frame 1 " in found.error
    assert "retention" in found.error
    assert "keep_states" in found.error
    folder = manager.get(id, export.id).spec.file.parents[1]
    over(sdk, id, blocked.id)
    running = sdk.begin_export(id, "ply")
    sdk.delete_scene(id)
    assert not folder.exists()
    with pytest.raises(NotFound):
        sdk.export(id, running.id)


def test_a_scene_that_sleeps_is_exported_asleep_and_leftovers_go_at_the_start(tmp_path):
    left = tmp_path / "exports" / "scene" / "export"
    left.mkdir(parents=True)
    (left / "export.zip").write_bytes(b"x")
    running = Running(fake_settings(tmp_path))
    try:
        assert not (tmp_path / "exports").exists()
        with Client(running.url, busy_timeout=HANG_S) as sdk:
            id = sdk.create_scene(make_rig(), frames_per_second=10).id
            push(sdk, id, [0])
            sdk.edit_scene(id, archived=True)
            assert sdk.put_to_sleep(id).asleep
            export = over(sdk, id, sdk.begin_export(id, "glb-parts").id)
            assert export.state == "done"
            assert sdk.scene(id).asleep
    finally:
        running.stop()


def test_failures_are_told_without_paths():
    full = OSError(28, "No space left on device", "/usr/share/a.npz")
    assert exporter.explain(full).startswith("the disk is full (No space left on device)")
    assert exporter.explain(RuntimeError("in /usr/share/a.npz")) == "RuntimeError: in a.npz"
