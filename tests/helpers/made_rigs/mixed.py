"""A rig of unlike cameras around a textured ball that moves: three sizes, a fisheye, grey, 16 bits, a palette."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from scas4d_core.cameras import Camera

RADIUS = 0.5
STEP = np.array([0.04, 0.02, 0.0])
"""Of the ball between two frames."""
SIZES = ((96, 72), (72, 96), (104, 64))
GREY, DEEP, PALETTE, FISHEYE = "c1", "c2", "c3", "c4"
COUNT = 9


def camera(number: int) -> Camera:
    """Camera `number`, 3 units away from the origin."""
    angle, (width, height) = 2 * np.pi * number / COUNT, SIZES[number % 3]
    centre = np.array([3 * np.sin(angle), 0.8 * (-1) ** number, -3 * np.cos(angle)])
    z = -centre / np.linalg.norm(centre)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(z, x), z]
    pose[:3, 3] = -pose[:3, :3] @ centre
    lens = np.array([[110.0 + number, 0, width / 2 + 1], [0, 110.0 + number, height / 2 - 1], [0, 0, 1]])
    return Camera(f"c{number}", lens, pose, width, height)


def seen_by(of: Camera, frame: int, fisheye: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """[H, W, 3] picture in [0, 1] and [H, W] mask; of an equidistant fisheye with the same intrinsics where asked."""
    uv = np.stack(np.meshgrid(np.arange(of.width) + 0.5, np.arange(of.height) + 0.5), -1)
    bent = (uv - of.intrinsics[:2, 2]) / of.intrinsics.diagonal()[:2]
    if fisheye:
        angle = np.linalg.norm(bent, axis=-1, keepdims=True)
        bent = bent * np.tan(angle) / np.maximum(angle, 1e-9)
    rays = np.concatenate([bent, np.ones((*bent.shape[:2], 1))], -1) @ of.rotation
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    from_middle = of.centre - frame * STEP
    along = -(rays @ from_middle)
    inside = RADIUS**2 - (from_middle @ from_middle - along**2)
    mask = inside > 0
    on_it = from_middle + rays * (along - np.sqrt(np.maximum(inside, 0)))[..., None]
    waves = np.sin(on_it @ np.array([[9.0, 4, -3], [-2, 11, 5], [6, -4, 12]]).T + [0.3, 1.1, 2.0])
    return np.where(mask[..., None], 0.5 + 0.4 * waves, 0.15), mask


def write_rig(folder: Path, frames: int = 2) -> Path:
    """Writes the capture: transforms.json, images/ and masks/."""
    entries = []
    for number in range(COUNT):
        of = camera(number)
        for t in range(frames):
            shown, mask = seen_by(of, t, of.name == FISHEYE)
            for kind in ("images", "masks"):
                (folder / kind / of.name).mkdir(parents=True, exist_ok=True)
            Image.fromarray(255 * mask.astype(np.uint8)).save(folder / "masks" / of.name / f"{t}.png")
            path = folder / "images" / of.name / f"{t}.png"
            eight = np.rint(255 * shown).astype(np.uint8)
            if of.name == GREY:
                Image.fromarray(eight).convert("L").save(path)
            elif of.name == DEEP:
                cv2.imwrite(str(path), np.rint(65535 * shown[..., ::-1]).astype(np.uint16))
            elif of.name == PALETTE:
                Image.fromarray(eight).quantize(256).save(path)
            else:
                Image.fromarray(eight).save(path)
        to_world = np.linalg.inv(of.world_to_camera) @ np.diag([1.0, -1, -1, 1])
        entries.append(
            {
                "file_path": f"images/{of.name}/0.png",
                "transform_matrix": to_world.tolist(),
                "camera_model": "OPENCV_FISHEYE" if of.name == FISHEYE else "PINHOLE",
                "w": of.width,
                "h": of.height,
                **{"fl_x": of.fx, "fl_y": of.fy, "cx": of.cx, "cy": of.cy},
            }
        )
    (folder / "transforms.json").write_text(json.dumps({"frames": entries, "fps": 10}))
    return folder
