"""Kills: no acknowledged frame may be lost, and no bit may differ.

Each scenario runs the whole service in a separate process. The undisturbed run comes first. The states of the other
runs must be bit-identical to those of the undisturbed run.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from client.cli.evaluate import Report
from client.wire import FrameState
from scas4d_core.storage.frame_files import checkpoint_file, frame_file
from server.storage.frame_store import has_record
from server.storage.layout import DataFolder
from studies.running.outcome import ScenarioResult
from studies.running.process import PATIENCE_S, Service, StudyError
from studies.running.study import AGAIN_S, FrameSender, Study, compare, digests, running

KILLS_OF_A_WORKER_AT_A_FRAME = 4
"""Maximum number of worker kills per frame. At the sixth kill, the service would rightly fail the frame."""

STAGES = ("received", "acknowledged", "solved", "written", "committed")
"""Stages after which a kill can be aimed, in order.

received: the frame's file exists. acknowledged: the sender has the receipt, and the frame may be decoded during the
update before it. solved: the checkpoint is on disk, and the state is about to be written. written: the state is on
disk, and the commit is about to be reported. committed: the commit was reported, and the next frame is being updated.
"""
VICTIMS = ("worker", "service")
RANDOM = "at random"
POLL_S = 0.0005
"""Seconds between checks whether a frame has reached a stage, less than a write takes."""


@dataclass(frozen=True)
class Kill:
    """A kill of the worker or the service.

    Attributes:
        victim: "worker" or "service".
        stage: stage of `STAGES` after which the kill happens, or None for a random moment.
    """

    victim: str
    stage: str | None = None


def planned_kills(frames: int, count: int, random_: random.Random) -> dict[int, list[Kill]]:
    """Returns the kills at each frame: half of them after a stage of the pipeline, the others at random moments."""
    between = count // 2
    kinds = [(stage, victim) for stage in STAGES for victim in VICTIMS]
    staged = [Kill(victim, stage) for stage, victim in (kinds * (between // len(kinds) + 1))[:between]]
    planned: dict[int, list[Kill]] = {}
    for kill in [*staged, *(Kill(random_.choice(VICTIMS)) for _ in range(count - between))]:
        planned.setdefault(random_.randrange(kill.stage is not None, frames), []).append(kill)
    return planned


def _in_order(kills: Sequence[Kill]) -> list[Kill]:
    """Returns the kills at a frame in the order of their stages, then those at random moments."""
    return sorted(kills, key=lambda kill: [*STAGES, None].index(kill.stage))


def kills(
    study: Study, expected: Mapping[int, str], update_s: float, count: int, seed: int, echo: Report
) -> ScenarioResult:
    """Kills the worker or the whole service with `kill -9` `count` times: between pipeline stages and at random."""
    random_ = random.Random(seed)
    planned = planned_kills(len(study.frames), count, random_)
    killed: Counter[int] = Counter()
    done: Counter[str] = Counter()
    with running(study, "kills") as (service, scene, sender):
        for index in range(len(study.frames)):
            thread = threading.Thread(target=sender.send, args=(index,))
            thread.start()
            for kill in _in_order(planned.get(index, ())):
                hit = None
                if kill.stage is None:
                    time.sleep(random_.uniform(0, 1.5 * update_s))
                elif _wait_for_stage(service, scene, sender, index, kill.stage):
                    hit = kill.stage
                elif index + 1 < len(study.frames):  # too late for this frame
                    planned.setdefault(index + 1, []).append(kill)
                    continue
                if kill.victim == "service" or (hit and killed[index] >= KILLS_OF_A_WORKER_AT_A_FRAME):
                    done["service"] += 1
                    service.kill()
                    service.start()
                else:
                    done["worker"] += 1
                    _kill_worker(service, scene, killed, at_once=hit is not None)
                done[hit or RANDOM] += 1
                echo(f"killed the {kill.victim} at frame {index}, {hit or RANDOM}")
            thread.join()
        service.finish(scene, len(study.frames))
        service.kill()
        service.start()  # after a second restart, everything must be restored
        service.finish(scene, len(study.frames))
        faults = sender.check() + compare(digests(DataFolder(service.data).scene(scene).states), expected)
        lost = len(study.frames) - len(sender.receipts)
        between = ", ".join(f"{done[stage]} {stage}" for stage in STAGES)
        summary = (
            f"{done['worker']} kills of the worker, {done['service']} of the service; between stages: {between}; "
            f"{lost} acknowledged frames lost, {len(expected)} states compared"
        )
        target = "0 acknowledged frames lost, final state bit-identical"
        return ScenarioResult(
            f"kill -9 at {count} moments over {len(study.frames)} frames, {count - done[RANDOM]} between stages",
            target,
            summary,
            faults,
        )


def _wait_for_stage(service: Service, scene: str, sender: FrameSender, index: int, stage: str) -> bool:
    """Waits until a frame has reached a stage, and returns whether it had not reached the next stage before.

    Raises:
        StudyError: the frame did not reach the stage within the time limit.
    """
    folder = DataFolder(service.data).scene(scene)
    reached: Sequence[Callable[[], bool]] = (
        lambda: has_record(folder.frames, index),
        lambda: index in sender.receipts,
        lambda: any((folder.states / name).exists() for name in (checkpoint_file(index), frame_file(index))),
        lambda: (folder.states / frame_file(index)).exists(),
        lambda: service.http.get(f"/v1/scenes/{scene}/frames/{index}").json().get("state") == FrameState.COMMITTED,
    )
    at = STAGES.index(stage)
    too_late = any(test() for test in reached[at + 1 :]) if at + 1 < len(STAGES) else reached[at]()
    until = time.monotonic() + PATIENCE_S
    while not reached[at]():
        if time.monotonic() > until:
            raise StudyError(f"frame {index} was never {stage}")
        time.sleep(POLL_S)
    return not too_late


def _kill_worker(service: Service, scene: str, killed: Counter[int], *, at_once: bool = False) -> None:
    """Kills the scene's worker once it processes a frame that has not reached the maximum number of kills.

    With ``at_once``, the worker is killed without asking which frame it processes, which may take too long.

    Raises:
        StudyError: there is no such worker within the time limit.
    """
    if at_once and (pid := service.worker_pid(scene)) is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        status = service.status(scene)
        killed[status.next_frame - status.queued] += 1
        return
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        status = service.status(scene)
        at_work = status.next_frame - status.queued
        pid = service.worker_pid(scene)
        if pid is not None and killed[at_work] < KILLS_OF_A_WORKER_AT_A_FRAME:
            killed[at_work] += 1
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            return
        time.sleep(AGAIN_S)
    raise StudyError("there was no worker to kill")
