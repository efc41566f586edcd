"""/metrics on a cluster: nodes, scenes on them, processes that wait; nothing of it where there is one machine."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator

import httpx
import pytest
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import generate_latest
from running import Running, fake_settings
from waiting import HANG_S

from client.wire import Cluster, Node, WaitingProcess
from server.health.metrics import cluster_gauges

ALIVE = Node(
    id="n1",
    host="stage-1",
    alive=True,
    cpus=8,
    cpus_reserved=1.25,
    gpus=0,
    memory_mb=16_000,
    memory_reserved_mb=900.5,
    scenes=["s1"],
)
LOST = ALIVE.model_copy(update={"id": "n2", "host": "stage-2", "alive": False, "scenes": []})
WAITS = WaitingProcess(scene="s2", role="worker", needs="1 CPU", seconds=9)


def written(cluster: Cluster) -> dict[str, float]:
    class Collector:
        def collect(self) -> Iterator[object]:
            return cluster_gauges(cluster)

    registry = CollectorRegistry()
    registry.register(Collector())  # type: ignore[arg-type]
    lines = generate_latest(registry).decode().splitlines()
    return {name: float(value) for name, value in (line.rsplit(" ", 1) for line in lines if not line.startswith("#"))}


def test_nodes_scenes_and_what_waits() -> None:
    assert written(Cluster(placement="ray", nodes=[ALIVE, LOST], waiting=[WAITS, WAITS])) == {
        "scas4d_cluster_up": 1,
        'scas4d_node_up{host="stage-1",node="n1"}': 1,
        'scas4d_node_up{host="stage-2",node="n2"}': 0,
        'scas4d_node_cpus{host="stage-1",node="n1"}': 8,
        'scas4d_node_cpus_reserved{host="stage-1",node="n1"}': 1.25,
        'scas4d_node_memory_bytes{host="stage-1",node="n1"}': 16e9,
        'scas4d_node_memory_reserved_bytes{host="stage-1",node="n1"}': 900.5e6,
        'scas4d_scene_node{node="n1",scene="s1"}': 1,
        'scas4d_processes_waiting{role="worker"}': 2,
    }


def test_a_head_that_does_not_answer_tells_no_node() -> None:
    found = written(Cluster(placement="ray", nodes=[ALIVE], waiting=[], head_responds=False))
    assert found == {
        "scas4d_cluster_up": 0,
        'scas4d_scene_node{node="n1",scene="s1"}': 1,
        'scas4d_processes_waiting{role="worker"}': 0,
    }


@pytest.fixture
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    running = Running(fake_settings(tmp_path_factory.mktemp("data")))
    yield running
    running.stop()


def test_they_follow_the_placement_and_go_with_what_they_are_of(running: Running) -> None:
    def nodes_told() -> list[str]:
        text = httpx.get(f"{running.url}/metrics", timeout=HANG_S).text
        return [line for line in text.splitlines() if line.startswith(("scas4d_node", "scas4d_scene_", "scas4d_cl"))]

    assert nodes_told() == []
    told = [Cluster(placement="ray", nodes=[ALIVE], waiting=[])]

    async def cluster() -> Cluster:
        await asyncio.sleep(0)
        return told[0]

    running.app.state.placement.cluster = cluster
    assert 'scas4d_scene_node{node="n1",scene="s1"} 1.0' in nodes_told()
    told[0] = Cluster(placement="ray", nodes=[], waiting=[])
    assert nodes_told() == ["scas4d_cluster_up 1.0"]
