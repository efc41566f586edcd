"""`scripts/bench simulate`: runs a cluster through failures and checks what remains in the folders."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

from scas4d_core.settings import Settings
from server.cluster.resource_needs import ResourceNeeds, resource_needs
from server.messages import SceneSpec
from server.processes import worker
from server.settings import ServerSettings
from server.storage.layout import DataFolder
from studies.simulation.clock import run_virtual
from studies.simulation.cluster import SimulatedCluster
from studies.simulation.delays import HEAD_S, Range
from studies.simulation.failures import Failure, Failures, drawn
from studies.simulation.record import FrameCounts, FrameRecord, TimeRecord, left_over
from studies.simulation.scene import ScenePlan
from studies.simulation.service import SimulatedService
from studies.simulation.takeover import Takeovers
from studies.simulation.work import content, frame_file, listed, read_frame
from studies.synthetic.wall import Size, rig

RIGS = (
    (0.50, Size(cameras=4)),
    (0.35, Size(width=640, height=480)),
    (0.15, Size(width=1280, height=720, cameras=24)),
)
"""Each entry pairs a share of the scenes with the size of their rig."""
FULL = 0.85
"""Share of the CPUs that the scenes use."""
CPU_BYTES = 1.6e9
"""Memory of a node per CPU, in bytes. A scene's worker uses 1.3 GB on average."""
APART_S = 1440.0
"""Mean seconds between the failures of one node."""
CREATED_S = 60.0
"""Seconds within which the scenes are created."""
MORE = 0.25
"""Scenes beyond the capacity, as a share of the CPUs. With these scenes, demand exceeds supply."""
MORE_AT, LEAVE_AT = 0.5, 0.6
"""Times at which the scenes beyond the capacity are requested and as many others end, as fractions of the duration."""
PATIENCE_S = 3600.0
"""Seconds after the last failure within which all frames must be committed."""
CALM_S = 420.0
"""Seconds at the end during which stopped nodes resume, abandoned workers end, and folders are cleaned up."""


@dataclass(frozen=True)
class Sizes:
    """The size of a simulation.

    Attributes:
        scenes: number of scenes.
        nodes: number of nodes.
        failures: number of failures.
        frames: frames per scene.
        seed: seed of all random draws.
        silent: shortest and longest time for which the head does not respond, in seconds.
    """

    scenes: int = 5000
    nodes: int = 200
    failures: int = 1000
    frames: int = 40
    seed: int = 0
    silent: Range = HEAD_S

    @property
    def cpus(self) -> int:
        """Number of CPUs per node."""
        return math.ceil(self.scenes / self.nodes / FULL)

    @property
    def more(self) -> int:
        """Number of scenes beyond the capacity."""
        return min(self.scenes, math.ceil(MORE * self.nodes * self.cpus))

    @property
    def seconds(self) -> float:
        """Seconds during which frames are sent and failures happen."""
        return self.failures * APART_S / self.nodes


@dataclass(frozen=True)
class Outcome:
    """The results of a simulation.

    Attributes:
        sizes: size of the simulation.
        frames: frame counts at the end of the run.
        placed: see `TimeRecord`.
        resumed: see `TimeRecord`.
        waited: see `TimeRecord`.
        unexplained: see `TimeRecord`.
        unplaced: number of workers without a place at the end.
        happened: number of failures, keyed by kind.
        workers: number of workers started.
        adrift: number of files written by workers that were given up.
        folders: number of folders of earlier epochs that are left in scenes that no user has ended.
        seconds: duration in virtual time.
    """

    sizes: Sizes
    frames: FrameCounts
    placed: dict[str, list[tuple[float, float]]]
    resumed: dict[str, list[tuple[float, float]]]
    waited: list[float]
    unexplained: int
    unplaced: int
    happened: dict[Failure, int]
    workers: int
    adrift: int
    folders: int
    seconds: float


def simulate(sizes: Sizes) -> Outcome:
    """Runs the simulation, which is deterministic for given sizes and seed, and returns its results.

    Raises:
        RuntimeError: the code of the service or of the simulation raised an exception.
    """
    level, memory = logging.getLogger("scas4d.server").level, Path("/dev/shm")
    logging.getLogger("scas4d.server").setLevel(logging.ERROR)
    try:
        with TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
            return run_virtual(_run(sizes, DataFolder(Path(folder))))
    finally:
        logging.getLogger("scas4d.server").setLevel(level)


