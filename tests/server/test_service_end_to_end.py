"""The core itself behind the real service: a small, short robot goes in, and comes back as views, tracks and parts."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData
from running import Running

from client import pictures, rig
from client.sdk import Client
from scas4d_core.captures import open_capture
from server.settings import ServerSettings

CAPTURE = Path(__file__).parents[2] / "samples" / "robot"
FRAMES = 3
SETTINGS = {
    "scene": {"image_scale": 0.25},
    "static": {"iterations": 300, "max_gaussians": 2500},
    "update": {"iterations": 30},
}


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    running = Running(ServerSettings(data=tmp_path_factory.mktemp("real")), core=None)
    told = []
    try:
        with Client(running.url) as client:
            delivery = rig.push(
                open_capture(CAPTURE),
                client,
                frames=FRAMES,
                settings=SETTINGS,
                on_progress=lambda *now: told.append(now),
            )
            yield client, delivery.status, told
    finally:
        running.stop()


def test_every_frame_is_committed_with_its_report(pushed):
    client, status, told = pushed
    assert (status.state, status.committed, status.error) == ("ready", FRAMES, None)
    assert told[-1] == ("frames", FRAMES, FRAMES)
    assert len({stage for stage, _, _ in told}) > 1  # the first frame told how far it is
    report = client.frame(status.id, 2)
    assert (report.iterations, report.gaussians) == (30, status.gaussians)
    assert report.psnr > 20
    assert 0 < report.moving <= report.gaussians


def test_held_out_cameras_see_the_robot(pushed):
    client, status, _ = pushed
    capture = open_capture(CAPTURE, image_scale=0.25)
    for index in range(FRAMES):
        for camera in capture.test_rig.cameras:
            true = capture.test_frame(index).images[camera.name]
            score = pictures.psnr(true, client.render(status.id, camera, index))
            black = pictures.psnr(true, np.zeros_like(true))
            assert score > black + 6, (index, camera.name, score, black)


def test_depth_alpha_and_parts_belong_together(pushed):
    client, status, _ = pushed
    camera = open_capture(CAPTURE, image_scale=0.25).test_rig.cameras[0]
    views = client.render_arrays(status.id, camera, kinds=["depth", "alpha", "parts"], parts=3)
    solid = views["alpha"] >= 0.5
    assert 0.02 < solid.mean() < 0.9
    assert np.array_equal(np.isfinite(views["depth"]), solid)
    distance = np.linalg.norm(camera.centre)
    assert np.all(np.abs(views["depth"][solid] - distance) < 0.5 * distance)
    assert set(np.unique(views["parts"])) <= {0, 1, 2, 3}
    assert len(np.unique(views["parts"][solid])) > 1
    labels = client.parts(status.id, 3)
    assert len(labels.labels) == status.gaussians


def test_pixels_are_followed_near_the_truth(pushed):
    client, status, _ = pushed
    capture = open_capture(CAPTURE)
    truth = capture.ground_truth
    tracks = client.tracks(status.id, points=truth.points[0][:64], at=0, project=["0"])
    assert tracks.frames == list(range(FRAMES))
    found = np.array(tracks.positions, dtype=float).swapaxes(0, 1)
    error = np.linalg.norm(found - truth.points[:FRAMES, :64], axis=-1)
    assert np.median(error[0]) < 1e-3
    assert np.median(error[-1]) < 0.1 * capture.extent
    assert np.shape(tracks.pixels["0"]) == (64, FRAMES, 2)


def test_the_ply_holds_every_gaussian(pushed):
    client, status, _ = pushed
    vertex = PlyData.read(io.BytesIO(client.ply(status.id, 1)))["vertex"]
    assert len(vertex) == status.gaussians
    assert np.isfinite(vertex["x"]).all()
