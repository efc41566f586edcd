"""Inputs of a service study, classes that send its frames, and the comparison of committed states."""

from __future__ import annotations

import hashlib
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from client.rig.sequence import ping_pong
from client.wire import FrameState
from scas4d_core.captures import Capture
from scas4d_core.gaussians import Gaussians
from scas4d_core.storage.history import History
from server.storage.layout import DataFolder
from studies.running.process import PATIENCE_S, Service, StudyError

AGAIN_S = 0.05

Files = tuple[dict[str, bytes], dict[str, bytes]]


@dataclass(frozen=True)
class Study:
    """Inputs of a service study: the frames to send, the scene settings and the environment of the service.

    Attributes:
        folder: folder for data folders and logs.
        capture: capture that provides the frames.
        frames: encoded images and masks of each frame.
        settings: scene settings.
        environment: environment variables for the service.
    """

    folder: Path
    capture: Capture
    frames: Sequence[Files]
    settings: Mapping[str, Any]
    environment: Mapping[str, str]

    def service(self, name: str, environment: Mapping[str, str] | None = None) -> Service:
        """Returns a service on the emptied data folder ``name``, not yet started.

        ``environment`` adds to the study's environment variables or overrides them.
        """
        data = self.folder / name
        shutil.rmtree(data, ignore_errors=True)
        data.mkdir(parents=True)
        return Service(data, {**self.environment, **(environment or {})})

    def create(self, service: Service, **more: Any) -> str:
        """Creates a scene that keeps all its images, and returns its id.

        ``more`` adds to the scene's ingest rules or overrides them.
        """
        rules = {"keep_frames": {}, "queue_frames": 100, **more}
        return service.create(self.capture.full_rig, self.settings, ingest=rules)


def encoded_frames(capture: Capture, count: int) -> list[Files]:
    """Returns the encoded images and masks of ``count`` frames. A shorter capture is played back and forth."""
    indices = [ping_pong(number, capture.frame_count) for number in range(count)]
    read = {index: _files(capture, index) for index in dict.fromkeys(indices)}
    return [read[index] for index in indices]


def _files(capture: Capture, index: int) -> Files:
    images = {name: capture.encoded_image(index, name) for name in capture.full_rig.names}
    files = {name: capture.encoded_mask(index, name) for name in capture.full_rig.names}
    masks = {name: mask for name, mask in files.items() if mask is not None}
    return images, masks if len(masks) == len(images) else {}


def digests(states: Path) -> dict[int, str]:
    """Returns a text for each committed state: a SHA-256 of its arrays, followed by the decisions in its report."""
    history = History.load(states)
    by_frame = {}
    for index in history.indices:
        digest = hashlib.sha256()
        for name, array in sorted(Gaussians.arrays(history.gaussians(index)).items()):
            digest.update(f"{name} {array.dtype} {array.shape}".encode())
            digest.update(array.tobytes())
        report = history.report(index)
        decided = {name: report.get(name) for name in ("index", "time", "iterations", "loss", "used", "dropped")}
        by_frame[index] = f"{digest.hexdigest()} {decided}"
    return by_frame


def compare(found: Mapping[int, str], expected: Mapping[int, str], but: Sequence[int] = ()) -> list[str]:
    """Describes how a run's states differ from those of the undisturbed run. Frames in `but` are not compared."""
    wrong = [index for index in expected if index not in but and found.get(index) != expected[index]]
    missing = [index for index in wrong if index not in found]
    faults = [f"frames {missing} are not committed"] if missing else []
    others = [index for index in wrong if index in found]
    if others:
        first = f"got {found[others[0]]}, expected {expected[others[0]]}"
        faults.append(f"states {others} are not bit-identical: {first}")
    return faults


