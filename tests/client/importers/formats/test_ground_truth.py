"""Every layout against ground truth: points projected with the formulas of the format land where the rig sees them.

Each writer makes a file from known cameras, and returns for each camera a function that projects world points [P, 3]
with the format's own formulas to pixels [P, 2], where the upper left corner of the image is (0, 0).
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from lenses import seen
from rigs import vector, write_pictures

from client.importers.open_source import open_source, read_calibration
from scas4d_core.captures import CaptureError

WIDTH, HEIGHT = 320, 240
NAMES = ("cam0", "cam1", "cam2")
POINTS = np.random.default_rng(7).uniform(-0.5, 0.5, (40, 3))


def turned(x, y, z):
    """A rotation [3, 3] about the three axes, in radians."""
    result = np.eye(3)
    for axis, angle in enumerate((x, y, z)):
        c, s = np.cos(angle), np.sin(angle)
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        one = np.eye(3)
        one[i, i], one[i, j], one[j, i], one[j, j] = c, -s, s, c
        result = one @ result
    return result


def poses():
    """World to camera [R, t] of each camera, with OpenCV's axes."""
    return {
        name: (turned(0.3 - 0.2 * i, 0.5 * i - 0.4, 0.2 * i + 0.1), np.array([0.1 * i, -0.05, 3.0 + 0.2 * i]))
        for i, name in enumerate(NAMES)
    }


def brown(x, y, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0):
    """OpenCV's perspective distortion."""
    r = x * x + y * y
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
        y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
    )


def fisheye(x, y, *k):
    """OpenCV's fisheye distortion."""
    r = np.hypot(x, y)
    theta = np.arctan(r)
    bent = theta * (1 + sum(value * theta ** (2 * i + 2) for i, value in enumerate(k)))
    return x * bent / r, y * bent / r


def normalized(points, rotation, translation):
    x, y, z = (points @ rotation.T + translation).T
    assert (z > 0).all()
    return x / z, y / z


def opencv(folder, *, write, first_pixel=0.0, model="brown"):
    """Files in OpenCV's conventions; `write` makes them from rows of (name, K, distortion, R, t)."""
    k = np.array([[211.0, 0, 155.2], [0, 214.5, 122.7], [0, 0, 1]])
    distortion = [0.03, -0.01, 2e-3, -4e-4] if model == "fisheye" else [-0.2, 0.05, 2e-3, -3e-3, 0.01]
    write(folder, [(name, k, distortion, *pose) for name, pose in poses().items()])

    def project(pose):
        def to_pixels(points):
            x, y = normalized(points, *pose)
            if model == "fisheye":
                x, y = fisheye(x, y, *distortion)
            else:
                k1, k2, p1, p2, k3 = distortion
                x, y = brown(x, y, k1, k2, k3, p1, p2)
            return np.stack([k[0, 0] * x + k[0, 2], k[1, 1] * y + k[1, 2]], -1) + 0.5 - first_pixel

        return to_pixels

    return {name: project(pose) for name, pose in poses().items()}


def panoptic(folder):
    def write(folder, rows):
        cameras = [
            {"name": name, "type": "hd", "resolution": [WIDTH, HEIGHT], "panel": 0, "node": i, "K": k.tolist(),
             "distCoef": distortion, "R": r.tolist(), "t": t[:, None].tolist()}
            for i, (name, k, distortion, r, t) in enumerate(rows)
        ]  # fmt: skip
        document = {"calibDataSource": "160422_calib_norm", "cameras": cameras}
        (folder / "calibration_160422_haggling1.json").write_text(json.dumps(document))

    return opencv(folder, write=write, first_pixel=0.5)


