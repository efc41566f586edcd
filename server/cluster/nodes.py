"""Nodes of the cluster as reported by Ray, with the resources that this service reserves on each."""

from __future__ import annotations

import socket
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import ray

from client.wire import Cluster, Node, WaitingProcess
from server.cluster.resource_needs import ResourceNeeds

RAY_LABEL_PREFIX = "ray.io/"
"""Prefix of the labels that Ray itself assigns to nodes."""
CONNECT_S = 3.0
"""Timeout in seconds for connecting to a live node."""


@dataclass(frozen=True)
class PlacedProcess:
    """Requested process, with its resource needs and its node.

    Attributes:
        needs: resources reserved for the process.
        node: id of the node that runs the process; None while the process is waiting for a node.
        since: value of `time.monotonic` when the process was requested, in seconds.
    """

    needs: ResourceNeeds
    node: str | None = None
    since: float = field(default_factory=time.monotonic)


def all_nodes() -> list[dict[str, Any]]:
    """Returns all current and former nodes in Ray's format. Blocks."""
    nodes: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    return nodes


def living_nodes() -> list[dict[str, Any]]:
    """Returns the live nodes in Ray's format. Blocks."""
    return [node for node in all_nodes() if node["Alive"]]


def is_lost(id: str) -> bool:
    """Returns whether a node is lost. Blocks.

    A node is lost if it is dead, nothing listens at its address, or the head node does not respond. The address is
    checked because the head node takes several seconds to notice a dead node, whereas the loss of an actor is noticed
    immediately. If this machine's own node is dead, every node counts as lost, because all actors of this service are
    lost.
    """
    try:
        living = living_nodes()
        own = [node for node in living if node["NodeID"] == id] if _includes_own_node(living) else []
        return not any(_accepts_connections(node["NodeManagerAddress"], node["NodeManagerPort"]) for node in own)
    except Exception:  # Ray may raise any exception if its head does not respond
        return True


def own_node_is_lost() -> bool:
    """Returns whether the head node reports this machine's node as dead. Blocks.

    Raises:
        Exception: any exception that Ray raises if the head node does not respond.
    """
    return not _includes_own_node(living_nodes())


def own_node() -> str:
    """Returns the id of the node that this process used to join the cluster."""
    return str(ray.get_runtime_context().get_node_id())


def own_machine() -> str:
    """Returns the address of this machine in the cluster.

    A machine may have several nodes, and its services may join through different ones.
    """
    return str(ray.util.get_node_ip_address())  # type: ignore[no-untyped-call]


def _includes_own_node(nodes: Iterable[Mapping[str, Any]]) -> bool:
    own = own_node()
    return any(node["NodeID"] == own for node in nodes)


def _accepts_connections(host: str, port: int) -> bool:
    try:
        with socket.create_connection((host, port), timeout=CONNECT_S):
            return True
    except OSError:
        return False


def describe_cluster(
    nodes: Iterable[Mapping[str, Any]],
    places: Collection[PlacedProcess],
    *,
    lost: Collection[str] = (),
    head_responds: bool = True,
) -> Cluster:
    """Returns a description of the cluster: its nodes with their resources, and the processes waiting for a node.

    The description includes all nodes that are alive, were recently lost, or run a process of this service.

    Args:
        nodes: nodes in Ray's format.
        places: processes of this service with their nodes.
        lost: ids of recently lost nodes.
        head_responds: whether the head node responds.
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
                labels={name: value for name, value in node["Labels"].items() if not name.startswith(RAY_LABEL_PREFIX)},
                alive=node["Alive"],
                cpus=has.get("CPU", 0.0),
                cpus_reserved=round(sum(needs.cpus for needs in own), 3),
                gpus=has.get("GPU", 0.0),
                memory_mb=round(has.get("memory", 0.0) / 1e6, 1),
                memory_reserved_mb=round(sum(needs.memory for needs in own) / 1e6, 1),
                scenes=sorted({needs.scene for needs in own if needs.role == "worker"}),
            )
        )
    now = time.monotonic()
    waiting = [
        WaitingProcess(scene=needs.scene, role=needs.role, needs=needs.describe(), seconds=round(now - place.since, 1))
        for place in places
        if place.node is None
        for needs in (place.needs,)
    ]
    return Cluster(placement="ray", nodes=statuses, waiting=waiting, head_responds=head_responds)
