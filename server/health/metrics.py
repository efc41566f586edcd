"""Prometheus gauges, computed at each scrape; `server.counters` has the counters and histograms."""

from __future__ import annotations

import shutil
from collections import Counter as Counts
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from prometheus_client.core import GaugeMetricFamily, Metric

from client.wire import Cluster, SceneState, SceneStatus
from server.settings import ServerSettings


@dataclass(frozen=True, eq=False)
class ServiceState:
    """Collector of the gauges of the service: scenes, queues, subscribers, disk and, if there is one, the cluster."""

    settings: ServerSettings
    scenes: Sequence[SceneStatus]
    subscribers: int
    ready_after: float | None
    connections: Mapping[str, int]
    cluster: Cluster | None = None

    def collect(self) -> Iterator[Metric]:
        """Yields the gauges with their current values."""
        by_state = GaugeMetricFamily("scas4d_scenes", "Number of scenes per state.", labels=["state"])
        for state in SceneState:
            by_state.add_metric([state.value], sum(status.state == state for status in self.scenes))
        yield by_state
        yield GaugeMetricFamily(
            "scas4d_scenes_degraded",
            "Number of degraded scenes, in any state.",
            value=sum(status.degraded for status in self.scenes),
        )
        awake = [status for status in self.scenes if not status.asleep]
        yield GaugeMetricFamily(
            "scas4d_scenes_asleep",
            "Number of scenes without processes, in any state.",
            value=len(self.scenes) - len(awake),
        )
        for name, help, field in (
            ("scas4d_queue_frames", "Number of acknowledged but unfinished frames.", "queued"),
            ("scas4d_committed_frames", "Number of frames that can be rendered and tracked.", "committed"),
            ("scas4d_gaussians", "Number of Gaussians.", "gaussians"),
        ):
            gauge = GaugeMetricFamily(name, help, labels=["scene"])
            for status in awake:
                gauge.add_metric([status.id], getattr(status, field) or 0)
            yield gauge
        yield GaugeMetricFamily(
            "scas4d_subscribers", "Number of WebSockets subscribed to scenes.", value=self.subscribers
        )
        by_kind = GaugeMetricFamily("scas4d_connections", "Number of open connections per phase.", labels=["kind"])
        for kind, count in self.connections.items():
            by_kind.add_metric([kind], count)
        yield by_kind
        free = shutil.disk_usage(self.settings.data).free
        yield GaugeMetricFamily("scas4d_disk_free_bytes", "Free space on the disk of the data folder.", value=free)
        if self.ready_after is not None:
            help = "Seconds from service start until the kernels were warmed up."
            yield GaugeMetricFamily("scas4d_ready_after_seconds", help, value=self.ready_after)
        if self.cluster is not None:
            yield from cluster_gauges(self.cluster)


def cluster_gauges(cluster: Cluster) -> Iterator[Metric]:
    """Yields the gauges of the cluster's nodes and of this service's processes on them.

    The node gauges have no samples while the head node does not respond.
    """
    yield GaugeMetricFamily(
        "scas4d_cluster_up", "1 if the cluster's head node responds, otherwise 0.", value=cluster.head_responds
    )
    nodes = cluster.nodes if cluster.head_responds else []
    for name, help, field, unit in (
        ("scas4d_node_up", "1 for a node that is alive, 0 for a recently lost one.", "alive", 1),
        ("scas4d_node_cpus", "CPUs of a node.", "cpus", 1),
        ("scas4d_node_cpus_reserved", "CPUs of a node reserved for scenes by estimate.", "cpus_reserved", 1),
        ("scas4d_node_memory_bytes", "Memory of a node.", "memory_mb", 1e6),
        (
            "scas4d_node_memory_reserved_bytes",
            "Memory of a node reserved for scenes by estimate.",
            "memory_reserved_mb",
            1e6,
        ),
    ):
        gauge = GaugeMetricFamily(name, help, labels=["node", "host"])
        for node in nodes:
            if node.alive or field == "alive":
                gauge.add_metric([node.id, node.host], unit * getattr(node, field))
        yield gauge
    places = GaugeMetricFamily(
        "scas4d_scene_node", "1 for the node that runs a scene's worker.", labels=["scene", "node"]
    )
    for node in cluster.nodes:
        for scene in node.scenes:
            places.add_metric([scene, node.id], 1)
    yield places
    help = "Number of scene processes that are waiting for a node or about to start, per role."
    waiting = GaugeMetricFamily("scas4d_processes_waiting", help, labels=["role"])
    for role, count in {"worker": 0, **Counts(one.role for one in cluster.waiting)}.items():
        waiting.add_metric([role], count)
    yield waiting
