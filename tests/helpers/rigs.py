"""A small rig on disk, as nerfstudio or COLMAP would leave it."""

from __future__ import annotations

import json

import numpy as np
from lenses import HEIGHT, LENSES, WIDTH, camera, pose
from PIL import Image

from client.importers.lens import MODELS

FLIP = np.diag([1.0, -1, -1, 1])
NAMES = ("cam2", "cam10", "cam1")
"""In no order: cameras are sorted naturally."""


def lenses(model="OPENCV"):
    return {name: camera(model, name, pose(0.2 * i - 0.2)) for i, name in enumerate(NAMES)}


def transforms(rig, model="OPENCV", world=None, scale=1.0, per_frame=False, path="images/{}/000000.jpg", **changes):
    """The document; `world` is an applied_transform [4, 4]."""
    parameters = dict(LENSES[model])
    fl = parameters.pop("f", None)
    numbers = {
        "camera_model": model,
        "w": WIDTH,
        "h": HEIGHT,
        "fl_x": parameters.pop("fx", fl),
        "fl_y": parameters.pop("fy", fl),
        **parameters,
    }
    frames = []
    for name, lens in rig.items():
        to_world = np.linalg.inv(lens.world_to_camera) @ FLIP
        to_world = (np.eye(4) if world is None else world) @ to_world
        to_world[:3, 3] *= scale
        frame = {"file_path": path.format(name), "transform_matrix": to_world.tolist()}
        frames.append(frame | numbers if per_frame else frame)
    meta = {"frames": frames} if per_frame else {**numbers, "frames": frames}
    if world is not None:
        meta["applied_transform"] = world[:3].tolist()
    if scale != 1:
        meta["applied_scale"] = scale
    return meta | changes


def write(path, document):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return path


def write_pictures(folder, names=NAMES, frames=("000000", "000001"), end=".png", size=(WIDTH, HEIGHT)):
    for i, name in enumerate(names):
        (folder / name).mkdir(parents=True, exist_ok=True)
        for t, frame in enumerate(frames):
            Image.new("RGB", size, (40 * i, 40 * t, 99)).save(folder / name / f"{frame}{end}")


def colmap_model(rig, folder, name, binary, points=3, path="{}.jpg", parameters=None):
    """A model of the rig in `folder`, one COLMAP camera a camera."""
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    for number, (of, lens) in enumerate(rig.items(), 1):
        values = parameters if parameters is not None else [LENSES[name].get(key, 0.0) for key in MODELS[name]]
        colmap = pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=values, camera_id=number)
        reconstruction.add_camera_with_trivial_rig(colmap)
        pose = pycolmap.Rigid3d(lens.world_to_camera[:3])
        image = pycolmap.Image(name=path.format(of), camera_id=number, image_id=number)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.0, 2.0]))] * number)
        reconstruction.add_image_with_trivial_frame(image, pose)
    for number in range(points):
        reconstruction.add_point3D(np.array([number, 0.5, -1.0]), pycolmap.Track(), np.array([255, 51 * number, 0]))
    folder.mkdir(parents=True, exist_ok=True)
    reconstruction.write_binary(folder) if binary else reconstruction.write_text(folder)
    return folder
