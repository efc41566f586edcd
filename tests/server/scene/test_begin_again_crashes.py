"""A crash at any point of a beginning ends wholly before it or wholly after it; damage costs what it hits."""

from __future__ import annotations

import errno
import os
import shutil

import fakes
import pytest
from running import pictures, problem
from sending import create, lasting_reports, put_form, serving, settled, status, wait_for

from client.wire import ReconstructionRequest
from scas4d_core.storage.history import History
from server.scene import new_reconstruction, stored_scene
from server.storage.events import FrameAccepted, FrameFailed, PicturesDeleted, ReconstructionBegun, StatesDeleted
from server.storage.journal import Journal, encode_events
from server.storage.layout import DataFolder
from server.storage.ledger import Ledger
from server.storage.recovery import NO_STATE, recover
from tests.helpers.journals import read_journal

CHANGED = {"static": {"iterations": fakes.PICKED}}
FRAMES = 3
AFTER = ["failed", "failed", "committed", "failed", "committed"]
"""Frames of a reconstruction that begins with frame 2, the one after which fails."""


def committed(data, id):
    """Bits of the committed states by the number of their reconstruction, and by frame."""
    found = {}
    for path in (DataFolder(data).scene(id).path).glob("states*"):
        history = History.load(path)
        found[path.name] = {index: history.gaussians(index).colours.tobytes() for index in history.indices}
    return found


def filled(http, sdk, red=10):
    """A scene with frames that are committed, whose second one was set aside."""
    id = create(http, queue_frames=9)
    for index in range(FRAMES):
        put_form(http, id, index, pictures(fakes.RAISES if index == 1 else red + index))
    sdk.wait(id, FRAMES - 1)
    settled(http, id)
    return id


def begin(http, id, **more):
    return http.put(f"/v1/scenes/{id}/reconstructions/1", json={"settings": CHANGED, "discard": True, **more})


@pytest.fixture
def crashes(monkeypatch):
    """Copies a scene's folder where the next step of its beginning would write: so a crash there leaves it."""
    at, reached = {}, []

    def step(name, id, folder):
        reached.append(name)
        if at.get(id, (None, None))[0] == name:
            shutil.copytree(folder, at[id][1] / "scenes" / id)
            del at[id]

    class Watched(Journal):
        async def append(self, *events):
            if any(isinstance(event, ReconstructionBegun) for event in events):
                step("event", self.path.parent.name, self.path.parent)
            await super().append(*events)

    write, bury = stored_scene.write_definition, DataFolder.move_to_deleted

    def definition(folder, given):
        step("definition", folder.name, folder.path)
        write(folder, given)

    def moved(self, path, name):
        if path.parent.name != "scenes":
            step(f"move {path.name}", path.parent.name, path.parent)
        return bury(self, path, name)

    monkeypatch.setattr(new_reconstruction, "Journal", Watched)
    monkeypatch.setattr(stored_scene, "write_definition", definition)
    monkeypatch.setattr(DataFolder, "move_to_deleted", moved)
    return at, reached


def test_a_crash_at_any_step_ends_before_or_after(tmp_path, crashes):
    at, reached = crashes
    whole, crashed = tmp_path / "whole", tmp_path / "crashed"
    steps = ("event", "definition", "move states", "move parts")
    with serving(whole) as (http, sdk):
        ids = [filled(http, sdk) for _ in steps]
        before = {id: committed(whole, id)["states"] for id in ids}
        for id, step in zip(ids, steps, strict=True):
            sdk.parts(id, 1)  # files of parts, too
            at[id] = (step, crashed)
            assert begin(http, id).status_code == 200
            sdk.wait(id, FRAMES - 1)
        assert at == {}, reached  # each step was taken
        after = {id: committed(whole, id)["states_1"] for id in ids}
    with serving(crashed) as (http, sdk):
        for id, step in zip(ids, steps, strict=True):
            found = settled(http, id)
            assert found["damage"] == [], step
            assert found["committed"] == FRAMES - 1
            if step == "event":
                assert (found["reconstruction"], committed(crashed, id)) == (0, {"states": before[id]})
            else:
                assert found["reconstruction"] == 1
                assert found["settings"]["static"]["iterations"] == fakes.PICKED
            assert begin(http, id).status_code == 200  # the client that got no answer asks again
            sdk.wait(id, FRAMES - 1)
            assert committed(crashed, id) == {"states_1": after[id]}, step
            assert not list(DataFolder(crashed).scene(id).path.glob("parts"))
            assert http.get(f"/v1/scenes/{id}/frames/1").json()["state"] == "failed"
    with serving(crashed) as (http, _):  # and once more: all is found again
        assert [status(http, id)["damage"] for id in ids] == [[]] * len(ids)
        assert [status(http, id)["reconstruction"] for id in ids] == [1] * len(ids)
        assert {id: committed(crashed, id)["states_1"] for id in ids} == after