async def _run(sizes: Sizes, data: DataFolder) -> Outcome:
    loop, random = asyncio.get_running_loop(), Random(sizes.seed)
    faults: list[dict[str, Any]] = []
    loop.set_exception_handler(lambda _, context: faults.append(context))
    rigs = [rig(size) for _, size in RIGS]
    specs = [SceneSpec(data.scene("any"), one, Settings()) for one in rigs]
    kinds = [_needs(spec) for spec in specs]
    by_rig = {id(one): needs for one, needs in zip(rigs, kinds, strict=True)}
    cluster = SimulatedCluster(sizes.nodes, sizes.cpus, round(sizes.cpus * CPU_BYTES), kinds, random)
    frames, times = FrameRecord(), TimeRecord(cluster.capacity, loop.time)
    takeovers = Takeovers(frames, random)
    between = sizes.seconds / sizes.frames
    service = SimulatedService(cluster, frames, times, takeovers, lambda spec: by_rig[id(spec.rig)], between)
    plans = _plans(sizes, data, specs, random)
    for plan, created in plans:
        loop.call_at(created, service.create, plan)
    failures = Failures(cluster, service, sizes.silent)
    failures.plan(drawn(sizes.failures, CREATED_S, sizes.seconds, random))
    with takeovers.watched():
        await asyncio.sleep(sizes.seconds)
        while not (service.done and failures.happened.total() == sizes.failures):
            await asyncio.sleep(10)
            if faults or loop.time() > sizes.seconds + PATIENCE_S:
                break
        await asyncio.sleep(CALM_S)
        service.end()
    if faults:
        raise RuntimeError(f"the simulation failed: {faults[0]['message']}") from faults[0].get("exception")
    kept = [plan.spec.folder for plan, _ in plans if plan.ends is None]
    return Outcome(
        sizes=sizes,
        frames=frames.total([_checked(frames, plan) for plan, _ in plans]),
        placed=times.placed,
        resumed=times.resumed,
        waited=times.waited,
        unexplained=times.unexplained,
        unplaced=times.waiting,
        happened=dict(failures.happened),
        workers=frames.workers,
        adrift=frames.adrift,
        folders=sum(left_over(folder.path) for folder in kept),
        seconds=loop.time(),
    )


def _needs(spec: SceneSpec) -> ResourceNeeds:
    needs = resource_needs(worker.main, spec, ServerSettings())
    assert needs is not None
    return needs


def _plans(sizes: Sizes, data: DataFolder, specs: Sequence[SceneSpec], random: Random) -> list[tuple[ScenePlan, float]]:
    """Returns all scenes and their creation times. The first ones end in time for those beyond the capacity."""
    end, plans = sizes.seconds, []
    shares = [share for share, _ in RIGS]
    for number in range(sizes.scenes + sizes.more):
        begin, last, count, ends = random.uniform(0, CREATED_S), end, sizes.frames, None
        if number < sizes.more:
            last, ends = MORE_AT * end, LEAVE_AT * end
        elif number >= sizes.scenes:
            begin, count = begin + MORE_AT * end, max(1, sizes.frames // 2)
        step = (last - begin) / count
        moments = [begin + step * (index + random.random()) for index in range(count)]
        (kind,) = random.choices(range(len(specs)), shares)
        spec = replace(specs[kind], folder=data.scene(f"scene-{number:05}"))
        plans.append((ScenePlan(spec, kind, moments, ends), begin))
    return plans


def _checked(frames: FrameRecord, plan: ScenePlan) -> FrameCounts:
    """Checks the states of a scene, read through the link as by a client, and returns their counts."""
    states, name = plan.spec.folder.states, plan.name
    counts_by_frame = {index: read_frame(frame_file(states, index)) for index in listed(states)}
    chain, state = [], name
    for index in range(len(plan.frames)):
        state = content(state, index)
        chain.append(state)
    frames.acknowledged.setdefault(name, 0)
    return frames.check(name, counts_by_frame, chain)
