"""The simulated service, which owns all scenes and recreates them from their folders after a restart."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from random import Random

from server.cluster.resource_needs import ResourceNeeds
from server.messages import SceneSpec
from studies.simulation.cluster import SimulatedCluster
from studies.simulation.delays import DOWN_S, RECOVER_S
from studies.simulation.process import SimulatedPlacement
from studies.simulation.record import FrameRecord, TimeRecord
from studies.simulation.scene import ScenePlan, SimulatedScene
from studies.simulation.takeover import Takeovers

INTERRUPTED = 20
"""Maximum number of scenes whose epoch is just starting when the service ends."""


class SimulatedService:
    """The simulated service, of which one instance runs at a time.

    Args:
        cluster: the modelled cluster.
        frames: record of the frames.
        times: record of placement and recovery times.
        takeovers: actions at the start of an epoch.
        needs: function that returns the resource needs of a scene's worker.
        between_s: seconds between the frames of a scene.

    Attributes:
        up: whether the service is running.
        plans: plans of all scenes that were requested and not ended by their users.
        scenes: scenes of the running instance, keyed by id.
    """

    def __init__(
        self,
        cluster: SimulatedCluster,
        frames: FrameRecord,
        times: TimeRecord,
        takeovers: Takeovers,
        needs: Callable[[SceneSpec], ResourceNeeds],
        between_s: float,
    ) -> None:
        self.up = True
        self.plans: dict[str, ScenePlan] = {}
        self.scenes: dict[str, SimulatedScene] = {}
        self._cluster, self._frames, self._times, self._takeovers = cluster, frames, times, takeovers
        self._random: Random = cluster.random
        self._needs, self._between_s = needs, between_s
        self.placement = self._place()

    @property
    def done(self) -> bool:
        """Whether the service runs and all frames of all scenes are committed."""
        return self.up and all(name in self.scenes and self.scenes[name].done for name in self.plans)

    def create(self, plan: ScenePlan) -> None:
        """Creates a scene. If the service is down, the scene is opened after the restart."""
        self.plans[plan.name] = plan
        plan.spec.folder.path.mkdir(parents=True)
        if self.up:
            self._open(plan, "new")

    async def restart(self) -> None:
        """Ends the service and restarts it later. Its scenes are then recovered one by one."""
        self.up = False
        now = self._cluster.loop.time()
        living = [scene for scene in self.scenes.values() if not scene.ended]
        for scene in self._random.sample(living, min(INTERRUPTED, len(living))):
            self._takeovers.interrupt(scene.plan.spec.folder)
        for scene in living:
            scene.kill()
            self._times.hit(scene.plan.name, "service", now, scene.plan.kind)
        for name in [name for name, scene in self.scenes.items() if scene.ended]:
            del self.plans[name]
        self.scenes.clear()
        self._times.forget()
        self.placement.abandon()
        await asyncio.sleep(self._random.uniform(*DOWN_S))
        self.placement = self._place()
        self.up = True
        for plan in tuple(self.plans.values()):
            self._cluster.later((0.0, RECOVER_S), lambda plan=plan: self._recover(plan))  # type: ignore[misc]

    def end(self) -> None:
        """Ends the service permanently."""
        for scene in self.scenes.values():
            scene.kill()
        self.placement.abandon()

    def _place(self) -> SimulatedPlacement:
        return SimulatedPlacement(self._cluster, self._frames, self._times, self._needs, self._between_s)

    def _recover(self, plan: ScenePlan) -> None:
        if self.up and plan.name not in self.scenes:
            self._open(plan, "restart")

    def _open(self, plan: ScenePlan, reason: str) -> None:
        self.scenes[plan.name] = SimulatedScene(plan, self.placement, reason)