def test_a_torn_event_never_was(tmp_path, crashes):
    at, _ = crashes
    with serving(tmp_path / "whole") as (http, sdk):
        id = filled(http, sdk)
        at[id] = ("definition", tmp_path / "crashed")
        assert begin(http, id).status_code == 200
    folder = DataFolder(tmp_path / "crashed").scene(id)
    content = folder.journal.read_bytes()
    (event,) = (event for event in read_journal(folder.journal).events if isinstance(event, ReconstructionBegun))
    start = len(content) - len(encode_events([event]))
    for end in range(start, len(content), 37):
        folder.journal.write_bytes(content[:end])
        found = recover(folder, id)
        assert (found.ledger.reconstruction, list(found.ledger.committed), found.good) == (
            0,
            [0, 2],
            start,
        )
        assert found.folder.states.name == "states"
    folder.journal.write_bytes(content)
    found = recover(folder, id)
    assert (found.ledger.reconstruction, list(found.ledger.committed)) == (1, [])
    assert found.ledger.waiting() == [0, 1, 2]
    assert found.folder.states.name == "states_1"


def damaged(folder, how):
    if how == "journal":
        folder.journal.unlink()
    elif how == "event":
        content = bytearray(folder.journal.read_bytes())
        content[content.index(b'"type":"reconstruction_begun"') + 3] ^= 4
        folder.journal.write_bytes(content)
    else:
        text = folder.definition.read_text()
        folder.definition.write_text(text.replace("studio", "studia"))


def test_damage_of_the_journal_or_the_definition_costs_no_state(tmp_path):
    hows = ("journal", "event", "definition")
    with serving(tmp_path) as (http, sdk):
        ids = [filled(http, sdk) for _ in hows]
        for id in ids:
            assert begin(http, id, frame=2).status_code == 200
            put_form(http, id, 3, pictures(fakes.RAISES))
            put_form(http, id, 4, pictures(34))
            sdk.wait(id, 4)
        before = {id: committed(tmp_path, id) for id in ids}
        reports = {id: lasting_reports(http, id) for id in ids}
    for id, how in zip(ids, hows, strict=True):
        damaged(DataFolder(tmp_path).scene(id), how)
    for turn in range(2):
        with serving(tmp_path) as (http, sdk):
            for id, how in zip(ids, hows, strict=True):
                found = settled(http, id)
                assert bool(found["damage"]) == (turn == 0), (how, found["damage"])
                assert (found["reconstruction"], found["first_frame"], found["state"]) == (1, 2, "ready"), how
                assert found["settings"]["static"]["iterations"] == fakes.PICKED
                assert committed(tmp_path, id) == before[id], how
                now = lasting_reports(http, id)
                if how == "definition":
                    assert now == reports[id]
                else:  # that frame 3 was set aside is lost: there is no state of it
                    assert [report["state"] for report in now if report["index"] != 3] == [*AFTER[:3], AFTER[4]]
                    assert now[3]["error"] == (NO_STATE if how == "journal" else "found missing")
                assert now[0]["error"] == "the reconstruction starts with frame 2"
    with serving(tmp_path) as (http, sdk):
        for id in ids:
            assert put_form(http, id, 5).status_code == 202
            assert sdk.wait(id, 5).state == "committed"


