"""Live views during updates: how much updates and an open-loop load of renders slow each other down.

A service runs in a separate process. For each rate, the study measures views while nothing is updated, updates without
views, and both together. The study alternates between the three, because a machine's speed drifts. Requests start at
fixed times, regardless of earlier requests. Latency is measured from the time at which a request was due, so that a
service that falls behind is noticed.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import statistics
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from client.cli.evaluate import Report
from client.cli.scores import Column, Row, markdown
from scas4d_core.captures import Capture
from studies.machine import in_words, machine
from studies.running.process import Service
from studies.running.study import Updates, encoded_frames

TARGET_RATE, TARGET_LATENCY, TARGET_SLOWER = 5.0, 2.0, 0.25
RATES = (1.0, 5.0, 20.0)
"""Views per second."""
WIDTH = 256
"""Width of a view in pixels."""
IDLE_S = 6.0
"""Seconds per turn during which views are requested while nothing is updated."""
WARM_UP = 3
"""Number of updates before the measurement. The first ones compile or load kernels and start cold."""


@dataclass
class ViewTimes:
    """Latencies and update times at one rate of views.

    Attributes:
        rate: views per second.
        idle: latency of each view without updates, in ms.
        loaded: latency of each view during updates, in ms.
        alone: seconds of each update without views.
        together: seconds of each update with views.
        refused: number of views without a response of 200.
    """

    rate: float
    idle: list[float] = field(default_factory=list)
    loaded: list[float] = field(default_factory=list)
    alone: list[float] = field(default_factory=list)
    together: list[float] = field(default_factory=list)
    refused: int = 0

    @property
    def latency(self) -> float:
        """Ratio of the median latency during updates to the median latency without updates."""
        return statistics.median(self.loaded) / statistics.median(self.idle)

    @property
    def slower(self) -> float:
        """Fraction by which the median update is slower with views than without."""
        return statistics.median(self.together) / statistics.median(self.alone) - 1


class Load:
    """Context manager that requests views at a fixed rate in a thread.

    Args:
        url: URL of the scene.
        cameras: names of the cameras, which are rendered in turn.
        rate: views per second.

    Attributes:
        latencies: latency of each view in ms, from the time at which it was due.
        refused: number of views without a response of 200.
    """

    def __init__(self, url: str, cameras: Sequence[str], rate: float) -> None:
        self.latencies: list[float] = []
        self.refused = 0
        self._url, self._cameras, self._rate = url, cameras, rate
        self._stop = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)

    def __enter__(self) -> Load:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    async def _run(self) -> None:
        limits = httpx.Limits(max_connections=256, max_keepalive_connections=256)
        async with httpx.AsyncClient(base_url=self._url, timeout=60, limits=limits) as http:
            began, number = time.perf_counter(), 0
            asked: set[asyncio.Task[None]] = set()
            while not self._stop.is_set():
                due = began + number / self._rate
                await asyncio.sleep(max(0.0, due - time.perf_counter()))
                task = asyncio.ensure_future(self._ask(http, self._cameras[number % len(self._cameras)], due))
                asked.add(task)
                task.add_done_callback(asked.discard)
                number += 1
            await asyncio.gather(*asked)

    async def _ask(self, http: httpx.AsyncClient, camera: str, due: float) -> None:
        try:
            answer = await http.get("render", params={"camera": camera, "format": "jpeg", "width": WIDTH})
        except httpx.HTTPError:
            self.refused += 1
            return
        if answer.status_code != 200:
            self.refused += 1
            return
        self.latencies.append(1000 * (time.perf_counter() - due))


def measure(
    capture: Capture,
    folder: Path,
    *,
    updates: int,
    turns: int,
    settings: Mapping[str, Any],
    echo: Report,
) -> list[ViewTimes]:
    """Measures views and updates, alone and together, and returns the times at each rate.

    For the arguments, see ``scripts/bench views --help``.
    """
    shutil.rmtree(folder, ignore_errors=True)
    data = folder / "data"
    data.mkdir(parents=True)
    service = Service(data)
    service.start()
    try:
        many = 1 + WARM_UP + 2 * updates * turns * len(RATES)
        scene = service.create(capture.rig, settings, ingest={"queue_frames": max(updates, WARM_UP) + 1})
        if capture.points is not None:
            service.put_points(scene, capture.points)
        frames = Updates(service, scene, encoded_frames(capture, many))
        echo("frame 0 …")
        frames.run(1)
        frames.run(WARM_UP)
        url = f"http://127.0.0.1:{service.port}/v1/scenes/{scene}/"
        names = capture.rig.names
        with Load(url, names, 2.0):  # opens connections and loads the reader's kernels
            time.sleep(3.0)
        times = [ViewTimes(rate) for rate in RATES]
        for _ in range(turns):
            for row in times:
                with Load(url, names, row.rate) as load:
                    time.sleep(IDLE_S)
                row.idle += load.latencies
                row.refused += load.refused
                row.alone += frames.run(updates)
                with Load(url, names, row.rate) as load:
                    row.together += frames.run(updates)
                row.loaded += load.latencies
                row.refused += load.refused
                echo(str(row_of(row)))
        return times
    finally:
        with contextlib.suppress(Exception):
            service.stop()
        service.kill()


COLUMNS = (
    Column("views per second", "rate", "g"),
    Column("idle, ms (95%)", "idle"),
    Column("during updates, ms (95%)", "loaded"),
    Column("ratio", "latency"),
    Column("update alone, s", "alone"),
    Column("under views, s", "together"),
    Column("slower", "slower", "+.0%"),
    Column("no response", "refused", "d"),
)


def row_of(times: ViewTimes) -> Row:
    """Returns the medians at one rate as a row of the table."""
    idle, loaded = (
        f"{statistics.median(each):.0f} ({np.percentile(each, 95):.0f})" for each in (times.idle, times.loaded)
    )
    alone, together = (statistics.median(each) for each in (times.alone, times.together))
    return vars(times) | {
        "idle": idle, "loaded": loaded, "alone": alone, "together": together, "latency": times.latency,
        "slower": times.slower,
    }  # fmt: skip


def table(rows: Sequence[ViewTimes]) -> str:
    """Formats the results as a Markdown table, followed by a sentence on the target."""
    text = markdown([row_of(times) for times in rows], COLUMNS)
    for row in rows:
        if row.rate == TARGET_RATE:
            reached = row.latency <= TARGET_LATENCY and row.slower <= TARGET_SLOWER and row.refused == 0
            text += (
                f"\n\nTarget at {TARGET_RATE:g} per second: median latency at most {TARGET_LATENCY:g} times idle, "
                f"updates at most {100 * TARGET_SLOWER:.0f}% slower: {'reached' if reached else '**missed**'} "
                f"({row.latency:.2f} times, {100 * row.slower:+.0f}%)."
            )
    return text


def page(rows: Sequence[ViewTimes], capture: str, updates: int, turns: int) -> str:
    """Returns the table as Markdown, preceded by the date, the machine and the conditions of the measurement."""
    day = datetime.now(UTC).date().isoformat()
    return (
        f"Measured {day} on {in_words(machine())}: `{capture}`, views {WIDTH} pixels wide as JPEG, every camera of the "
        f"rig in turn; {turns} turns of {updates} updates alone and {updates} under views. Medians, with the 95th "
        f"percentile in parentheses.\n\n{table(rows)}\n"
    )
