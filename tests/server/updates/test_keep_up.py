"""A budget that keeps up with the cameras: its time limit, its errors, and frames whose limit falls as they queue."""

from __future__ import annotations

import fakes
import httpx
import pytest
from running import Running, fake_settings, pictures, problem
from sending import create, finished, framed
from waiting import HANG_S

from client.sdk import Client
from client.wire import FRAME_MEDIA_TYPE, Budget
from server.keep_up import SHORTEST, with_fewer_iterations, with_time_limit


def test_the_limit_follows_the_rate_and_the_queue():
    limits = [with_time_limit(Budget(keep_up_fps=25), waiting).budget_ms for waiting in range(9)]
    assert limits[0] < 1000 / 25
    assert limits == sorted(limits, reverse=True)
    assert limits[4] == pytest.approx(limits[0] / 2)
    for other in (Budget(), Budget(iterations=30), Budget(budget_ms=70.0)):
        assert with_time_limit(other, 5) == other


def test_updates_are_shortened_to_a_third_and_only_while_frames_wait():
    assert [with_fewer_iterations(Budget(), waiting, 90).iterations for waiting in (0, 1, 2, 9)] == [None, 45, 30, 30]
    assert with_fewer_iterations(Budget(), 9, 2).iterations == 1
    for own in (Budget(iterations=30), Budget(budget_ms=70.0), Budget(keep_up_fps=25.0)):
        assert with_fewer_iterations(own, 5, 100) == own


@pytest.fixture
def served(tmp_path, monkeypatch):
    go_on = tmp_path / "go-on"
    monkeypatch.setenv("FAKE_GO_ON", str(go_on))
    running = Running(fake_settings(tmp_path / "data", queue_frames=6))
    with httpx.Client(base_url=running.url, timeout=HANG_S) as http, Client(running.url) as sdk:
        yield running, http, sdk, go_on
    running.stop()


def send_while_one_waits(http, id, go_on):
    """Sends five frames, of which the second waits in the worker until the last one has arrived."""
    for index, red in enumerate((0, fakes.WAITS, 3, 4, 5)):
        answer = http.put(
            f"/v1/scenes/{id}/frames/{index}",
            content=framed(index, pictures(red)),
            headers={"Content-Type": FRAME_MEDIA_TYPE},
        )
        assert answer.status_code == 202
        if index == 0:
            finished(http, id, 0)
    go_on.touch()
    finished(http, id, 4)


def test_waiting_frames_get_less_time(served):
    _, http, sdk, go_on = served
    id = create(http)
    found = sdk.set_budget(id, keep_up_fps=10.0)
    assert (found.effective.keep_up_fps, found.effective.budget_ms) == (10, 90)
    send_while_one_waits(http, id, go_on)
    budgets = [sdk.frame(id, index).budget for index in range(5)]
    limits = [budget.budget_ms for budget in budgets[2:]]
    assert limits == sorted(limits)  # the queue drains
    assert limits[-1] == 90
    assert limits[0] < 90
    assert {budget.keep_up_fps for budget in budgets[1:]} == {10}
    assert sdk.set_budget(id).effective.budget_ms is None


def test_a_scene_that_skips_shortens_updates_while_frames_wait(served):
    _, http, sdk, go_on = served
    refuses, skips, has_a_budget = create(http), create(http, when_full="skip"), create(http, when_full="skip")
    sdk.set_budget(has_a_budget, iterations=7)
    iterations = {}
    assert [sdk.scene(id).queue_limit for id in (refuses, skips)] == [6, 8]
    for id in (refuses, skips, has_a_budget):
        go_on.unlink(missing_ok=True)
        send_while_one_waits(http, id, go_on)
        assert sdk.scene(id).skipped == 0
        iterations[id] = [sdk.frame(id, index).budget.iterations for index in range(1, 5)]
    usual = sdk.scene(skips).settings["update"]["iterations"]
    assert iterations[refuses] == [None] * 4
    assert iterations[has_a_budget] == [7] * 4
    assert iterations[skips] == [None, usual // SHORTEST, usual // 2, None]  # two, one and no later frames wait


def test_two_time_limits_and_impossible_rates_are_refused(served):
    _, http, _, _ = served
    id = create(http)
    for body in ({"keep_up_fps": 25.0, "budget_ms": 30.0}, {"keep_up_fps": 0.0}, {"keep_up_fps": 5000.0}):
        document = problem(http.put(f"/v1/scenes/{id}/budget", json=body), 422)
        assert document["remedy"]
    assert http.put(f"/v1/scenes/{id}/budget", json={"keep_up_fps": 29.97}).status_code == 200
