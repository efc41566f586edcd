from __future__ import annotations

import asyncio
import inspect

import numpy as np
import pytest
from running import HEIGHT, WIDTH, make_rig, pictures

from client.errors import FrameGap
from client.rig import Pace, push
from client.sdk import AsyncClient, Client
from scas4d_core.captures import open_capture


def test_the_rig_simulator_sends_a_capture(service, capture_folder):
    told = []
    with Client(service.url) as client:
        status = push(
            open_capture(capture_folder),
            client,
            on_progress=lambda *now: told.append(now),
            settings={"update": {"seed": 3}},
        ).status
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
        status = push(open_capture(capture_folder), client, pace=Pace(fps=4), frames=3).status
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
            assert (await client.wait(scene.id, 0, every=0.05)).state == "committed"
            view = await client.render(scene.id, make_rig().cameras[1])
            arrays = await client.render_arrays(scene.id, "c0", kinds=["depth"])
            tracks = await client.tracks(scene.id, points=np.zeros((1, 3)))
            parts = await client.parts(scene.id, 2)
            ply = await client.ply(scene.id, 0)
            assert scene.id in [other.id for other in await client.scenes()]
            with pytest.raises(FrameGap, match="gap"):
                await client.put_frame(scene.id, 5, pictures())
            await client.delete_scene(scene.id)
            return view, arrays, tracks, parts, ply

    view, arrays, tracks, parts, ply = asyncio.run(job())
    assert view.shape == (HEIGHT, WIDTH, 3)
    assert arrays["depth"].shape == (HEIGHT, WIDTH)
    assert tracks.ids == [0]
    assert parts.count == 2
    assert ply.startswith(b"ply")


def test_both_clients_have_the_same_methods():
    def public(kind):
        return {name: inspect.signature(getattr(kind, name)) for name in dir(kind) if not name.startswith("_")}

    sync, parallel = public(Client), public(AsyncClient)
    assert sync.keys() == parallel.keys()
    calls = sync.keys() - {"close", "send", "watch", "wait"}
    assert len(calls) > 15
    for name in calls:
        assert sync[name].parameters == parallel[name].parameters
        assert getattr(AsyncClient, name).__doc__ == getattr(Client, name).__doc__ != None  # noqa: E711
    coroutine = AsyncClient("http://x").live()
    assert inspect.iscoroutine(coroutine)
    coroutine.close()


def test_methods_say_what_they_take():
    assert list(inspect.signature(Client("http://x").put_frame).parameters)[:3] == ["id", "index", "images"]
