"""Adds up what the scenes of all services of a cluster take of its nodes."""

from __future__ import annotations

from collections.abc import Iterable

from client.wire import Cluster, Node


def together(own: Cluster, others: Iterable[Cluster]) -> Cluster:
    """Returns the nodes as this service knows them, with what is taken of each by all, and all that waits."""
    nodes, waiting = {node.id: node for node in own.nodes}, list(own.waiting)
    for other in others:
        waiting += other.waiting
        for node in other.nodes:
            nodes[node.id] = _added(nodes[node.id], node) if node.id in nodes else node
    return own.model_copy(update={"nodes": list(nodes.values()), "waiting": waiting})


def _added(node: Node, more: Node) -> Node:
    return node.model_copy(
        update={
            "cpus_taken": round(node.cpus_taken + more.cpus_taken, 3),
            "memory_taken_mb": round(node.memory_taken_mb + more.memory_taken_mb, 1),
            "scenes": sorted({*node.scenes, *more.scenes}),
        }
    )
