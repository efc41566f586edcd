"""Measures `/health/live`, memory and updates, both normally and during an attack by clients without a token.

The attack is `studies.service.attack`, in a separate process. One service runs with a token and one without. The scene
is updated continuously. A turn with the attack lasts until its last connection is closed.
"""

from __future__ import annotations

import http.client
import json
import statistics
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field

import numpy as np

from studies.machine import resident_mb
from studies.options import Echo
from studies.running.outcome import ScenarioResult
from studies.running.process import Service
from studies.running.study import Study, Updates

P99_MS, MEMORY_MB, CLOSED_S, SLOWER = 50.0, 50.0, 60.0, 1.1
TOKEN = "of-the-study-and-of-nobody-else"
EVERY_S = 0.05
"""Interval in seconds between two requests to `/health/live`, each over its own connection."""
PATIENCE_S = 120.0
AT_ONCE = 4
WARM_UP = 3
"""Number of updates before the measurement. The first ones compile or load kernels and start cold."""


@dataclass(frozen=True)
class Attack:
    """Size of an attack.

    Attributes:
        header: bytes of the endless header.
        halves: number of half-sent headers.
        uploads: number of stalled uploads.
    """

    header: int = 300_000_000
    halves: int = 300
    uploads: int = 300


@dataclass
class AttackTimes:
    """Measurements of all rounds, with or without the attack.

    Attributes:
        health: response time of each request to `/health/live`, in ms.
        lost: number of these requests that did not return status 200.
        memory: largest memory of the service's process, in MB.
        updates: seconds of each update.
    """

    health: list[float] = field(default_factory=list)
    lost: int = 0
    memory: float = 0.0
    updates: list[float] = field(default_factory=list)

    def p(self, percent: float) -> float:
        """Returns a percentile of the response times of the health check, in ms."""
        return float(np.percentile(self.health, percent))


class Watch:
    """Polls `/health/live` and the service's memory in a thread while the context is active."""

    def __init__(self, service: Service, side: AttackTimes) -> None:
        self._service, self._side = service, side
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(EVERY_S):
            began = time.perf_counter()
            connection = http.client.HTTPConnection("127.0.0.1", self._service.port, timeout=PATIENCE_S)
            try:
                connection.request("GET", "/health/live")
                answer = connection.getresponse()
                answer.read()
                self._side.lost += answer.status != 200
            except (OSError, http.client.HTTPException):
                self._side.lost += 1
            finally:
                connection.close()
            self._side.health.append(1000 * (time.perf_counter() - began))
            self._side.memory = max(self._side.memory, resident_mb(self._service.pid))


def strangers(study: Study, attack: Attack, *, turns: int, seconds: float, token: bool, echo: Echo) -> ScenarioResult:
    """Measures one service with and without the attack and returns the result.

    Args:
        study: frames and settings of the scene.
        attack: size of the attack.
        turns: number of turns without and with the attack.
        seconds: shortest duration of a turn without the attack.
        token: whether the service has a token, which the attack does not know.
        echo: callback that prints progress messages.
    """
    environment = {**study.environment, **({"SCAS4D_TOKEN": TOKEN} if token else {})}
    name = "strangers-token" if token else "strangers"
    service = Study(study.folder, study.capture, study.frames, study.settings, environment).service(name)
    service.start()
    without, attacked = AttackTimes(), AttackTimes()
    closed, left = 0.0, 0
    try:
        scene = study.create(service, queue_frames=AT_ONCE + 1)
        updates = Updates(service, scene, study.frames)
        updates.run(1)
        updates.run(WARM_UP)
        for turn in range(turns):
            with Watch(service, without):
                until = time.monotonic() + seconds
                while time.monotonic() < until:
                    without.updates += updates.run(AT_ONCE)
            with Watch(service, attacked):
                upload = f"/v1/scenes/{scene}/frames/{updates.next + AT_ONCE}"  # for a frame that is never sent
                attacker = _start(service.port, upload, attack)
                while attacker.poll() is None:
                    attacked.updates += updates.run(AT_ONCE)
            ended = json.loads(attacker.communicate()[0])
            closed, left = max(closed, ended["seconds"]), left + int(ended["open"])
            echo(
                f"turn {turn + 1}: all closed after {ended['seconds']:.1f} s, {ended['open']} left; "
                f"{ended['sent'] / 1e6:.1f} MB of header sent; /health/live p99 {attacked.p(99):.1f} ms"
            )
    finally:
        service.stop()
    return compare(attack, without, attacked, closed, left, token=token)


def _start(port: int, path: str, attack: Attack) -> subprocess.Popen[bytes]:
    given = {"port": port, "path": path, "patience": PATIENCE_S, **vars(attack)}
    options = [part for name, value in given.items() for part in (f"--{name}", str(value))]
    return subprocess.Popen([sys.executable, "-m", "studies.service.attack", *options], stdout=subprocess.PIPE)


def compare(
    attack: Attack, without: AttackTimes, attacked: AttackTimes, closed: float, left: int, *, token: bool
) -> ScenarioResult:
    """Compares the measurements and returns the attack's row of the table.

    Args:
        attack: size of the attack.
        without: measurements without the attack.
        attacked: measurements with the attack.
        closed: seconds until the last connection was closed.
        left: number of connections that were not closed.
        token: whether the service has a token.
    """
    slower = statistics.median(attacked.updates) / statistics.median(without.updates)
    memory = attacked.memory - without.memory
    late = attacked.p(99) - without.p(99)
    faults = [
        said
        for missed, said in (
            (late > P99_MS, f"/health/live p99 rose by {late:.1f} ms"),
            (attacked.lost > 0, f"{attacked.lost} health checks without a response"),
            (memory > MEMORY_MB, f"memory grew by {memory:.0f} MB"),
            (left > 0 or closed > CLOSED_S, f"{left} connections left, the others closed after {closed:.0f} s"),
            (slower > SLOWER, f"updates take {slower:.2f} times as long"),
        )
        if missed
    ]
    summary = (
        f"/health/live p50 {without.p(50):.1f} → {attacked.p(50):.1f} ms, p99 {without.p(99):.1f} → "
        f"{attacked.p(99):.1f} ms, {attacked.lost} of {len(attacked.health)} without a response; memory "
        f"{without.memory:.0f} → {attacked.memory:.0f} MB; all closed after {closed:.0f} s; update "
        f"{statistics.median(without.updates):.3f} → {statistics.median(attacked.updates):.3f} s ({slower:.2f} times)"
    )
    return ScenarioResult(
        f"strangers, {'a token' if token else 'no token'}: an endless header of {attack.header / 1e6:.0f} MB, "
        f"{attack.halves} half-sent headers, {attack.uploads} stalled uploads at once",
        f"/health/live responds, p99 rises by at most {P99_MS:.0f} ms, memory by {MEMORY_MB:.0f} MB; all closed within "
        f"{CLOSED_S:.0f} s; updates take at most {SLOWER:g} times as long",
        summary,
        faults,
    )