def kalibr(model, name):
    def make(folder):
        def write(folder, rows):
            lines, before = [], None
            for camera, k, distortion, r, t in rows:
                pose = np.eye(4)
                pose[:3, :3], pose[:3, 3] = r, t
                lines += [f"{camera}:", "  cam_overlaps: [1, 2]", "  camera_model: pinhole"]
                if before is not None:
                    lines.append("  T_cn_cnm1:")
                    lines += [f"  - {row}" for row in (pose @ np.linalg.inv(before)).tolist()]
                numbers = [*distortion[:4]] if name == "equidistant" else distortion[:4]
                lines += [f"  distortion_coeffs: {numbers}", f"  distortion_model: {name}"]
                lines += [f"  intrinsics: {[k[0, 0], k[1, 1], k[0, 2], k[1, 2]]}".replace("np.float64", "")]
                lines += [f"  resolution: [{WIDTH}, {HEIGHT}]", f"  rostopic: /{camera}/image_raw"]
                before = pose
            (folder / "camchain-rig.yaml").write_text("\n".join(lines).replace("(", "").replace(")", "") + "\n")

        projectors = opencv(folder, write=write, model=model)
        r0, t0 = poses()["cam0"]  # the world is the first camera

        def of(project):
            return lambda points: project((points - t0) @ r0)

        if model == "brown":  # radtan has no k3
            return {name: of(without_k3(pose)) for name, pose in poses().items()}
        return {name: of(project) for name, project in projectors.items()}

    return make


def without_k3(pose):
    def project(points):
        x, y = brown(*normalized(points, *pose), -0.2, 0.05, 0.0, 2e-3, -3e-3)
        return np.stack([211.0 * x + 155.2, 214.5 * y + 122.7], -1) + 0.5

    return project


def ros(model, name):
    """ROS's camera_info with the pose that it lacks."""

    def make(folder):
        def write(folder, rows):
            for camera, k, distortion, r, t in rows:
                lines = [f"image_width: {WIDTH}", f"image_height: {HEIGHT}", f"camera_name: {camera}"]
                for field, values in (("camera_matrix", k), ("distortion_coefficients", np.array([distortion]))):
                    lines += [f"{field}:", f"  rows: {values.shape[0]}", f"  cols: {values.shape[1]}"]
                    lines.append(f"  data: {[float(value) for value in values.ravel()]}")
                lines.insert(-4, f"distortion_model: {name}")
                lines += [f"R: {r.tolist()}", f"T: {t.tolist()}"]
                (folder / f"{camera}.yaml").write_text("\n".join(lines) + "\n")

        return opencv(folder, write=write, model=model)

    return make


def opencv_json(folder):
    def write(folder, rows):
        for camera, k, distortion, r, t in rows:

            def matrix(values):
                values = np.atleast_2d(values)
                return {"type_id": "opencv-matrix", "rows": len(values), "cols": values.shape[1], "dt": "d",
                        "data": values.ravel().tolist()}  # fmt: skip

            document = {"image_width": WIDTH, "image_height": HEIGHT, "cameraMatrix": matrix(k),
                        "distCoeffs": matrix(distortion), "R": matrix(vector(r)), "T": matrix(t)}  # fmt: skip
            (folder / f"{camera}.json").write_text(json.dumps(document, indent=4))

    return opencv(folder, write=write)


def llff(folder):
    """Camera to world, with columns down, right, back; then height, width, focal length."""
    focal, rows, projectors = 210.0, [], {}
    write_pictures(folder / "images", names=NAMES)
    for name, (r, t) in poses().items():
        right, down, forward = r
        matrix = np.stack([down, right, -forward, -r.T @ t, [HEIGHT, WIDTH, focal]], 1)
        rows.append([*matrix.ravel(), 1.0, 10.0])

        def project(points, matrix=matrix):
            x_down, y_right, z_back = ((points - matrix[:, 3]) @ matrix[:, :3]).T
            return np.stack([WIDTH / 2 - focal * y_right / z_back, HEIGHT / 2 - focal * x_down / z_back], -1)

        projectors[name] = project
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return projectors


