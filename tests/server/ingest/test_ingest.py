"""Doors for frames beside the form: framed bytes, camera by camera, WebSocket; missing, skipped, kept."""

from __future__ import annotations

import contextlib
import json
import threading
import time

import fakes
import pytest
from running import make_rig, picture, pictures, problem
from sending import FRAMED, finished, framed, put_camera, status, wait_for
from sending import put_framed as put
from waiting import HANG_S
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from client.wire import FRAME_MEDIA_TYPE
from server.ingest import acknowledge
from server.ingest.pictures import largest_frame


def test_a_form_and_framed_bytes_of_the_same_pictures_are_the_same_frame(http, make):
    id = make()
    first = put(http, id, 0)
    assert first.status_code == 202
    files = {name: (name, data) for name, data in pictures().items()}
    again = http.put(f"/v1/scenes/{id}/frames/0", files=files)
    assert (again.status_code, again.json()) == (202, first.json())
    assert finished(http, id, 0)["used_cameras"] == ["c0", "c1"]


def test_framed_bytes_that_are_none_are_refused_by_name(http, make):
    id = make()
    url = f"/v1/scenes/{id}/frames/0"
    whole = framed(0)
    for body in (b"", b"S4DF", b"PK\3\4 and more", whole[:-1], whole + b"\0", whole[:30]):
        document = problem(http.put(url, content=body, headers=FRAMED), 422)
        assert document["field"] == "body"
        assert document["remedy"]
    assert problem(http.put(url, content=framed(1), headers=FRAMED), 422)["field"] == "head.index"
    assert problem(put(http, id, 0, {"c0": picture()}), 422)["field"] == "c1"
    assert status(http, id)["next_frame"] == 0
    assert status(http, id)["frames_kept"] == 0


def test_a_refused_upload_leaves_no_file(http, make, service):
    id = make()
    problem(put(http, id, 0, {"c0": picture(), "c1": picture()[:-9]}), 422)
    problem(put(http, id, 4), 409)
    folder = service.app.state.scenes[id].spec.folder.frames
    assert list(folder.iterdir()) == []


