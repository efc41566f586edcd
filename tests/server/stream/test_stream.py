from __future__ import annotations

import json

import numpy as np
import pytest
from running import HEIGHT, WIDTH, make_rig, pictures
from waiting import HANG_S
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from client.errors import InvalidRequest, NotFound
from client.stream import (
    StatesEvent,
    Stream,
    TracksEvent,
    ViewEvent,
    finished_frames,
    live_states,
    parts,
    scene_changes,
    tracks,
    view,
)
from client.wire.stream import MAGIC, STREAM_PROTOCOL, BinaryHead, FrameMessage, SceneMessage, pack, unpack
from scas4d_core.compact import CompactReader
from server.counters import FRAME_LATENCY


@pytest.fixture
def stream(service, scene):
    with Stream(service.url, scene) as opened:
        yield opened


def raw(service, scene, **options):
    address = f"ws{service.url.removeprefix('http')}/v1/scenes/{scene}/stream"
    return connect(address, **{"subprotocols": [STREAM_PROTOCOL], "compression": None, "max_size": None, **options})


def reply(socket):
    """The next message that answers one of ours: a change of the scene may arrive at any time."""
    while (message := json.loads(socket.recv(timeout=HANG_S)))["type"] == "scene":
        pass
    return message


def push(sdk, scene, frames, **options):
    for index in frames:
        sdk.put_frame(scene, index, pictures(**options))
    return sdk.wait(scene, frames[-1])


def until(stream, wanted):
    """Events up to and with the first that is wanted."""
    events = []
    while not (events and wanted(events[-1])):
        events.append(stream.receive(HANG_S))
        assert events[-1] is not None
    return events


def corner(event):
    """Which frame the fake's picture is of."""
    return round(float(event.picture()[0, 0, 0]) / 25.5)


def test_the_scene_as_it_changes_and_frames_with_their_metrics(sdk, scene, stream):
    stream.subscribe("s", scene_changes())
    assert until(stream, lambda e: True)[0].status.state == "awaiting_first_frame"
    stream.subscribe("f", finished_frames())
    push(sdk, scene, range(3))
    # Whichever of the two comes first: a report in the place of an unsent one goes before a status behind that.
    seen = set()

    def both(event):
        seen.add(isinstance(event, FrameMessage) and event.report.index == 2)
        if isinstance(event, SceneMessage) and event.status.committed == 3 and event.status.state == "ready":
            seen.add("status")
        return {True, "status"} <= seen

    events = until(stream, both)
    reports = [event.report for event in events if isinstance(event, FrameMessage)]
    assert sum(event.missed for event in events if isinstance(event, FrameMessage)) + len(reports) == 3
    assert (reports[-1].state, reports[-1].psnr, reports[-1].seconds["update"]) == ("committed", 31.5, 0.01)
    last = [event.status for event in events if isinstance(event, SceneMessage)][-1]
    assert (last.committed, last.queued, last.id) == (3, 0, scene)


def test_a_frame_that_was_set_aside_is_told_too(sdk, scene, stream):
    stream.subscribe("f", finished_frames())
    push(sdk, scene, [0])
    sdk.put_frame(scene, 1, pictures(250))  # the fake raises
    told = until(stream, lambda e: e.report.index == 1)[-1].report
    assert told.state == "failed"
    assert "told to raise" in told.error


def test_a_view_follows_the_newest_frame(sdk, scene, stream):
    camera = make_rig().cameras[0].scaled(2)
    stream.subscribe("v", view(camera, format="png"), tag=7)  # before there is any frame: it waits
    for index in range(3):
        push(sdk, scene, [index])
        event = until(stream, lambda e, index=index: e.frame == index)[-1]
        assert isinstance(event, ViewEvent)
        assert (event.id, event.tag, event.media_type) == ("v", 7, "image/png")
        assert event.picture().shape == (2 * HEIGHT, 2 * WIDTH, 3)
        assert corner(event) == index


