"""Two textured plates that part, seen by four cameras and splatted by a z-buffer: a capture and reconstructions."""

from __future__ import annotations

import json
import types
from pathlib import Path

import numpy as np
from PIL import Image

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.parts import parts
from scas4d_core.query.tracks import tracks_of_pixels, tracks_of_points
from scas4d_core.storage.history import History

FRAMES, WIDTH, HEIGHT = 4, 48, 40
TRAIN, TEST = ("0", "1"), ("2", "3")


def camera(number: int) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = [0.1 * number - 0.15, 0, 3]
    return Camera(str(number), np.array([[60.0, 0, 24], [0, 60, 20], [0, 0, 1]]), pose, WIDTH, HEIGHT)


def plates(t: int) -> np.ndarray:
    """[P, 3]: the left plate travels left, the right one right and back a little."""
    u, v = (g.ravel() for g in np.meshgrid(np.linspace(0, 0.5, 30), np.linspace(-0.4, 0.4, 48)))
    left = np.stack([u - 0.52 - 0.03 * t, v, 0 * u], axis=-1)
    right = np.stack([u + 0.02 + 0.03 * t, v, 0.01 * t + 0 * u], axis=-1)
    return np.vstack([left, right]).astype(np.float32).astype(np.float64)  # as the states will hold them


def which() -> np.ndarray:
    return np.repeat([1, 2], len(plates(0)) // 2)


def colours() -> np.ndarray:
    return np.random.default_rng(0).integers(1, 64, size=(len(plates(0)), 3)) * 3 / 255


def splat(seen_by: Camera, points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every point paints 3×3 pixels with its value, the nearest on top: values [H, W, C] and depth (NaN: empty)."""
    uv, z = seen_by.project(points)
    depth, picture = np.full((HEIGHT, WIDTH), np.nan), np.zeros((HEIGHT, WIDTH, values.shape[1]))
    for i in np.argsort(-z):
        column, row = uv[i].astype(int)
        block = slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2)
        picture[block], depth[block] = values[i], z[i]
    return picture, depth


def write_capture(folder: Path) -> Path:
    """Writes the plates as a capture with ground truth, and returns its folder."""
    for file, names in (("train_meta.json", TRAIN), ("test_meta.json", TEST)):
        cameras = [camera(int(name)) for name in names]
        meta = {
            "w": WIDTH,
            "h": HEIGHT,
            "k": [[c.intrinsics.tolist() for c in cameras]] * FRAMES,
            "w2c": [[c.world_to_camera.tolist() for c in cameras]] * FRAMES,
            "fn": [[f"{name}/{t:06d}.png" for name in names] for t in range(FRAMES)],
            "cam_id": [[int(name) for name in names]] * FRAMES,
        }
        folder.mkdir(exist_ok=True)
        (folder / file).write_text(json.dumps(meta))
    visible = np.zeros((FRAMES, 4, 100), dtype=bool)
    chosen = np.random.default_rng(1).choice(len(plates(0)), 100, replace=False)
    for name in (*TRAIN, *TEST):
        for t in range(FRAMES):
            picture, _ = splat(camera(int(name)), plates(t), np.hstack([colours(), which()[:, None]]))
            labels = picture[..., 3].astype(np.uint8)
            for kind, image in (
                ("ims", (picture[..., :3] * 255).round().astype(np.uint8)),
                ("seg", (labels > 0).astype(np.uint8)),
                *([("gt_parts", labels)] if name in TEST else []),
            ):
                (folder / kind / name).mkdir(parents=True, exist_ok=True)
                Image.fromarray(image).save(folder / kind / name / f"{t:06d}.png")
            uv = camera(int(name)).project(plates(t)[chosen])[0]
            visible[t, int(name)] = ((uv >= 0) & (uv < (WIDTH, HEIGHT))).all(axis=-1)
    np.savez(
        folder / "gt_tracks.npz",
        points=np.stack([plates(t)[chosen] for t in range(FRAMES)]).astype(np.float32),
        part_id=which()[chosen],
        visible=visible,
        colour=colours()[chosen],
    )
    pose = [np.eye(4).tolist()] * FRAMES
    part = {"rigid": True, "static": False, "foreground": True, "pose": pose}
    (folder / "scene.json").write_text(
        json.dumps({"extent": 1.2, "parts": [{"id": 1, "name": "left", **part}, {"id": 2, "name": "right", **part}]})
    )
    return folder


class Perfect:
    """Stands in for Reconstruction: one Gaussian a point, moved as the truth moves, drawn by the same z-buffer."""

    speed = 1.0
    brightness = 1.0
    report = None
    fitted = 0

    @classmethod
    def start(cls, rig, frame, settings, *, points=None, progress=None, static=None, history=None, dropped=None):
        self = cls()
        self.world, self.history = WorldFrame(np.zeros(3)), History()
        self._commit(0)
        self.static = static or StaticResult(self.history.gaussians(0), {}, [0.5, 0.25])
        cls.fitted = cls.fitted + (static is None)
        return self

    def step(self, frame, dropped=None, started=None):
        self._commit(frame.index)
        return types.SimpleNamespace(seconds={"render": 0.5, "losses": 0.25}, moving=2, gaussians=3, alarms=[])

    def _commit(self, t):
        n = len(plates(0))
        means = plates(0) + self.speed * (plates(t) - plates(0))
        self.history.append(t, t / 30, Gaussians(
            means=means.astype(np.float32),
            factors=np.tile(np.diag([0.01, 0.01, 0.001]).astype(np.float32), (n, 1, 1)),
            rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
            opacities=np.full(n, 0.9, np.float32),
            colours=colours().astype(np.float32),
            foreground=np.ones(n, np.float32),
            ids=np.arange(n),
        ))  # fmt: skip

    def render(self, camera, index=None, *, background=(0, 0, 0), labels=None):
        n = len(plates(0))
        values = np.hstack([colours() * self.brightness, (np.zeros(n) if labels is None else labels + 1)[:, None]])
        picture, depth = splat(camera, self.history.gaussians(index).means, values)
        return types.SimpleNamespace(
            colour=picture[..., :3].astype(np.float32),
            depth=depth,
            alpha=np.isfinite(depth).astype(float),
            parts=None if labels is None else picture[..., 3].astype(np.uint8),
        )

    def tracks_of_points(self, points, index, indices):
        return tracks_of_points(self.history, self.world, points, index, indices)

    def tracks_of_pixels(self, camera, uv, index, indices):
        return tracks_of_pixels(self.history, self.world, camera, uv, index, indices, self._depth)

    def with_visibility(self, tracks, camera, index):
        return tracks.with_visibility(self.history, self.world, camera, index)

    def _depth(self, seen_by, at):
        view = self.render(seen_by, at)
        return view.depth, view.alpha

    def parts(self, count=None):
        return parts(self.history, count)


class Slow(Perfect):
    """Follows only half of the motion, and is too dark."""

    speed = 0.5
    brightness = 0.8
