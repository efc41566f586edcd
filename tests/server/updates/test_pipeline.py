"""The next frame is updated while the state before it is written: order, crashes, failures and disks that break."""

from __future__ import annotations

import os
import signal

import fakes
import httpx
import pytest
from running import Running, fake_settings, pictures
from sending import create, finished, framed, status
from waiting import HANG_S, wait_for

from client.wire import FRAME_MEDIA_TYPE
from scas4d_core.storage.history import History


@pytest.fixture
def go_on(tmp_path, monkeypatch):
    """The file that lets late writes go on."""
    file = tmp_path / "go-on"
    monkeypatch.setenv("FAKE_GO_ON", str(file))
    return file


@pytest.fixture
def served(tmp_path, go_on):
    running = Running(fake_settings(tmp_path / "data", queue_frames=6))
    with httpx.Client(base_url=running.url, timeout=HANG_S) as http:
        yield running, http
    running.stop()


def send(http, id, index, red):
    answer = http.put(
        f"/v1/scenes/{id}/frames/{index}",
        content=framed(index, pictures(red)),
        headers={"Content-Type": FRAME_MEDIA_TYPE},
    )
    assert answer.status_code == 202, answer.text


def begun(http):
    """A new scene whose frame 0 is committed."""
    id = create(http)
    send(http, id, 0, 0)
    finished(http, id, 0)
    return id


def state_of(http, id, index):
    return http.get(f"/v1/scenes/{id}/frames/{index}").json()["state"]


def worker_pid(running, id):
    return int(running.app.state.scenes[id].spec.folder.worker_lock.read_text())


def test_the_next_frame_is_updated_before_the_last_one_is_written(served, go_on):
    _, http = served
    id = begun(http)
    for index, red in ((1, fakes.WRITES_LATE), (2, 7), (3, 8)):
        send(http, id, index, red)
    wait_for(lambda: state_of(http, id, 2) == "updating")
    assert [state_of(http, id, index) for index in (1, 2, 3)] == ["updating", "updating", "queued"]
    assert status(http, id)["committed"] == 1  # committed means written
    assert status(http, id)["behind_seconds"] > 0
    assert http.get(f"/v1/scenes/{id}/render?camera=c0&frame=1").status_code == 404
    go_on.touch()
    finished(http, id, 3)
    assert [state_of(http, id, index) for index in range(4)] == ["committed"] * 4
    assert status(http, id)["behind_seconds"] == 0
    first, second = (http.get(f"/v1/scenes/{id}/frames/{index}").json()["latency"] for index in (1, 2))
    for latency in (first, second):
        assert latency["total"] == pytest.approx(latency["queue"] + latency["update"] + latency["commit"])
    assert first["commit"] > second["queue"]  # the second was updated while the first was written
    assert 'scas4d_frame_latency_seconds_count{stage="total"}' in http.get("/metrics").text


def test_a_crash_while_a_state_is_written_repeats_both_frames(served, go_on):
    running, http = served
    id, undisturbed = begun(http), create(http)
    for index, red in ((1, fakes.WRITES_LATE), (2, 7), (3, 8)):
        send(http, id, index, red)
    wait_for(lambda: state_of(http, id, 2) == "updating")
    os.kill(worker_pid(running, id), signal.SIGKILL)
    go_on.touch()
    finished(http, id, 3)
    for index, red in ((0, 0), (1, fakes.WRITES_LATE), (2, 7), (3, 8)):
        send(http, undisturbed, index, red)
    finished(http, undisturbed, 3)
    folders = [running.app.state.scenes[scene].spec.folder.states for scene in (id, undisturbed)]
    crashed, whole = map(History.load, folders)
    assert crashed.indices == whole.indices == [0, 1, 2, 3]
    for index in whole.indices:
        arrays = [history.gaussians(index).arrays() for history in (crashed, whole)]
        for name in arrays[0]:
            assert arrays[0][name].tobytes() == arrays[1][name].tobytes(), (index, name)


def test_a_state_that_cannot_be_written_fails_its_frame_and_no_other(served):
    _, http = served
    id = begun(http)
    for index, red in ((1, fakes.CANNOT_BE_WRITTEN), (2, 7), (3, 8)):
        send(http, id, index, red)
    assert finished(http, id, 1)["state"] == "failed"
    finished(http, id, 3)
    assert [state_of(http, id, index) for index in range(4)] == ["committed", "failed", "committed", "committed"]


def test_frames_that_fail_are_reported_after_the_frame_before_them(served, go_on):
    _, http = served
    id = begun(http)
    send(http, id, 1, fakes.WRITES_LATE)
    send(http, id, 2, fakes.RAISES)
    wait_for(lambda: state_of(http, id, 2) == "updating")
    assert state_of(http, id, 1) == "updating"
    go_on.touch()
    assert finished(http, id, 2)["state"] == "failed"
    assert state_of(http, id, 1) == "committed"


def test_a_worker_that_is_stopped_finishes_its_write(served, go_on):
    _, http = served
    id = begun(http)
    send(http, id, 1, 5)
    finished(http, id, 1)
    assert http.post(f"/v1/scenes/{id}/sleep").status_code == 200
    send(http, id, 2, 6)
    finished(http, id, 2)
    assert status(http, id)["worker_deaths"] == 0
