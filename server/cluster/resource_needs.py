"""Resource needs of scene processes, which Ray's scheduler uses to choose their nodes.

The needs are derived from the memory estimate of the scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from client.wire import RigModel
from server.health.estimate import estimate
from server.messages import SceneSpec
from server.processes import reader_process, worker
from server.processes.placement import Entry
from server.settings import ServerSettings

READER_CPUS = 0.25
"""CPUs reserved for a reader, which works only while clients view the scene and has priority over updates."""
BACKGROUND_CPUS = 0.1
"""CPUs reserved for a replay or an export, which use the remaining CPU time."""


@dataclass(frozen=True)
class ResourceNeeds:
    """Resource needs of one process.

    Attributes:
        role: one-word role of the process.
        scene: scene name.
        cpus: number of CPUs, which may be fractional.
        memory: memory in bytes.
        labels: required node labels.
    """

    role: str
    scene: str
    cpus: float
    memory: int
    labels: Mapping[str, str] = field(default_factory=dict)

    def describe(self) -> str:
        """Returns the needs as text.

        >>> ResourceNeeds("worker", "a", 1, 700_000_000).describe()
        '1 CPU and 0.7 GB of memory'
        >>> ResourceNeeds("worker", "a", 1, 700_000_000, {"rig": "stage-a"}).describe()
        '1 CPU and 0.7 GB of memory on a node with rig=stage-a'
        """
        labels = ", ".join(f"{name}={value}" for name, value in self.labels.items())
        node = f" on a node with {labels}" if labels else ""
        return f"{self.cpus:g} CPU and {self.memory / 1e9:.1f} GB of memory{node}"

    def actor_options(self) -> dict[str, Any]:
        """Returns the needs as options of a Ray actor."""
        room = {"num_cpus": self.cpus, "memory": self.memory}
        return room | ({"label_selector": dict(self.labels)} if self.labels else {})


def resource_needs(entry: Entry, spec: Any, server: ServerSettings) -> ResourceNeeds | None:
    """Returns the resource needs of a process.

    Returns None for a process without a scene. Such a process runs on the service's machine.
    """
    scene = spec if isinstance(spec, SceneSpec) else getattr(spec, "scene", None)
    if not isinstance(scene, SceneSpec):
        return None
    sizes = estimate(RigModel.of(scene.rig), scene.settings, server)
    name, labels = scene.folder.name, scene.nodes
    if entry is worker.main:
        return ResourceNeeds("worker", name, 1.0, round(1e6 * sizes.worker_mb), labels)
    memory = round(1e6 * sizes.readers_mb / 2)
    if entry in (reader_process.run_view_reader, reader_process.run_bulk_reader):
        return ResourceNeeds(entry.__name__, name, READER_CPUS, memory, labels)
    return ResourceNeeds(entry.__module__.rpartition(".")[2], name, BACKGROUND_CPUS, memory, labels)
