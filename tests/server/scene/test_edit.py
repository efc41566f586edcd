"""A scene is renamed, archived and kept shorter once it is there; it holds over sleep, restart, a lost journal."""

from __future__ import annotations

import os

import pytest
from fakes import SLOW
from running import pictures, problem
from sending import filled, finished, put_form, put_to_sleep, serving_with, status, view, wait_for


def edit(http, id, **changes):
    return http.patch(f"/v1/scenes/{id}", json=changes)


def test_it_holds_over_a_restart(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http)
        assert edit(http, id, name="rehearsal").json()["name"] == "rehearsal"
        assert edit(http, id, keep_frames={"last": 3}).json()["ingest"]["keep_frames"] == {
            "last": 3,
            "bytes": None,
            "seconds": None,
        }
        put_to_sleep(http, id)
        assert status(http, id)["name"] == "rehearsal"
    with serving_with(tmp_path) as (_, http, _sdk):
        found = status(http, id)
        assert (found["name"], found["ingest"]["keep_frames"]["last"]) == ("rehearsal", 3)


def test_it_holds_where_the_journal_is_written_anew(tmp_path):
    with serving_with(tmp_path) as (running, http, _):
        id = filled(http)
        edit(http, id, name="rehearsal", archived=True)
        journal = tmp_path / "scenes" / id / "journal.log"
        journal.unlink()
        scene = running.app.state.scenes.awake[id]
        scene.updates.worker._process._loop.call_soon_threadsafe(scene.log.journal.rewrite_if_moved)
        wait_for(journal.exists)
        wait_for(lambda: journal.stat().st_size > 0)
    with serving_with(tmp_path) as (_, http, _sdk):
        assert (status(http, id)["name"], status(http, id)["archived"]) == ("rehearsal", True)


def test_states_beyond_the_rule_go_at_once(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http, 6)
        put_to_sleep(http, id)
        edit(http, id, keep_states={"last": 3})
        wait_for(lambda: status(http, id)["states_deleted"] > 0)
        found = status(http, id)
        assert found["committed"] + found["states_deleted"] == 6
        assert view(http, id, 5).status_code == 200
        assert view(http, id, 1).status_code == 404
        put_form(http, id, 6)
        assert finished(http, id, 6)["state"] == "committed"


def test_pictures_beyond_the_rule_go_at_once(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http, 6)
        assert status(http, id)["frames_kept"] == 6
        assert edit(http, id, keep_frames={"last": 1}).json()["frames_kept"] < 6


def test_pictures_that_are_too_old_go_and_are_counted(tmp_path):
    with serving_with(tmp_path) as (running, http, _sdk):
        id = filled(http, 6)
        for file in running.app.state.scenes[id].spec.folder.frames.iterdir():
            os.utime(file, (0, 0))
        edit(http, id, keep_frames={"seconds": 3600})
        # The newest two may have to be updated again.
        wait_for(lambda: (status(http, id)["frames_kept"], status(http, id)["frames_deleted"]) == (1, 5))
        put_form(http, id, 6)
        assert finished(http, id, 6)["state"] == "committed"
        wait_for(lambda: status(http, id)["frames_deleted"] == 6)
        assert status(http, id)["committed"] == 7  # the take is kept
        assert problem(edit(http, id, keep_states={"seconds": 3600}), 422)["remedy"]


def test_an_archived_scene_takes_no_frames_until_that_is_taken_back(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http)
        assert edit(http, id, archived=True).json()["archived"] is True
        refused = problem(put_form(http, id, 2), 409)
        assert refused["detail"] == "the scene is archived"
        assert "restore" in refused["remedy"]
        assert view(http, id).status_code == 200
        assert put_form(http, id, 1).status_code == 202  # it is here: the same answer as before
        edit(http, id, archived=False)
        put_form(http, id, 2)
        assert finished(http, id, 2)["state"] == "committed"


def test_a_scene_with_frames_that_wait_is_not_archived(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http)
        put_form(http, id, 2, pictures(SLOW))
        assert problem(edit(http, id, archived=True), 409)["field"] == "archived"
        assert status(http, id)["archived"] is False
        finished(http, id, 2)


@pytest.mark.parametrize(
    ("changes", "field"),
    [({}, "body"), ({"nam": "x"}, "nam"), ({"archived": 1}, "archived"), ({"keep_states": {"last": -1}}, "last")],
)
def test_wrong_changes_are_refused(tmp_path_factory, quiet_scene, http, changes, field):
    assert field in str(problem(edit(http, quiet_scene, **changes), 422)["field"])


def test_a_rule_for_states_needs_a_place(tmp_path):
    with serving_with(tmp_path, max_scenes=1) as (running, http, _sdk):
        ids = []
        for _ in range(3):
            ids.append(filled(http, 4))
            put_to_sleep(http, ids[-1])
        for id in ids:
            assert edit(http, id, keep_states={"last": 3}).status_code in (200, 429)
        scenes = running.app.state.scenes
        with_processes = [scene for scene in scenes.awake.values() if scene.updates.worker._process is not None]
        assert len(with_processes) <= 1
        assert all(scene.has_place for scene in with_processes)


def test_an_archived_scene_is_not_begun_again(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = filled(http, 2)
        edit(http, id, archived=True)
        document = problem(http.put(f"/v1/scenes/{id}/reconstructions/1", json={"discard": True}), 409)
        assert document["field"] == "archived"
        assert status(http, id)["committed"] == 2
