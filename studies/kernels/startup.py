"""Times the start of a service, from an empty kernel cache to the first committed update.

A service starts without compiled kernels. As soon as it is ready, the study sends it the first two frames of a capture,
as a rig would. Two checkouts can be compared. They are measured alternately, because the speed of a shared machine
drifts.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from client.errors import ServiceError, ServiceUnreachable
from client.importers.open_source import open_source
from client.sdk import Client
from studies.apart import in_a_process
from studies.machine import in_words, machine
from studies.options import Echo

ROOT = Path(__file__).parents[2]
EVERY_S = 0.1
PATIENCE_S = 1800.0
ENDING_S = 120.0
ADOPT = 36
"""PR_SET_CHILD_SUBREAPER: adopts processes whose parent has ended, so that their CPU time is counted."""


@dataclass(frozen=True)
class Start:
    """One start of a service.

    Attributes:
        checkout: checkout that contains the service.
        ready: seconds from the start of the process until the service was ready.
        first: seconds from the start of the process until frame 0 was committed.
        update: seconds from the start of the process until the first update was committed.
        processor: CPU time of all processes of the service, in seconds.
    """

    checkout: Path
    ready: float
    first: float
    update: float
    processor: float


def measure(capture: Path, checkouts: list[Path], repeats: int, echo: Echo) -> list[Start]:
    """Starts a service from each checkout ``repeats`` times, alternating between checkouts, and returns all starts.

    Raises:
        RuntimeError: a service or one of its processes did not end, or no update was committed.
    """
    starts = []
    for turn in range(repeats):
        for checkout in checkouts:
            starts.append(start(capture, checkout))
            echo(f"turn {turn + 1}, {checkout.name}: {_words(starts[-1])}")
    return starts


def start(capture: Path, checkout: Path) -> Start:
    """Starts a service from a checkout with an empty cache, sends it two frames, and returns the measurements.

    The measurement runs in a separate process, which waits for all its child processes and counts only their CPU time.
    """
    begun: Start = in_a_process(_start, capture, checkout)
    return begun


def _start(capture: Path, checkout: Path) -> Start:
    with contextlib.suppress(OSError, AttributeError):  # only Linux can count the compilers' time
        ctypes.CDLL(None).prctl(ADOPT, 1, 0, 0, 0)
    source = open_source(capture)
    with tempfile.TemporaryDirectory() as folder, _service(checkout, Path(folder)) as (url, process):
        spent, began = _spent(), time.monotonic()
        with Client(url, outage=0) as client:
            while not _ready(client):
                _check(process, began)
            ready = time.monotonic() - began
            scene = client.create_scene(source.rig).id
            if source.points is not None:
                client.put_points(scene, source.points)
            for index in range(2):
                client.put_frame(scene, index, {name: source.encoded_image(index, name) for name in source.rig.names})
            committed = [0.0, 0.0]
            for index in range(2):
                while (client.scene(scene).last_committed or 0) < index or client.scene(scene).committed == 0:
                    _check(process, began)
                committed[index] = time.monotonic() - began
        _end(process)
    return Start(checkout, ready, committed[0], committed[1], _spent() - spent)


def table(starts: list[Start]) -> str:
    """Formats the medians of each checkout, and their ratios to the first checkout, as a Markdown table."""
    lines = [
        f"{in_words(machine())}; medians of {sum(one.checkout == starts[0].checkout for one in starts)} starts each, "
        "in alternation.",
        "",
        "| checkout | ready | frame 0 | first update | CPU time | first update, ratio | CPU time, ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    medians: dict[Path, list[float]] = {}
    for one in starts:
        mine = [other for other in starts if other.checkout == one.checkout]
        columns = ([getattr(other, name) for other in mine] for name in ("ready", "first", "update", "processor"))
        medians.setdefault(one.checkout, [statistics.median(column) for column in columns])
    first = medians[starts[0].checkout]
    for checkout, row in medians.items():
        seconds = " | ".join(f"{value:.0f} s" for value in row)
        lines.append(f"| {checkout.name} | {seconds} | {row[2] / first[2]:.2f} | {row[3] / first[3]:.2f} |")
    return "\n".join(lines)


def _words(one: Start) -> str:
    return (
        f"ready after {one.ready:.1f} s, frame 0 after {one.first:.1f} s, first update after {one.update:.1f} s, "
        f"CPU time {one.processor:.1f} s"
    )


@contextlib.contextmanager
def _service(checkout: Path, folder: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    path = os.pathsep.join([str(checkout), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(folder / "cache")}
    command = [sys.executable, "-m", "client.cli.main", "serve", "--port", str(port), "--data", str(folder / "data")]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(command, cwd=checkout, env=environment, stdout=log, stderr=log)
    try:
        yield f"http://127.0.0.1:{port}", process
    finally:
        _end(process)


def _ready(client: Client) -> bool:
    try:
        client.ready()
    except ServiceUnreachable:
        return False
    except ServiceError as error:
        if (error.problem.model_extra or {}).get("warming_up"):
            return False
        raise
    return True


def _check(process: subprocess.Popen[bytes], began: float) -> None:
    if process.poll() is not None:
        raise RuntimeError(f"the service exited with status {process.returncode}")
    if time.monotonic() - began > PATIENCE_S:
        raise RuntimeError(f"no update within {PATIENCE_S:.0f} s")
    time.sleep(EVERY_S)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Stops the service and waits for all its processes, whose CPU time is counted only after they end."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
    process.wait()
    until = time.monotonic() + ENDING_S
    with contextlib.suppress(ChildProcessError):  # no child process is left
        while True:
            if os.waitpid(-1, os.WNOHANG) == (0, 0):
                if time.monotonic() > until:
                    raise RuntimeError(
                        f"a process of the service is still running {ENDING_S:.0f} s after the service exited"
                    )
                time.sleep(EVERY_S)


def _spent() -> float:
    """Returns the CPU seconds of all child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
