"""Node failures in a cluster: no acknowledged frame may be lost, and the states must be bit-identical."""

from __future__ import annotations

import os
import random
import shutil
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from client.wire import Cluster
from server.storage.fencing import current_epoch, epochs
from server.storage.layout import DataFolder, epoch_folder
from studies.cluster.nodes import Nodes
from studies.options import Echo
from studies.running.outcome import ScenarioResult
from studies.running.process import PATIENCE_S, Service, StudyError, wait_until
from studies.running.study import AGAIN_S, FrameSender, Study, compare, digests, running, undisturbed

GOES_ON_S = 30.0
"""Seconds within which a scene must resume after its node is lost."""
HEAD_GONE_S = 10.0
"""Seconds for which the head stays down."""
WAITS_S = 5.0
"""Seconds after which an unplaced worker counts as waiting for resources. Workers with resources start earlier."""
SWEPT_S = 180.0
"""Seconds within which the folders of earlier workers must be removed."""


def killed_nodes(
    study: Study, nodes: Nodes, expected: Mapping[int, str], update_s: float, count: int, seed: int, echo: Echo
) -> ScenarioResult:
    """Kills the node of the scene's worker with `kill -9` at `count` random moments. A new node joins each time."""
    random_ = random.Random(seed)
    moments = [random_.randrange(1, len(study.frames)) for _ in range(count)]
    pauses: list[float] = []
    with running(study, "nodes") as (service, scene, sender):
        for index in range(len(study.frames)):
            thread = threading.Thread(target=sender.send, args=(index,))
            thread.start()
            for _ in range(moments.count(index)):
                time.sleep(random_.uniform(0, 1.5 * update_s))
                node, before = _node_of(service, nodes, scene)
                nodes.kill(node)
                began = time.monotonic()
                nodes.add()
                wait_until(partial(_works, service, scene, before), "the scene did not resume")
                pauses.append(time.monotonic() - began)
                echo(f"killed the node at frame {index}: {len(pauses)} of {count}, resumed after {pauses[-1]:.1f} s")
            thread.join()
        service.finish(scene, len(study.frames))
        faults = _faults_of_kills(service, scene, sender, expected, pauses)
        lost = len(study.frames) - len(sender.receipts)
        longest = max(pauses, default=0.0)
        summary = f"{lost} acknowledged frames lost, {len(expected)} states compared, resumed within {longest:.1f} s"
        target = (
            f"0 acknowledged frames lost, final state bit-identical, no frame blamed, resumed within {GOES_ON_S:g} s"
        )
        return ScenarioResult(f"a node killed at {count} random moments", target, summary, faults)


def stopped_node(
    study: Study, nodes: Nodes, expected: Mapping[int, str], update_s: float, echo: Echo
) -> ScenarioResult:
    """Stops a node with SIGSTOP during an update and resumes it after its scene has moved to another node."""
    with running(study, "stopped") as (service, scene, sender):
        states = DataFolder(service.data).scene(scene).states
        _send(sender, _second_half(study, service, scene, sender))
        time.sleep(0.5 * update_s)
        node, _ = _node_of(service, nodes, scene)
        stale = current_epoch(states)
        assert stale is not None
        nodes.stop(node)
        began, committed = time.monotonic(), service.status(scene).committed
        wait_until(lambda: service.status(scene).committed > committed, "the scene did not resume")
        pause = time.monotonic() - began
        echo(f"the scene resumed after {pause:.1f} s; resuming the old node")
        folder = epoch_folder(states, stale)
        before = _changed(folder)
        nodes.resume(node)
        written: set[str] = set()
        until = time.monotonic() + 5 * update_s + 5
        while time.monotonic() < until:
            written |= {name for name, changed in _changed(folder).items() if before.get(name) != changed}
            time.sleep(AGAIN_S / 5)
        service.finish(scene, len(study.frames))
        faults = sender.check() + compare(digests(states), expected)
        if not written:
            faults.append("the old worker wrote nothing, so nothing was tested; run the scenario again")
        until = time.monotonic() + SWEPT_S
        while len(epochs(states)) > 1 and time.monotonic() < until:
            time.sleep(AGAIN_S)
        if still := sorted(epochs(states))[:-1]:
            faults.append(f"the folders of epochs {still} still exist")
        summary = (
            f"resumed after {pause:.1f} s; the old worker wrote {len(written)} files, all removed without being read"
        )
        target = "the old worker's files are removed without being read; final state bit-identical"
        return ScenarioResult("a node stopped, then resumed after its scene has moved", target, summary, faults)


