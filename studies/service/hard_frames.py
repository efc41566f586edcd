"""Runs the frame cases on a service, which must accept all frames, keep its workers alive, and report what is wrong.

All cases are sent to one scene, one after the other, with good frames between them. Another scene gets only the good
frames. The committed states are read from the folders of the scenes and compared.
"""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from client.wire import FRAME_MEDIA_TYPE, FrameState, frame_chunks
from scas4d_core.captures.frame import Frame
from scas4d_core.engines.limits import rig_limits
from scas4d_core.frame_outcome import Alarm, AlarmKind, FrameOutcome
from scas4d_core.frame_report import FrameReport
from scas4d_core.gaussians import Gaussians
from scas4d_core.metrics import psnr
from scas4d_core.query.committed import CommittedScene
from scas4d_core.storage.history import History
from server.storage.layout import DataFolder
from studies.hard_frames.footage import AnyFootage
from studies.hard_frames.frames import FrameCase, FrameStep, Pictures, Sent, good, named, teleported, violations
from studies.hard_frames.study import AT, sound
from studies.options import Echo
from studies.running.process import PATIENCE_S, Service

FARTHEST = 1.0
"""Largest jump of the object, in multiples of its size. With a jump of twice its size, it would leave the images."""
BETWEEN = 2
"""Number of good frames between the last frame that is checked for one case and the first frame of the next case."""
AGAIN_S = 0.05


class BackAndForth:
    """Footage that is played back and forth endlessly."""

    def __init__(self, footage: AnyFootage) -> None:
        self._footage = footage

    def frame(self, index: int) -> Frame:
        """Returns a frame with the training images."""
        return self._footage.frame(self._inside(index))

    def truth(self, index: int) -> Pictures:
        """Returns the true images of the held-out cameras."""
        return self._footage.truth(self._inside(index))

    def jumped(self, index: int, sizes: float) -> tuple[Frame, Pictures] | None:
        """Returns the images with the object moved by a multiple of its size, or None if unavailable."""
        return self._footage.jumped(self._inside(index), sizes)

    def _inside(self, index: int) -> int:
        last = self._footage.count - 1
        turn = index % (2 * last)
        return min(turn, 2 * last - turn)


@dataclass
class ServiceCaseResult:
    """Result of a case at one size, on the service.

    Attributes:
        case: the case.
        size: size at which the case was run.
        said: summaries of the reports on the faulty frames.
        last: PSNR of the last frame minus that of the undisturbed run, in dB.
        violations: violated checks.
    """

    case: FrameCase
    size: Any
    said: str
    last: float
    violations: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class SentCase:
    """Frames that are sent for one case.

    Attributes:
        case: the case.
        size: size at which the case is run.
        first: index of the first of these frames in the scene.
        sent: the frames.
    """

    case: FrameCase
    size: Any
    first: int
    sent: Sequence[Sent]


def script(footage: BackAndForth, cases: Sequence[FrameCase]) -> tuple[list[Sent], list[SentCase]]:
    """Returns all frames to send, and the frames of each case. A permanent jump is followed by a jump back."""
    sent = [good(footage, index) for index in range(AT)]
    parts: list[SentCase] = []
    for case in cases:
        for size in case.sizes:
            like = sent[-1].like + 1
            case_frames = case.make(footage, like, size)
            if case_frames is None or (case.make is teleported and size > FARTHEST):
                continue
            parts.append(SentCase(case, size, len(sent), case_frames))
            sent += case_frames
            sent += [
                good(footage, sent[-1].like + 1 + number) for number in range(BETWEEN if case_frames[-1].good else 6)
            ]
    return sent, parts


def study(
    footage: AnyFootage, folder: Path, names: Sequence[str] = (), echo: Echo = print
) -> tuple[list[ServiceCaseResult], list[str]]:
    """Runs the cases whose name contains one of ``names``, or all cases if it is empty.

    Returns:
        The result of each case, and the faults of the service itself.
    """
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "data").mkdir(parents=True)
    endless = BackAndForth(footage)
    cases = [case for case in named(footage) if not names or any(name in case.name for name in names)]
    sent, parts = script(endless, cases)
    service = Service(folder / "data")
    service.start()
    try:
        usual, faults = _push(service, footage, [good(endless, index) for index in range(sent[-1].like + 1)], echo)
        echo(f"undisturbed run: {usual.count} frames")
        scene, more = _push(service, footage, sent, echo)
        lines = [_result(part, scene, usual, footage) for part in parts]
    finally:
        service.stop()
    faults += more
    for line in lines:
        echo(f"{'passed' if not line.violations else 'FAILED'}  {line.case.name}, {line.size}  {line.last:+.1f} dB")
        echo(f"       {line.said}")
        for violation in line.violations:
            echo(f"       ! {violation}")
    failed = sum(bool(line.violations) for line in lines)
    echo(
        f"{len(lines)} runs (cases and sizes) in {len(sent)} frames, {failed} failures; service faults: "
        f"{faults or 'none'}"
    )
    return lines, faults


