"""Kills, truncated and damaged logs, and a full disk: no acknowledged frame may be lost, and no bit may differ.

Each scenario runs the whole service in a separate process. The undisturbed run comes first. The states of the other
runs must be bit-identical to those of the undisturbed run.
"""

from __future__ import annotations

import contextlib
import os
import random
import resource
import shutil
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from client.wire import FrameState
from scas4d_core.storage.frame_files import checkpoint_file, frame_file
from server.storage.events import FrameAccepted
from server.storage.frame_store import has_record
from server.storage.journal import read_journal
from server.storage.layout import DataFolder, SceneFolder
from studies.options import Echo
from studies.running.outcome import ScenarioResult
from studies.running.process import PATIENCE_S, Service, StudyError
from studies.running.study import AGAIN_S, FrameSender, Study, compare, digests, running, undisturbed
from studies.service.beginnings import beginnings

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

CUTS, FLIPS = 20, 1
"""Numbers of truncated log files, and of log files with a flipped bit."""
PARTS = ("kills", "beginnings", "log", "disk")
"""Names of the scenarios."""


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
    study: Study, expected: Mapping[int, str], update_s: float, count: int, seed: int, echo: Echo
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


def damaged_log(
    study: Study, expected: Mapping[int, str], cuts: int, flips: int, seed: int, echo: Echo
) -> ScenarioResult:
    """Truncates log files or flips a bit while the service is down. It must then start, report the damage and continue.

    Half of the frames are committed and the other half are waiting, as they would be after a kill.
    """
    random_ = random.Random(seed)
    service = study.service("log")
    service.start()
    half = len(study.frames) // 2
    scene = study.create(service)
    sender = FrameSender(study, service, scene)
    for index in range(half):
        sender.send(index)
    service.finish(scene, half)
    service.http.post(f"/v1/scenes/{scene}/pause")
    for index in range(half, len(study.frames)):
        sender.send(index)
    service.kill()
    service.stop()
    faults = list(sender.faults)
    dropped = 0
    for number in range(cuts + flips):
        kind = "cut" if number < cuts else "flip"
        victim = study.service("damaged")
        shutil.rmtree(victim.data)
        shutil.copytree(service.data, victim.data)
        folder = DataFolder(victim.data).scene(scene)
        said, hit = _damage(folder, kind, random_, half)
        victim.start()
        try:
            victim.http.post(f"/v1/scenes/{scene}/resume")
            status = victim.finish(scene, len(study.frames) if hit is None else 0)
            echo(f"{said}: {'; '.join(status.damage) or 'nothing reported'}")
            wrong = _check_damaged(victim, scene, sender, hit)
            wrong += compare(digests(folder.states), expected, range(hit, len(study.frames)) if hit else ())
            if hit is not None:
                report = victim.frame(scene, hit)
                dropped += 1
                if report.state != FrameState.FAILED or not report.error:
                    wrong.append(f"frame {hit} is {report.state}, although its record is damaged")
            elif not status.damage:
                wrong.append("the damage was not reported")
            faults += [f"{said}: {fault}" for fault in wrong]
        except StudyError as error:
            faults.append(f"{said}: {error}")
        finally:
            victim.stop()
    summary = f"started {cuts + flips} times; {dropped} frames failed with a reason, all others committed"
    target = "the service starts, loses nothing acknowledged before the damage, and reports what it dropped"
    return ScenarioResult(
        f"{cuts} truncations and {flips} flipped bytes in journal and frame log", target, summary, faults
    )