def test_frames_that_come_side_by_side_are_taken_in_order(http, make, service):
    id = make(queue_frames=50)
    http.post(f"/v1/scenes/{id}/pause")
    answers = {}

    def send(index):
        import httpx

        with httpx.Client(base_url=service.url, timeout=HANG_S) as own:
            answer = put(own, id, index)
            while answer.status_code == 409:  # its sender is ahead of the one before
                answer = put(own, id, index)
            answers[index] = answer.status_code

    threads = [threading.Thread(target=send, args=(index,)) for index in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(HANG_S)
    assert answers == dict.fromkeys(range(6), 202)
    assert status(http, id)["next_frame"] == 6


def test_a_frame_of_parts_closes_when_all_cameras_are_in(http, make):
    id = make()
    first = put_camera(http, id, 0, "c0", picture(1))
    assert first.status_code == 202, first.text
    assert (first.json()["received"], first.json()["absent"], first.json()["frame"]) == (["c0"], ["c1"], None)
    assert http.get(f"/v1/scenes/{id}/frames/0").json()["state"] == "open"
    assert status(http, id)["open_frames"] == [0]
    assert put_camera(http, id, 0, "c0", picture(1)).json() == first.json()
    assert problem(put_camera(http, id, 0, "c0", picture(2)), 409)["field"] == "c0"
    assert problem(put_camera(http, id, 0, "c7", picture(2)), 422)["field"] == "c"
    assert problem(put_camera(http, id, 0, "c1", picture()[:-9]), 422)["field"] == "c1"
    assert problem(put(http, id, 0), 409)["received"] == ["c0"]
    last = put_camera(http, id, 0, "c1", picture(3)).json()
    assert last["absent"] == []
    # The same pictures as a whole frame have the same identity.
    whole = put(http, id, 0, {"c0": picture(1), "c1": picture(3)})
    assert (whole.status_code, whole.json()) == (202, last["frame"])
    assert finished(http, id, 0)["state"] == "committed"
    assert put_camera(http, id, 0, "c1", picture(3)).json()["frame"] == last["frame"]
    assert problem(put_camera(http, id, 0, "c1", picture(4)), 409)["field"] == "c1"


def test_a_camera_may_be_ahead_and_frames_close_in_order(http, make):
    id = make()
    for index in range(3):
        assert put_camera(http, id, index, "c0", picture(index), time=index / 4).status_code == 202
    assert put_camera(http, id, 1, "c1", picture()).json()["frame"] is None
    assert status(http, id)["next_frame"] == 0
    assert put_camera(http, id, 0, "c1", picture()).json()["frame"]["time"] == 0
    assert finished(http, id, 1)["time"] == 0.25
    assert status(http, id)["open_frames"] == [2]
    assert problem(put_camera(http, id, 99, "c0", picture()), 409)["expected"] == 2
    assert problem(put_camera(http, id, 2, "c1", picture(), time=0.75), 422)["field"] == "time"


def test_masks_of_parts(http, make):
    id = make(1)
    assert put_camera(http, id, 0, "c0", picture(1), kind="mask").json()["received"] == []
    assert put_camera(http, id, 0, "c0", picture()).json()["frame"] is not None
    body = framed(1, {"c0": picture()}, {"c0": picture(1)}, part=True)
    answer = http.put(f"/v1/scenes/{id}/frames/1/cameras/c0", content=body, headers=FRAMED)
    assert answer.json()["frame"]["index"] == 1


def test_a_frame_is_closed_on_request_down_to_the_minimum(http, make):
    id = make(4)  # the minimum is 2
    problem(http.post(f"/v1/scenes/{id}/frames/0/close"), 404)
    put_camera(http, id, 0, "c0", picture())
    assert problem(http.post(f"/v1/scenes/{id}/frames/0/close"), 409)["received"] == ["c0"]
    put_camera(http, id, 0, "c2", picture())
    closed = http.post(f"/v1/scenes/{id}/frames/0/close")
    assert closed.status_code == 202
    assert http.post(f"/v1/scenes/{id}/frames/0/close").json() == closed.json()
    report = finished(http, id, 0)
    assert (report["state"], report["used_cameras"]) == ("committed", ["c0", "c2"])
    assert sorted(report["dropped_cameras"]) == ["c1", "c3"]
    assert problem(put_camera(http, id, 0, "c1", picture()), 409)["field"] == "c1"


def test_a_frame_is_closed_at_its_deadline(http, make):
    id = make(2, open_frame_seconds=0.3)
    put_camera(http, id, 0, "c1", picture())
    report = finished(http, id, 0)
    assert (report["state"], report["used_cameras"]) == ("committed", ["c1"])


def test_fewer_cameras_than_the_minimum_set_the_frame_aside(http, make):
    id = make(2, open_frame_seconds=0.2, minimum_cameras=2)
    put_camera(http, id, 0, "c1", picture())
    report = finished(http, id, 0)
    assert (report["state"], report["error"]) == (
        "failed",
        "usable images: 1 (the scene requires at least 2)",
    )
    assert put(http, id, 1).status_code == 202  # and the next one starts the scene
    assert finished(http, id, 1)["state"] == "committed"


def test_a_frame_is_declared_missing_for_ever(http, make):
    id = make()
    url = f"/v1/scenes/{id}/frames"
    put(http, id, 0)
    assert problem(http.post(f"{url}/2/missing"), 409)["expected"] == 1
    declared = http.post(f"{url}/1/missing", json={"reason": "cable"})
    assert (declared.json()["state"], declared.json()["error"]) == ("missing", "cable")
    assert http.post(f"{url}/1/missing", json={"reason": "other"}).json() == declared.json()
    assert "missing" in problem(put(http, id, 1), 409)["detail"]
    assert problem(http.post(f"{url}/0/missing"), 409)["expected"] == 2
    put(http, id, 2)
    report = finished(http, id, 2)
    assert (report["state"], report["time"]) == ("committed", 0.2)  # by time, not by count
    assert status(http, id)["missing"] == 1


def test_a_scene_may_skip_to_the_newest(http, make):
    id = make(queue_frames=2, when_full="skip")
    put(http, id, 0)
    finished(http, id, 0)
    http.post(f"/v1/scenes/{id}/pause")
    for index in range(1, 6):
        assert put(http, id, index).status_code == 202
    http.post(f"/v1/scenes/{id}/resume")
    assert finished(http, id, 5)["state"] == "committed"
    states = [http.get(f"/v1/scenes/{id}/frames/{index}").json()["state"] for index in range(6)]
    assert states == ["committed", "skipped", "skipped", "skipped", "skipped", "committed"] or states == [
        "committed", "skipped", "skipped", "skipped", "committed", "committed",
    ]  # fmt: skip
    assert status(http, id)["skipped"] == states.count("skipped")
    assert put(http, id, 2).status_code == 202  # the same again: the same answer


def test_a_paused_scene_takes_frames_and_reconstructs_none(http, make):
    id = make(queue_frames=3)
    assert http.post(f"/v1/scenes/{id}/pause").json()["state"] == "paused"
    put(http, id, 0)
    other = make()
    put(http, other, 0)
    assert finished(http, other, 0)["state"] == "committed"  # made and sent later
    assert (status(http, id)["state"], status(http, id)["queued"]) == ("paused", 1)
    assert http.post(f"/v1/scenes/{id}/resume").json()["paused"] is False
    assert finished(http, id, 0)["state"] == "committed"


def test_what_a_scene_does_hides_neither_that_it_is_paused_nor_that_it_is_degraded(http, make):
    id = make(queue_frames=3)
    for index, red in enumerate((0, fakes.RAISES)):
        put(http, id, index, pictures(red))
        finished(http, id, index)
    after = status(http, id)
    assert (after["state"], after["paused"], after["degraded"]) == ("degraded", False, True)
    put(http, id, 2, pictures(fakes.SLOW))
    wait_for(lambda: status(http, id)["state"] == "updating")
    during = http.post(f"/v1/scenes/{id}/pause").json()
    assert (during["state"], during["paused"], during["degraded"]) == ("updating", True, True)
    assert "told to raise" in during["error"]
    finished(http, id, 2)
    wait_for(lambda: status(http, id)["state"] == "paused")
    assert (status(http, id)["degraded"], status(http, id)["error"]) == (False, None)


def test_retention_deletes_pictures_and_states_and_says_so(http, make, service):
    id = make(queue_frames=8, keep_frames={"last": 3}, keep_states={"last": 2})
    receipts = []
    for index in range(7):
        receipts.append(put(http, id, index).json())
        finished(http, id, index)
    wait_for(lambda: status(http, id)["frames_kept"] == 3 and status(http, id)["states_deleted"] == 4)
    reports = [http.get(f"/v1/scenes/{id}/frames/{index}").json() for index in range(7)]
    assert [report["pictures_kept"] for report in reports] == [False] * 4 + [True] * 3
    assert [report["deleted"] for report in reports] == [False, True, True, True, True, False, False]
    assert len(list(service.app.state.scenes[id].spec.folder.frames.iterdir())) == 3
    # What a frame was is known for ever.
    assert put(http, id, 1).json() == receipts[1]
    assert problem(put(http, id, 1, pictures(9)), 409)["identity"] == receipts[1]["identity"]
    assert "retention" in problem(http.get(f"/v1/scenes/{id}/render?frame=2"), 404)["detail"]
    assert http.get(f"/v1/scenes/{id}/render?frame=0").status_code == 200


def test_nothing_uncommitted_is_deleted(http, make):
    id, other = (make(queue_frames=8, keep_frames={"last": 0}) for _ in range(2))
    http.post(f"/v1/scenes/{id}/pause")
    for index in range(4):
        put(http, id, index)
    for index in range(4):
        put(http, other, index)
    finished(http, other, 3)
    wait_for(lambda: status(http, other)["frames_kept"] == 1)  # sent later, and deleted
    assert status(http, id)["frames_kept"] == 4
    http.post(f"/v1/scenes/{id}/resume")
    finished(http, id, 3)
    wait_for(lambda: status(http, id)["frames_kept"] == 1)  # the newest may have to be done again
    assert status(http, id)["frame_bytes"] > 0


def test_frames_over_a_websocket(http, make, service):
    id = make(queue_frames=8)
    with connect(f"{service.url.replace('http', 'ws')}/v1/scenes/{id}/ingest") as socket:

        def say(data):
            socket.send(data)
            return json.loads(socket.recv())

        first = say(framed(0))
        assert (first["index"], first["status"], first["receipt"]["index"]) == (0, 202, 0)
        assert say(framed(0)) == first
        assert (say(framed(5))["status"], say(b"rubbish")["status"]) == (409, 422)
        bad = say(framed(1, {"c0": picture()[:-9], "c1": picture()}))
        assert (bad["status"], bad["problem"]["field"]) == (422, "c0")
        part = say(framed(1, {"c0": picture()}, part=True))
        assert part["receipt"]["absent"] == ["c1"]
        assert say(framed(1, {"c1": picture()}, part=True))["receipt"]["frame"]["index"] == 1
        socket.send("text")
        with pytest.raises(Exception, match="1003"):
            socket.recv()
    assert finished(http, id, 1)["state"] == "committed"
    with pytest.raises(InvalidStatus) as refused:
        connect(f"{service.url.replace('http', 'ws')}/v1/scenes/none/ingest")
    assert json.loads(refused.value.response.body)["status"] == 404


def test_a_full_queue_says_over_a_websocket_when_to_come_again(http, make, service):
    id = make(queue_frames=1)
    http.post(f"/v1/scenes/{id}/pause")
    with connect(f"{service.url.replace('http', 'ws')}/v1/scenes/{id}/ingest") as socket:
        socket.send(framed(0))
        first = json.loads(socket.recv())
        assert (first["status"], first["retry_after"]) == (202, None)
        socket.send(framed(1))
        full = json.loads(socket.recv())
    by_http = http.put(f"/v1/scenes/{id}/frames/1", content=framed(1), headers={"Content-Type": FRAME_MEDIA_TYPE})
    assert (full["status"], by_http.status_code) == (429, 429)
    assert full["retry_after"] == int(by_http.headers["Retry-After"]) >= 1


def test_a_scene_has_only_so_many_sending_websockets(http, make, service, monkeypatch):
    id = make()
    address = f"{service.url.replace('http', 'ws')}/v1/scenes/{id}/ingest"
    most = 3
    monkeypatch.setattr(acknowledge, "MAX_SOCKETS", most)
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(connect(address)) for _ in range(most)]
        with pytest.raises(InvalidStatus) as refused:
            connect(address)
        document = json.loads(refused.value.response.body)
        assert (document["status"], document["field"]) == (429, "id")
        assert refused.value.response.headers["Retry-After"]
        sockets[0].close()
        stack.enter_context(retried(lambda: connect(address), InvalidStatus))  # there is room again


