"""Node failures in a cluster: no acknowledged frame may be lost, and the states must be bit-identical."""

from __future__ import annotations

import random
import shutil
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

from client.cli.evaluate import Report
from server.storage.layout import DataFolder
from studies.cluster.nodes import Nodes
from studies.running.outcome import ScenarioResult
from studies.running.process import PATIENCE_S, Service, StudyError, wait_until
from studies.running.study import AGAIN_S, FrameSender, Study, compare, digests, running, undisturbed

GOES_ON_S = 30.0
"""Seconds within which a scene must resume after its node is lost."""
HEAD_GONE_S = 10.0
"""Seconds for which the head stays down."""


def killed_nodes(
    study: Study, nodes: Nodes, expected: Mapping[int, str], update_s: float, count: int, seed: int, echo: Report
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


def restarted_head(
    study: Study, nodes: Nodes, expected: Mapping[int, str], update_s: float, echo: Report
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


PARTS = ("nodes", "head")
"""Names of the scenarios. In "head", a cluster of its own is used, whose head stores its state in Redis."""


def run(study: Study, *, count: int, seed: int, parts: Sequence[str], echo: Report) -> list[ScenarioResult]:
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
    if "nodes" in parts:
        with Nodes() as nodes:
            outcomes.append(killed_nodes(_on(study, nodes), nodes, expected, update_s, count, seed, echo))
    return outcomes


def _on(study: Study, nodes: Nodes) -> Study:
    return replace(study, environment={**study.environment, "SCAS4D_PLACEMENT": f"ray={nodes.address}"})
