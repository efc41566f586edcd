"""Merged view of the resource reservations of all services in a cluster."""

from __future__ import annotations

from collections.abc import Iterable

from client.wire import Cluster, Node


def merge_clusters(own: Cluster, others: Iterable[Cluster]) -> Cluster:
    """Returns the cluster as this service sees it, with the reservations of all services added.

    The waiting processes of all services are also included.
    """
    nodes, waiting = {node.id: node for node in own.nodes}, list(own.waiting)
    for other in others:
        waiting += other.waiting
        for node in other.nodes:
            nodes[node.id] = _merge_node(nodes[node.id], node) if node.id in nodes else node
    return own.model_copy(update={"nodes": list(nodes.values()), "waiting": waiting})


def _merge_node(node: Node, more: Node) -> Node:
    return node.model_copy(
        update={
            "cpus_reserved": round(node.cpus_reserved + more.cpus_reserved, 3),
            "memory_reserved_mb": round(node.memory_reserved_mb + more.memory_reserved_mb, 1),
            "scenes": sorted({*node.scenes, *more.scenes}),
        }
    )
