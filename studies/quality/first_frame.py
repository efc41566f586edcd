"""Frame 0, fitted once and shared by all rows of a capture with the same inputs.

Rows then differ only in their updates, and frame 0 is fitted only for the first row.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import fields
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from scas4d_core.cameras import Rig
from scas4d_core.captures import Capture
from scas4d_core.effects.evidence import Evidence
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History

VERSION = 5
"""Version of the fit of frame 0. Increase it if the result changes for the same images and settings."""

CLOUD_VERSION = 4
"""Version of the initial point clouds computed from images. Increase it if they change."""

ARRAYS = tuple(field.name for field in fields(Gaussians))


def first_frame_key(capture: Capture, settings: Settings) -> str:
    """Returns the key of a capture's frame 0, computed from its cameras, images, masks, points and settings.

    Args:
        capture: capture as passed to the method, without withheld inputs.
        settings: complete settings, of which only those of the scene and of frame 0 matter.
    """
    hasher = hashlib.sha256()
    described = [VERSION, settings.scene.model_dump(mode="json"), settings.static.model_dump(mode="json")]
    hasher.update(json.dumps(described, sort_keys=True).encode())
    for camera in capture.full_rig.cameras:
        hasher.update(f"{camera.name} {camera.width} {camera.height}".encode())
        hasher.update(camera.intrinsics.tobytes() + camera.world_to_camera.tobytes())
    for kind, files in (("image", capture.encoded_image), ("mask", capture.encoded_mask)):
        for name in sorted(capture.full_rig.names):
            data = files(0, name)
            hasher.update(b"" if data is None else f"{kind} {name} ".encode() + data)
    if capture.points is None:
        hasher.update(f"cloud {CLOUD_VERSION}".encode())
    else:
        for array in (capture.points.positions, capture.points.colours, capture.points.foreground):
            hasher.update(b"points" if array is None else array.tobytes())
    return f"{capture.name}-{hasher.hexdigest()[:12]}"


def load_first_frame(path: Path) -> tuple[StaticResult, float] | None:
    """Returns a stored frame 0 and its fitting time in seconds, or None if it is not stored."""
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in ARRAYS if name in file}  # arrays that are None are not stored
        names, exposures = file["exposure_names"].tolist(), file["exposures"]
        rows = zip(*(file[f"evidence_{name}"].tolist() for name in ("names", "shares", "texts")), strict=True)
        evidence = {name: Evidence(share, text) for name, share, text in rows}
        losses = file["losses"].tolist()
        result = StaticResult(Gaussians(**arrays), dict(zip(names, exposures, strict=True)), losses, evidence=evidence)
        return result, float(file["seconds"])


def save_first_frame(path: Path, result: StaticResult, seconds: float) -> None:
    """Atomically stores a frame 0 and its fitting time in seconds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names, evidence = sorted(result.exposures), result.evidence or {}
    beside = path.with_suffix(f".{os.getpid()}.part")
    arrays: dict[str, Any] = {
        "exposure_names": np.array(names, dtype=np.str_),
        "exposures": np.array([result.exposures[name] for name in names], np.float32).reshape(-1, 3, 2),
        "losses": np.array(result.losses),
        "evidence_names": np.array(list(evidence), dtype=np.str_),
        "evidence_shares": np.array([one.share for one in evidence.values()]),
        "evidence_texts": np.array([one.text for one in evidence.values()], dtype=np.str_),
        "seconds": np.float64(seconds),
        **result.gaussians.arrays(),
    }
    with beside.open("wb") as file:
        np.savez(file, **arrays)
    beside.replace(path)


def first_of(capture: Capture, out: Path, settings: Settings) -> StaticResult:
    """Returns frame 0 from a study folder, fitting and storing it on first use.

    Each mode of the gloss effect (``direction``) has its own frame 0.
    """
    key = first_frame_key(capture, settings)
    gloss = settings.effects.get("direction", "auto")
    path = out / "first" / f"{key}{'' if gloss == 'auto' else f'-direction-{gloss}'}.npz"
    result = load_first_frame(path)
    if result is None:
        began = perf_counter()
        scene = Reconstruction.start(capture.rig, capture.frame(0), settings, points=capture.points)
        assert scene.static is not None
        save_first_frame(path, scene.static, perf_counter() - began)
        result = load_first_frame(path)
        assert result is not None
    return result[0]


def started(capture: Capture, settings: Settings, out: Path, states: Path | None = None) -> Reconstruction:
    """Returns a reconstruction after frame 0, which is read from the study or fitted and stored on first use.

    Args:
        capture: capture to reconstruct.
        settings: reconstruction settings.
        out: study folder.
        states: empty folder for committed states; None to keep them in memory.
    """
    static = first_of(capture, out, settings)
    history = History() if states is None else History.open(states)
    return Reconstruction.start(
        capture.rig, capture.frame(0), settings, points=capture.points, static=static, history=history
    )


def continued(states: Path, copy: Path, rig: Rig, settings: Settings) -> Reconstruction:
    """Returns a reconstruction that continues committed states in a copy of their folder.

    On the device that committed them, it continues bit-identically.

    Args:
        states: folder of the committed states, which is left unchanged.
        copy: folder of the copy; its contents are deleted.
        rig: cameras of the reconstruction.
        settings: reconstruction settings.
    """
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(states, copy)
    scene = Reconstruction.resume(rig, settings, History.open(copy))
    assert scene.resumed is not None
    assert not scene.resumed.cold  # otherwise, the motion and the usual values of the cameras would be missing
    return scene