@dataclass(frozen=True)
class Pushed:
    """A scene of the service, read from its folder.

    Attributes:
        committed: committed states of the scene.
        count: number of frames to send.
    """

    committed: CommittedScene
    count: int

    def state(self, index: int) -> Gaussians:
        """Returns the committed state of a frame."""
        return self.committed.history.gaussians(index)

    def report(self, index: int) -> FrameReport:
        """Returns the report of a frame."""
        record = self.committed.history.report(index)
        known = {item.name: record[item.name] for item in fields(FrameReport) if item.name in record}
        alarms = [Alarm(AlarmKind(one["kind"]), one["camera"], one["evidence"]) for one in known.pop("alarms", [])]
        return FrameReport(**{**known, "outcome": FrameOutcome(record["outcome"]), "alarms": alarms})

    def psnr(self, footage: AnyFootage, index: int, truth: Pictures) -> float:
        """Returns the PSNR in dB of a frame on the held-out cameras, whose true images are ``truth``."""
        return float(
            np.mean(
                [psnr(self.committed.render(camera, index).colour, truth[camera.name]) for camera in footage.held_out]
            )
        )


def _push(service: Service, footage: AnyFootage, sent: Sequence[Sent], echo: Echo) -> tuple[Pushed, list[str]]:
    """Sends frames to a new scene one after the other, and returns the scene and the faults of the service."""
    faults: list[str] = []
    scene = service.create(
        footage.rig,
        footage.settings.model_dump(mode="json"),
        ingest={"keep_frames": {}, "minimum_cameras": 1, "exact_states": None},
    )
    if footage.points is not None:
        service.put_points(scene, footage.points)
    pids = set()
    for index, one in enumerate(sent):
        until = time.monotonic() + PATIENCE_S
        files, whole = encoded(one.frame), len(one.frame.images) == len(footage.rig)
        while (answer := _send(service, scene, index, whole, *files)).status_code == 429 and time.monotonic() < until:
            time.sleep(AGAIN_S)
        if answer.status_code != 202:
            faults.append(f"frame {index} got status {answer.status_code}: {answer.text}")
            break
        if index % 20 == 0:
            service.finish(scene, index + 1)
            pids.add(service.worker_pid(scene))
    status = service.finish(scene, len(sent) if not faults else 0)
    pids.add(service.worker_pid(scene))
    if len(pids) != 1 or None in pids:
        faults.append(f"the worker died: its processes were {pids}")
    for index in range(status.next_frame):
        report = service.frame(scene, index)
        if report.state != FrameState.COMMITTED or report.worker_deaths:
            faults.append(f"frame {index} is {report.state} after {report.worker_deaths} deaths: {report.error}")
    echo(f"scene {scene}: {status.next_frame} frames, {len(faults)} faults")
    history = History.load(DataFolder(service.data).scene(scene).states)
    world = footage.rig.world_frame(footage.settings.scene.metres_per_unit)
    limits = rig_limits(footage.settings.scene.near, world, footage.rig.cameras)
    return Pushed(CommittedScene(history, world, limits), len(sent)), faults


def _send(
    service: Service, scene: str, index: int, whole: bool, images: dict[str, bytes], masks: dict[str, bytes]
) -> httpx.Response:
    """Sends a frame as a whole or camera by camera.

    Returns:
        The first unsuccessful response, or the last response if all are successful.
    """
    if whole:
        return service.put(scene, index, images, masks)
    address = f"/v1/scenes/{scene}/frames/{index}"
    for name, image in images.items():
        body = b"".join(frame_chunks(index, {name: image}, {name: masks[name]} if name in masks else {}))
        answer = service.http.put(f"{address}/cameras/{name}", content=body, headers={"Content-Type": FRAME_MEDIA_TYPE})
        if answer.status_code >= 300:
            return answer
    return service.http.post(f"{address}/close")


def encoded(frame: Frame) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """Encodes the images and masks of a frame as PNG."""
    images = {name: _png(np.asarray(frame.images[name])) for name in frame.images}
    return images, {name: _png(255 * np.asarray(frame.masks[name])) for name in frame.masks}


def _png(picture: NDArray[np.uint8]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", compress_level=1)
    return file.getvalue()


def _result(part: SentCase, scene: Pushed, usual: Pushed, footage: AnyFootage) -> ServiceCaseResult:
    """Compares the frames of one case with those of the undisturbed scene."""
    steps = []
    for number, sent in enumerate(part.sent):
        index = part.first + number
        before, after = scene.state(index - 1).arrays(), scene.state(index).arrays()
        like = BackAndForth(footage).truth(sent.like)
        steps.append(
            FrameStep(
                replace(sent, frame=Frame(index, 0.0, {}, {})),
                scene.report(index),
                all(np.array_equal(before[name], after[name]) for name in before),
                sound(scene.state(index)),
                scene.psnr(footage, index, sent.truth),
                usual.psnr(footage, sent.like, like),
            )
        )
    faulty = [step for step in steps if not step.sent.good]
    said = "; ".join(
        dict.fromkeys(
            step.report.degraded or ", ".join(step.report.dropped.values()) or "; ".join(step.report.attempts)
            for step in faulty
        )
    )
    return ServiceCaseResult(
        part.case, part.size, said, steps[-1].psnr - steps[-1].usual, violations(part.case, steps, part.size)
    )


def table(lines: Sequence[ServiceCaseResult]) -> str:
    """Formats the results as a Markdown table, with one row per case and size."""
    rows = ["| case | size | reports | dB, last frame | passes |", "|" + "---|" * 5]
    for line in lines:
        verdict = "yes" if not line.violations else f"**no**: {'; '.join(line.violations)}"
        rows.append(f"| {line.case.name} | {line.size} | {line.said} | {line.last:+.1f} | {verdict} |")
    return "\n".join(rows)
