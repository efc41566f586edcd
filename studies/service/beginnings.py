"""Restarts a scene's reconstruction repeatedly while the service is killed. The states must be bit-identical."""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import httpx

from server.storage.events import ReconstructionBegun
from server.storage.journal import read_journal
from server.storage.layout import DataFolder
from studies.options import Echo
from studies.running.outcome import ScenarioResult
from studies.running.process import PATIENCE_S, Service, StudyError
from studies.running.study import AGAIN_S, Study, compare, digests, running

SPREADS_S = (0.1, 1.0)
"""Longest delays, in seconds, from a restart request to the kill.

The kill thus happens before or after the restart is recorded, or during the first frame.
"""


def beginnings(study: Study, expected: Mapping[int, str], count: int, seed: int, echo: Echo) -> ScenarioResult:
    """Kills the whole service with `kill -9` at a random moment during each of `count` restarts.

    Half of the frames arrive before the first restart, and one more with each restart.
    """
    random_ = random.Random(seed)
    sent = len(study.frames) // 2
    ended: Counter[str] = Counter()
    with running(study, "beginnings") as (service, scene, sender):
        for index in range(sent):
            sender.send(index)
        service.finish(scene, sent)
        for number in range(1, count + 1):
            asking = threading.Thread(target=_begin, args=(service, scene, number))
            sending = threading.Thread(target=sender.send, args=(sent,))
            asking.start()
            if sent < len(study.frames):
                sending.start()
                sent += 1
            time.sleep(random_.uniform(0, random_.choice(SPREADS_S)))
            service.kill()
            events = read_journal(DataFolder(service.data).scene(scene).journal).events
            known = max((event.number for event in events if isinstance(event, ReconstructionBegun)), default=0)
            ended["after" if known == number else "before"] += 1
            service.start()
            asking.join()
            if sending.ident is not None:
                sending.join()
            status = service.status(scene)
            echo(f"killed during restart {number} of {count}; the scene's reconstruction is {status.reconstruction}")
            if status.reconstruction != number:
                raise StudyError(
                    f"reconstruction {number} was acknowledged, but the scene's is {status.reconstruction}"
                )
        for index in range(sent, len(study.frames)):
            sender.send(index)
        service.finish(scene, len(study.frames))
        folder = replace(DataFolder(service.data).scene(scene), reconstruction=count)
        faults = sender.check() + compare(digests(folder.states), expected)
        faults += [f"{path.name} was not deleted" for path in folder.path.glob("states*") if path != folder.states]
        faults += [f"damage was reported: {said}" for said in service.status(scene).damage]
        summary = (
            f"{ended['before']} restarts had no effect, {ended['after']} took effect; {len(expected)} states compared"
        )
        target = "each restart takes effect fully or not at all; final state bit-identical to a run without restarts"
        return ScenarioResult(f"kill -9 during {count} restarts of the reconstruction", target, summary, faults)


def _begin(service: Service, scene: str, number: int) -> None:
    """Repeats a request until it is acknowledged, like a client that gets no response."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        try:
            address = f"/v1/scenes/{scene}/reconstructions/{number}"
            if service.http.put(address, json={"discard": True}).status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(AGAIN_S)