def metashape(kind):
    """Camera to chunk, then chunk to world by rotation, translation and scale."""

    def make(folder):
        lens = {
            "f": 210.0,
            "cx": -3.7,
            "cy": 2.4,
            "b1": 1.5,
            "k1": -0.2,
            "k2": 0.05,
            "k3": 0.01,
            "p1": 2e-3,
            "p2": -3e-3,
        }
        if kind == "fisheye":
            lens = {"f": 150.0, "cx": -3.7, "cy": 2.4, "b1": 0.5, "k1": 0.03, "k2": -0.01, "k3": 2e-3, "k4": -4e-4}
        turn, shift, scale = turned(0.4, -0.2, 0.7), np.array([2.0, -1.0, 0.5]), 2.5
        world = {name: (r, t) for name, (r, t) in poses().items()}
        cameras, projectors = [], {}
        for i, (name, (r, t)) in enumerate(world.items()):
            to_chunk = np.eye(4)
            to_chunk[:3, :3] = turn.T @ r.T
            to_chunk[:3, 3] = turn.T @ (-r.T @ t - shift) / scale
            text = " ".join(repr(float(value)) for value in to_chunk.ravel())
            camera = f'<camera id="{i}" sensor_id="0" component_id="0" label="{name}.jpg">'
            cameras.append(f"{camera}<transform>{text}</transform></camera>")

            def project(points, to_chunk=to_chunk):
                chunk = (points - shift) @ turn / scale
                x, y, z = ((chunk - to_chunk[:3, 3]) @ to_chunk[:3, :3]).T
                x, y = x / z, y / z
                if kind == "fisheye":
                    r = np.hypot(x, y)
                    x, y = x * np.arctan(r) / r, y * np.arctan(r) / r
                r2 = x * x + y * y
                p1, p2 = lens.get("p1", 0.0), lens.get("p2", 0.0)
                radial = 1 + lens["k1"] * r2 + lens["k2"] * r2**2 + lens["k3"] * r2**3 + lens.get("k4", 0.0) * r2**4
                bent_x = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
                bent_y = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
                u = WIDTH / 2 + lens["cx"] + bent_x * (lens["f"] + lens["b1"])
                return np.stack([u, HEIGHT / 2 + lens["cy"] + bent_y * lens["f"]], -1)

            projectors[name] = project
        cameras.append('<camera id="9" sensor_id="0" label="cam9"/>')
        values = "".join(f"<{key}>{value}</{key}>" for key, value in lens.items())
        numbers = {key: " ".join(repr(float(v)) for v in np.ravel(value)) for key, value in
                   {"rotation": turn, "translation": shift, "scale": scale}.items()}  # fmt: skip
        transform = "".join(f'<{key} locked="0">{value}</{key}>' for key, value in numbers.items())
        (folder / "cameras.xml").write_text(
            '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="rig" enabled="true">'
            f'<sensors next_id="1"><sensor id="0" label="unknown" type="{kind}">'
            f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
            f'<calibration type="{kind}" class="initial"><f>9</f></calibration><calibration type="{kind}" '
            f'class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>{values}</calibration></sensor></sensors>'
            f'<components next_id="1"><component id="0" label="c"><transform>{transform}</transform></component>'
            f'</components><cameras next_id="9"><group id="0">{"".join(cameras)}</group></cameras></chunk></document>'
        )
        return projectors

    return make


