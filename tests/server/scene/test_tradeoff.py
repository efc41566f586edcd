"""What accuracy costs in time: measured from reports, replayed on request, extrapolated by a stated model."""

from __future__ import annotations

from types import SimpleNamespace

import fakes
import pytest
from running import Running, fake_settings, make_rig, pictures, problem
from sending import serving
from waiting import HANG_S, wait_for

from client.sdk import Client
from client.wire import IngestSettings, Retention
from scas4d_core.frame_outcome import OTHER_ORDERS
from server.scene.tradeoff import usable_reports


def push(sdk, id, indices, red=0):
    for index in indices:
        sdk.put_frame(id, index, pictures(red))
    sdk.wait(id, indices[-1])


def replayed(sdk, id):
    wait_for(lambda: sdk.tradeoff(id).replay.state != "running")
    return sdk.tradeoff(id)


def points(found, kind):
    return {point.iterations: point for point in found.points if point.kind == kind}


@pytest.fixture(scope="module")
def ran(service):
    """A scene that ran 100 and 40 iterations."""
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = sdk.create_scene(make_rig(), frames_per_second=10).id
        push(sdk, id, range(4))
        sdk.set_budget(id, iterations=40)
        push(sdk, id, range(4, 6))
        push(sdk, id, [6], red=fakes.HELD)
        push(sdk, id, [7])
        yield sdk, id
        sdk.delete_scene(id)


def test_a_first_update_in_several_orders_tells_nothing_of_its_iterations():
    seconds = {"total": 2.0}
    reports = [
        SimpleNamespace(
            state="committed", index=index, iterations=300, degraded=None, attempts=["as set"], seconds=taken
        )
        for index, taken in ((1, {**seconds, OTHER_ORDERS: 1.0}), (2, seconds))
    ]
    assert [report.index for report in usable_reports(reports, 0)] == [2]


def test_a_scene_without_a_frame_has_nothing_to_tell(sdk, scene):
    found = sdk.tradeoff(scene)
    assert (found.points, found.curve, found.model, found.replay.state) == ([], [], None, "none")
    assert found.budget.iterations == 100


def test_what_frames_ran_is_measured_by_iterations(ran):
    sdk, id = ran
    found = points(sdk.tradeoff(id), "measured")
    assert list(found) == [40, 100]
    assert (found[100].frames, found[40].frames) == (3, 3)  # neither the first frame nor the one that was held
    assert found[100].error == pytest.approx(0.01)
    assert found[40].error == pytest.approx(0.025)
    assert (found[40].psnr, found[40].threads) == (31.5, 2)
    report = sdk.frame(id, 5)
    assert found[40].milliseconds >= 1000 * report.seconds["total"]  # writing comes on top
    assert sdk.frame(id, 7).write_seconds is not None
    assert sdk.frame(id, 1).write_seconds is None  # no update was before it


def test_the_way_of_an_update_is_told_in_its_curve(ran):
    sdk, id = ran
    found = [(point.planned, point.iterations, point.milliseconds, point.loss) for point in sdk.tradeoff(id).curve]
    assert found == [(40, 20, 40, 0.5), (40, 40, 80, 0.25), (100, 50, 100, 0.5), (100, 100, 200, 0.25)]


def test_what_it_did_not_run_is_extrapolated_in_time_alone(ran):
    sdk, id = ran
    found = sdk.tradeoff(id)
    assert found.model.per_iteration == pytest.approx(2.0)
    guessed = points(found, "extrapolated")
    assert list(guessed) == [10, 25, 50, 200, 300, 500]  # not 100, which was measured
    for iterations, point in guessed.items():
        assert point.milliseconds == pytest.approx(found.model.fixed + 2.0 * iterations)
        assert (point.error, point.psnr, point.frames, point.threads) == (None, None, 0, 2)


def test_a_replay_measures_other_budgets_beside_the_scenes_own(ran):
    sdk, id = ran
    before = sdk.scene(id)
    begun = sdk.replay(id, [10, 25], frames=3).replay
    assert (begun.state, begun.iterations, begun.frames, begun.warm_up) == ("running", [40, 10, 25], [5, 6, 7], 4)
    found = replayed(sdk, id)
    assert (found.replay.state, found.replay.done, found.replay.total) == ("done", 12, 12)
    again = points(found, "replayed")
    assert list(again) == [10, 25, 40]
    assert [point.frames for point in again.values()] == [3, 3, 3]
    assert {point.threads for point in again.values()} == {1}
    assert again[25].error == pytest.approx(1 / 25)
    assert again[25].milliseconds >= 75
    assert 25 in points(found, "extrapolated")  # on as many threads as the scene has it was not measured
    assert sdk.scene(id) == before
    assert [sdk.frame(id, index).iterations for index in range(8)] == [100] * 4 + [40] * 4


