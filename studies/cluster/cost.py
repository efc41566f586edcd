"""``scripts/bench cluster``: Ray's overhead for updates and views, and throughput on three nodes versus one machine.

Both services run on this machine and take turns. They differ only in how processes start and how messages are sent.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from client.wire import FrameState
from studies.options import Echo
from studies.running.process import Service, StudyError
from studies.running.study import FrameSender, Study

PLACEMENTS = ("local", "ray")
EVERY_S = 0.01
"""Interval in seconds at which the study checks whether a frame is committed."""


@dataclass
class CostFigures:
    """Measurements of one placement.

    Attributes:
        updates: seconds from the acknowledgement of each frame to its commit.
        views: seconds per view.
        throughput: committed frames per second over all scenes together, one value per turn.
    """

    updates: list[float] = field(default_factory=list)
    views: list[float] = field(default_factory=list)
    throughput: list[float] = field(default_factory=list)


def measure(
    study: Study, address: str, *, scenes: int, turns: int, views: int, echo: Echo = print
) -> dict[str, CostFigures]:
    """Measures both placements alternately and returns the figures of each.

    Args:
        study: study whose frames are sent to each scene.
        address: address of the Ray cluster.
        scenes: number of concurrent scenes in the throughput measurement.
        turns: number of measurements of each placement.
        views: number of views rendered per turn.
        echo: callback that prints progress messages.

    Raises:
        StudyError: a frame was not committed, or a view failed.
    """
    figures = {name: CostFigures() for name in PLACEMENTS}
    services = {
        "local": study.service("local", {"SCAS4D_MAX_SCENES": str(scenes + 1)}),
        "ray": study.service("ray", {"SCAS4D_MAX_SCENES": str(scenes + 1), "SCAS4D_PLACEMENT": f"ray={address}"}),
    }
    try:
        for service in services.values():
            service.start()
        for turn in range(turns):
            lone = {name: _begun(study, service) for name, service in services.items()}
            for name in (PLACEMENTS, PLACEMENTS[::-1])[turn % 2]:
                figures[name].views += _views(services[name], lone[name], study.capture.full_rig.names[0], views)
            for name, seconds in _updates(study, services, lone).items():
                figures[name].updates += seconds
            for name, scene in lone.items():
                services[name].http.delete(f"/v1/scenes/{scene}")
            echo(f"turn {turn + 1} of {turns}: one scene")
        for turn in range(turns):
            for name in (PLACEMENTS, PLACEMENTS[::-1])[turn % 2]:
                figures[name].throughput.append(_together(study, services[name], scenes))
            echo(f"turn {turn + 1} of {turns}: {scenes} scenes")
    finally:
        for service in services.values():
            service.stop()
    return figures


def summarize(found: dict[str, CostFigures], scenes: int) -> str:
    """Formats the measurements as a Markdown table, followed by the ratio per frame."""
    local, ray = found["local"], found["ray"]
    ratios = [there / here for here, there in zip(local.updates, ray.updates, strict=True)]
    rows = [
        ("update, median, s", median(local.updates), median(ray.updates), 3),
        ("view, median, ms", 1e3 * median(local.views), 1e3 * median(ray.views), 1),
        (f"{scenes} scenes, frames per second, median", median(local.throughput), median(ray.throughput), 2),
    ]
    table = ["| | local | Ray | ratio | difference |", "|---|---|---|---|---|"]
    for name, here, there, digits in rows:
        table.append(
            f"| {name} | {here:.{digits}f} | {there:.{digits}f} | {there / here:.3f} | {there - here:+.{digits}f} |"
        )
    low, middle, high = np.percentile(ratios, (25, 50, 75))
    table += [
        "",
        f"Ratio per frame over {len(ratios)} updates: median {middle:.3f} (quartiles {low:.3f} and {high:.3f})",
    ]
    return "\n".join(table)


def _begun(study: Study, service: Service) -> str:
    """Creates a scene, waits until its first frame is committed, and returns its id."""
    scene = study.create(service)
    FrameSender(study, service, scene).send(0)
    service.finish(scene, 1)
    return scene


def _views(service: Service, scene: str, camera: str, count: int) -> list[float]:
    """Returns the time in seconds of each view of an idle scene, excluding the first view."""
    seconds = []
    for _ in range(count + 1):
        began = time.monotonic()
        answer = service.http.post(f"/v1/scenes/{scene}/render", json={"camera": camera, "format": "jpeg"})
        seconds.append(time.monotonic() - began)
        if answer.status_code != 200:
            raise StudyError(answer.text)
    return seconds[1:]


def _updates(study: Study, services: Mapping[str, Service], scenes: Mapping[str, str]) -> dict[str, list[float]]:
    """Sends frames to the services in turn and returns the seconds of each update, keyed by service."""
    seconds: dict[str, list[float]] = {name: [] for name in scenes}
    for index in range(1, len(study.frames)):
        for name in (PLACEMENTS, PLACEMENTS[::-1])[index % 2]:
            service, scene = services[name], scenes[name]
            FrameSender(study, service, scene).send(index)
            began = time.monotonic()
            service.finish(scene, index + 1, EVERY_S)
            seconds[name].append(time.monotonic() - began)
            _check(service, [scene], index + 1)
    return seconds


def _together(study: Study, service: Service, scenes: int) -> float:
    """Returns the combined throughput of several scenes after their first frames, in frames per second."""
    ids = [_begun(study, service) for _ in range(scenes)]
    threads = [threading.Thread(target=_send_all, args=(study, service, id)) for id in ids]
    for id in ids:
        service.http.post(f"/v1/scenes/{id}/pause")
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    began = time.monotonic()
    for id in ids:
        service.http.post(f"/v1/scenes/{id}/resume")
    for id in ids:
        service.finish(id, len(study.frames))
    seconds = time.monotonic() - began
    _check(service, ids, len(study.frames))
    for id in ids:
        service.http.delete(f"/v1/scenes/{id}")
    return scenes * (len(study.frames) - 1) / seconds


def _send_all(study: Study, service: Service, scene: str) -> None:
    sender = FrameSender(study, service, scene)
    for index in range(1, len(study.frames)):
        sender.send(index)


def _check(service: Service, scenes: Sequence[str], frames: int) -> None:
    for scene in scenes:
        report = service.frame(scene, frames - 1)
        if report.state != FrameState.COMMITTED:
            raise StudyError(f"scene {scene}: frame {frames - 1} is {report.state}: {report.error}")