def opensfm(kind):
    def make(folder):
        side, lens = max(WIDTH, HEIGHT), {"projection_type": kind, "width": WIDTH, "height": HEIGHT}
        if kind in ("perspective", "fisheye"):
            lens |= {"focal": 0.66, "k1": -0.02, "k2": 0.005}
        else:
            lens |= {"focal_x": 0.66, "focal_y": 0.67, "c_x": 0.01, "c_y": -0.02, "k1": -0.2, "k2": 0.05}
        lens |= {"k3": 0.01, "p1": 2e-3, "p2": -3e-3} if kind == "brown" else {}
        lens |= {"k1": 0.03, "k2": -0.01, "k3": 2e-3, "k4": -4e-4} if kind == "fisheye_opencv" else {}
        shots, projectors = {}, {}
        for name, (r, t) in poses().items():
            shots[f"{name}.jpg"] = {"camera": "v2 x", "rotation": vector(r).tolist(), "translation": t.tolist()}

            def project(points, pose=(r, t)):
                x, y = normalized(points, *pose)
                if "fisheye" in kind:
                    x, y = fisheye(x, y, *(lens.get(f"k{i}", 0.0) for i in range(1, 5)))
                else:
                    x, y = brown(x, y, *(lens.get(key, 0.0) for key in ("k1", "k2", "k3", "p1", "p2")))
                u = lens.get("focal_x", lens.get("focal")) * x + lens.get("c_x", 0.0)
                v = lens.get("focal_y", lens.get("focal")) * y + lens.get("c_y", 0.0)
                # OpenSfM's H: the first pixel's centre is (0, 0)
                return np.stack([side * u + (WIDTH - 1) / 2, side * v + (HEIGHT - 1) / 2], -1) + 0.5

            projectors[name] = project
        small = {"cameras": {"v2 x": lens}, "shots": {"cam0.jpg": shots["cam0.jpg"]}, "points": {}}
        points = {"1": {"coordinates": [0, 0.5, 1], "color": [255, 0, 51]}}
        (folder / "reconstruction.json").write_text(
            json.dumps([small, {"cameras": {"v2 x": lens}, "shots": shots, "points": points}])
        )
        return projectors

    return make


def meshroom(kind, version):
    """AliceVision samples images at whole numbers, so the first pixel's centre is (0, 0)."""

    def make(folder):
        order = {"pinhole": 0, "radial3": 3, "brown": 5, "fisheye4": 4}[kind]
        given = [0.03, -0.01, 2e-3, -4e-4] if kind == "fisheye4" else [-0.2, 0.05, 0.01, 2e-3, -3e-3][:order]
        fx, fy, offset = 211.0, 211.0 if version < (1, 2, 0) else 214.5, (-4.8, 2.7)
        lens = {"intrinsicId": "7", "width": str(WIDTH), "height": str(HEIGHT), "type": kind, "serialNumber": "",
                "distortionParams": [str(value) for value in given] or "", "locked": "false"}  # fmt: skip
        centre = offset if version >= (1, 2, 1) else (offset[0] + WIDTH / 2, offset[1] + HEIGHT / 2)
        lens["principalPoint"] = [str(value) for value in centre]
        if version < (1, 2, 0):
            lens["pxFocalLength"] = str(fx)
        elif version < (1, 2, 2):
            lens["pxFocalLength"] = [str(fx), str(fy)]
        else:
            lens |= {"sensorWidth": "36", "focalLength": str(fx * 36 / WIDTH)}
            lens["pixelRatio"] = str(fx / fy if version < (1, 2, 5) else fy / fx)
        views, pose_list, projectors = [], [], {}
        for i, (name, (r, t)) in enumerate(poses().items()):
            views.append({"viewId": str(i), "poseId": str(i), "intrinsicId": "7", "path": f"/home/x/rig/{name}.jpg"})
            transform = {"rotation": [str(value) for value in r.T.ravel()], "center": [str(v) for v in -r.T @ t]}
            pose_list.append({"poseId": str(i), "pose": {"transform": transform, "locked": "1"}})

            def project(points, pose=(r, t)):
                x, y = normalized(points, *pose)
                x, y = fisheye(x, y, *given) if kind == "fisheye4" else brown(x, y, *given)
                return np.stack([fx * x + WIDTH / 2 + offset[0], fy * y + HEIGHT / 2 + offset[1]], -1) + 0.5

            projectors[name] = project
        views.append({"viewId": "9", "poseId": "9", "intrinsicId": "7", "path": "/home/x/rig/cam9.jpg"})
        document = {
            "version": [str(part) for part in version],
            "views": views,
            "intrinsics": [lens],
            "poses": pose_list,
        }
        (folder / "cameras.sfm").write_text(json.dumps(document))
        return projectors

    return make


