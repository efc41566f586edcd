"""The stream's client against a stand-in of the service that breaks on command."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager

import pytest
from waiting import HANG_S
from websockets.asyncio.server import serve

from client.errors import NotAuthorized, ServiceUnreachable
from client.stream import AsyncStream, ViewEvent, finished_frames, view
from client.wire import ProblemDetails
from client.wire.stream import STREAM_PROTOCOL, BinaryHead, pack

HEAD = BinaryHead(type="render", id="v", missed=0, frame=4, media_type="image/png")


def run(test):
    asyncio.run(asyncio.wait_for(test, HANG_S))


@asynccontextmanager
async def standing_in(handler, **options):
    async with serve(handler, "127.0.0.1", 0, subprotocols=[STREAM_PROTOCOL], **options) as server:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"


def test_after_a_break_everything_is_subscribed_to_again_as_it_was_last():
    taken = []

    async def handler(socket):
        taken.append([])
        wanted = 3 if len(taken) == 1 else 2
        while len(taken[-1]) < wanted:
            taken[-1].append(json.loads(await socket.recv()))
        if len(taken) < 3:
            await socket.close(1012, "restart")
        else:
            await socket.send(pack(HEAD, b"picture"))
            await socket.wait_closed()

    async def test():
        async with standing_in(handler) as url, AsyncStream(url, "s") as stream:
            await stream.subscribe("f", finished_frames())
            await stream.subscribe("v", view("c0"), tag=1)
            await stream.update("v", frame=4, tag=2)
            event = await stream.receive()
            assert isinstance(event, ViewEvent)
            assert (event.frame, event.body) == (4, b"picture")
        assert [message["type"] for message in taken[0]] == ["subscribe", "subscribe", "update"]
        for later in taken[1:]:
            assert [message["id"] for message in later] == ["f", "v"]
            assert later[1]["request"]["frame"] == 4
            assert later[1]["tag"] == 2

    run(test())


def test_a_deleted_scene_ends_the_iteration():
    async def handler(socket):
        await socket.send(json.dumps({"type": "gone", "reason": "the scene was deleted"}))
        await socket.close(4404)

    async def test():
        async with standing_in(handler) as url, AsyncStream(url, "s") as stream:
            assert [event async for event in stream] == []

    run(test())


def test_a_refused_handshake_says_why():
    problem = ProblemDetails(title="Unauthorized", status=401, detail="the service asks for a token")

    def refuse(connection, request):
        response = connection.respond(401, problem.model_dump_json())
        return response

    async def handler(socket):
        raise AssertionError

    async def test():
        async with standing_in(handler, process_request=refuse) as url:
            with pytest.raises(NotAuthorized, match="asks for a token"):
                await AsyncStream(url, "s").__aenter__()

    run(test())


def test_nobody_there_is_waited_for_and_then_given_up():
    async def test():
        with pytest.raises(ServiceUnreachable, match="cannot be reached"):
            await AsyncStream("http://127.0.0.1:1", "s", outage=0.5).__aenter__()

    run(test())


def test_the_token_goes_in_a_header_and_the_scene_is_quoted():
    seen = []

    async def handler(socket):
        seen.append((socket.request.path, socket.request.headers.get("Authorization")))

    async def test():
        async with standing_in(handler) as url, AsyncStream(url, "a/b", token="secret"):
            pass
        assert seen == [("/v1/scenes/a%2Fb/stream", "Bearer secret")]

    run(test())
