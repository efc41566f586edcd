"""Slow readers, many readers, dragged cameras: what the stream does when more is wanted than can be sent."""

from __future__ import annotations

import asyncio
import json
from types import SimpleNamespace
from unittest import mock

import pytest
from running import WIDTH, make_rig, pictures
from waiting import HANG_S
from websockets.asyncio.client import connect

from client.wire import CameraModel, RenderRequest
from client.wire.stream import STREAM_PROTOCOL, Subscribed, unpack
from server.problems import Problem
from server.processes import shared_queries
from server.processes.queries import Answer, PartsQuery, RenderQuery
from server.processes.shared_queries import SharedQueries, fingerprint
from server.stream.live_queries import LiveRender
from server.stream.outbox import MAX_UNSENT_REPLIES, Outbox

READERS = 99
FRAMES = 5
LARGE = {"width": 600, "height": 600}
"""4 MB as npz: more than the buffers of a socket hold."""


def run(test):
    asyncio.run(asyncio.wait_for(test, HANG_S))


async def settle():
    for _ in range(50):
        await asyncio.sleep(0)


class Reader:
    """Answers when the test says so."""

    def __init__(self):
        self.asked = []
        self.waiting = []

    async def __call__(self, query):
        self.asked.append(query)
        self.waiting.append(asyncio.get_running_loop().create_future())
        return await self.waiting[-1]

    async def answer(self, body=b"x"):
        self.waiting.pop(0).set_result(Answer(0, body, "image/png"))
        await settle()


def one_at_once(ask):
    with mock.patch.object(shared_queries, "QUERIES_AT_ONCE", 1):
        return SharedQueries(ask)


def question(name):
    return lambda: SimpleNamespace(key=name, query=name)


def test_many_who_ask_the_same_share_one_answer():
    async def test():
        reader = Reader()
        shared = SharedQueries(reader)
        tasks = [asyncio.create_task(shared.answer(question("a"))) for _ in range(100)]
        await settle()
        assert reader.asked == ["a"]
        tasks[0].cancel()  # the one who came first leaves: the others keep their answer
        await reader.answer(b"picture")
        answers = await asyncio.gather(*tasks[1:])
        assert {answer.body for _, answer in answers} == {b"picture"}
        assert (await shared.answer(question("a")))[1].body == b"picture"  # who comes a moment later
        assert reader.asked == ["a"]

    run(test())


def test_no_more_than_so_many_questions_are_with_the_reader_and_nobody_is_passed_over():
    async def test():
        reader = Reader()
        shared = SharedQueries(reader)
        tasks = [asyncio.create_task(shared.answer(question(name))) for name in "abcd"]
        for asked in (["a", "b"], ["a", "b", "c"], ["a", "b", "c", "d"], ["a", "b", "c", "d"]):
            await settle()
            assert reader.asked == asked
            await reader.answer()
        await asyncio.gather(*tasks)

    run(test())


def test_trajectories_and_parts_do_not_stand_before_views():
    async def test():
        reader = Reader()
        shared = one_at_once(reader)
        camera = make_rig().cameras[0]
        view = RenderQuery(camera, 0, ("colour",), "png", (0.0, 0.0, 0.0))
        queries = [PartsQuery(2), PartsQuery(3), view]
        tasks = [asyncio.create_task(shared.answer(question(query))) for query in queries]
        await settle()
        assert reader.asked == [queries[0], view]  # one of each lane
        for _ in queries:
            await reader.answer()
        await asyncio.gather(*tasks)
        assert reader.asked == [queries[0], view, queries[1]]

    run(test())


def test_a_question_that_fails_gives_its_turn_back():
    async def test():
        def raises():
            raise Problem(404, "the frame is gone", remedy="-")

        async def refuses(query):
            raise Problem(503, "too slow", remedy="-")

        shared = one_at_once(refuses)
        for asked in (raises, question("a"), question("a"), raises):
            with pytest.raises(Problem):
                await shared.answer(asked)
        assert shared.asked == 2

    run(test())


