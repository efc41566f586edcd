"""The budget of a scene: from which frame on it holds, and that no end of the service forgets it."""

from __future__ import annotations

import contextlib
import os
import signal
import time

import fakes
import httpx
import pytest
from running import Running, fake_settings, make_rig, pictures, problem
from waiting import HANG_S

from client.sdk import Client
from client.wire import Budget
from server.storage.events import BudgetChanged, FrameAccepted
from server.storage.ledger import Ledger


@contextlib.contextmanager
def serving(folder):
    running = Running(fake_settings(folder))
    try:
        with (
            httpx.Client(base_url=running.url, timeout=HANG_S) as http,
            Client(running.url, busy_timeout=HANG_S) as sdk,
        ):
            yield running, http, sdk
    finally:
        running.stop()


def push(sdk, id, *indices, red=0):
    for index in indices:
        sdk.put_frame(id, index, pictures(red))
    sdk.wait(id, indices[-1])


def iterations(sdk, id):
    return [sdk.frame(id, index).iterations for index in range(sdk.scene(id).committed)]


def test_a_scene_has_the_budget_of_its_settings_until_another_is_put(sdk):
    id = sdk.create_scene(make_rig(), settings={"update": {"iterations": 70, "skip_tolerance": 0.5}}).id
    found = sdk.budget(id)
    assert (found.requested, found.since) == (Budget(), 0)
    assert found.effective.model_dump() == {
        "iterations": 70,
        "budget_ms": None,
        "keep_up_fps": None,
        "stop_gain": 0.0,
        "skip_tolerance": 0.5,
    }
    put = sdk.set_budget(id, budget_ms=400, skip_tolerance=-1)
    assert put == sdk.budget(id)
    limits = {"iterations": 70, "budget_ms": 400, "keep_up_fps": None, "stop_gain": 0.0, "skip_tolerance": -1}
    assert put.effective.model_dump() == limits
    assert sdk.scene(id).budget == put.requested
    assert sdk.set_budget(id).effective == found.effective  # nothing put: as it was made
    sdk.delete_scene(id)


def test_a_scene_that_still_waits_for_its_points_takes_one(sdk):
    id = sdk.create_scene(make_rig(1)).id  # of one camera: frame 0 needs points
    assert sdk.set_budget(id, iterations=50).effective.iterations == 50
    sdk.delete_scene(id)


def test_it_holds_from_the_first_frame_that_is_not_begun(sdk, scene):
    push(sdk, scene, 0, 1)
    assert sdk.set_budget(scene, iterations=25).since == 2
    push(sdk, scene, 2)
    sdk.put_frame(scene, 3, pictures(fakes.SLOW))
    until = time.monotonic() + HANG_S
    while sdk.frame(scene, 3).state != "updating":
        assert time.monotonic() < until
        time.sleep(0.02)
    assert sdk.set_budget(scene, iterations=50).since == 4  # the one at work keeps what it began with
    push(sdk, scene, 4)
    assert sdk.frame(scene, 3).budget == Budget(iterations=25)
    assert sdk.frame(scene, 4).budget == Budget(iterations=50)
    assert iterations(sdk, scene) == [fakes.ITERATIONS, fakes.ITERATIONS, 25, 25, 50]


def test_frames_that_wait_get_the_budget_that_held_for_them_after_kill_9(tmp_path):
    with serving(tmp_path) as (_, http, sdk):
        id = sdk.create_scene(make_rig(), frames_per_second=10).id
        push(sdk, id, 0, 1)
        sdk.set_budget(id, iterations=25)
        sdk.put_frame(id, 2, pictures(fakes.SLOW))
        until = time.monotonic() + HANG_S
        while sdk.frame(id, 2).state != "updating":
            assert time.monotonic() < until
            time.sleep(0.02)
        sdk.set_budget(id, iterations=50)
        worker = int((tmp_path / "scenes" / id / "worker.lock").read_text())
        http.post(f"/v1/scenes/{id}/pause")
        os.kill(worker, signal.SIGKILL)
    with serving(tmp_path) as (_, http, sdk):
        assert sdk.budget(id).requested == Budget(iterations=50)
        assert sdk.scene(id).budget == Budget(iterations=50)
        sdk.resume(id)
        push(sdk, id, 3)
        assert iterations(sdk, id) == [fakes.ITERATIONS, fakes.ITERATIONS, 25, 50]
        assert sdk.set_budget(id).since == 4
        push(sdk, id, 4)
        assert iterations(sdk, id)[-1] == fakes.ITERATIONS


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"iterations": 0}, "iterations"),
        ({"iterations": 10**9}, "iterations"),
        ({"iterations": 2.5}, "iterations"),
        ({"budget_ms": 0}, "budget_ms"),
        ({"budget_ms": -5}, "budget_ms"),
        ({"budget_ms": 1e300}, "budget_ms"),
        ({"stop_gain": 1}, "stop_gain"),
        ({"skip_tolerance": -2}, "skip_tolerance"),
        ({"milliseconds": 500}, "milliseconds"),
        ([], "body"),
    ],
)
def test_what_is_no_budget_is_refused_and_changes_nothing(http, quiet_scene, body, field):
    document = problem(http.put(f"/v1/scenes/{quiet_scene}/budget", json=body), 422)
    assert document["field"].split(".")[-1] == field
    assert document["remedy"]
    assert http.get(f"/v1/scenes/{quiet_scene}/budget").json()["requested"] == Budget().model_dump()


def test_numbers_that_are_none_are_refused(http, quiet_scene):
    for text in (b'{"budget_ms": NaN}', b'{"previous": Infinity}', b'{"budget_ms": 1e999}'):
        answer = http.put(
            f"/v1/scenes/{quiet_scene}/budget", content=text, headers={"Content-Type": "application/json"}
        )
        problem(answer, 422)


def test_a_scene_that_failed_takes_none(http, sdk):
    id = sdk.create_scene(make_rig()).id
    sdk.put_frame(id, 0, pictures(fakes.RAISES))
    sdk.wait(id, 0)
    problem(http.put(f"/v1/scenes/{id}/budget", json={"iterations": 5}), 409)
    problem(http.put("/v1/scenes/nope/budget", json={"iterations": 5}), 404)
    sdk.delete_scene(id)


def test_later_events_win_and_each_frame_finds_its_own():
    ledger = Ledger("s")
    for index in range(6):
        ledger.apply(FrameAccepted(index=index, time=float(index), identity="0" * 64, files=("f",)))
    for index, count in ((2, 20), (4, 40), (3, 30)):  # frames were taken back in between
        ledger.apply(BudgetChanged(index=index, budget=Budget(iterations=count)))
    assert [ledger.budget_of(index).iterations for index in range(6)] == [None, None, 20, 30, 30, 30]
    assert ledger.next_to_begin() == 0