def retried(action, error):
    until = time.monotonic() + HANG_S
    while True:
        try:
            return action()
        except error:
            assert time.monotonic() < until
            time.sleep(0.02)


def test_nothing_larger_than_a_picture_of_the_rig_is_received(http, make, service):
    id = make()
    large = picture() + bytes(1_100_000)
    assert len(large) < service.app.state.settings.max_body_mb * 1e6
    frame = framed(0, {"c0": picture(), "c1": large})
    url = f"/v1/scenes/{id}/frames/0"
    answers = [
        http.put(f"{url}/cameras/c1", content=large),
        http.put(f"{url}/cameras/c1", content=iter([large])),  # no length announced
        http.put(url, content=frame, headers={"Content-Type": FRAME_MEDIA_TYPE}),
        http.put(url, files={"c0": ("c0", picture()), "c1": ("c1", large)}),
    ]
    for answer in answers:
        document = problem(answer, 413)
        assert document["field"] == "c1"
    with connect(f"{service.url.replace('http', 'ws')}/v1/scenes/{id}/ingest", max_size=None) as socket:
        socket.send(frame)
        assert json.loads(socket.recv())["status"] == 413
        with contextlib.suppress(ConnectionClosed):  # it may hear of it while it sends
            socket.send(bytes(largest_frame(make_rig()) + 1))
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv()
        assert closed.value.rcvd.code == 1009
    assert put(http, id, 0).status_code == 202


