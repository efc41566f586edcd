"""Peak memory of a reconstruction compared with the service's estimate (server/health/estimate.py).

The scene is a ball in the middle of a ring of cameras. Frame 0 and two updates are reconstructed with few iterations,
because memory does not depend on their number. A second study measures a service whose scenes are all asleep: its
memory, and the times to list the scenes and to render a first view.
"""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from client.cli.evaluate import peak_megabytes
from client.wire import RigModel
from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Frame, InitialPoints
from scas4d_core.presets import preset
from server.health.estimate import estimate
from server.settings import ServerSettings
from server.storage.definition import read_definition, write_definition
from server.storage.layout import DataFolder, SceneFolder
from studies.constants import varied
from studies.machine import resident_mb
from studies.running.process import Service


def ring(count: int, size: int) -> Rig:
    """Creates a ring of cameras with square images, 2 m from the origin."""
    lens = np.array([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]])
    cameras = []
    for k in range(count):
        c, s = np.cos(2 * np.pi * k / count), np.sin(2 * np.pi * k / count)
        pose = np.eye(4)
        pose[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
        pose[2, 3] = 2.0
        cameras.append(Camera(f"c{k}", lens, pose, size, size))
    return Rig(tuple(cameras))


def frame(rig: Rig, size: int, index: int, masked: bool) -> Frame:
    """Creates a frame that shows a ball, which moves by one pixel per frame."""
    rows, columns = np.mgrid[:size, :size]
    ball = np.hypot(rows - size / 2, columns - size / 2 - index) < 0.24 * size
    picture = np.zeros((size, size, 3), np.uint8)
    picture[ball] = (np.stack([rows, columns, rows + columns], -1)[ball] % 256).astype(np.uint8)
    images = {name: picture.copy() for name in rig.names}
    return Frame(index, index / 30, images, {name: ball.astype(np.uint8) for name in rig.names} if masked else {})


def measure(cameras: int, size: int, gaussians: int, scale: float, masks: bool) -> dict[str, float]:
    """Returns the measured and estimated peak memory in MB, their ratio, and the number of Gaussians."""
    from scas4d_core.reconstruction import Reconstruction
    from scas4d_core.warm_up import compile_in_processes

    compile_in_processes()  # or the compilers would count
    static = {"iterations": 8, "max_gaussians": gaussians}
    settings = preset("scas4d", {"static": static, "update": {"iterations": 4}, "scene": {"image_scale": scale}})
    rig = ring(cameras, size)
    normals = np.random.default_rng(0).normal(size=(gaussians, 3))
    points = 0.4 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = InitialPoints(points, np.full((gaussians, 3), 0.5, np.float32), None)
    first = frame(rig, size, 0, masks)
    static_scene = "scas4d_core.first_frame.static_scene"
    with varied(f"{static_scene}.INITIAL_SHARE", 1.0), varied(f"{static_scene}.MIN_VIEWS", 0):
        reconstruction = Reconstruction.start(rig, first, settings, points=cloud)  # keeps every requested Gaussian
    for index in (1, 2):
        reconstruction.step(frame(rig, size, index, masks))
    peak = peak_megabytes() or float("nan")
    expected = estimate(RigModel.of(rig), settings, ServerSettings()).worker_mb
    kept = len(reconstruction.history.gaussians(0))
    return {"peak_mb": round(peak), "estimate_mb": round(expected), "ratio": peak / expected, "kept": kept}


def sleeping(scene: Path, count: int, views: int, work: Path) -> dict[str, float]:
    """Copies a scene's folder, starts a service on the sleeping copies, and requests views of some of them.

    Args:
        scene: folder of a scene with committed frames, in the data folder of a service that has stopped.
        count: number of copies.
        views: number of scenes that are woken, one after the other.
        work: data folder; its contents are deleted.

    Returns:
        Memory per scene in MB; seconds from startup until the scenes are listed, for new and for known folders; and
        median and longest seconds until the first view of a scene is rendered.
    """
    shutil.rmtree(work, ignore_errors=True)
    empty, full = work / "empty", DataFolder(work / "full")
    full.scenes.mkdir(parents=True)
    definition, _ = read_definition(SceneFolder(scene))
    names = [f"{number:012x}" for number in range(count)]
    for name in names:
        folder = full.scene(name)
        shutil.copytree(scene, folder.path)
        write_definition(folder, replace(definition, id=name))
        os.utime(folder.journal, (0, 0))  # last used long ago
    megabytes = {}
    for name, data in (("empty", empty), ("new", full.path), ("again", full.path)):
        data.mkdir(exist_ok=True)
        service = Service(data)
        try:
            began = time.perf_counter()
            service.start()
            listed = service.http.get("/v1/scenes").json()["scenes"]
            megabytes[name] = time.perf_counter() - began, resident_mb(service.pid), len(listed)
            waited = [_first_view(service, one) for one in names[:views]] if name == "again" else []
        finally:
            service.stop()
    (_, alone, _), (new, together, counted), (seconds, _, again) = (
        megabytes["empty"],
        megabytes["new"],
        megabytes["again"],
    )
    assert (counted, again) == (count, count), f"{counted} and {again} of {count} scenes are listed"
    return {
        "mb_a_scene": (together - alone) / count,
        "new_list_s": new,
        "list_s": seconds,
        "view_s": float(np.median(waited)),
        "longest_view_s": max(waited),
    }


def _first_view(service: Service, name: str) -> float:
    camera = service.http.get(f"/v1/scenes/{name}").json()["cameras"][0]
    began = time.perf_counter()
    service.http.post(f"/v1/scenes/{name}/render", json={"camera": camera}).raise_for_status()
    waited = time.perf_counter() - began
    service.http.post(f"/v1/scenes/{name}/sleep").raise_for_status()
    return waited
