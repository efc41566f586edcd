"""Nodes of the cluster as Ray tells them, and what this service has on each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import ray

from client.wire import Cluster, Node, Waiting
from server.cluster.needs import Needs


def all_nodes() -> list[dict[str, Any]]:
    """All nodes that there have been, as Ray describes them. Blocking."""
    found: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    return found


def living_nodes() -> list[dict[str, Any]]:
    """Those that are alive. Blocking."""
    return [node for node in all_nodes() if node["Alive"]]


def is_lost(id: str) -> bool:
    """True where a node is dead, or the head of the cluster does not say. Blocking."""
    try:
        return id not in {node["NodeID"] for node in living_nodes()}
    except Exception:  # whatever Ray raises without its head
        return True


def cluster_of(nodes: Sequence[Mapping[str, Any]], places: Mapping[str, tuple[Needs, str | None]]) -> Cluster:
    """Nodes that are alive, and lost ones that had a process, with what they have.

    Args:
        nodes: as Ray describes them. places: processes, with the id of their node; None: they wait for one.
    """
    found = []
    for node in nodes:
        own = [needs for needs, place in places.values() if place == node["NodeID"]]
        if not (node["Alive"] or own):
            continue
        has = node["Resources"]
        found.append(
            Node(
                id=node["NodeID"],
                host=node["NodeManagerHostname"],
                alive=node["Alive"],
                cpus=has.get("CPU", 0.0),
                cpus_taken=round(sum(needs.cpus for needs in own), 3),
                gpus=has.get("GPU", 0.0),
                memory_mb=round(has.get("memory", 0.0) / 1e6, 1),
                memory_taken_mb=round(sum(needs.memory for needs in own) / 1e6, 1),
                scenes=sorted(needs.scene for needs in own if needs.role == "worker"),
            )
        )
    waiting = [
        Waiting(scene=needs.scene, role=needs.role, needs=needs.words())
        for needs, place in places.values()
        if place is None
    ]
    return Cluster(placement="ray", nodes=found, waiting=waiting)