def test_messages_that_do_not_wait_are_taken_and_answered_in_order(http, make, service):
    id = make(queue_frames=20)
    http.post(f"/v1/scenes/{id}/pause")
    with connect(f"{service.url.replace('http', 'ws')}/v1/scenes/{id}/ingest") as socket:
        bodies = [framed(index) for index in range(5)]
        bodies.append(framed(5, {"c0": picture()}, part=True))
        bodies.append(framed(6))  # its turn comes when the part's frame is closed: here it is not
        bodies.append(framed(5, {"c1": picture()}, part=True))
        bodies += [framed(6), framed(6), framed(7, {"c0": picture()[:-9], "c1": picture()}), framed(8), framed(7)]
        for body in bodies:
            socket.send(body)
        answers = [json.loads(socket.recv()) for _ in bodies]
    expected = [*range(6), 6, 5, 6, 6, 7, 8, 7]
    assert [answer["index"] for answer in answers] == expected
    assert [answer["status"] for answer in answers] == [202] * 6 + [409] + [202] * 3 + [422, 409, 202]
    assert status(http, id)["next_frame"] == 8
    assert status(http, id)["frames_kept"] == 8


def test_a_sender_that_goes_away_loses_nothing_that_it_sent_whole(http, make, service):
    id = make(queue_frames=20)
    http.post(f"/v1/scenes/{id}/pause")
    with connect(f"{service.url.replace('http', 'ws')}/v1/scenes/{id}/ingest") as socket:
        for index in range(3):
            socket.send(framed(index))
        assert json.loads(socket.recv())["status"] == 202
    wait_for(lambda: status(http, id)["next_frame"] >= 1)
    scene = service.app.state.scenes[id]
    wait_for(lambda: len(list(scene.spec.folder.frames.iterdir())) == status(http, id)["next_frame"])
    assert put(http, id, status(http, id)["next_frame"]).status_code == 202


def test_a_frame_that_raises_keeps_its_reason(http, make):
    id = make()
    put(http, id, 0)
    finished(http, id, 0)
    put(http, id, 1, pictures(fakes.RAISES))
    assert "told to raise" in finished(http, id, 1)["error"]
    assert status(http, id)["failed"] == 1