def full_nodes(study: Study, nodes: Nodes, expected: Mapping[int, str], update_s: float, echo: Echo) -> ScenarioResult:
    """Kills the scene's node while other scenes fill the remaining nodes, then deletes those scenes."""
    with running(study, "full") as (service, scene, sender):
        left = _second_half(study, service, scene, sender)
        others = _fill(study, service)
        node, _ = _node_of(service, nodes, scene)
        committed = service.status(scene).committed
        nodes.kill(node)
        wait_until(lambda: _waits(service, scene), "the scene does not report that it is waiting")
        said = str(service.status(scene).error)
        _send(sender, left)
        time.sleep(5 * update_s)
        faults = []
        if service.status(scene).committed > committed:
            faults.append("the scene continued although no node was free, so nothing was tested")
        echo(f"{len(others)} scenes fill the nodes; reported reason: {said}")
        began = time.monotonic()
        for other in others:
            service.http.delete(f"/v1/scenes/{other}").raise_for_status()
        wait_until(lambda: service.status(scene).committed > committed, "the scene did not resume once a node was free")
        pause = time.monotonic() - began
        nodes.add()
        status = service.finish(scene, len(study.frames))
        faults += _faults_of_kills(service, scene, sender, expected, [pause])
        if status.degraded:
            faults.append(f"the scene is still degraded: {status.error}")
        summary = (
            f"{len(left)} frames acknowledged while the scene waited and reported why; next commit {pause:.1f} s after "
            "a node was free"
        )
        target = (
            "frames are acknowledged, the scene reports why it waits and resumes once a node is free; bit-identical"
        )
        return ScenarioResult("a node killed while other scenes fill the rest", target, summary, faults)


def restarted_head(
    study: Study, nodes: Nodes, expected: Mapping[int, str], update_s: float, echo: Echo
) -> ScenarioResult:
    """Kills the cluster's head with `kill -9` during an update, and later restarts it from the state kept in Redis."""
    with running(study, "head") as (service, scene, sender):
        left = _second_half(study, service, scene, sender)
        sending = threading.Thread(target=_send, args=(sender, left))
        sending.start()
        time.sleep(0.5 * update_s)
        before = service.status(scene).committed
        nodes.stop_head()
        time.sleep(HEAD_GONE_S)
        without = service.status(scene).committed - before
        echo(f"{without} frames committed in {HEAD_GONE_S:g} s without a head")
        nodes.start_head()
        sending.join()
        service.finish(scene, len(study.frames))
        deaths = service.status(scene).worker_deaths
        node, _ = _node_of(service, nodes, scene)
        nodes.kill(node)  # tests whether the restarted head places and monitors workers
        nodes.add()
        wait_until(lambda: service.status(scene).worker_deaths > deaths, "a lost node was not noticed")
        wait_until(lambda: service.worker_pid(scene) is not None, "the scene was not placed again")
        faults = sender.check() + compare(digests(DataFolder(service.data).scene(scene).states), expected)
        summary = (
            f"{without} frames committed meanwhile, {deaths} workers lost; then a node was killed and its scene "
            f"placed on another one; {len(expected)} states compared"
        )
        target = "0 acknowledged frames lost, final state bit-identical, scenes are placed again afterwards"
        return ScenarioResult(f"the head killed, restarted after {HEAD_GONE_S:g} s (Redis)", target, summary, faults)


def _second_half(study: Study, service: Service, scene: str, sender: FrameSender) -> range:
    """Sends the first half of the frames, waits for their commits, and returns the indices of the other frames."""
    half = len(study.frames) // 2
    _send(sender, range(half))
    service.finish(scene, half)
    return range(half, len(study.frames))