def transforms_with_angle(folder):
    """instant-ngp: the angle across the width, and no size."""
    write_pictures(folder / "images", names=NAMES)
    focal, frames, projectors = 210.0, [], {}
    for name, (r, t) in poses().items():
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = r.T @ np.diag([1.0, -1, -1]), -r.T @ t
        frames.append({"file_path": f"images/{name}/000000", "transform_matrix": to_world.tolist()})

        def project(points, to_world=to_world):
            x, y, z = ((points - to_world[:3, 3]) @ to_world[:3, :3]).T  # OpenGL: y up, z back
            return np.stack([WIDTH / 2 - focal * x / z, HEIGHT / 2 + focal * y / z], -1)

        projectors[name] = project
    angle = 2 * np.arctan(WIDTH / 2 / focal)
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return projectors


FORMATS = {
    "panoptic": panoptic,
    "llff": llff,
    "opencv json": opencv_json,
    "instant-ngp": transforms_with_angle,
    "kalibr radtan": kalibr("brown", "radtan"),
    "kalibr equidistant": kalibr("fisheye", "equidistant"),
    "ros plumb_bob": ros("brown", "plumb_bob"),
    "ros equidistant": ros("fisheye", "equidistant"),
    **{f"metashape {kind}": metashape(kind) for kind in ("frame", "fisheye")},
    **{f"opensfm {kind}": opensfm(kind) for kind in ("perspective", "brown", "fisheye", "fisheye_opencv")},
    **{f"meshroom {kind}": meshroom(kind, (1, 2, 6)) for kind in ("pinhole", "radial3", "brown", "fisheye4")},
    **{f"meshroom {version}": meshroom("radial3", version) for version in ((1, 0, 0), (1, 2, 0), (1, 2, 1), (1, 2, 4))},
}


@pytest.mark.parametrize("name", FORMATS)
def test_points_land_where_the_format_puts_them(tmp_path, name):
    if "kalibr" in name or "ros" in name:
        pytest.importorskip("yaml")
    projectors = FORMATS[name](tmp_path)
    points = POINTS
    if "kalibr" in name:  # the world is the first camera
        rotation, translation = poses()["cam0"]
        points = points @ rotation.T + translation
    found = read_calibration(tmp_path)
    assert found.names == NAMES
    for lens in found.cameras:
        assert (lens.width, lens.height) == (WIDTH, HEIGHT)
        assert np.linalg.det(lens.world_to_camera[:3, :3]) == pytest.approx(1)
        wanted = projectors[lens.name](points)
        assert np.abs(seen(lens, points) - wanted).max() < 1e-6
        spread = wanted.max(axis=0) - wanted.min(axis=0)
        assert spread.min() > 20  # the points tell the axes apart


