"""Batches of frames in one request: order, refused frames, full queues, repeats and numbering."""

from __future__ import annotations

import json

import pytest
from running import picture, pictures, problem
from sending import FRAMED, finished, framed, put_framed, status
from waiting import HANG_S
from websockets.sync.client import connect

from client.calls import NewFrame
from client.ingest import IngestSocket
from client.sdk import AsyncClient, Client

DAMAGED = {"c0": picture(), "c1": picture()[:-9]}


def post(http, id, *frames, **params):
    return http.post(f"/v1/scenes/{id}/frames", content=b"".join(frames), headers=FRAMED, params=params)


def post_form(http, id, *fields):
    """Sends fields (name, bytes or text), as `curl -F` does."""
    files = [(name, (None, value) if isinstance(value, str) else ("file", value)) for name, value in fields]
    return http.post(f"/v1/scenes/{id}/frames", files=files)


def form_of(index, images=None):
    return [(f"{index}/{camera}", data) for camera, data in (images or pictures()).items()]


def statuses(answer):
    return [entry["status"] for entry in answer.json()["answers"]]


def states(http, id):
    return [frame["state"] for frame in http.get(f"/v1/scenes/{id}/frames").json()["frames"]]


@pytest.fixture
def paused(http, make):
    """A scene with frame 0 committed that takes six more and updates none of them."""
    id = make(queue_frames=6)
    assert put_framed(http, id, 0).status_code == 202
    finished(http, id, 0)
    http.post(f"/v1/scenes/{id}/pause")
    return id


def test_a_batch_gives_the_receipts_of_its_frames_sent_alone(http, paused, make):
    answer = post(http, paused, framed(1), framed(2, pictures(5), time=0.25), framed(3))
    assert answer.status_code == 202
    entries = answer.json()["answers"]
    assert [entry["index"] for entry in entries] == [1, 2, 3]
    alone = make(queue_frames=6)
    http.post(f"/v1/scenes/{alone}/pause")
    put_framed(http, alone, 0)
    for index, (images, time) in enumerate([(None, None), (pictures(5), 0.25), (None, None)], 1):
        receipt = put_framed(http, alone, index, images, time=time).json()
        assert entries[index - 1]["receipt"] == {**receipt, "scene": paused}


def test_a_form_is_the_same_batch(http, paused):
    first = post(http, paused, framed(1), framed(2, pictures(5), time=0.25))
    fields = [*form_of(2, pictures(5)), ("2/time", "0.25"), *form_of(1)]
    again = post_form(http, paused, *fields)
    assert (again.status_code, again.json()) == (202, first.json())


@pytest.mark.parametrize(
    "send",
    [
        lambda http, id, frames: post(http, id, *(framed(*frame) for frame in frames)),
        lambda http, id, frames: post_form(http, id, *(field for frame in frames for field in form_of(*frame))),
    ],
    ids=["framed", "form"],
)
def test_a_refused_frame_is_named_and_the_others_are_accepted(http, paused, send):
    answer = send(http, paused, [(1,), (2, DAMAGED), (3,)])
    assert answer.status_code == 207
    first, refused, last = answer.json()["answers"]
    assert (first["status"], refused["status"], last["status"]) == (202, 422, 202)
    assert (refused["index"], refused["problem"]["field"], refused["missing"]) == (2, "c1", True)
    assert (last["index"], last["missing"]) == (3, False)
    assert states(http, paused) == ["committed", "queued", "missing", "queued"]
    assert "refused in a batch" in http.get(f"/v1/scenes/{paused}/frames/2").json()["error"]
    again = send(http, paused, [(1,), (2, DAMAGED), (3,)])
    assert statuses(again) == [202, 422, 202]
    assert status(http, paused)["next_frame"] == 4


def test_a_refused_frame_at_the_end_can_be_sent_again(http, paused):
    assert statuses(post(http, paused, framed(1), framed(2, DAMAGED))) == [202, 422]
    assert states(http, paused) == ["committed", "queued"]
    assert statuses(post(http, paused, framed(2), framed(3))) == [202, 202]


def test_a_batch_can_stop_at_a_refused_frame_which_is_then_sent_without_the_image(http, paused):
    answer = post(http, paused, framed(1), framed(2, DAMAGED), framed(3), on_refusal="stop")
    assert statuses(answer) == [202, 422, 422]
    assert [entry["index"] for entry in answer.json()["answers"]] == [1, 2, 3]
    assert not any(entry["missing"] for entry in answer.json()["answers"])
    assert states(http, paused) == ["committed", "queued"]
    assert statuses(post(http, paused, framed(2, DAMAGED), framed(3), on_refusal="stop")) == [422, 422]
    assert statuses(post(http, paused, framed(2), framed(3), on_refusal="stop")) == [202, 202]
    assert problem(post(http, paused, framed(4), on_refusal="wait"), 422)["field"] == "query.on_refusal"


def test_several_refused_frames_in_a_row_are_missing(http, paused):
    answer = post(http, paused, framed(1, DAMAGED), framed(2, {"c0": picture()}), framed(3))
    assert statuses(answer) == [422, 422, 202]
    assert [entry["missing"] for entry in answer.json()["answers"]] == [True, True, False]


def test_a_gap_is_refused_and_declares_nothing_missing(http, paused):
    answer = post(http, paused, framed(1), framed(3), framed(4), framed(2))
    assert statuses(answer) == [202, 409, 409, 202]
    assert answer.json()["answers"][1]["problem"]["expected"] == 2
    assert states(http, paused) == ["committed", "queued", "queued"]