def test_equal_questions_have_one_fingerprint():
    def asked(rig, **changes):
        query = {"frame": 1, "kinds": ("colour",), "format": "png", "background": (0.0, 0.0, 0.0), "parts": None}
        return fingerprint(RenderQuery(camera=rig.cameras[0], **query | changes))

    assert asked(make_rig()) == asked(make_rig())
    others = [asked(make_rig(), frame=2), asked(make_rig(), kinds=("depth",)), asked(make_rig().scaled(2))]
    assert len({asked(make_rig()), *others}) == 4


def live_of(reader, outbox):
    rig = make_rig()
    scene = SimpleNamespace(
        id="s", committed=[0], rig=rig, camera=rig.__getitem__, committed_frame=lambda index, field="frame": 0,
        spec=SimpleNamespace(settings=SimpleNamespace(scene=SimpleNamespace(background=(0.0, 0.0, 0.0)))),
    )  # fmt: skip
    return LiveRender("v", scene, one_at_once(reader), outbox)


def test_a_dragged_camera_is_rendered_where_it_is_not_everywhere_it_was():
    async def test():
        reader, outbox, sent = Reader(), Outbox(), []

        async def send(message):
            sent.append(unpack(message)[0])

        live = live_of(reader, outbox)
        tasks = [asyncio.create_task(live.run()), asyncio.create_task(outbox.send_all(send))]
        for tag in range(50):
            camera = CameraModel.of(make_rig().cameras[0].scaled(1 + tag))
            live.set_request(RenderRequest(camera=camera), tag)
            if tag == 0:
                await settle()
        await reader.answer()  # of the first place; the reader had begun it
        assert [query.camera.width for query in reader.asked] == [WIDTH, 50 * WIDTH]
        await reader.answer()
        assert [(head.tag, head.missed) for head in sent] == [(0, 0), (49, 48)]
        for task in tasks:
            task.cancel()

    run(test())


def test_a_slow_reader_asks_for_nothing_more():
    async def test():
        reader, outbox, sent, gate = Reader(), Outbox(), [], asyncio.Event()

        async def send(message):
            await gate.wait()
            sent.append(unpack(message)[0])

        live = live_of(reader, outbox)
        tasks = [asyncio.create_task(live.run()), asyncio.create_task(outbox.send_all(send))]
        live.set_request(RenderRequest(camera="c0"), 0)
        await settle()
        await reader.answer()
        for tag in range(1, 21):
            live.set_request(RenderRequest(camera="c1"), tag)
            await settle()
        assert len(reader.asked) == 1
        gate.set()
        await settle()
        await reader.answer()
        assert [(head.tag, head.missed) for head in sent] == [(0, 0), (20, 19)]
        for task in tasks:
            task.cancel()

    run(test())


def test_a_mailbox_keeps_the_newest_of_each_and_says_what_it_took_the_place_of():
    async def test():
        outbox, sent = Outbox(), []

        async def send(message):
            sent.append(message)

        for number in range(10):
            outbox.put("a", lambda missed, number=number: f"a{number} {missed}")
        outbox.put("b", lambda missed: f"b {missed}", missed=4)
        outbox.put("a", lambda missed: f"a10 {missed}")  # keeps its place before b
        outbox.put("c", lambda missed: "c")
        outbox.drop("c")
        await outbox.reply(Subscribed(id="x"))
        task = asyncio.create_task(outbox.send_all(send))
        await settle()
        assert sent == ['{"type":"subscribed","id":"x"}', "a10 10", "b 4"]
        outbox.put("a", lambda missed: f"again {missed}")
        await settle()
        assert sent[-1] == "again 0"
        task.cancel()

    run(test())


def test_a_client_that_sends_without_reading_is_not_listened_to():
    async def test():
        outbox = Outbox()

        async def flood():
            for number in range(1000):
                await outbox.reply(Subscribed(id=str(number)))

        task = asyncio.create_task(flood())
        await settle()
        assert len(outbox._replies) == MAX_UNSENT_REPLIES
        task.cancel()

    run(test())


