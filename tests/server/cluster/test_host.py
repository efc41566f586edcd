"""The actor of a process: messages that come before the process, or out of order, reach it in theirs."""

from __future__ import annotations

import asyncio
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from server.cluster import host
from server.cluster.host import Host
from server.processes.messages import Stop


def echo(spec: Any, connection: Connection[Any, Any]) -> None:
    while not isinstance(message := connection.recv(), Stop):
        connection.send((spec, message))


def test_messages_reach_the_process_in_order_from_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host, "_node_id", lambda: "here")

    async def run() -> list[Any]:
        actor, found = Host(None, tmp_path), list[Any]()
        await actor.post(1, "b")
        await actor.post(0, "a")
        await actor.start(echo, "scene")
        await actor.post(2, "c")
        while len(found) < 3:
            found += await asyncio.wait_for(actor.take(), 30)
        await actor.stop(5)
        return found

    assert asyncio.run(run()) == [("scene", "a"), ("scene", "b"), ("scene", "c")]