def change(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


PANOPTIC = "calibration_160422_haggling1.json"
METASHAPE, MESHROOM = ("metashape frame", "cameras.xml"), ("meshroom brown", "cameras.sfm")
OPENSFM = ("opensfm fisheye", "reconstruction.json")
SECOND = '"points": {}}, {"cameras": {"v2 x": {"projection_type": '
HUGE = "1" + "0" * 400
KALIBR = ("kalibr radtan", "camchain-rig.yaml")


@pytest.mark.parametrize(
    ("name", "file", "old", "new", "said"),
    [
        ("panoptic", PANOPTIC, '"name": "cam1"', '"name": 7', r"cameras\[1\]: name must be"),
        ("panoptic", PANOPTIC, '"K": [[', '"K": [[[], ', "'cam0': the camera matrix must be 9"),
        (*METASHAPE, "<k3>0.01</k3>", "<k3>0.01</k3><k4>0.2</k4>", "k4 = 0.2 is not supported"),
        (*METASHAPE, "<k3>0.01</k3>", "<k3>0.01</k3><b2>3</b2>", "b2 = 3 is not supported .*optimize"),
        (*METASHAPE, "<k1>-0.2</k1>", "<k1>much</k1>", "k1 must be a finite number; got 'much'"),
        (*METASHAPE, "<f>210.0</f>", "<fx>210.0</fx>", "has no f; export .* 1.2 or later"),
        (*METASHAPE, 'type="frame" class="adj', 'type="spherical" class="adj', "type 'spherical'"),
        (*METASHAPE, "<transform>0", "<transform>0 0", "transform must be 16 finite numbers"),
        (*METASHAPE, '<scale locked="0">2.5', '<scale locked="0">-1', "scale must be positive; got -1"),
        (*METASHAPE, "</document>", "", "cannot be read as XML"),
        (*KALIBR, "radtan", "fov", "cam0: unsupported camera_model 'pinhole' .* 'fov'"),
        (*KALIBR, "intrinsics: [", "intrinsics: [1, ", "cam0: intrinsics must be 4"),
        (
            "ros plumb_bob",
            "cam1.yaml",
            "plumb_bob",
            "thin_prism",
            "cam1.yaml: unsupported distortion_model 'thin_prism'",
        ),
        (*MESHROOM, '"focalLength": "', '"focalLength": "x', "focalLength must be a finite number"),
        (*MESHROOM, "]}", "]", "cameras.sfm is not valid JSON"),
        (*MESHROOM, '"sensorWidth": "36"', '"sensorWidth": "0"', "sensorWidth must be positive; got 0"),
        (*MESHROOM, '"type": "brown"', '"type": ["brown"]', r"unsupported distortion \['brown'\]"),
        ("meshroom (1, 2, 4)", "cameras.sfm", 'Ratio": "', 'Ratio": "-', "pixelRatio must be positive; got -"),
        ("opensfm brown", "reconstruction.json", '"projection_type": "brown"', '"projection_type": "dual"', None),
        (*OPENSFM, f'{SECOND}"fisheye"', f"{SECOND}[]", r"unsupported projection_type \[\]"),
        (*OPENSFM, f'{SECOND}"fisheye", "width": 320', f'{SECOND}"fisheye", "width": {HUGE}', "width must be a finite"),
        (*OPENSFM, 'cam1.jpg": {"camera": "v2 x"', 'cam1.jpg": {"camera": ["v2 x"]', r"camera \['v2 x'\] is not in"),
        (*OPENSFM, '"width": 320', f'"width": {HUGE * 20}', "is not valid JSON"),
        ("panoptic", PANOPTIC, '"resolution": [320', f'"resolution": [{HUGE}', "size must be 2 finite numbers"),
        ("panoptic", PANOPTIC, '"resolution": [320, 240]', '"resolution": "64"', "size must be 2 finite .*got '64'"),
        ("instant-ngp", "transforms.json", '"transform_matrix": [[', f'"transform_matrix": [[{HUGE}, ', "4x4 or 3x4"),
        (*MESHROOM, '"brown"', '"3deradial4"', "unsupported distortion '3deradial4'"),
        (*MESHROOM, '"version": ["1"', '"version": ["x"', "version must be 3 finite numbers"),
        (*MESHROOM, '"intrinsicId": "7", "path"', '"intrinsicId": "8", "path"', "intrinsicId '8' is not"),
        ("instant-ngp", "transforms.json", '"camera_angle_x"', '"angle"', "missing fl_x .*or set camera_angle_x"),
        (
            "instant-ngp",
            "transforms.json",
            '"camera_angle_x": 1',
            '"camera_angle_x": 7',
            "between 0 and 3.14159 radians",
        ),
    ],
)
def test_what_is_wrong_is_named(tmp_path, name, file, old, new, said):
    FORMATS[name](tmp_path)
    change(tmp_path / file, old, new)
    if said is None:  # the smaller reconstruction, which is not read
        assert read_calibration(tmp_path).names == NAMES
        return
    with pytest.raises(CaptureError, match=said) as caught:
        read_calibration(tmp_path)
    assert file in str(caught.value)


def test_rows_of_llff_must_be_as_many_as_cameras(tmp_path):
    llff(tmp_path)
    write_pictures(tmp_path / "images", names=["cam3"])
    with pytest.raises(CaptureError, match=r"poses_bounds.npy has 3 rows, one per camera, but there are 4 images in"):
        read_calibration(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((4, 16)))
    with pytest.raises(CaptureError, match=r"must be an array \[cameras, 17\]; got shape \[4, 16\]"):
        read_calibration(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((4, 17)))
    with pytest.raises(CaptureError, match=r"row 0 \(camera 'cam0'\) must contain a pose and height, width"):
        read_calibration(tmp_path)
    (tmp_path / "poses_bounds.npy").write_bytes(b"no array")
    with pytest.raises(CaptureError, match="cannot be read as a NumPy array"):
        read_calibration(tmp_path)


@pytest.mark.parametrize("shape", ["(10000000000000, 17)", "(3, 17"])
def test_a_damaged_header_of_llff_is_named(tmp_path, shape):
    llff(tmp_path)
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    (tmp_path / "poses_bounds.npy").write_bytes(b"\x93NUMPY\x01\x00v\x00" + header.encode())
    with pytest.raises(CaptureError, match="cannot be read as a NumPy array"):
        read_calibration(tmp_path)


def test_rows_of_llff_belong_to_sorted_file_names(tmp_path):
    """Of `cam.mp4` and `cam-2.mp4`, the second comes first, unlike their names without extension."""
    llff(tmp_path)
    (tmp_path / "images").rename(tmp_path / "other")
    for name in ("cam.mp4", "cam-2.mp4", "dam.mp4"):
        (tmp_path / name).write_bytes(b"")
    by_name = {lens.name: lens.world_to_camera for lens in read_calibration(tmp_path).cameras}
    for name, (rotation, _) in zip(("cam-2", "cam", "dam"), poses().values(), strict=True):
        assert np.allclose(by_name[name][:3, :3], rotation)


def test_rows_of_llff_belong_to_sorted_videos(tmp_path):
    """N3DV and Meet Room: one video a camera beside the file; numbers without zeros sort like text, with a remark."""
    llff(tmp_path)
    (tmp_path / "images").rename(tmp_path / "other")
    for name in ("cam_10.mp4", "cam_2.mp4", "cam_1.mp4"):
        (tmp_path / name).write_bytes(b"")
    found = read_calibration(tmp_path)
    assert found.names == ("cam_1", "cam_2", "cam_10")
    by_name = {lens.name: lens.world_to_camera for lens in found.cameras}
    for name, (rotation, _) in zip(("cam_1", "cam_10", "cam_2"), poses().values(), strict=True):
        assert np.allclose(by_name[name][:3, :3], rotation)
    assert found.remarks == (
        "poses_bounds.npy: its rows are assigned to the cameras in alphabetical order: cam_1, cam_10, cam_2",
    )


def test_flat_pictures_of_llff(tmp_path):
    llff(tmp_path)
    for name in NAMES:
        (tmp_path / "images" / name / "000000.png").rename(tmp_path / "images" / f"{name}.png")
        (tmp_path / "images" / name / "000001.png").unlink()
        (tmp_path / "images" / name).rmdir()
    source = open_source(tmp_path)
    assert (source.rig.names, source.frame_count) == (NAMES, 1)


def test_panoptic_names_frames_and_videos_after_their_cameras(tmp_path):
    pytest.importorskip("cv2")
    panoptic(tmp_path)
    for name in NAMES[:2]:
        write_pictures(tmp_path / "hdImgs", names=[name], frames=[f"{name}_00000100", f"{name}_00000101"])
    source = open_source(tmp_path)
    assert (source.rig.names, source.frame_count) == (NAMES[:2], 2)
    assert source.remarks == ("skipped cameras that have no images in hdImgs: cam2",)


def test_cameras_without_a_pose_are_left_out(tmp_path):
    metashape("frame")(tmp_path)
    assert read_calibration(tmp_path).remarks == (
        "cameras.xml: skipped cameras that are disabled or have no transform: cam9",
    )
    (tmp_path / "cameras.xml").unlink()
    meshroom("pinhole", (1, 2, 6))(tmp_path)
    assert read_calibration(tmp_path).remarks == ("skipped cameras that have no pose: cam9",)
    (tmp_path / "cameras.sfm").unlink()
    panoptic(tmp_path)
    (file,) = tmp_path.glob("*.json")
    change(file, '"R": [', '"Rot": [')
    found = read_calibration(tmp_path)
    assert found.names == NAMES[1:]
    assert found.remarks == (f"{file.name}: skipped cameras that have no pose: cam0",)


def test_a_chain_of_kalibr_ends_where_a_transform_is_missing(tmp_path):
    pytest.importorskip("yaml")
    kalibr("brown", "radtan")(tmp_path)
    change(tmp_path / "camchain-rig.yaml", "T_cn_cnm1", "T_cam_imu")
    found = read_calibration(tmp_path)
    assert found.names == ("cam0",)
    assert found.remarks == ("camchain-rig.yaml: skipped cameras that no T_cn_cnm1 connects with cam0: cam1, cam2",)


def test_of_several_reconstructions_the_largest_is_read_and_all_are_named(tmp_path):
    opensfm("brown")(tmp_path)
    found = read_calibration(tmp_path)
    assert found.remarks == (
        "reconstruction.json: found 2 reconstructions (0 with 1 images, 1 with 3 images); using 1, which has the most "
        "images",
    )
    assert found.points.positions.tolist() == [[0, 0.5, 1]]
    assert np.allclose(found.points.colours, [[1, 0, 0.2]])
    (tmp_path / "reconstruction.json").unlink()
    metashape("frame")(tmp_path)
    change(
        tmp_path / "cameras.xml",
        'sensor_id="0" component_id="0" label="cam0',
        'sensor_id="0" component_id="1" label="cam0',
    )
    change(tmp_path / "cameras.xml", "</components>", '<component id="1" label="d"/></components>')
    found = read_calibration(tmp_path)
    assert found.names == NAMES[1:]
    assert found.remarks[0] == (
        "cameras.xml: found 2 chunks or components (chunk 'rig', component 0 with 2 cameras, chunk 'rig', component 1 "
        "with 1 cameras); using chunk 'rig', component 0, the largest"
    )


def test_unreadable_documents_are_named(tmp_path):
    file = tmp_path / "cam0.xml"
    file.write_text('<?xml version="1.0" encoding="gbk"?><document><chunk/></document>')
    with pytest.raises(CaptureError, match=r"cam0.xml cannot be read as XML \(multi-byte encodings"):
        read_calibration(tmp_path)
    deep = 5000
    file.write_text(f"<opencv_storage><K >{'<a>' * deep}{'</a>' * deep}</K></opencv_storage>")
    with pytest.raises(CaptureError, match=r"cam0.xml: its elements are nested too deeply"):
        read_calibration(tmp_path)
    file.unlink()
    (tmp_path / "calibration.toml").write_text(f"[a]\nmatrix = {'9' * 5000}\n")
    with pytest.raises(CaptureError, match=r"calibration.toml cannot be read as TOML"):
        read_calibration(tmp_path)
    (tmp_path / "rig.json").write_text("5")
    with pytest.raises(CaptureError, match=r"rig.json is no calibration in a known format"):
        read_calibration(tmp_path, tmp_path / "rig.json")


def test_an_image_name_that_is_too_long_is_not_found(tmp_path):
    transforms_with_angle(tmp_path)
    change(tmp_path / "transforms.json", "images/cam0/000000", f"images/cam0/{'x' * 5000}")
    assert read_calibration(tmp_path).names == NAMES  # the size is that of another image of the folder
    assert (
        "camera 'cam0' has no image that belongs to"
        in open_source(tmp_path, pictures="named").usable_frame(0)[1]["cam0"]
    )


def test_an_image_name_of_thousands_of_digits_is_a_name(tmp_path):
    opensfm("brown")(tmp_path)
    change(tmp_path / "reconstruction.json", '"cam1.jpg"', f'"{"9" * 5000}.jpg"')
    assert read_calibration(tmp_path).label("9" * 60) == "9" * 5000
