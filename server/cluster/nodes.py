"""Nodes of the cluster as Ray lists them, and what this service has on each."""

from __future__ import annotations

import socket
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import ray

from client.wire import Cluster, Node, Waiting
from server.cluster.needs import Needs

RAYS_OWN = "ray.io/"
"""Prefix of labels that Ray gives a node."""
LISTENS_S = 3.0
"""A node that is there takes a connection within so long."""


@dataclass(frozen=True)
class Place:
    """Of a process: the id of its node, None while it waits for one; since when, `time.monotonic`."""

    needs: Needs
    node: str | None = None
    since: float = field(default_factory=time.monotonic)


def all_nodes() -> list[dict[str, Any]]:
    """All nodes that there have been, as Ray describes them. Blocking."""
    nodes: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    return nodes


def living_nodes() -> list[dict[str, Any]]:
    """Those that are alive. Blocking."""
    return [node for node in all_nodes() if node["Alive"]]


def is_lost(id: str) -> bool:
    """True where a node is dead, nobody listens at its address, or the head of the cluster does not say. Blocking.

    The head takes some seconds to find a node dead, and an actor of it is missed at once. Where this machine's own node
    is dead, all actors of this service are lost with it.
    """
    try:
        living = living_nodes()
        own = [node for node in living if node["NodeID"] == id] if _own_is_in(living) else []
        return not any(_listens(node["NodeManagerAddress"], node["NodeManagerPort"]) for node in own)
    except Exception:  # whatever Ray raises without its head
        return True


def own_node_is_lost() -> bool:
    """True where the head of the cluster says that the node of this machine is dead. Blocking.

    Raises:
        Exception: whatever Ray raises without its head.
    """
    return not _own_is_in(living_nodes())


def own_node() -> str:
    """The id of the node of this machine by which this process is a member."""
    return str(ray.get_runtime_context().get_node_id())


def own_machine() -> str:
    """The address of this machine in the cluster. It may have several nodes; services of one may be members by each."""
    return str(ray.util.get_node_ip_address())  # type: ignore[no-untyped-call]


def _own_is_in(nodes: Iterable[Mapping[str, Any]]) -> bool:
    own = own_node()
    return any(node["NodeID"] == own for node in nodes)


def _listens(host: str, port: int) -> bool:
    try:
        with socket.create_connection((host, port), timeout=LISTENS_S):
            return True
    except OSError:
        return False


def cluster_of(
    nodes: Iterable[Mapping[str, Any]], places: Collection[Place], *, lost: Collection[str] = (), answers: bool = True
) -> Cluster:
    """Nodes that are alive, were lost lately, or had a process, with what they have; and what waits.

    Args:
        nodes: as Ray describes them. places: of processes. lost: ids. answers: the head of the cluster does.
    """
    statuses = []
    for node in nodes:
        own = [place.needs for place in places if place.node == node["NodeID"]]
        if not (node["Alive"] or own or node["NodeID"] in lost):
            continue
        has = node["Resources"]
        statuses.append(
            Node(
                id=node["NodeID"],
                host=node["NodeManagerHostname"],
                labels={name: value for name, value in node["Labels"].items() if not name.startswith(RAYS_OWN)},
                alive=node["Alive"],
                cpus=has.get("CPU", 0.0),
                cpus_taken=round(sum(needs.cpus for needs in own), 3),
                gpus=has.get("GPU", 0.0),
                memory_mb=round(has.get("memory", 0.0) / 1e6, 1),
                memory_taken_mb=round(sum(needs.memory for needs in own) / 1e6, 1),
                scenes=sorted({needs.scene for needs in own if needs.role == "worker"}),
            )
        )
    now = time.monotonic()
    waiting = [
        Waiting(scene=needs.scene, role=needs.role, needs=needs.words(), seconds=round(now - place.since, 1))
        for place in places
        if place.node is None
        for needs in (place.needs,)
    ]
    return Cluster(placement="ray", nodes=statuses, waiting=waiting, answers=answers)
