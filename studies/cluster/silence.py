"""``scripts/bench head``: downtime of a cluster head that a supervisor restarts whenever it exits.

The head, which uses Redis, and a node run on this machine. Each has its own process namespace and address, as if on two
machines, because `ray start --head` refuses to start next to processes of another node.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from signal import SIGKILL
from types import TracebackType
from typing import Any, Self

from studies.cluster.nodes import HEALTH, REDIS, STORE_BYTES, redis
from studies.running.process import StudyError, wait_until

HEAD, NODE, PORT = "127.0.0.1", "127.0.0.2", 6397
APART = ("unshare", "--pid", "--fork", "--mount-proc", "--kill-child")
BETWEEN_S = (8.0, 14.0)
"""Shortest and longest pause between two kills, in seconds."""
PATIENCE_S = 60.0
NOT_STARTED = "the cluster did not start"


class SupervisedCluster:
    """A cluster with one node, and a head that is restarted whenever it exits.

    Raises:
        StudyError: the process does not have root privileges, or redis-server is not installed.
    """

    def __init__(self) -> None:
        if os.geteuid() != 0:
            raise StudyError("this study requires root privileges to run the head in its own process namespace")
        if (program := shutil.which("redis-server")) is None:
            raise StudyError("this study requires redis-server; install it with: apt-get install redis-server")
        os.environ.update({f"RAY_health_check_{name}": str(value) for name, value in HEALTH.items()})
        self._redis = redis(program)
        self._address_of_redis = os.environ.pop(REDIS)
        self._over = False
        self._starting = threading.Lock()
        self._running: list[subprocess.Popen[bytes]] = []
        self._supervisor = threading.Thread(target=self._supervise, daemon=True)

    def __enter__(self) -> Self:
        self._supervisor.start()
        try:
            wait_until(lambda: _listens(PORT), NOT_STARTED, PATIENCE_S)
            self._start("--address", f"{HEAD}:{PORT}", "--node-ip-address", NODE, "--num-cpus", "1")
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._starting:
            self._over = True
            for process in self._running:
                process.kill()
                process.wait()
        self._supervisor.join()
        self._redis.kill()
        self._redis.wait()

    def _supervise(self) -> None:
        while (
            head := self._start("--head", "--node-ip-address", HEAD, "--port", str(PORT), "--num-cpus", "0")
        ) is not None:
            head.wait()

    def _start(self, *options: str) -> subprocess.Popen[bytes] | None:
        """Starts a Ray node and returns its process, or None if the study has ended."""
        store = ("--object-store-memory", str(STORE_BYTES), "--block", "--disable-usage-stats")
        with self._starting:
            if self._over:
                return None
            started = subprocess.Popen(
                [*APART, str(Path(sys.executable).with_name("ray")), "start", *options, *store],
                env=os.environ | ({REDIS: self._address_of_redis} if "--head" in options else {}),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            self._running.append(started)
            return started


class Answers:
    """A Ray actor that confirms that it is running."""

    def is_there(self) -> bool:
        """Returns True, as a response from a running actor."""
        return True


def silences(count: int, echo: Callable[[str], None]) -> list[float]:
    """Kills the head `count` times and returns the seconds from each kill until a new actor responds."""
    import ray

    gaps = []
    with SupervisedCluster():
        wait_until(lambda: _joined(ray), NOT_STARTED, PATIENCE_S)
        made: Any = ray.remote(Answers)
        try:
            for number in range(count):
                time.sleep(random.uniform(*BETWEEN_S))
                for pid in _heads():
                    os.kill(pid, SIGKILL)
                began = time.monotonic()
                actor = made.options(num_cpus=0.1).remote()
                ray.get(actor.is_there.remote(), timeout=PATIENCE_S)
                gaps.append(time.monotonic() - began)
                ray.kill(actor)
                echo(f"{number + 1} of {count}: {gaps[-1]:.2f} s")
        finally:
            ray.shutdown()
    return gaps


def summarize(found: Sequence[float]) -> str:
    """Formats the measured downtimes as a sentence."""
    ordered = sorted(found)
    return (
        "An actor requested right after the head was killed responded after a median of "
        f"{ordered[len(ordered) // 2]:.1f} s "
        f"({ordered[0]:.1f} to {ordered[-1]:.1f} s over {len(ordered)} kills)"
    )


def _joined(ray: Any) -> bool:
    """Tries to join the cluster through the node, not the head, and returns whether an actor then responds."""
    with contextlib.suppress(Exception):  # whatever Ray raises while the node is starting
        ray.init(address=f"{HEAD}:{PORT}", _node_ip_address=NODE, log_to_driver=False, logging_level="ERROR")
        ray.get(ray.remote(Answers).options(num_cpus=0.1).remote().is_there.remote(), timeout=PATIENCE_S)
        return True
    ray.shutdown()
    return False


def _heads() -> Iterator[int]:
    for path in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            arguments = (path / "cmdline").read_text().split("\0") if path.name.isdecimal() else [""]
            if arguments[0].endswith("gcs_server") and f"--gcs_server_port={PORT}" in arguments:
                yield int(path.name)


def _listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((HEAD, port), timeout=1):
        return True
    return False
