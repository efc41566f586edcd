"""`scas4d reconstruct`: reconstructs a capture in this process, without a service."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from client import pictures
from client.cli.capture_options import finish, note
from client.exports.video.video_file import video_file
from client.left_out import LeftOut
from client.progress import Bars, console
from scas4d_core.captures import Capture, CaptureError, ImageError
from scas4d_core.compact import CompactWriter, FileHeader
from scas4d_core.frame_outcome import AlarmKind
from scas4d_core.presets import preset as named
from scas4d_core.rig_checks import check_rig, rig_warnings
from scas4d_core.settings import Settings

if TYPE_CHECKING:
    from scas4d_core.first_frame.static_result import StaticResult
    from scas4d_core.frame_report import FrameReport
    from scas4d_core.reconstruction import Reconstruction
    from scas4d_core.storage.history import History

FRAME_ALARMS = (AlarmKind.FRAME_REJECTED, AlarmKind.FRAME_IN_PART)
"""Alarms whose evidence is already part of the report's ``degraded`` text."""


@dataclass(frozen=True)
class ReconstructedFrame:
    """One reconstructed frame, with its times and its report. The frame may be degraded.

    Attributes:
        index: frame index in the capture.
        seconds: wall-clock time of this frame in seconds, including decoding.
        cpu_seconds: CPU time of this frame in seconds, summed over all threads.
        report: report on the update; None for the first frame.
        unusable: cameras whose image cannot be used.
    """

    index: int
    seconds: float
    cpu_seconds: float
    report: FrameReport | None
    unusable: Collection[str] = ()


def reconstruct_frames(
    capture: Capture,
    settings: Settings,
    count: int,
    *,
    history: History | None = None,
    static: StaticResult | None = None,
    progress: Callable[[str, int, int], None],
    left_out: LeftOut,
    on_message: Callable[[str], None],
) -> Iterator[tuple[Reconstruction, ReconstructedFrame]]:
    """Reconstructs the first `count` frames of a capture in order.

    Cameras without a usable image are left out. Like the service, the function leaves out a frame if too few cameras
    remain, and starts with the first other frame. After each frame that is not left out, it yields the reconstruction
    and the result of the frame.

    Args:
        capture: capture at full size; the reconstruction resizes its images itself.
        settings: reconstruction settings.
        count: number of frames, at least 1.
        history: storage for the states; None to keep them in memory.
        static: previously fitted first frame; None to fit it here.
        progress: callback that receives (stage, done, total).
        left_out: record of the images that cannot be used.
        on_message: callback that receives the messages of `left_out`.

    Raises:
        CaptureError: if every frame was left out.
    """
    from scas4d_core.reconstruction import Reconstruction

    reconstruction: Reconstruction | None = None
    for index in range(count):
        started, cpu = time.perf_counter(), time.process_time()
        frame, dropped = capture.usable_frame(index)
        report: FrameReport | None = None
        for message in left_out.record(index, dropped):
            on_message(message)
        if left_out.is_too_much(dropped):
            continue
        if reconstruction is None:
            reconstruction = Reconstruction.start(
                capture.rig,
                frame,
                settings,
                points=capture.points,
                progress=lambda now: progress(f"frame 0, {now.stage}", now.done, now.total),
                history=history,
                static=static,
                dropped=dropped,
            )
        else:
            report = reconstruction.step(frame, dropped=dropped, started=started)
        done = ReconstructedFrame(index, time.perf_counter() - started, time.process_time() - cpu, report, dropped)
        progress("frames", index + 1, count)
        yield reconstruction, done
    if reconstruction is None:
        raise CaptureError(f"{capture.name} has no frame that can be used: {left_out.summary}")


