"""The study of live views: arrivals do not wait for answers, and the sums of its table."""

from __future__ import annotations

import threading
import time

import pytest
from running import make_rig, pictures
from waiting import wait_for, wait_for_soon

from client.sdk import Client
from studies.service.views import Load, ViewTimes, table


@pytest.fixture(scope="module")
def address(service):
    with Client(service.url) as sdk:
        id = sdk.create_scene(make_rig(), frames_per_second=10).id
        sdk.put_frame(id, 0, pictures())
        sdk.wait(id, 0)
        yield f"{service.url}/v1/scenes/{id}/"
        sdk.delete_scene(id)


def test_views_are_asked_for_at_their_rate_and_timed(address):
    began, rate = time.perf_counter(), 20.0
    with Load(address, ["c0", "c1"], rate) as load:
        wait_for(lambda: len(load.latencies) >= 10)
    assert load.refused == 0
    assert len(load.latencies) <= rate * (time.perf_counter() - began) + 1
    assert all(latency > 0 for latency in load.latencies)


def test_arrivals_do_not_wait_for_answers(address, service, monkeypatch):
    """Views are asked for while nothing is answered; each counts from when it was due."""
    readers = service.app.state.scenes[address.rstrip("/").rsplit("/", 1)[1]].readers
    ask = readers.views.ask
    asked, opened = [], threading.Event()

    async def slow(query):
        asked.append(time.perf_counter())
        await wait_for_soon(opened.is_set)
        return await ask(query)

    monkeypatch.setattr(readers.views, "ask", slow)
    with Load(address, ["c0"], 10.0) as load:
        wait_for(lambda: len(asked) >= 8 and time.perf_counter() - asked[0] > 1)
        opened.set()
    assert load.refused == 0
    assert len(load.latencies) >= 8
    assert max(load.latencies) > 1000


def test_views_without_an_answer_are_counted(address):
    with Load(address, ["nobody"], 20.0) as load:
        wait_for(lambda: load.refused >= 5)
    assert load.latencies == []


def test_the_table_judges_the_bar():
    good = ViewTimes(5.0, idle=[10, 12, 14], loaded=[20, 22, 24], alone=[1.0, 1.0], together=[1.2, 1.2])
    assert good.latency == pytest.approx(22 / 12)
    assert good.slower == pytest.approx(0.2)
    other = ViewTimes(20.0, idle=[10], loaded=[90], alone=[1.0], together=[2.0])
    text = table([good, other])
    assert ": reached (1.83 times, +20%)" in text
    assert len(text.split("\n\n")[0].splitlines()) == 4
    for change in ({"loaded": [30]}, {"together": [1.3]}, {"refused": 1}):
        bad = ViewTimes(**{"rate": 5.0, "idle": [12], "loaded": [22], "alone": [1.0], "together": [1.2]} | change)
        assert "**missed**" in table([bad])
