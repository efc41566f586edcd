from __future__ import annotations

import asyncio

import httpx
import numpy as np
import pytest
from running import HEIGHT, WIDTH, make_rig, pictures

from client.rig import push
from client.sdk import AsyncClient, Client, ServiceError
from scas4d_core.captures import open_capture


def test_the_rig_simulator_sends_a_capture(service, capture_folder):
    told = []
    with Client(service.url) as client:
        status = push(
            open_capture(capture_folder), client, told=lambda *now: told.append(now), settings={"update": {"seed": 3}}
        )
        assert (status.name, status.committed, status.state) == ("tiny", 4, "ready")
        assert status.cameras == ["0", "1"]
        assert status.gaussians == 5  # the cloud came first
        assert status.settings["update"]["seed"] == 3
        assert told[-1] == ("frames", 4, 4)
        assert client.frame(status.id, 3).time == pytest.approx(3 / 30)
        client.delete_scene(status.id)


def test_a_rig_sends_no_faster_than_asked(service, capture_folder):
    with Client(service.url) as client:
        began = asyncio.run(_clock())
        status = push(open_capture(capture_folder), client, fps=4, frames=3)
        assert asyncio.run(_clock()) - began > 0.5
        assert status.committed == 3
        client.delete_scene(status.id)


async def _clock():
    return asyncio.get_running_loop().time()


def test_the_async_client_does_the_same(service):
    async def job():
        async with AsyncClient(service.url) as client:
            scene = await client.create_scene(make_rig(), name="async")
            await client.put_frame(scene.id, 0, pictures())
            while (await client.frame(scene.id, 0)).state != "committed":
                await asyncio.sleep(0.05)
            view = await client.render(scene.id, make_rig().cameras[1])
            arrays = await client.render_arrays(scene.id, "c0", kinds=["depth"])
            tracks = await client.tracks(scene.id, points=np.zeros((1, 3)))
            parts = await client.parts(scene.id, 2)
            ply = await client.ply(scene.id, 0)
            assert scene.id in [other.id for other in await client.scenes()]
            with pytest.raises(ServiceError, match="gap"):
                await client.put_frame(scene.id, 5, pictures())
            await client.delete_scene(scene.id)
            return view, arrays, tracks, parts, ply

    view, arrays, tracks, parts, ply = asyncio.run(job())
    assert view.shape == (HEIGHT, WIDTH, 3)
    assert arrays["depth"].shape == (HEIGHT, WIDTH)
    assert tracks.ids == [0]
    assert parts.count == 2
    assert ply.startswith(b"ply")


class Flaky(httpx.BaseTransport):
    """Answers as it is told, then with 200."""

    def __init__(self, *answers):
        self.answers = list(answers)
        self.requests = []

    def handle_request(self, request):
        self.requests.append(request.method)
        answer = self.answers.pop(0) if self.answers else httpx.Response(200, json=OK)
        if isinstance(answer, Exception):
            raise answer
        return answer


OK = {"scene": "s", "index": 0, "time": 0.0, "identity": "i"}


def flaky(*answers, patience=5.0):
    client = Client("http://nowhere", patience=patience)
    transport = Flaky(*answers)
    client._http = httpx.Client(base_url="http://nowhere", transport=transport)
    return client, transport


def test_frames_are_sent_again_after_broken_connections_and_full_queues():
    busy = httpx.Response(429, headers={"Retry-After": "0"}, json={})
    client, transport = flaky(httpx.ReadError("cut"), busy, httpx.ConnectError("down"), busy)
    assert client.put_frame("s", 0, {"c": b"x"}).identity == "i"
    assert transport.requests == ["PUT"] * 5


def test_creating_a_scene_is_not_sent_twice():
    client, transport = flaky(httpx.ReadError("cut"))
    with pytest.raises(httpx.ReadError):
        client.create_scene(make_rig())
    assert transport.requests == ["POST"]


def test_creating_is_tried_again_where_nothing_was_sent():
    client, transport = flaky(
        httpx.ConnectError("down"), httpx.Response(422, json={"title": "t", "status": 422, "detail": "d"})
    )
    with pytest.raises(ServiceError, match="d"):
        client.create_scene(make_rig())
    assert transport.requests == ["POST", "POST"]


def test_patience_and_tries_end():
    busy = [
        httpx.Response(429, headers={"Retry-After": "0"}, json={"title": "t", "status": 429, "detail": "full"})
    ] * 99
    client, transport = flaky(*busy, patience=0.35)
    with pytest.raises(ServiceError, match="full"):
        client.put_frame("s", 0, {"c": b"x"})
    assert len(transport.requests) < 10
    client, transport = flaky(*[httpx.ConnectError("down")] * 9)
    with pytest.raises(httpx.ConnectError):
        client.put_frame("s", 0, {"c": b"x"})


def test_a_delete_that_was_lost_on_the_way_back_is_done():
    gone = httpx.Response(404, json={"title": "t", "status": 404, "detail": "gone"})
    client, _ = flaky(httpx.ReadError("cut"), gone)
    client.delete_scene("s")
    client, _ = flaky(gone)
    with pytest.raises(ServiceError, match="gone"):
        client.delete_scene("s")


def test_an_answer_of_another_service_is_shown():
    client, _ = flaky(httpx.Response(502, text="<html>bad gateway"))
    with pytest.raises(ServiceError, match="bad gateway"):
        client.scenes()
