"""The fake core with pictures: points drawn as discs; they depend on camera, frame and mode."""

from __future__ import annotations

from types import SimpleNamespace

import fakes
import numpy as np

from scas4d_core.cameras import Camera, Rig
from scas4d_core.storage.history import run_now

COUNT = 24
BUMPED_FROM = 5
"""Frame from which the reports say that camera c2 was bumped."""
OFF = tuple(
    f"matching features of camera 'c{number}' are {number + 3}.4 px from their epipolar lines (median of 212), "
    "compared with 0.6 px for the rig: the calibration may be inaccurate, or images may belong to another camera or "
    "time; set static.refine_calibration to refine the calibration using the images of frame 0"
    for number in range(4)
)
"""Warnings of a frame 0 that is a guess (``fakes.GUESSED``), beside the one that says so."""


def make_rig():
    """Six cameras on a ring around the origin, z up, pictures 32 by 24."""
    cameras = []
    for number in range(6):
        angle = 2 * np.pi * number / 6
        eye = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.0])
        z = -eye / np.linalg.norm(eye)
        x = np.cross(z, [0, 0, 1])
        x /= np.linalg.norm(x)
        rotation = np.array([x, np.cross(z, x), z])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
        cameras.append(Camera(f"c{number}", np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), pose, 32, 24))
    return Rig(tuple(cameras))


def positions():
    """[COUNT, 3] on a spiral, so that no two views of it are the same."""
    turn = np.linspace(0, 4 * np.pi, COUNT)
    return np.stack([0.8 * np.cos(turn), 0.8 * np.sin(turn), np.linspace(-0.5, 0.7, COUNT)], axis=1)


def colours():
    return np.stack([np.linspace(0.2, 1, COUNT), np.linspace(1, 0.2, COUNT), np.full(COUNT, 0.5)], axis=1)


class DrawnReconstruction(fakes.FakeReconstruction):
    def commit(self, frame, dropped, notes, defer=run_now):
        fits = {
            name: {"psnr": 32.0 + number, "colour_shift": [0.001, 0, 0], "health": 0.95}
            for number, name in enumerate(frame.images)
        }
        alarms = []
        if frame.index >= BUMPED_FROM:
            fits["c2"] = {"psnr": 21.0, "colour_shift": [0.06, 0.01, -0.02], "health": 0.2}
            alarms = [{"kind": "camera_misfit", "camera": "c2", "evidence": "its picture fits 11.0 dB worse: moved?"}]
            alarms.append({"kind": "light", "camera": None, "evidence": "the pictures are 1.3 times as bright"})
        seconds = {"total": (0.8 + 0.1 * (frame.index % 3)) * self.iterations / fakes.ITERATIONS}
        more = {"cameras": fits, "psnr": 31.0 + np.sin(frame.index), "seconds": seconds, "alarms": alarms}
        if not self.history.indices and next(iter(frame.images.values()))[0, 0, 0] == fakes.GUESSED:
            off = {"miscalibrated": list(make_rig().names[:4]), "warnings": list(OFF)}
            more["calibration"] = {"cameras": {}, **off, "refined": None}
        return super().commit(frame, dropped, {**(notes or {}), **more}, defer)


class DrawnCommitted(fakes.FakeCommitted):
    def render(self, camera, index, *, background, labels=None):
        inside = self.world.camera_to_inside(camera)
        means = self.history.gaussians(index).means
        uv, z = inside.project(means)
        shape = (camera.height, camera.width)
        depth = np.full(shape, np.nan, np.float32)
        nearest = np.full(shape, -1)
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        for number in np.argsort(-z):
            if z[number] > 0:
                disc = np.hypot(columns - uv[number, 0], rows - uv[number, 1]) < 0.09 * inside.fx / z[number]
                depth[disc], nearest[disc] = z[number], number
        met = nearest >= 0
        colour = np.broadcast_to(np.array(background or (0, 0, 0), np.float32), (*shape, 3)).copy()
        colour[met] = colours()[nearest[met]]
        parts = None
        if labels is not None:
            parts = np.where(met, np.asarray(labels)[np.maximum(nearest, 0)] + 1, 0).astype(np.uint8)
        return SimpleNamespace(colour=colour, alpha=met.astype(np.float32), depth=depth, parts=parts)

    def _depth(self, camera, index):
        view = self.render(camera, index, background=(0, 0, 0))
        return view.depth, view.alpha

    def parts(self, count, previous=None):
        return np.arange(COUNT) * (count or 3) // COUNT


def install():
    """Puts this in the place of the core in this process."""
    fakes.install(Reconstruction=DrawnReconstruction, CommittedScene=DrawnCommitted)