def test_a_hundred_subscribers_of_which_one_never_reads(service, sdk, scene):
    """All over real sockets: 99 follow frames and one of three views, one asks for much and sleeps."""
    address = f"ws{service.url.removeprefix('http')}/v1/scenes/{scene}/stream"
    view = CameraModel.of(make_rig().cameras[0]).model_dump()

    def subscribe(id, topic, **request):
        return json.dumps({"type": "subscribe", "id": id, "topic": topic, "request": request})

    async def opened(number, **options):
        socket = await connect(address, subprotocols=[STREAM_PROTOCOL], compression=None, max_size=None, **options)
        camera = {**view, **LARGE} if number == READERS else {**view, "name": str(number // 33)}
        await socket.send(subscribe("f", "frames"))
        await socket.send(subscribe("v", "render", camera=camera, format="npz" if number == READERS else "png"))
        await socket.send(subscribe("s", "scene"))
        return socket

    async def next_frame(socket, reports, views):
        """Reads until both the report and the picture of a new frame are there."""
        before = (len(reports), len(views))
        while len(reports) == before[0] or len(views) == before[1]:
            message = await asyncio.wait_for(socket.recv(), HANG_S)
            if isinstance(message, bytes):
                views.append(unpack(message)[0])
            elif (told := json.loads(message))["type"] == "frame":
                reports.append((told["report"]["index"], told["missed"]))

    async def test():
        readers = await asyncio.gather(*(opened(number) for number in range(READERS)))
        sleeper = await opened(READERS, max_queue=1, ping_interval=None)
        reports, views = [[] for _ in readers], [[] for _ in readers]
        for index in range(FRAMES):
            await asyncio.to_thread(sdk.put_frame, scene, index, pictures())
            await asyncio.gather(*map(next_frame, readers, reports, views))
        for seen, looked in zip(reports, views, strict=True):
            assert seen == [(index, 0) for index in range(FRAMES)]
            assert [head.frame for head in looked] == list(range(FRAMES))
            assert sum(head.missed for head in looked) == 0
        # Three cameras are three renders a frame, and the sleeper costs one at most.
        assert 3 * FRAMES < service.app.state.hub._channels[scene].queries.asked <= 4 * FRAMES
        newest = {}
        while newest.get("f", (0, 0))[0] < FRAMES - 1 or newest.get("v", (0, 0))[0] < FRAMES - 1:
            message = await asyncio.wait_for(sleeper.recv(), HANG_S)
            if isinstance(message, bytes):
                head = unpack(message)[0]
                newest["v"] = (head.frame, newest.get("v", (0, 0))[1] + head.missed)
            elif (told := json.loads(message))["type"] == "frame":
                newest["f"] = (told["report"]["index"], newest.get("f", (0, 0))[1] + told["missed"])
        assert newest["f"][1] > 0  # it missed frames, and knows how many
        assert newest["v"][1] > 0
        await asyncio.gather(*(socket.close() for socket in (*readers, sleeper)))

    run(test())
    assert sdk.scene(scene).committed == FRAMES


def test_subscribers_of_a_scene_are_bounded(service, scene):
    limit = service.app.state.settings.max_subscribers
    address = f"ws{service.url.removeprefix('http')}/v1/scenes/{scene}/stream"

    async def test():
        sockets = [await connect(address, subprotocols=[STREAM_PROTOCOL]) for _ in range(limit)]
        with pytest.raises(Exception, match="429"):
            await connect(address, subprotocols=[STREAM_PROTOCOL])
        await sockets.pop().close()
        for _ in range(100):  # the service hears of it a moment later
            if service.app.state.hub.count(scene) < limit:
                break
            await asyncio.sleep(0.05)
        sockets.append(await connect(address, subprotocols=[STREAM_PROTOCOL]))
        await asyncio.gather(*(socket.close() for socket in sockets))

    run(test())
