"""``scripts/bench drift``: captures with two drifting cameras, with and without pose tracking.

The images of a drifting camera are resampled as if the camera rotated, because resampling for a rotation requires no
depth. One camera rotates horizontally and another one vertically, by a number of pixels per frame, up to a maximum.
Test cameras do not move.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from client.cli.evaluate import Report, settings_record
from client.cli.scores import Column, Row, digest, kept_row, markdown
from client.importers.open_source import open_source
from scas4d_core.cameras import Camera
from scas4d_core.captures import Capture
from scas4d_core.captures.frame import Frame
from scas4d_core.effects.cameras.alignment import pixel_offset, turn_from_pixels, twist_to_matrix
from scas4d_core.effects.cameras.pose_drift import NAME
from scas4d_core.engines.views import CameraArrays
from scas4d_core.metrics.evaluation import measure_pictures
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from studies.machine import core_version, machine
from studies.quality.first_frame import started
from studies.quality.settings import settings_of

COLUMNS = (
    Column("capture", "capture"),
    Column("cameras", "cameras"),
    Column("poses", "poses"),
    Column("updates", "updates", "d"),
    Column("PSNR", "psnr", ".2f"),
    Column("last five", "last", ".2f"),
    Column("off by at the end", "true"),
    Column("found", "found"),
)
WAYS = ("stand", "drift")
"""Behaviour of the cameras: they are fixed, or two of them drift."""
MODES = ("off", "auto")
"""Modes of the effect ``pose_drift`` that are compared."""


def run(
    captures: Sequence[Path],
    out: Path,
    *,
    updates: int = 14,
    pixels: float = 0.3,
    most: float = 4.0,
    changes: Sequence[str] = (),
    again: bool = False,
    report: Report = print,
) -> list[Row]:
    """Updates each capture with and without drift and tracking, prints the table and writes it to ``out/drift.md``.

    Args:
        captures: capture folders.
        out: study folder, which stores each finished run; a second call resumes the study.
        updates: updates per capture.
        pixels: drift of a camera per frame, in pixels of the capture's files.
        most: largest drift, in pixels of the capture's files.
        changes: changes to the settings.
        again: whether to repeat finished runs.
        report: callback that prints progress messages.

    Returns:
        Four rows per capture.
    """
    rows = []
    for folder in captures:
        for way, mode in ((way, mode) for way in WAYS for mode in MODES):
            settings = settings_of("scas4d", None, 0, [*changes, f"effects.{NAME}={mode}"])
            key = digest(settings_record(settings, ()), updates, way, pixels, most)
            path = out / "drift" / f"{folder.resolve().name}-{way}-{mode}-{key}.json"
            drift = (pixels, most) if way == "drift" else (0.0, 0.0)
            known = {"key": path.stem, "cameras": way, "poses": mode}
            row = kept_row(path, partial(_row, known, folder, out, settings, updates, drift), again=again)
            report(f"{row['capture']}, cameras {way}, {NAME} {mode}: {row['psnr']:.2f} dB")
            rows.append(row)
    table = markdown(rows, COLUMNS)
    (out / "drift.md").write_text(table + "\n")
    report(table)
    return rows


def _row(known: Row, folder: Path, out: Path, settings: Settings, updates: int, drift: tuple[float, float]) -> Row:
    row = _played(folder, out, settings, updates, drift)
    return {**known, **row, "settings": settings_record(settings, ()), "core": core_version(), "machine": machine()}


def _played(folder: Path, out: Path, settings: Settings, updates: int, drift: tuple[float, float]) -> Row:
    capture = open_source(folder)
    tests = open_source(folder, image_scale=settings.scene.image_scale)
    scene = started(capture, settings, out)
    names, scores, offsets = capture.rig.names, list[float](), dict[str, NDArray[np.float64]]()
    for index in range(1, min(updates, capture.frame_count - 1) + 1):
        size = min(drift[1], index * drift[0])
        offsets = {names[len(names) // 8]: np.array([size, 0, 0]), names[-len(names) // 3]: np.array([0, size, 0])}
        scene.step(turned(capture, index, offsets if size else {}))
        score = measure_pictures(scene, tests, index)[0]["psnr"]
        scores.append(float("nan") if score is None else score)
    arrays = scene.history.effects(scene.history.indices[-1]).get(NAME, {})
    twists = arrays.get("twists", np.zeros((len(names), 6)))
    offsets_found = {name: _pixels(scene, name, twists[names.index(name)]) for name in offsets}
    scale = settings.scene.image_scale
    return {
        "capture": capture.name,
        "updates": len(scores),
        "psnr": float(np.mean(scores)),
        "last": float(np.mean(scores[-5:])),
        "true": _words({name: scale * offset for name, offset in offsets.items()}),
        "found": _words(offsets_found),
        "followed": [name for name, twist in zip(names, twists, strict=True) if twist.any()],
    }


def _pixels(scene: Reconstruction, name: str, twist: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns [3] pixel offsets in the reconstruction's images, for content as far away as the rig's centre."""
    camera = scene.rig[name]
    return pixel_offset(CameraArrays.of(camera).lens, twist, float(np.linalg.norm(camera.centre)))


def _words(offsets: Mapping[str, NDArray[np.float64]]) -> str:
    return "; ".join(f"{name}: {offset[0]:.2f}, {offset[1]:.2f}" for name, offset in offsets.items())


def turned(capture: Capture, index: int, offsets: Mapping[str, NDArray[np.float64]]) -> Frame:
    """Returns a frame with some cameras rotated by pixels across, down and around the axis (see ``pixel_offset``)."""
    frame = capture.frame(index)
    images, masks = dict(frame.images), dict(frame.masks)
    for name, offset in offsets.items():
        images[name] = _seen(images[name], capture.rig[name], offset, 3)
        if name in masks:
            masks[name] = _seen(masks[name], capture.rig[name], offset, 0)
    return replace(frame, images=images, masks=masks)


def _seen(
    picture: NDArray[np.uint8], camera: Camera, offset: NDArray[np.float64], order: Literal[0, 3]
) -> NDArray[np.uint8]:
    """Resamples an image [H, W] or [H, W, 3] for a rotated camera, using splines and repeated borders."""
    twist = np.concatenate([np.zeros(3), turn_from_pixels(CameraArrays.of(camera).lens) @ offset])
    back = camera.intrinsics @ twist_to_matrix(twist)[:3, :3].T @ np.linalg.inv(camera.intrinsics)
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y, z = np.einsum("ij,jhw->ihw", back, np.stack([u, v, np.ones_like(u)]))
    places = np.stack([y / z - 0.5, x / z - 0.5])
    planes = np.atleast_3d(picture).astype(np.float64)
    planes_seen = [map_coordinates(planes[..., k], places, order=order, mode="nearest") for k in range(planes.shape[2])]
    seen: NDArray[np.uint8] = (
        np.rint(np.clip(np.stack(planes_seen, axis=-1), 0, 255)).astype(np.uint8).reshape(picture.shape)
    )
    return seen