def test_a_view_is_moved_in_time_and_space(sdk, scene, stream):
    push(sdk, scene, range(3))
    stream.subscribe("v", view("c0", 0, format="png"), tag=1)
    assert corner(until(stream, lambda e: True)[-1]) == 0
    stream.update("v", frame=1, tag=2)
    moved = until(stream, lambda e: e.tag == 2)[-1]
    assert (moved.frame, corner(moved)) == (1, 1)
    stream.update("v", camera=make_rig().cameras[1].scaled(3), frame=None, tag=3)
    moved = until(stream, lambda e: e.tag == 3)[-1]
    assert (moved.frame, moved.picture().shape) == (2, (3 * HEIGHT, 3 * WIDTH, 3))
    stream.update("v", kinds=["depth"], format="png", tag=4)
    moved = until(stream, lambda e: e.tag == 4)[-1]
    assert (moved.headers["x-depth-near"], moved.headers["x-depth-far"]) == ("2.0", "4.0")


def test_tracks_come_whole_first_and_then_go_on(sdk, scene, stream):
    push(sdk, scene, range(2))
    stream.subscribe("t", tracks(ids=[1], project=["c0"]))
    first = until(stream, lambda e: isinstance(e, TracksEvent))[-1]
    assert (first.first, first.frame, first.model().frames) == (0, 1, [0, 1])
    push(sdk, scene, [2])
    later = until(stream, lambda e: True)[-1]
    assert (later.first, later.frame) == (2, 2)
    whole = sdk.tracks(scene, ids=[1], project=["c0"])
    assert [*first.model().positions[0], *later.model().positions[0]] == whole.positions[0]
    stream.update("t", ids=[0], tag=5)
    again = until(stream, lambda e: e.tag == 5)[-1]
    assert (again.first, again.model().ids) == (0, [0])


def test_parts_come_every_so_many_frames(sdk, scene, stream):
    push(sdk, scene, [0])
    stream.subscribe("p", parts(2, every=2))
    stream.subscribe("f", finished_frames())
    assert until(stream, lambda e: e.id == "p")[-1].model().labels == [0, 1]
    push(sdk, scene, [1])
    push(sdk, scene, [2])
    frames = [event.frame for event in until(stream, lambda e: e.id == "p" and e.frame == 2) if event.id == "p"]
    assert frames == [2]


def test_nothing_comes_after_unsubscribing(sdk, scene, service):
    with raw(service, scene) as socket:
        assert json.loads(socket.recv(timeout=HANG_S))["type"] == "hello"
        for id in ("a", "b"):
            socket.send(json.dumps({"type": "subscribe", "id": id, "topic": "frames"}))
        socket.send(json.dumps({"type": "unsubscribe", "id": "a"}))
        replies = [json.loads(socket.recv(timeout=HANG_S)) for _ in range(3)]
        assert [(r["type"], r["id"]) for r in replies] == [
            ("subscribed", "a"),
            ("subscribed", "b"),
            ("unsubscribed", "a"),
        ]
        push(sdk, scene, [0])
        assert json.loads(socket.recv(timeout=HANG_S))["id"] == "b"


def test_a_deleted_scene_ends_its_streams(sdk, service):
    scene = sdk.create_scene(make_rig()).id
    with Stream(service.url, scene) as stream, raw(service, scene) as socket:
        stream.subscribe("s", scene_changes())
        assert stream.receive(HANG_S).status.id == scene
        sdk.delete_scene(scene)
        assert all(isinstance(event, SceneMessage) for event in stream)  # and it ends
        socket.recv(timeout=HANG_S)
        assert json.loads(socket.recv(timeout=HANG_S))["type"] == "gone"
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=HANG_S)
        assert closed.value.rcvd.code == 4404