class Updates:
    """Sends frames to a scene in batches, playing them back and forth.

    Attributes:
        next: index of the next frame to send.
    """

    def __init__(self, service: Service, scene: str, frames: Sequence[Files]) -> None:
        self._service, self._scene, self._frames = service, scene, frames
        self.next = 0

    def run(self, count: int) -> list[float]:
        """Sends ``count`` frames at once, waits for their commits, and returns the seconds of each update.

        Raises:
            StudyError: a frame was refused or not committed.
        """
        first = self.next
        for index in range(first, first + count):
            answer = self._service.put(self._scene, index, *self._frames[ping_pong(index, len(self._frames))])
            if not answer.is_success:
                raise StudyError(answer.text)
        self.next += count
        self._service.finish(self._scene, self.next)
        reports = [self._service.frame(self._scene, index) for index in range(first, self.next)]
        for report in reports:
            if report.state != FrameState.COMMITTED:
                raise StudyError(f"frame {report.index} was not committed: {report.error}")
        return [report.seconds["total"] for report in reports]


class FrameSender:
    """Sends frames, retrying until each is acknowledged, and records the acknowledgements.

    Attributes:
        receipts: acknowledgement of each frame, by index.
        faults: descriptions of frames that were refused or never acknowledged.
    """

    def __init__(self, study: Study, service: Service, scene: str) -> None:
        self.study, self.service, self.scene = study, service, scene
        self.receipts: dict[int, dict[str, Any]] = {}
        self.faults: list[str] = []

    def send(self, index: int) -> None:
        """Sends a frame repeatedly until it is acknowledged. Records a fault if it is refused or times out."""
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            try:
                answer = self.service.put(self.scene, index, *self.study.frames[index])
            except httpx.TransportError:
                time.sleep(AGAIN_S)
                continue
            if answer.status_code == 202:
                self.receipts[index] = answer.json()
                return
            if answer.status_code not in (429, 503, 507):
                self.faults.append(f"frame {index} got status {answer.status_code}: {answer.text}")
                return
            time.sleep(AGAIN_S)
        self.faults.append(f"frame {index} was never acknowledged")

    def check(self) -> list[str]:
        """Checks that every acknowledged frame is committed with the acknowledged identity, and returns the faults.

        Each frame is also sent again, which must give the same acknowledgement.
        """
        faults = list(self.faults)
        for index, receipt in self.receipts.items():
            report = self.service.frame(self.scene, index)
            if report.state != FrameState.COMMITTED:
                faults.append(f"frame {index} was acknowledged but is {report.state}: {report.error}")
            if report.identity != receipt["identity"]:
                faults.append(f"frame {index} has a different identity than acknowledged")
            again = self.service.put(self.scene, index, *self.study.frames[index])
            if again.status_code != 202 or again.json() != receipt:
                faults.append(f"frame {index}, sent again, got status {again.status_code}: {again.text}")
        return faults


@contextmanager
def running(
    study: Study, name: str, environment: Mapping[str, str] | None = None, **rules: Any
) -> Iterator[tuple[Service, str, FrameSender]]:
    """Starts a service on an empty folder and yields it with a new scene and a sender. Stops it at the end.

    Args:
        study: the study.
        name: name of the service's folder.
        environment: additional environment variables of the service.
        rules: ingest rules of the scene, as in `Study.create`.
    """
    service = study.service(name, environment)
    service.start()
    try:
        scene = study.create(service, **rules)
        yield service, scene, FrameSender(study, service, scene)
    finally:
        service.stop()


def undisturbed(study: Study) -> tuple[dict[int, str], float]:
    """Returns the digests of the states of an undisturbed run, and the mean seconds per update.

    Raises:
        StudyError: a frame was not acknowledged or not committed.
    """
    with running(study, "undisturbed") as (service, scene, sender):
        sender.send(0)
        service.finish(scene, 1)
        began = time.monotonic()
        for index in range(1, len(study.frames)):
            sender.send(index)
        service.finish(scene, len(study.frames))
        seconds = (time.monotonic() - began) / max(1, len(study.frames) - 1)
        if faults := sender.check():
            raise StudyError(f"the undisturbed run failed: {'; '.join(faults)}")
        return digests(DataFolder(service.data).scene(scene).states), seconds