def test_frames_after_a_full_queue_are_not_tried(http, paused):
    answer = post(http, paused, *(framed(index) for index in range(1, 10)))
    assert answer.status_code == 207
    assert statuses(answer) == [202] * 6 + [429] * 3
    last = answer.json()["answers"][-1]
    assert last["retry_after"] == 5
    assert (last["index"], last["missing"]) == (9, False)
    full = post(http, paused, framed(7), framed(8))
    problem(full, 429)
    assert full.headers["Retry-After"] == "5"
    assert states(http, paused) == ["committed"] + ["queued"] * 6


def test_a_scene_that_cannot_start_declares_no_frame_missing(http, make, service):
    id = make(cameras=1)
    scene = service.app.state.scenes[id]
    scene.points_sha256 = None
    scene.ledger.points_sha256 = None
    answer = post(http, id, framed(0, {"c0": picture()}), framed(1, {"c0": picture()}))
    assert statuses(answer) == [422, 422]
    assert not any(entry["missing"] for entry in answer.json()["answers"])
    assert status(http, id)["next_frame"] == 0


def test_numbers_may_be_left_to_the_service(http, paused):
    frames = [framed(7, pictures(value), time=time) for value, time in ((1, 0.5), (2, 0.6), (3, 0.7))]
    answer = post(http, paused, *frames[:2], numbering="next")
    assert [entry["receipt"]["index"] for entry in answer.json()["answers"]] == [1, 2]
    again = post(http, paused, *frames, numbering="next")  # the first two are known by their times
    assert [entry["receipt"]["index"] for entry in again.json()["answers"]] == [1, 2, 3]
    refused = post(http, paused, framed(0, DAMAGED, time=0.8), framed(0, time=0.9), numbering="next")
    assert statuses(refused) == [422, 202]
    assert refused.json()["answers"][1]["index"] == 4  # a refused frame takes no number
    late, without = post(http, paused, framed(0, time=0.65), framed(0), numbering="next").json()["answers"]
    assert (late["receipt"]["index"], late["receipt"]["time"]) == (5, 1.0)  # 0.1 s after frame 4
    assert without["problem"]["field"] == "time"
    assert status(http, paused)["next_frame"] == 6


def test_what_is_no_batch_is_refused_by_name(http, paused):
    assert problem(post(http, paused), 422)["field"] == "body"
    assert problem(post_form(http, paused, ("c0", picture())), 422)["value"] == "c0"
    assert problem(post(http, paused, framed(1), numbering="first"), 422)["field"] == "query.numbering"
    plain = http.post(f"/v1/scenes/{paused}/frames", content=b"x", headers={"Content-Type": "image/png"})
    assert problem(plain, 415)["field"] == "Content-Type"
    for rest in (b"PK\3\4 and more", framed(2)[:6], b"S4DF\4\0\0\0{}{}"):
        answer = post(http, paused, framed(1), rest)
        assert statuses(answer) == [202, 422]
        assert answer.json()["answers"][1]["index"] is None
    assert statuses(post(http, paused, framed(1), framed(2)[:-3])) == [202, 422]
    assert status(http, paused)["next_frame"] == 2


def test_a_batch_leaves_no_file_of_a_refused_frame(http, paused, service):
    folder = service.app.state.scenes[paused].spec.folder.frames
    before = len(list(folder.iterdir()))
    post(http, paused, framed(1, DAMAGED), framed(5), framed(2, DAMAGED))
    assert len(list(folder.iterdir())) == before


def test_a_message_with_several_frames_is_a_batch(http, paused, service):
    url = f"{service.url.replace('http', 'ws')}/v1/scenes/{paused}/ingest"
    with connect(url, max_size=None) as socket:
        socket.send(framed(1) + framed(2, DAMAGED) + framed(3))
        socket.send(framed(4))
        answers = [json.loads(socket.recv(timeout=HANG_S)) for _ in range(4)]
    assert [(answer["index"], answer["status"]) for answer in answers] == [(1, 202), (2, 422), (3, 202), (4, 202)]
    with connect(f"{url}?numbering=next") as socket:
        socket.send(framed(0, time=0.7))
        assert json.loads(socket.recv(timeout=HANG_S))["receipt"]["index"] == 5


def test_the_clients_send_frames_again_that_had_no_room(http, make, service):
    for send in ("http", "async", "socket"):
        id = make(queue_frames=2)
        frames = [NewFrame(index, pictures(index)) for index in range(7)]
        frames[4] = NewFrame(4, DAMAGED)
        with Client(service.url, busy_timeout=HANG_S) as client:
            if send == "http":
                answers = client.put_frames(id, frames)
            elif send == "async":
                answers = _run_async(service.url, id, frames)
            else:
                with IngestSocket(client, id) as socket:
                    answers = socket.put_frames(frames)
        assert [(answer.index, answer.status) for answer in answers] == [
            (index, 422 if index == 4 else 202) for index in range(7)
        ]
        finished(http, id, 6)
        assert states(http, id) == ["committed"] * 4 + ["missing"] + ["committed"] * 2


def _run_async(url, id, frames):
    import asyncio

    async def job():
        async with AsyncClient(url, busy_timeout=HANG_S) as client:
            return await client.put_frames(id, frames)

    return asyncio.run(job())
