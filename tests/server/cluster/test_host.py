"""The actor of a process: messages that come before the process, or out of order, reach it in theirs."""

from __future__ import annotations

import asyncio
import os
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
from waiting import HANG_S

from server.cluster import folder_marker, process_host
from server.cluster.process_host import ProcessHost, ProcessScheduling
from server.messages import Stop


def echo(spec: Any, connection: Connection[Any, Any]) -> None:
    while not isinstance(message := connection.recv(), Stop):
        connection.send((spec, message))


def manner(spec: Any, connection: Connection[Any, Any]) -> None:
    connection.send((os.environ.get("OMP_NUM_THREADS"), os.getpriority(os.PRIO_PROCESS, 0)))
    connection.recv()


def test_a_process_runs_as_on_the_machine_of_its_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray's own are nicer than all else on the node, and have a thread of OpenMP for each CPU of the actor."""
    monkeypatch.setattr(process_host, "_node_id", lambda: "here")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    folder_marker.write_marker(tmp_path, "mine")
    nice = os.getpriority(os.PRIO_PROCESS, 0)

    async def run() -> Any:
        os.setpriority(os.PRIO_PROCESS, 0, nice + 3)  # of this thread alone
        actor = ProcessHost(None, tmp_path, "mine", ProcessScheduling("2", nice))
        await actor.start(manner, "scene")
        found = await asyncio.wait_for(actor.receive(), HANG_S)
        await actor.stop(5)
        return found

    with ThreadPoolExecutor(1) as pool:
        threads, niceness = pool.submit(asyncio.run, run()).result()[0]
    assert threads == "2"
    assert niceness == (nice if os.geteuid() == 0 else nice + 3)


def test_messages_reach_the_process_in_order_from_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_host, "_node_id", lambda: "here")

    folder_marker.write_marker(tmp_path, "mine")

    async def run() -> list[Any]:
        actor, found = ProcessHost(None, tmp_path, "mine"), list[Any]()
        await actor.post(1, "b")
        await actor.post(0, "a")
        await actor.start(echo, "scene")
        await actor.post(2, "c")
        while len(found) < 3:
            found += await asyncio.wait_for(actor.receive(), HANG_S)
        await actor.stop(5)
        return found

    assert asyncio.run(run()) == [("scene", "a"), ("scene", "b"), ("scene", "c")]


def test_a_node_with_a_folder_of_its_own_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It joined later, and its folder at that path can be written to: what is committed there would be lost."""
    monkeypatch.setattr(process_host, "_node_id", lambda: "here")
    monkeypatch.setattr(folder_marker, "VISIBLE_S", 0.1)
    folder_marker.write_marker(tmp_path, "another service")
    started = asyncio.run(ProcessHost(None, tmp_path, "mine").start(echo, "scene"))
    assert started.pid is None
    assert started.fault is not None
    assert started.fault.endswith(f"cannot see the data folder {tmp_path}; mount it on that node")
