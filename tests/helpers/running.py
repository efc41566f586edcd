"""A real service on a free port of the loopback with a fake in place of the core, small rigs and pictures."""

from __future__ import annotations

import io
import socket
import threading

import fakes
import numpy as np
import uvicorn
from PIL import Image
from waiting import HANG_S, wait_for

from scas4d_core.cameras import Camera, Rig
from server.app import create_app
from server.connections.config import uvicorn_config
from server.problems import Problem
from server.processes.placement import Placement
from server.settings import ServerSettings

WIDTH, HEIGHT = 24, 16


class Running:
    """A uvicorn server in a thread.

    `core` is called first in each of its processes, None: the core itself; `placement` starts them.
    """

    def __init__(self, settings, port=None, ready=True, core=fakes.install, placement=Placement):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = port or free.getsockname()[1]
        self.app = create_app(settings, placement(core))
        config = uvicorn_config(self.app, port=self.port, log_level="error")
        self.server = uvicorn.Server(config)
        self.thread = threading.Thread(target=self.server.run)
        self.thread.start()
        wait_for(lambda: self.server.started and self.recovered(ready))
        self.url = f"http://127.0.0.1:{self.port}"

    def recovered(self, asked):
        try:
            if asked:
                self.app.state.scenes.recovering.check()
        except Problem:
            return False
        return True

    def stop(self):
        self.server.should_exit = True
        self.thread.join(HANG_S)


def fake_settings(folder, **changes):
    """Small limits, so that tests reach them."""
    given = dict(data=folder, queue_frames=2, max_body_mb=2, max_scenes=4, warm_up=False)
    return ServerSettings(**given | changes)


def make_rig(count=2):
    k = np.array([[20.0, 0, WIDTH / 2], [0, 20, HEIGHT / 2], [0, 0, 1]])
    return Rig(tuple(Camera(f"c{i}", k, beside(i), WIDTH, HEIGHT) for i in range(count)))


def beside(number):
    """World to camera: 3 before the origin, micrometres beside one another: two places, with the same pictures."""
    pose = np.eye(4)
    pose[:3, 3] = [-4e-6 * number, 0, 3]
    return pose


def picture(red=0, size=(WIDTH, HEIGHT), format="PNG", mode="RGB", **options):
    file = io.BytesIO()
    Image.new("RGB", size, (red, 10, 20)).convert(mode).save(file, format, **options)
    return file.getvalue()


def pictures(red=0, count=2):
    return {f"c{i}": picture(red) for i in range(count)}


def problem(response, status):
    """The problem document of an error, checked for what every one has."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    document = response.json()
    assert document["status"] == status
    assert document["detail"]
    return document
