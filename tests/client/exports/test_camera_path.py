"""Paths of the camera: what they look at, how they go on between keys, and faults of a file by the field's name."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from export_cases.blob import make_rig
from scipy.spatial.transform import Rotation

from client.exports.video.camera_path import key_pose_path, orbit_path
from client.exports.video.rig_view import RigView
from scas4d_core.cameras import Camera, Rig
from scas4d_core.errors import InputError

LENS = np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
SIZE = (80, 60)


def keyed(tmp_path, document, frames=None):
    file = tmp_path / "keys.json"
    file.write_text(document if isinstance(document, str) else json.dumps(document))
    rig = make_rig()
    return key_pose_path(file, rig, SIZE, frames or {3: 0.0, 5: 0.25, 8: 1.0}, rig["front"])


def placed(time, position, look_at=(0, 0, 0), **more):
    return {"time": time, "position": list(position), "look_at": list(look_at), **more}


def test_a_path_goes_through_its_keys_without_a_jerk(tmp_path):
    places = [(0, 0, -4), (3, -1, -3), (4, 0, 0), (3, 1, 3)]
    times = [0.0, 0.5, 1.5, 2.0]
    path = keyed(tmp_path, {"keys": [placed(t, p, (0.1 * t, 0, 0)) for t, p in zip(times, places, strict=True)]})
    for time, place in zip(times, places, strict=True):
        camera = path(time)
        assert camera.centre == pytest.approx(place, abs=1e-9)
        assert camera.project([0.1 * time, 0, 0])[0] == pytest.approx([40, 30], abs=1e-6)
    centres = np.array([path(t).centre for t in np.arange(0, 2, 0.01)])
    speeds = np.diff(centres, axis=0) / 0.01
    assert np.linalg.norm(np.diff(speeds, axis=0), axis=1).max() < 0.02 * np.linalg.norm(speeds, axis=1).max() * 5
    assert path(-1.0).centre == pytest.approx(places[0])
    assert path(9.0).centre == pytest.approx(places[-1])
    rig_up = RigView.of(make_rig()).up
    assert all(path(t).rotation[1] @ rig_up < -0.5 for t in times)  # upright


def test_the_key_poses_of_the_page_are_a_path(tmp_path):
    page = (Path(__file__).parents[3] / "docs/videos.md").read_text()
    (document,) = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    path = keyed(tmp_path, document, frames={6: 0.1, 7: 2.0})
    assert path(2.0).centre == pytest.approx([1.2, -1.6, 1.8])


def test_poses_turn_the_short_way_and_stay_rotations(tmp_path):
    keys, poses = [], []
    for number, angle in enumerate((0.0, 0.8, 1.1)):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec([0.1, angle, 0]).as_matrix()
        pose[:3, 3] = [number, 2, 3]
        poses.append(pose)
        keys.append({"frame": (3, 5, 8)[number], "world_to_camera": pose.tolist()})
    path = keyed(tmp_path, {"keys": keys})
    for time, pose in zip((0.0, 0.25, 1.0), poses, strict=True):
        assert path(time).world_to_camera == pytest.approx(pose, abs=1e-9)
    middle = path(0.125).rotation
    turned = Rotation.from_matrix(middle @ poses[0][:3, :3].T).magnitude()
    assert 0.2 < turned < 0.7


def test_the_field_of_view_goes_along(tmp_path):
    path = keyed(tmp_path, {"keys": [placed(0, (0, 0, -4), field_of_view=60), placed(2, (1, 0, -4), field_of_view=30)]})
    heights = [2 * np.degrees(np.arctan(30 / path(time).fy)) for time in (0.0, 1.0, 2.0)]
    assert heights[0] == pytest.approx(60)
    assert heights[2] == pytest.approx(30)
    assert 30 < heights[1] < 60


def test_up_may_be_given_and_one_key_is_enough(tmp_path):
    path = keyed(tmp_path, {"up": [0, 0, 3], "keys": [placed(0, (4, 0, 0))]})
    assert path(1.0).to_camera([0, 0, 1])[1] == pytest.approx(-1)  # upwards in the picture
    above = keyed(tmp_path, {"up": [0, 0, 3], "keys": [placed(0, (0, 0, 4))]})(0.0)  # along "up"
    assert above.project([0, 0, 0])[0] == pytest.approx([40, 30])


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ("{", "keys.json: invalid JSON"),
        ({"keys": []}, r"keys.json: keys: list should have at least 1 item"),
        ({"keys": [placed("x", (0, 0, 1))]}, r"keys\[0\].time 'x': input should be a valid number"),
        ({"keys": [placed(0, (0, 1))]}, r"keys\[0\].position: list should have at least 3 items"),
        ({"keys": [placed(0, (0, 1, 0), aim=1)]}, r"keys\[0\].aim 1: extra inputs are not permitted"),
        (
            {"keys": [placed(0, (0, 0, 1)), placed(0, (0, 0, 2))]},
            r"keys\[1\].time 0.0 is not later than keys\[0\]",
        ),
        ({"keys": [{"time": 0, "position": [0, 0, 1]}]}, r"keys\[0\]: position and look_at must be set together"),
        ({"keys": [{"time": 0}]}, r"keys\[0\]: set either position and look_at, or world_to_camera"),
        ({"keys": [placed(0, (0, 0, 1), frame=1)]}, r"keys\[0\]: set either time .* or frame"),
        ({"keys": [placed(0, (0, 0, 0))]}, r"keys\[0\]: position and look_at are the same point"),
        (
            {"keys": [{"frame": 4, "position": [0, 0, 1], "look_at": [0, 0, 0]}]},
            r"keys\[0\].frame 4 is not in the video",
        ),
        (
            {"keys": [{"time": 0, "world_to_camera": np.diag([2.0, 1, 1, 1]).tolist()}]},
            r"keys\[0\].world_to_camera: .* is not a rotation",
        ),
        ({"keys": [placed(0, (0, 0, 1), field_of_view=190)]}, r"keys\[0\].field_of_view 190: .* less than or equal"),
        ({"up": [0, 0, 0], "keys": [placed(0, (0, 0, 1))]}, "up is the zero vector"),
    ],
)
def test_faults_of_a_file_name_their_field(tmp_path, document, said):
    with pytest.raises(InputError, match=said):
        keyed(tmp_path, document)


def test_an_orbit_keeps_its_distance_and_its_target():
    rig = make_rig()
    view = RigView.of(rig)
    path = orbit_path(rig, rig["side"], SIZE, turn=45.0)
    assert path(0.0).centre == pytest.approx(rig["side"].centre)
    assert path(8.0).centre == pytest.approx(rig["side"].centre)
    for time in np.linspace(0, 8, 9):
        camera = path(time)
        assert np.linalg.norm(camera.centre - view.target) == pytest.approx(200)  # centimetres
        assert camera.project(view.target)[0] == pytest.approx([40, 30])


def test_rigs_that_tell_no_point():
    poses = np.stack([np.eye(4)] * 3)
    poses[1, 0, 3], poses[2, 0, 3] = -1, 1
    parallel = RigView.of(Rig(tuple(Camera(str(k), LENS, pose, 64, 48) for k, pose in enumerate(poses))))
    assert parallel.target == pytest.approx([0, 0, 2])  # before them
    one = Rig((Camera("a", LENS, np.eye(4), 64, 48),))
    assert RigView.of(one).target == pytest.approx([0, 0, 2])
    above = np.eye(4)
    above[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # looks along −y, which it takes for up
    assert np.isfinite(orbit_path(Rig((Camera("a", LENS, above, 64, 48),)), one["a"], SIZE, 30)(1.0).centre).all()
