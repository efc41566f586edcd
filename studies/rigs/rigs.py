"""``scripts/bench rigs``: reconstructs captures of third-party rigs from their folders, with default settings.

Frame 0 keeps its time limit, because its duration is measured. The study should run on an otherwise idle machine. With
five or more cameras, one is held out. As a baseline, the image of the nearest training camera is also compared with
that of the held-out camera. For all captures, tracks are compared with optical flow (``flow.py``).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from client.cli.changes import parse_changes
from client.cli.evaluate import Report, save_comparisons, settings_record
from client.cli.scores import Column, Row, markdown
from client.importers.open_source import CaptureOptions
from scas4d_core import metrics
from scas4d_core.cameras import Rig
from scas4d_core.captures import Capture, Frame
from scas4d_core.engines.choose import renderer_of
from scas4d_core.engines.limits import rig_limits
from scas4d_core.engines.views import CameraArrays
from scas4d_core.frame_outcome import Candidate
from scas4d_core.presets import preset
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.warm_up import compile_in_processes
from studies.rigs.flow import flow_consistency
from studies.rows import RowStudy

ENOUGH_TO_HOLD_OUT = 5
"""Minimum number of cameras for holding one out. With fewer, each camera sees content that no other camera sees."""

COLUMNS = (
    Column("capture", "capture"),
    Column("cameras", "cameras", "d"),
    Column("pixels", "pixels"),
    Column("frames", "frames", "d"),
    Column("first points", "method"),
    Column("covered", "coverage", ".2f"),
    Column("Gaussians", "gaussians", ",d"),
    Column("pairs", "pairs", ".1f"),
    Column("99%", "pairs_99", ".0f"),
    Column("frame 0 s", "seconds_first", ".0f"),
    Column("update s", "seconds_update", ".1f"),
    Column("held", "held", "d"),
    Column("unmoved", "unmoved", "d"),
    Column("training dB", "psnr_training", ".1f"),
    Column("held out", "held_out"),
    Column("its dB", "psnr_held_out", ".1f"),
    Column("nearest picture dB", "psnr_nearest", ".1f"),
    Column("flow px", "flow_px", ".1f"),
    Column("epipolar px", "epipolar_px", ".1f"),
)


def run(
    captures: Sequence[Path],
    out: Path,
    *,
    frames: int = 20,
    longer: int = 480,
    changes: Sequence[str] = (),
    again: bool = False,
    options: CaptureOptions,
    report: Report = print,
) -> list[Row]:
    """Reconstructs captures, prints the table and writes it to ``out/rigs.md``.

    For the arguments, see ``scripts/bench rigs --help``. A second call for the same folder resumes the study.

    Returns:
        One row per capture.
    """
    study = RowStudy(out, "rigs", COLUMNS, again=again, report=report)
    compile_in_processes()
    for folder in captures:
        name = folder.resolve().name
        study.add(
            name,
            (list(changes), frames, longer, *options.changed.items()),
            partial(measured, folder, options, frames, longer, changes, out / "pictures" / name),
            lambda row: markdown([row], COLUMNS),
        )
    return study.finish()


def measured(
    folder: Path, options: CaptureOptions, frames: int, longer: int, changes: Sequence[str], pictures: Path
) -> Row:
    """Reconstructs one capture and returns its row.

    The arguments are as in ``run``, except for ``pictures``, the folder for comparison images.
    """
    names = options.open(folder).full_rig.names
    if not options.test and len(names) >= ENOUGH_TO_HOLD_OUT:
        options = replace(options, test=(names[len(names) // 2],))
    given = options.open(folder)
    size = max(max(camera.width, camera.height) for camera in given.full_rig.cameras)
    settings = preset("scas4d", parse_changes(changes), {"scene": {"image_scale": min(1.0, longer / size)}})
    truth = options.open(folder, image_scale=settings.scene.image_scale)
    count = min(frames, given.frame_count)
    began = time.perf_counter()
    scene = Reconstruction.start(given.rig, given.frame(0), settings, points=given.points)
    first = time.perf_counter() - began
    assert scene.report is not None
    cloud, seconds, held, unmoved = scene.report.cloud, list[float](), 0, 0
    for index in range(1, count):
        began = time.perf_counter()
        report = scene.step(given.frame(index))
        seconds.append(time.perf_counter() - began)
        held += report.outcome.rejected
        unmoved += report.candidate is Candidate.PREVIOUS
    cameras = [CameraArrays.of(camera) for camera in scene.rig.cameras]
    renderer = renderer_of("cpu", (0, 0, 0), rig_limits(settings.scene.near, scene.world, given.rig.cameras))
    pairs = np.concatenate([each.ravel() for each in renderer.pairs_per_pixel(scene.history.first, cameras)])
    trained = [_psnr(scene, truth.rig, truth.frame(index)) for index in range(count)]
    row: Row = {
        "capture": given.name,
        "cameras": len(names),
        "pixels": " and ".join(sorted({f"{camera.width}×{camera.height}" for camera in truth.rig.cameras})),
        "frames": count,
        "method": None if cloud is None else cloud.method,
        "coverage": None if cloud is None else cloud.coverage,
        "gaussians": len(scene.history.first),
        "pairs": float(pairs.mean()),
        "pairs_99": float(np.percentile(pairs, 99)),
        "seconds_first": first,
        "shortened": list(scene.history.report(0).get("shortened") or []),
        "seconds_update": float(np.median(seconds)) if seconds else None,
        "held": held,
        "unmoved": unmoved,
        "psnr_training": float(np.mean(trained)),
        "settings": settings_record(settings, ()),
    }
    if (unseen := truth.test_rig) is not None:
        scores = [_psnr(scene, unseen, truth.test_frame(index)) for index in range(count)]
        row |= {
            "held_out": ", ".join(unseen.names),
            "psnr_held_out": float(np.mean(scores)),
            "psnr_nearest": float(np.mean([_nearest_psnr(truth, unseen, index) for index in range(count)])),
        }
    if count > 1:
        row |= flow_consistency(scene, truth, count)
    seen = truth if truth.test_rig is not None else truth.with_training_as_test()
    for index in sorted({0, count - 1}):
        save_comparisons(scene, seen, index, pictures)
    return row


def _psnr(scene: Reconstruction, rig: Rig, frame: Frame) -> float:
    """Returns the mean PSNR in dB of a rig's cameras, rendered without their estimated gains."""
    return float(
        np.mean([metrics.psnr(scene.render(rig[n], frame.index).colour, image) for n, image in frame.images.items()])
    )


def _nearest_psnr(truth: Capture, unseen: Rig, index: int) -> float:
    """Returns the mean PSNR in dB if each held-out image is replaced with that of the nearest training camera."""
    pictures, seen, scores = truth.test_frame(index).images, truth.frame(index).images, []
    centres = np.array([camera.centre for camera in truth.rig.cameras])
    for camera in unseen.cameras:
        nearest = truth.rig.cameras[int(np.linalg.norm(centres - camera.centre, axis=1).argmin())]
        true = pictures[camera.name]
        scores.append(metrics.psnr(_resized(seen[nearest.name], true.shape) / np.float32(255), true))
    return float(np.mean(scores))


def _resized(image: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Resizes an image [H, W, 3] with nearest-neighbour sampling."""
    lines, columns = (np.arange(want) * have // want for want, have in zip(shape[:2], image.shape[:2], strict=True))
    resized: NDArray[np.uint8] = image[lines[:, None], columns[None]]
    return resized
