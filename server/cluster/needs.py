"""Needs of a scene's process, for a node that has room: by its scene's estimate; Ray's scheduler counts with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from client.wire import RigModel
from server.health.estimate import estimate
from server.messages import SceneSpec
from server.processes import renderer, worker
from server.processes.placement import Entry
from server.settings import ServerSettings

READER_CPUS = 0.25
"""Of a reader: it works while somebody looks, and goes before the updates then."""
ASIDE_CPUS = 0.1
"""Of a replay or an export: they take what is left."""


@dataclass(frozen=True)
class Needs:
    """Of one process.

    Attributes:
        role: what it does, in a word. scene: whose. cpus: parts of them. memory: bytes. labels: of the node.
    """

    role: str
    scene: str
    cpus: float
    memory: int
    labels: Mapping[str, str] = field(default_factory=dict)

    def words(self) -> str:
        """In words.

        >>> Needs("worker", "a", 1, 700_000_000).words()
        '1 CPU and 0.7 GB of memory'
        >>> Needs("worker", "a", 1, 700_000_000, {"rig": "stage-a"}).words()
        '1 CPU and 0.7 GB of memory on a node with rig=stage-a'
        """
        labels = ", ".join(f"{name}={value}" for name, value in self.labels.items())
        node = f" on a node with {labels}" if labels else ""
        return f"{self.cpus:g} CPU and {self.memory / 1e9:.1f} GB of memory{node}"

    def options(self) -> dict[str, Any]:
        """As options of a Ray actor."""
        room = {"num_cpus": self.cpus, "memory": self.memory}
        return room | ({"label_selector": dict(self.labels)} if self.labels else {})


def needs_of(entry: Entry, spec: Any, server: ServerSettings) -> Needs | None:
    """Needs of a process; None where it is of no scene, and belongs to the service's own machine."""
    scene = spec if isinstance(spec, SceneSpec) else getattr(spec, "scene", None)
    if not isinstance(scene, SceneSpec):
        return None
    sizes = estimate(RigModel.of(scene.rig), scene.settings, server)
    name, labels = scene.folder.name, scene.nodes
    if entry is worker.main:
        return Needs("worker", name, 1.0, round(1e6 * sizes.worker_mb), labels)
    memory = round(1e6 * sizes.readers_mb / 2)
    if entry in (renderer.views, renderer.bulk):
        return Needs(entry.__name__, name, READER_CPUS, memory, labels)
    return Needs(entry.__module__.rpartition(".")[2], name, ASIDE_CPUS, memory, labels)