MESSAGES = [
    ("{", "message"),
    (b"\x00", "message"),
    ('{"type":"subscribe","id":"a"}', "topic"),
    ('{"type":"shout","id":"a"}', "message"),
    ('{"type":"subscribe","id":"a","topic":"weather"}', "topic"),
    ('{"type":"subscribe","id":"","topic":"scene"}', "id"),
    ('{"type":"subscribe","id":"a","topic":"scene","request":{"frame":1}}', "request.frame"),
    ('{"type":"subscribe","id":"a","topic":"render","request":{}}', "request.camera"),
    ('{"type":"subscribe","id":"a","topic":"render","request":{"camera":"c0","frame":-1}}', "request.frame"),
    ('{"type":"subscribe","id":"a","topic":"parts","request":{"every":0}}', "request.every"),
    ('{"type":"update","id":"nobody","request":{}}', "id"),
    ('{"type":"unsubscribe","id":"nobody"}', "id"),
    ('{"type":"update","id":"scene","request":{}}', "id"),
    ('{"type":"update","id":"view","request":{"camera":{"name":"x"}}}', "request.camera"),
]


@pytest.mark.parametrize(("message", "field"), MESSAGES)
def test_a_bad_message_is_answered_by_name_and_changes_nothing(service, scene, message, field):
    with raw(service, scene) as socket:
        socket.recv(timeout=HANG_S)
        for id, topic, request in (("scene", "scene", {}), ("view", "render", {"camera": "c0"})):
            socket.send(json.dumps({"type": "subscribe", "id": id, "topic": topic, "request": request}))
        assert [reply(socket)["type"] for _ in range(2)] == ["subscribed", "subscribed"]
        socket.send(message)
        error = reply(socket)
        assert error["type"] == "error"
        assert field in error["problem"]["field"]
        assert error["problem"]["remedy"]
        assert 400 <= error["problem"]["status"] < 500
        socket.send(json.dumps({"type": "unsubscribe", "id": "view"}))
        assert reply(socket) == {"type": "unsubscribed", "id": "view"}


def test_what_cannot_be_rendered_is_an_error_of_its_subscription(sdk, scene, stream):
    push(sdk, scene, [0])
    stream.subscribe("v", view("c7"), tag=1)
    with pytest.raises(InvalidRequest, match="c7"):
        stream.receive(HANG_S)
    stream.update("v", camera="c0", frame=9, tag=2)
    with pytest.raises(NotFound, match="frame 9"):
        stream.receive(HANG_S)
    stream.subscribe("t", tracks(ids=[99]))  # only the reader knows
    with pytest.raises(InvalidRequest, match="99"):
        stream.receive(HANG_S)
    stream.update("v", frame=0, format="png", tag=3)
    assert until(stream, lambda e: e.tag == 3)[-1].frame == 0


def test_a_message_that_is_too_large_ends_the_stream(service, scene):
    with raw(service, scene) as socket:
        limit = json.loads(socket.recv(timeout=HANG_S))["limits"]["message_bytes"]
        socket.send(json.dumps({"type": "subscribe", "id": "x" * limit, "topic": "scene"}))
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=HANG_S)
        assert closed.value.rcvd.code == 1009


def test_subscriptions_of_one_client_are_bounded(service, scene):
    with raw(service, scene) as socket:
        limit = json.loads(socket.recv(timeout=HANG_S))["limits"]["subscriptions"]
        for number in range(limit + 1):
            socket.send(json.dumps({"type": "subscribe", "id": str(number), "topic": "frames"}))
        replies = [json.loads(socket.recv(timeout=HANG_S)) for _ in range(limit + 1)]
        assert [reply["type"] for reply in replies] == ["subscribed"] * limit + ["error"]
        assert replies[-1]["problem"]["status"] == 429
        socket.send(json.dumps({"type": "subscribe", "id": "0", "topic": "scene"}))  # in the place of the one before
        assert json.loads(socket.recv(timeout=HANG_S)) == {"type": "subscribed", "id": "0"}


def test_the_handshake_is_refused_with_a_reason(service, scene):
    for id, options, status, words in (
        ("nobody", {}, 404, "no scene"),
        (scene, {"subprotocols": None}, 400, "scas4d.stream.v1"),
        (scene, {"subprotocols": ["scas4d.stream.v9"]}, 400, "scas4d.stream.v1"),
    ):
        with pytest.raises(InvalidStatus) as refused:
            raw(service, id, **options)
        assert refused.value.response.status_code == status
        assert words in refused.value.response.body.decode()
    with pytest.raises(NotFound):
        Stream(service.url, "nobody").__enter__()