def _damage(folder: SceneFolder, kind: str, random_: random.Random, half: int) -> tuple[str, int | None]:
    """Damages the journal or the record of a waiting frame.

    Returns:
        A description of the damage, and the index of the affected frame; None for the journal.
    """
    journal = folder.journal
    taken = {event.index: event for event in read_journal(journal).events if isinstance(event, FrameAccepted)}
    waiting = [index for index in taken if index >= half]
    hit = random_.choice([None, random_.choice(waiting)])
    file = journal if hit is None else folder.frames / taken[hit].files[0]
    at = random_.randrange(1, file.stat().st_size)
    with file.open("r+b") as opened:
        if kind == "cut":
            opened.truncate(at)
        else:
            opened.seek(at)
            byte = opened.read(1)[0]
            opened.seek(at)
            opened.write(bytes([byte ^ (1 << random_.randrange(8))]))
    return f"{kind} of {file.name} at byte {at}", hit


def _check_damaged(service: Service, scene: str, sender: FrameSender, hit: int | None) -> list[str]:
    faults = []
    for index, receipt in sender.receipts.items():
        report = service.frame(scene, index)
        if index != hit and report.state != FrameState.COMMITTED:
            faults.append(f"frame {index} is {report.state}: {report.error}")
        if report.identity != receipt["identity"]:
            faults.append(f"frame {index} has a different identity")
    return faults


def full_disk(study: Study, expected: Mapping[int, str], echo: Echo) -> ScenarioResult:
    """Prevents files from growing, first for the service and then for the worker, and lifts the limit each time.

    The file size limit is set on the running processes (RLIMIT_FSIZE). Every write then fails where it would fail on a
    full disk.
    """
    faults: list[str] = []
    with running(study, "full") as (service, scene, sender):
        half = len(study.frames) // 2
        for index in range(half):
            sender.send(index)
        service.finish(scene, half)
        with _no_room(service.pid):
            answers = [service.put(scene, half, *study.frames[half]) for _ in range(3)]
            echo(f"while the disk is full: {[answer.status_code for answer in answers]}")
            faults += [
                f"expected status 507, got {answer.status_code}" for answer in answers if answer.status_code != 507
            ]
            if service.status(scene).next_frame != half:
                faults.append("a frame was accepted but not acknowledged")
        worker = service.worker_pid(scene)
        assert worker is not None
        before = service.status(scene).error  # possibly still the error that the service had no room
        with _no_room(worker):
            sender.send(half)
            until = time.monotonic() + PATIENCE_S
            while service.status(scene).error in (None, before) and time.monotonic() < until:
                time.sleep(AGAIN_S)
            echo(f"while the worker has no disk space: {service.status(scene).error}")
            if service.frame(scene, half).state != FrameState.UPDATING:
                faults.append("the worker did not wait for disk space")
        for index in range(half + 1, len(study.frames)):
            sender.send(index)
        service.finish(scene, len(study.frames))
        faults += sender.check() + compare(digests(DataFolder(service.data).scene(scene).states), expected)
    target = "status 507 while the disk is full; no acknowledged frame lost, all committed once there is space"
    return ScenarioResult(
        "disk full during ingest", target, "507 while full; all committed once there was space", faults
    )


@contextlib.contextmanager
def _no_room(pid: int) -> Any:
    soft, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (soft, hard))


def run(study: Study, *, moments: int, seed: int, parts: Sequence[str], echo: Echo) -> list[ScenarioResult]:
    """Runs the scenarios named in `parts` and returns their results.

    Args:
        study: study that defines the frames and the service.
        moments: number of kills, and of reconstruction restarts.
        seed: random seed for the moments and places of the faults.
        parts: names of the scenarios to run.
        echo: callback that prints progress messages.
    """
    expected, update_s = undisturbed(study)
    echo(f"undisturbed run: {len(expected)} states, {update_s:.2f} s per update")
    scenarios: dict[str, Callable[[], ScenarioResult]] = {
        "kills": lambda: kills(study, expected, update_s, moments, seed, echo),
        "beginnings": lambda: beginnings(study, expected, moments, seed, echo),
        "log": lambda: damaged_log(study, expected, CUTS, FLIPS, seed, echo),
        "disk": lambda: full_disk(study, expected, echo),
    }
    return [scenarios[part]() for part in PARTS if part in parts]