def _node_of(service: Service, nodes: Nodes, scene: str) -> tuple[int, int]:
    """Waits until the scene has a worker, and returns its node and process id.

    Raises:
        StudyError: no worker is running on any node within the time limit.
    """
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        pid = service.worker_pid(scene)
        if pid is not None and (node := nodes.of(pid)) is not None:
            return node, pid
        time.sleep(AGAIN_S)
    raise StudyError("the scene's worker is not running on any node")


def _changed(folder: Path) -> dict[str, int]:
    """Returns the modification time of each file in a folder, keyed by name. Files that disappear are skipped."""
    changes = {}
    for name in os.listdir(folder) if folder.is_dir() else ():
        with suppress(FileNotFoundError):
            changes[name] = (folder / name).stat().st_mtime_ns
    return changes


def _fill(study: Study, service: Service) -> list[str]:
    """Creates scenes until no node has room for another worker, and returns their ids."""
    scenes: list[str] = []
    while not scenes or not _waits(service, scenes[-1]):
        scenes.append(study.create(service))
        wait_until(partial(_is_placed_or_waits, service, scenes[-1]), "a scene is neither placed nor waiting")
    return scenes


def _is_placed_or_waits(service: Service, scene: str) -> bool:
    return service.worker_pid(scene) is not None or _waits(service, scene)


def _waits(service: Service, scene: str) -> bool:
    """Returns whether the scene's worker is waiting because no node has room."""
    waiting = Cluster.model_validate_json(service.http.get("/v1/cluster").content).waiting
    return any(one.scene == scene and one.role == "worker" and one.seconds > WAITS_S for one in waiting)


def _faults_of_kills(
    service: Service, scene: str, sender: FrameSender, expected: Mapping[int, str], pauses: Sequence[float]
) -> list[str]:
    """Returns the faults after node kills: lost frames, differing states, wrongly blamed frames, long pauses."""
    faults = sender.check() + compare(digests(DataFolder(service.data).scene(scene).states), expected)
    if blamed := service.deaths(scene):
        faults.append(f"a frame was blamed for the loss of {blamed} nodes")
    return faults + [f"the scene resumed only after {pause:.0f} s" for pause in pauses if pause > GOES_ON_S]


def _send(sender: FrameSender, indices: range) -> None:
    for index in indices:
        sender.send(index)


def _works(service: Service, scene: str, before: int | None) -> bool:
    """Returns whether a new worker is processing a frame, or no frames are queued."""
    if service.worker_pid(scene) in (None, before):
        return False
    status = service.status(scene)
    return status.state == "updating" or status.queued == 0


PARTS = ("nodes", "stopped", "full", "head")
"""Names of the scenarios. In "head", a cluster of its own is used, whose head stores its state in Redis."""


def run(study: Study, *, count: int, seed: int, parts: Sequence[str], echo: Echo) -> list[ScenarioResult]:
    """Runs the scenarios named in `parts` on a cluster and compares the states with a single-machine run.

    Args:
        study: study that defines the frames and the service.
        count: number of kills.
        seed: random seed for the moments of the kills.
        parts: names of the scenarios to run.
        echo: callback that prints progress messages.

    Raises:
        StudyError: the scenario "head" is requested, but redis-server is not installed.
    """
    outcomes, redis_server = [], shutil.which("redis-server")
    if "head" in parts and redis_server is None:
        raise StudyError("part head requires redis-server; install it with: apt-get install redis-server")
    expected, update_s = undisturbed(study)
    echo(f"undisturbed run on one machine: {len(expected)} states, {update_s:.2f} s per update")
    if "head" in parts:
        with Nodes(redis_server=redis_server) as nodes:
            outcomes.append(restarted_head(_on(study, nodes), nodes, expected, update_s, echo))
    if set(parts) == {"head"}:
        return outcomes
    with Nodes() as nodes:
        there = _on(study, nodes)
        if "nodes" in parts:
            outcomes.append(killed_nodes(there, nodes, expected, update_s, count, seed, echo))
        if "stopped" in parts:
            outcomes.append(stopped_node(there, nodes, expected, update_s, echo))
        if "full" in parts:
            outcomes.append(full_nodes(there, nodes, expected, update_s, echo))
    return outcomes


def _on(study: Study, nodes: Nodes) -> Study:
    return replace(study, environment={**study.environment, "SCAS4D_PLACEMENT": f"ray={nodes.address}"})
