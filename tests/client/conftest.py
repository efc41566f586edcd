"""The service of the server's tests, and a capture small enough to be sent in a moment."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from running import HEIGHT, WIDTH, Running, fake_settings, make_rig
from waiting import HANG_S

from client.sdk import Client

FRAMES = 4


@pytest.fixture(autouse=True)
def video_cache(tmp_path_factory, monkeypatch):
    """Keeps indices of test videos out of the user's cache folder."""
    folder = tmp_path_factory.mktemp("videos")
    monkeypatch.setattr("client.importers.video.index.cache_folder", lambda: folder)
    return folder


@pytest.fixture(scope="session")
def service(tmp_path_factory):
    running = Running(fake_settings(tmp_path_factory.mktemp("data")))
    yield running
    running.stop()


@pytest.fixture
def client(service):
    """A client of the service, whose scenes are deleted afterwards."""
    with Client(service.url, busy_timeout=HANG_S) as client:
        yield client
        for status in client.scenes():
            client.delete_scene(status.id)


@pytest.fixture(scope="session")
def capture_folder(tmp_path_factory):
    """Two training cameras and a test camera in the Dynamic3DGaussians layout, with masks and a cloud of 5 points."""
    folder = tmp_path_factory.mktemp("captures") / "tiny"
    cameras = make_rig(3).cameras
    for name, ids in (("train", (0, 1)), ("test", (2,))):
        one = {
            "k": [cameras[i].intrinsics.tolist() for i in ids],
            "w2c": [cameras[i].world_to_camera.tolist() for i in ids],
            "cam_id": list(ids),
        }
        meta = {"w": WIDTH, "h": HEIGHT, **{key: [value] * FRAMES for key, value in one.items()}}
        meta["fn"] = [[f"{i}/{t:06d}.png" for i in ids] for t in range(FRAMES)]
        folder.mkdir(exist_ok=True)
        (folder / f"{name}_meta.json").write_text(json.dumps(meta))
    for i in range(3):
        for kind, mode in (("ims", "RGB"), ("seg", "L")):
            (folder / kind / str(i)).mkdir(parents=True)
            for t in range(FRAMES):
                colour = (t, i, 0) if mode == "RGB" else 1
                Image.new(mode, (WIDTH, HEIGHT), colour).save(folder / kind / str(i) / f"{t:06d}.png")
    data = np.zeros((5, 7), np.float32)
    data[:, 0] = np.arange(5)
    data[:, 3:] = 0.5
    np.savez(folder / "init_pt_cld.npz", data=data)
    return folder
