"""Every route of the service has a method of the SDK: the service's own description is what is compared with."""

from __future__ import annotations

import inspect
import re

import httpx
import numpy as np
from running import make_rig, picture
from waiting import HANG_S

from client import calls
from client.sdk import Client
from scas4d_core.captures import InitialPoints

POINTS = InitialPoints(np.zeros((1, 3)), np.zeros((1, 3), np.float32))
CALLS = [
    calls.live(),
    calls.ready(),
    calls.ingest_ready(),
    calls.metrics(),
    calls.ticket(),
    calls.share(),
    calls.create_scene(make_rig()),
    calls.estimate(make_rig()),
    calls.scenes(),
    calls.scene("s"),
    calls.rig("s"),
    calls.pause("s"),
    calls.resume("s"),
    calls.begin_again("s", 3),
    calls.edit_scene("s", name="x"),
    calls.put_to_sleep("s"),
    calls.delete_scene("s"),
    calls.put_points("s", POINTS),
    calls.put_frame("s", 7, {"c0": b"x"}),
    calls.put_frames("s", [calls.NewFrame(7, {"c0": b"x"})]),
    calls.put_camera("s", 7, "c0", b"x"),
    calls.close_frame("s", 7),
    calls.declare_missing("s", 7),
    calls.frame("s", 7),
    calls.frames("s"),
    calls.ply("s", 7),
    calls.states("s"),
    calls.begin_export("s", "ply"),
    calls.exports("s"),
    calls.export("s", "e7"),
    calls.export_file("s", "e7"),
    calls.delete_export("s", "e7"),
    calls.picture("s", 7, "c0"),
    calls.render("s", "c0"),
    calls.render_file("s", "c0"),
    calls.render_arrays("s", "c0"),
    calls.tracks("s", ids=[0]),
    calls.tracks_arrays("s", ids=[0]),
    calls.parts("s"),
    calls.joints("s"),
    calls.gaussians("s", [0]),
    calls.budget("s"),
    calls.cluster(),
    calls.set_budget("s", iterations=50),
    calls.tradeoff("s"),
    calls.replay("s"),
    calls.end_replay("s"),
]
AS_AN_ADDRESS = {("GET", "/v1/scenes/{id}/render"), ("GET", "/v1/scenes/{id}/tracks")}
"""The same as a POST beside them, for a browser's address line."""
PAGES = ("/viewer", "/docs", "/openapi.json", "/redoc")


def template(path):
    path = re.sub(r"^/v1/scenes/s\b", "/v1/scenes/{id}", path)
    path = re.sub(r"/exports/e7\b", "/exports/{export}", path)
    path = re.sub(r"/reconstructions/3$", "/reconstructions/{n}", path)
    return re.sub(r"/cameras/c0$", "/cameras/{c}", re.sub(r"/frames/7\b", "/frames/{n}", path))


def test_every_route_has_a_method_and_every_method_a_route(service):
    described = httpx.get(f"{service.url}/openapi.json", timeout=HANG_S).json()["paths"]
    routes = {
        (method.upper(), path)
        for path, methods in described.items()
        for method in methods
        if path != "/" and not path.startswith(PAGES)
    }
    covered = {(call.method, template(call.path)) for call in CALLS}
    assert routes - AS_AN_ADDRESS == covered
    functions = {name for name, value in vars(calls).items() if inspect.isfunction(value)}
    assert functions <= set(dir(Client))
    assert len({id(call) for call in CALLS}) == len(functions)


def test_pause_close_missing_and_listings(service):
    with Client(service.url, busy_timeout=HANG_S) as client:
        scene = client.create_scene(make_rig())
        try:
            assert client.rig(scene.id).names == ("c0", "c1")
            client.put_frame(scene.id, 0, {"c0": picture(), "c1": picture()})
            client.wait(scene.id, 0)
            assert client.pause(scene.id).paused
            assert client.pause(scene.id).paused
            part = client.put_camera(scene.id, 1, "c1", picture(3), time=0.5)
            assert (part.received, part.absent, part.frame) == (["c1"], ["c0"], None)
            assert client.frame(scene.id, 1).state == "open"
            assert client.close_frame(scene.id, 1).time == 0.5
            assert client.declare_missing(scene.id, 2, "lost").error
            assert client.scene(scene.id).state == "paused"
            assert not client.resume(scene.id).paused
            assert client.wait(scene.id, 1).state in ("committed", "failed")
            listed = client.frames(scene.id, first=1)
            assert [(report.index, report.state) for report in listed.frames][1] == (2, "missing")
            assert client.frames(scene.id, limit=1).next == 1
            assert client.live().status == "live"
            assert "# HELP" in client.metrics()
            assert client.ticket().ticket != client.ticket().ticket
            assert client.render_file(scene.id, "c0", format="jpeg").startswith(b"\xff\xd8")
            assert client.tracks_arrays(scene.id, ids=[0])
        finally:
            client.delete_scene(scene.id)
