"""A small rig on disk, as nerfstudio, COLMAP and the tools of laboratories would leave it."""

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


# Tools of laboratories.


def vector(rotation):
    """Rodrigues' vector of a rotation [3, 3] by less than a half turn."""
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    angle = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
    return axis / (2 * np.sin(angle)) * angle if angle > 1e-9 else np.zeros(3)


def opencv_matrix(lens):
    """Its matrix as OpenCV counts pixels: the first centre at (0, 0)."""
    k = lens.intrinsics.copy()
    k[:2, 2] -= 0.5
    return k


def fields(lens, *, rotation=None):
    """The lines of a TOML table of a camera: anipose's, Pose2Sim's, and in the main caliscope's."""
    r = lens.world_to_camera[:3, :3]
    fisheye = ["fisheye = true"] if lens.fisheye else []
    straight = [0.0] * 5
    return [
        f"size = [ {WIDTH}, {HEIGHT},]",
        f"matrix = {opencv_matrix(lens).tolist()}",
        f"distortions = {lens.distortion.tolist() if lens.distortion.any() or lens.fisheye else straight}",
        f"rotation = {(vector(r) if rotation is None else rotation).tolist()}",
        f"translation = {lens.world_to_camera[:3, 3].tolist()}",
        *fisheye,
    ]


def anipose(rig, name="{}"):
    """calibration.toml; `name` makes the names of cameras, as Pose2Sim's int_{}_img."""
    tables = [[f"[cam_{i}]", f'name = "{name.format(n)}"', *fields(lens)] for i, (n, lens) in enumerate(rig.items())]
    return "\n\n".join("\n".join(table) for table in [*tables, ["[metadata]", "adjusted = true", "error = 0.7"]])


def caliscope(lenses, *, key="cam_id", matrices=False, more=""):
    """camera_array.toml of lenses by their numbers."""
    tables = []
    for i, lens in lenses.items():
        rotation = lens.world_to_camera[:3, :3] if matrices else None
        about = [f"[cameras.{i}]", f"{key} = {i}", "rotation_count = 1", "error = 0.4", "ignore = false"]
        tables.append("\n".join([*about, *fields(lens, rotation=rotation)]))
    return "\n\n".join([*tables, more])


def qualisys(rig, *, unit=64, left=0, top=0, model="Miqus Video", doctype=""):
    """A .qca.txt: camera's places in millimetres, OpenGL's axes, subpixels; `left`, `top`: of the recorded window."""
    cameras = []
    for name, lens in rig.items():
        k = opencv_matrix(lens)
        r = np.diag([1.0, -1, -1]) @ lens.world_to_camera[:3, :3]
        x, y, z = 1000 * lens.pinhole().centre
        window = f'left="{left}" top="{top}" right="{left + WIDTH - 1}" bottom="{top + HEIGHT - 1}"'
        k1, k2, p1, p2, k3, *_ = lens.distortion
        entries = " ".join(f'r{i + 1}{j + 1}="{r[i, j]!r}"' for i in range(3) for j in range(3)).replace("np.", "")
        entries = entries.replace("float64(", "").replace(")", "")
        cameras.append(
            f'<camera active="1" serial="{name}" model="{model}" viewrotation="0" avg-residual="0.4">'
            f"<fov_video {window}/>"
            f'<fov_video_max left="0" top="0" right="{WIDTH + 99}" bottom="{HEIGHT + 99}"/>'
            f'<transform x="{float(x)!r}" y="{float(y)!r}" z="{float(z)!r}" {entries}/>'
            f'<intrinsic focallength="9.3" sensorMinU="0" sensorMaxU="{unit * (WIDTH + 99)}" sensorMinV="0" '
            f'sensorMaxV="{unit * (HEIGHT + 99)}" skew="0" '
            f'focalLengthU="{float(unit * k[0, 0])!r}" focalLengthV="{float(unit * k[1, 1])!r}" '
            f'centerPointU="{float(unit * (k[0, 2] + left))!r}" centerPointV="{float(unit * (k[1, 2] + top))!r}" '
            f'radialDistortion1="{float(k1)!r}" radialDistortion2="{float(k2)!r}" radialDistortion3="{float(k3)!r}" '
            f'tangentalDistortion1="{float(p1)!r}" tangentalDistortion2="{float(p2)!r}"/></camera>'
        )
    head = "<?xml version='1.0' encoding='ASCII'?>\n" + doctype
    return f'{head}<calibration source="made up"><cameras>{"".join(cameras)}</cameras></calibration>'


def stored(name, values):
    """A matrix as OpenCV's FileStorage writes it to YAML."""
    values = np.atleast_2d(values)
    listed = ", ".join(f"{value:.17e}" for value in values.ravel())
    return (
        f"{name}: !!opencv-matrix\n   rows: {len(values)}\n   cols: {values.shape[1]}\n   dt: d\n   data: [ {listed} ]"
    )


def easymocap(rig, folder, *, sizes=False, rotations=("R", "Rot"), posed=None):
    """intri.yml and extri.yml."""
    names = "\n".join(["names:", *(f'   - "{name}"' for name in rig)])
    intrinsics, extrinsics = [names], [names]
    for name, lens in rig.items():
        r, t = lens.world_to_camera[:3, :3], lens.world_to_camera[:3, 3]
        intrinsics += [stored(f"K_{name}", opencv_matrix(lens)), stored(f"dist_{name}", lens.distortion[:5])]
        intrinsics += [f"H_{name}: {HEIGHT}", f"W_{name}: {WIDTH}"] if sizes else []
        if posed is None or name in posed:
            extrinsics += [stored(f"R_{name}", vector(r)[:, None])] if "R" in rotations else []
            extrinsics += [stored(f"Rot_{name}", r)] if "Rot" in rotations else []
            extrinsics += [stored(f"T_{name}", t[:, None])]
    folder.mkdir(parents=True, exist_ok=True)
    for file, lines in (("intri.yml", intrinsics), ("extri.yml", extrinsics)):
        (folder / file).write_text("\n".join(["%YAML:1.0", "---", *lines, ""]))


def opencv_file(lens, *, size=True, pose=True):
    """A camera's YAML: the fields of OpenCV's calibration sample, and R and T."""
    lines = [
        stored("camera_matrix", opencv_matrix(lens)),
        stored("distortion_coefficients", lens.distortion[:, None]),
        f"fisheye_model: {int(lens.fisheye)}",
    ]
    lines += [f"image_width: {WIDTH}", f"image_height: {HEIGHT}"] if size else []
    if pose:
        lines += [stored("R", lens.world_to_camera[:3, :3]), stored("T", lens.world_to_camera[:3, 3:])]
    return "\n".join(["%YAML:1.0", "---", 'calibration_time: "now"', *lines, ""])