def test_what_fits_into_a_time_is_told_by_frames_that_moved_and_were_met(sdk):
    id = sdk.create_scene(make_rig(), frames_per_second=10).id
    push(sdk, id, [0])
    sdk.set_budget(id, budget_ms=60 * fakes.MS_EACH)
    push(sdk, id, range(1, 4))
    push(sdk, id, [4], red=fakes.HELD)
    push(sdk, id, [5], red=fakes.STANDS)
    assert sdk.frame(id, 5).iterations == 0
    assert sdk.replay(id, [10], frames=1).replay.iterations == [60, 10]
    assert replayed(sdk, id).replay.state == "done"
    sdk.delete_scene(id)


def test_one_replay_at_a_time_and_the_scene_goes_on_beside_it(tmp_path, monkeypatch):
    go_on = tmp_path / "go on"
    monkeypatch.setenv("FAKE_GO_ON", str(go_on))
    with serving(tmp_path / "data") as (http, sdk):
        goes_on_beside_a_replay(http, sdk, go_on)


def goes_on_beside_a_replay(http, sdk, go_on):
    id = sdk.create_scene(make_rig(), frames_per_second=10).id
    push(sdk, id, range(2))
    go_on.touch()
    push(sdk, id, [2], red=fakes.WAITS)
    go_on.unlink()  # it waits in the replay
    sdk.replay(id, [50], frames=1)
    document = problem(http.post(f"/v1/scenes/{id}/tradeoff", json={}), 409)
    assert "running" in document["detail"]
    push(sdk, id, [3])
    assert sdk.tradeoff(id).replay.state == "running"
    go_on.touch()
    assert replayed(sdk, id).replay.state == "done"
    go_on.unlink()
    sdk.replay(id, [50], frames=1)
    ended = sdk.end_replay(id).replay
    assert (ended.state, ended.error) == ("failed", "the replay was stopped on request")
    assert sdk.end_replay(id).replay == ended
    assert not sdk.scene(id).degraded
    sdk.replay(id, [50], frames=1)
    sdk.delete_scene(id)  # in the middle of it
    problem(http.get(f"/v1/scenes/{id}/tradeoff"), 404)


@pytest.mark.parametrize("budget", [fakes.RAISES_IN_REPLAY, fakes.DIES_IN_REPLAY])
def test_a_replay_that_fails_says_so_and_harms_nothing(ran, budget):
    sdk, id = ran
    sdk.replay(id, [budget], frames=1)
    found = replayed(sdk, id).replay
    assert found.state == "failed"
    assert ("told to raise" if budget == fakes.RAISES_IN_REPLAY else "exit code 7") in found.error
    assert not sdk.scene(id).degraded
    sdk.replay(id, [10], frames=1)
    assert replayed(sdk, id).replay.state == "done"


def test_what_cannot_be_replayed_says_what_would_help(http, sdk):
    kept = IngestSettings(keep_frames=Retention(last=2), queue_frames=9)
    id = sdk.create_scene(make_rig(), frames_per_second=10, ingest=kept).id
    document = problem(http.post(f"/v1/scenes/{id}/tradeoff"), 409)
    assert document["field"] == "frames"
    push(sdk, id, range(7))
    wait_for(lambda: not sdk.frame(id, 4).pictures_kept)
    document = problem(http.post(f"/v1/scenes/{id}/tradeoff", json={"frames": 4}), 409)
    assert "were deleted" in document["detail"]
    assert "at most 1 frame" in document["remedy"]
    assert sdk.replay(id, [10], frames=1).replay.state == "running"
    sdk.delete_scene(id)
    few = IngestSettings(keep_states=Retention(last=3), queue_frames=9)
    id = sdk.create_scene(make_rig(), frames_per_second=10, ingest=few).id
    push(sdk, id, range(7))
    wait_for(lambda: sdk.scene(id).states_deleted >= 3)
    document = problem(http.post(f"/v1/scenes/{id}/tradeoff", json={"frames": 2}), 409)
    assert "deleted" in document["detail"]
    assert "keep_states" in document["remedy"]
    sdk.delete_scene(id)


@pytest.mark.parametrize(
    "body",
    [
        {"iterations": []},
        {"iterations": [0]},
        {"iterations": [1] * 9},
        {"iterations": 25},
        {"frames": 0},
        {"frames": 17},
        {"frame": 4},
    ],
)
def test_what_is_no_replay_is_refused(http, quiet_scene, body):
    assert problem(http.post(f"/v1/scenes/{quiet_scene}/tradeoff", json=body), 422)["remedy"]


def test_after_a_restart_what_was_measured_is_read_again(tmp_path):
    running = Running(fake_settings(tmp_path))
    with Client(running.url, busy_timeout=HANG_S) as sdk:
        id = sdk.create_scene(make_rig(), frames_per_second=10).id
        push(sdk, id, range(4))
        before = sdk.tradeoff(id)
    running.stop()
    running = Running(fake_settings(tmp_path))
    try:
        with Client(running.url, busy_timeout=HANG_S) as sdk:
            assert sdk.tradeoff(id) == before
            assert sdk.tradeoff(id) == before
    finally:
        running.stop()