def test_a_full_disk_refuses_and_leaves_the_scene_as_it_was(tmp_path, monkeypatch):
    class Full(Journal):
        async def append(self, *events):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with serving(tmp_path) as (http, sdk):
        id = filled(http, sdk)
        before = committed(tmp_path, id)
        with monkeypatch.context() as patched:
            patched.setattr(new_reconstruction, "Journal", Full)
            problem(begin(http, id), 507)
        assert committed(tmp_path, id) == before
        assert settled(http, id)["reconstruction"] == 0
        put_form(http, id, FRAMES)
        assert sdk.wait(id, FRAMES).state == "committed"
        assert begin(http, id).status_code == 200
        assert sdk.wait(id, FRAMES).state == "committed"


def taken(index):
    return FrameAccepted(index=index, time=index / 10, identity=f"{index:064x}", files=(f"{index}",))


def begun(number, index):
    return ReconstructionBegun(number=number, index=index, points=None, settings={}, request=ReconstructionRequest())


def test_what_happened_to_frames_before_is_forgotten_and_frames_of_old_states_are_no_commits():
    ledger = Ledger("abc")
    events = [taken(0), taken(1), PicturesDeleted(frames=(0,)), taken(2), StatesDeleted(frames=(0, 1))]
    events += [FrameFailed(index=2, reason="fault", dropped={"c0": "dark"}, fatal=True), taken(3)]
    for event in [*events, begun(1, 1), begun(1, 1)]:
        ledger.apply(event)
    assert ledger.waiting() == [1, 2, 3]
    assert (ledger.fatal, ledger.states_deleted, ledger.reconstruction) == (None, 0, 1)
    assert not any(ledger.frames[index].deleted for index in range(4))
    assert ledger.frames[2].report.dropped_cameras == {}
    ledger.apply(begun(1, 0))  # known already
    assert ledger.waiting() == [1, 2, 3]
    ledger.apply(begun(2, 0))
    assert ledger.waiting() == [1, 2, 3]
    assert "had been deleted" in ledger.frames[0].error
    ledger.reconcile([1, 2], {})
    assert (list(ledger.committed), ledger.waiting()) == ([1, 2], [3])


def test_a_scene_whose_states_are_lost_begins_again(tmp_path):
    with serving(tmp_path) as (http, sdk):
        id = filled(http, sdk)
        before = committed(tmp_path, id)["states"]
    states = DataFolder(tmp_path).scene(id).states
    for name in ("fixed.npz", "fixed.copy.npz"):
        content = (states / name).read_bytes()
        (states / name).write_bytes(content[: len(content) // 2])
    with serving(tmp_path) as (http, sdk):
        wait_for(lambda: status(http, id)["state"] == "failed")
        found = status(http, id)
        assert "cannot resume from the committed states" in found["error"]
        assert f"PUT /v1/scenes/{id}/reconstructions/1" in found["error"]
        assert begin(http, id).status_code == 200
        assert sdk.wait(id, FRAMES - 1).state == "committed"
        assert committed(tmp_path, id) == {"states_1": before}
        assert status(http, id)["damage"] == found["damage"] != []


def test_a_frame_whose_event_is_damaged_is_not_lost_by_a_beginning(tmp_path):
    with serving(tmp_path) as (http, sdk):
        id = filled(http, sdk)
        http.post(f"/v1/scenes/{id}/pause")
        put_form(http, id, FRAMES, pictures(33))
        journal = DataFolder(tmp_path).scene(id).journal
        content = bytearray(journal.read_bytes())
        (last,) = (e for e in read_journal(journal).events if isinstance(e, FrameAccepted) and e.index == FRAMES)
        content[content.rindex(encode_events([last])) + 2] ^= 1
        journal.write_bytes(content)
        assert begin(http, id).status_code == 200
        assert status(http, id)["next_frame"] == FRAMES + 1
        http.post(f"/v1/scenes/{id}/resume")
        assert sdk.wait(id, FRAMES).state == "committed"