def reconstruct(
    given: Capture,
    out: Path,
    *,
    frames: int | None,
    preset: str,
    changes: Mapping[str, Any],
    videos: bool = False,
) -> None:
    """Reconstructs every frame and writes comparison images, `states/`, `states.s4d` and `last.ply` to `out`.

    Renders are compared with the test cameras' images. If there are no test cameras, one training camera is used and
    the last printed line says so. An image that cannot be used is left out, with a message.

    Args:
        given: capture at full size; the reconstruction resizes its images itself.
        out: output folder; created if missing.
        frames: number of frames; None for all.
        preset: preset name.
        changes: nested settings that override the preset.
        videos: whether to also write each camera's comparison images as a video at the capture's frame rate.

    Raises:
        CaptureError: if a frame was left out, because it has too few usable images; all files are written before.
    """
    from scas4d_core.query.parts import parts
    from scas4d_core.query.ply import write_ply
    from scas4d_core.storage.history import History

    settings = named(preset, changes)
    positions = None if given.points is None else given.points.positions
    check_rig(given.full_rig, settings.scene, positions)
    for sentence in rig_warnings(given.full_rig, settings.scene, positions):
        if sentence not in given.remarks:
            console.print(sentence)
    capture = given.scaled(settings.scene.image_scale)
    count = min(frames or capture.frame_count, capture.frame_count)
    rig = capture.test_rig or capture.rig
    cameras = rig.cameras if capture.test_rig is not None else rig.cameras[:1]
    if (out / "states" / "fixed.npz").exists():  # left over from an earlier run
        shutil.rmtree(out / "states")
    compact = out / "states.s4d"
    compact.unlink(missing_ok=True)
    history = History(out / "states")
    left_out = LeftOut(given.rig)
    compile_kernels()
    with Bars() as bars, ExitStack() as opened:
        writer: CompactWriter | None = None
        add: dict[str, Callable[[pictures.Picture], None]] = {}
        frames_of = reconstruct_frames(
            given, settings, count, history=history, progress=bars, left_out=left_out, on_message=note
        )
        for reconstruction, done in frames_of:
            index = done.index
            if writer is None:
                head = FileHeader(
                    reconstruction.world,
                    background=history.background,
                    rig=reconstruction.calibrated,
                    frames_per_second=given.fps,
                )
                writer = opened.enter_context(CompactWriter(compact, head))
            writer.add(index, history.time(index), history.gaussians(index))
            truth = capture.test_frame(index) if capture.test_rig is not None else capture.frame(index)
            scores = []
            if (done.report is None or index == count - 1) and reconstruction.report is not None:
                for sentence in reconstruction.report.warnings:
                    if sentence not in given.remarks:
                        console.print(sentence)
            if capture.test_rig is None:
                cameras = reconstruction.calibrated.scaled(settings.scene.image_scale).cameras[:1]
            for camera in cameras:
                try:
                    true = truth.images[camera.name]
                except (CaptureError, ImageError) as fault:
                    if capture.test_rig is not None:  # that of a training camera has been reported
                        note(f"frame {index}, not compared with camera {camera.name}: {fault}")
                    continue
                render = pictures.eight_bit(reconstruction.render(camera, index).colour)
                scores.append(pictures.psnr(true, render))
                compared = pictures.comparison(true, render)
                pictures.save(out / f"camera_{camera.name}" / f"{index:06d}.png", compared)
                if videos and camera.name not in add:
                    file = out / f"camera_{camera.name}.mp4"
                    add[camera.name] = opened.enter_context(video_file(file, given.fps))
                if videos:
                    add[camera.name](compared)
            score = f"{np.mean(scores):.2f} dB" if scores else "not compared"
            remarks = remarks_on(done.report, done.unusable)
            console.print(f"frame {index}: {score}{remarks}", markup=False, soft_wrap=True)
        if writer is not None and history.newest.moving.any():
            writer.add_parts(history.indices[-1], parts(history))
    write_ply(out / "last.ply", history.gaussians(history.indices[-1]), reconstruction.world)
    seen = (
        ""
        if capture.test_rig is not None
        else f" (PSNR of training camera {cameras[0].name}; use --test to hold out others)"
    )
    console.print(f"images, states, states.s4d and last.ply: {out}{seen}")
    finish(left_out)


def remarks_on(report: FrameReport | None, reported: Collection[str] = ()) -> str:
    """Returns the text printed after a frame's PSNR: why the frame is degraded, and its alarms.

    Args:
        report: report of the frame, or None.
        reported: cameras about which a message says why they were left out.

    >>> remarks_on(None)
    ''
    """
    if report is None:
        return ""
    parts = [] if report.degraded is None else [report.degraded]
    for alarm in report.alarms:
        if alarm.kind is AlarmKind.CAMERA_LEFT_OUT and alarm.camera in reported:
            continue
        if alarm.kind not in FRAME_ALARMS:  # `degraded` already contains this evidence
            parts.append(alarm.evidence if alarm.camera is None else f"camera {alarm.camera}: {alarm.evidence}")
    return "".join(f"\n  ! {part}" for part in parts)


def compile_kernels() -> None:
    """Compiles the kernels in separate processes, unless they are cached."""
    from scas4d_core.warm_up import EVERY, compile_in_processes

    with Bars() as bars:
        compile_in_processes(EVERY, on_progress=lambda done, total: bars("compiling the kernels", done, total))