def test_a_binary_message_is_read_back_and_damage_is_noticed():
    head = BinaryHead(type="render", id="v", missed=3, frame=2, media_type="image/png")
    message = pack(head, b"pixels")
    assert message.startswith(MAGIC)
    assert unpack(message) == (head, b"pixels")
    for damaged in (b"", b"S4D", b"XXXX" + message[4:], message[:20]):
        with pytest.raises(ValueError, match="binary message"):
            unpack(damaged)


def test_a_picture_is_as_over_http(sdk, scene, stream):
    push(sdk, scene, [0])
    stream.subscribe("v", view("c1", format="png", background=(0.0, 0.0, 1.0)))
    event = until(stream, lambda e: True)[-1]
    assert np.array_equal(event.picture(), sdk.render(scene, "c1", background=(0.0, 0.0, 1.0)))


def test_long_trajectories_are_asked_for_in_pieces(service, sdk, scene, stream, monkeypatch):
    """So that the questions of others find their turn in between."""
    push(sdk, scene, range(4))
    monkeypatch.setattr("server.processes.track_answers.PIECE_POINTS", 2)
    bulk = service.app.state.scenes[scene].readers.bulk
    stream.subscribe("t", tracks(ids=[0, 1]))
    event = until(stream, lambda e: True)[-1]
    assert (event.first, event.frame) == (0, 3)
    assert bulk._asked == 4


def states_of(bodies, path):
    """The states in a file of joined bodies, by frame."""
    path.write_bytes(b"".join(bodies))
    with CompactReader(path) as reader:
        return {index: reader.state(index) for index in reader.frames}


def test_states_come_as_a_key_frame_and_then_as_changes(sdk, service, scene, stream, tmp_path):
    push(sdk, scene, range(2))
    stream.subscribe("s", live_states(), tag=3)
    events = until(stream, lambda e: True)
    for index in (2, 3):
        push(sdk, scene, [index])
        events += until(stream, lambda e, index=index: e.frame == index)
    assert all(isinstance(event, StatesEvent) for event in events)
    assert [(event.frame, event.after, event.missed, event.tag) for event in events] == [
        (1, None, 0, 3),
        (2, 1, 0, 3),
        (3, 2, 0, 3),
    ]
    assert all(event.age >= 0 for event in events)
    found = states_of([event.body for event in events], tmp_path / "live.s4d")
    true = states_of([sdk.states(scene)[0]], tmp_path / "all.s4d")
    assert set(found) == {1, 2, 3}
    for index, state in found.items():  # two decodings of one state
        assert np.allclose(state.means, true[index].means, atol=2 * 0.04 * 0.05)
        assert np.array_equal(state.ids, true[index].ids)
    committed = {sample.labels["stage"] for metric in FRAME_LATENCY.collect() for sample in metric.samples}
    assert "publish" in committed


def test_viewers_share_one_encoding_and_one_that_joins_late_gets_a_key_frame(service, sdk, scene, stream, tmp_path):
    push(sdk, scene, [0])
    with Stream(service.url, scene) as other, Stream(service.url, scene) as late:
        queries = service.app.state.hub._channels[scene].queries
        for one in (stream, other):
            one.subscribe("s", live_states())
            assert until(one, lambda e: True)[-1].after is None
        for index in (1, 2):
            push(sdk, scene, [index])
            bodies = {until(one, lambda e, index=index: e.frame == index)[-1].body for one in (stream, other)}
            assert len(bodies) == 1
        assert queries.asked == 3
        late.subscribe("s", live_states())
        joined = until(late, lambda e: True)[-1]
        assert (joined.frame, joined.after) == (2, None)
        push(sdk, scene, [3])
        followed = [until(one, lambda e: e.frame == 3)[-1] for one in (stream, late)]
        assert followed[0].body == followed[1].body
        found = states_of([joined.body, followed[1].body], tmp_path / "late.s4d")
        assert max(found) == 3
