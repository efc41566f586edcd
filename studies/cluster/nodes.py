"""A Ray cluster of several nodes on one machine, whose nodes can be killed, stopped and resumed."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

HEALTH = {"period_ms": 1000, "timeout_ms": 2000, "failure_threshold": 3, "initial_delay_ms": 1000}
"""Settings of Ray's health checks, which declare a silent node lost after 3 to 9 s instead of about a minute."""
REDIS, REDIS_S = "RAY_REDIS_ADDRESS", 10.0
STORE_BYTES = 80 * 2**20
"""Size of each node's object store, which scenes do not use."""


class Nodes:
    """A Ray cluster: a head without resources for scenes, and several nodes.

    Args:
        count: number of nodes besides the head.
        cpus: CPUs per node.
        redis_server: path of the redis-server program that stores the head's state; in memory if None.

    Attributes:
        address: head address, for `--placement ray=ADDRESS`.
    """

    def __init__(self, count: int = 3, cpus: float = 2, redis_server: str | None = None) -> None:
        from ray.cluster_utils import Cluster

        self._redis = None if redis_server is None else redis(redis_server)
        os.environ.update({f"RAY_health_check_{name}": str(value) for name, value in HEALTH.items()})
        self._cpus = cpus
        self._cluster: Any = Cluster(
            initialize_head=True,
            head_node_args={"num_cpus": 0, "object_store_memory": STORE_BYTES, "include_dashboard": False},
        )
        self._nodes: dict[int, Any] = {}
        self.address = str(self._cluster.address)
        for _ in range(count):
            self.add()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for pid in tuple(self._nodes):
            self.resume(pid)
        self._cluster.shutdown()
        if self._redis is not None:
            self._redis.kill()
            self._redis.wait()
            del os.environ[REDIS]

    def add(self, labels: Mapping[str, str] | None = None) -> int:
        """Adds a node with the given labels and returns the process id of its raylet, which identifies the node."""
        node = self._cluster.add_node(
            num_cpus=self._cpus, object_store_memory=STORE_BYTES, labels=dict(labels) if labels else None
        )
        pid = int(node.all_processes["raylet"][0].process.pid)
        self._nodes[pid] = node
        return pid

    def of(self, pid: int) -> int | None:
        """Returns the node on which a process runs, or None if the process runs elsewhere or has ended."""
        while pid > 1:
            if pid in self._nodes:
                return pid
            pid = _parent(pid)
        return None

    def kill(self, node: int) -> None:
        """Kills all processes of a node with `kill -9`. The node does not restart."""
        tree = [node, *_below(node)]
        for pid in tree:
            _signal(pid, signal.SIGKILL)
        with contextlib.suppress(Exception):  # Ray may already consider it gone
            self._cluster.remove_node(self._nodes[node], allow_graceful=False)
        del self._nodes[node]

    def stop(self, node: int) -> None:
        """Stops all processes of a node with SIGSTOP, the raylet first."""
        for pid in (node, *_below(node)):
            _signal(pid, signal.SIGSTOP)

    def kill_node_of_head(self) -> None:
        """Kills the head's raylet with `kill -9`. Services that joined the cluster through it lose their actors."""
        self._cluster.head_node.kill_raylet()

    def stop_head(self) -> None:
        """Kills the head and its raylet with `kill -9`, because `ray start --block` ends both when one ends."""
        self._cluster.head_node.kill_gcs_server()
        self.kill_node_of_head()

    def start_head(self) -> None:
        """Restarts the head at its old address, without its raylet. Services join through another node."""
        self._cluster.head_node.start_gcs_server()

    def resume(self, node: int) -> None:
        """Resumes a node with SIGCONT, workers first, before their raylet learns that the node was declared dead."""
        for pid in (*reversed(_below(node)), node):
            _signal(pid, signal.SIGCONT)


def redis(program: str) -> subprocess.Popen[bytes]:
    """Starts an in-memory Redis server and stores its address in the environment, where Ray reads it.

    Raises:
        TimeoutError: the server does not listen in time.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    started = subprocess.Popen(
        [program, "--port", str(port), "--bind", "127.0.0.1", "--save", "", "--appendonly", "no"],
        stdout=subprocess.DEVNULL,
    )
    until = time.monotonic() + REDIS_S
    while True:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            os.environ[REDIS] = f"127.0.0.1:{port}"
            return started
        if time.monotonic() > until:
            raise TimeoutError(f"{program} is not listening after {REDIS_S:g} s")
        time.sleep(0.05)


def _signal(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def _parent(pid: int) -> int:
    """Returns the parent process id, or 0 if the process has ended."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except (OSError, IndexError, ValueError):
        return 0


def _below(pid: int) -> list[int]:
    """Returns the descendants of a process, parents first."""
    parents = {each: _parent(each) for each in _pids()}
    pids, level = [], [pid]
    while level := [each for each, parent in parents.items() if parent in level]:
        pids += level
    return pids


def _pids() -> Iterator[int]:
    return (int(path.name) for path in Path("/proc").iterdir() if path.name.isdecimal())
