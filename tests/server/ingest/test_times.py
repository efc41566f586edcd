"""Times of frames: bounds at every door, clocks that are set, suspected units, and what a restart keeps."""

from __future__ import annotations

import json
import math

import pytest
from running import make_rig, picture, pictures, problem
from sending import FRAMED, create, finished, framed, put_camera, put_framed, serving, settled, status
from waiting import HANG_S
from websockets.sync.client import connect

from client.wire import FRAME_MEDIA_TYPE, RigModel
from client.wire.framing import PREFIX

BAD = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf, "-2e19": -2e19, "1e300": 1e300}
"""Times as JSON and as a form field writes them."""


def body(text):
    """Frame 0 as S4DF, with this text as its time."""
    files = [{"camera": name, "size": len(data)} for name, data in pictures().items()]
    head = f'{{"index": 0, "time": {text}, "files": {json.dumps(files)}}}'.encode()
    return PREFIX.pack(b"S4DF", len(head)) + head + b"".join(pictures().values())


def by_form(http, url, scene, text):
    files = {name: (name, data) for name, data in pictures().items()}
    return problem(http.put(f"/v1/scenes/{scene}/frames/0", files=files, data={"time": text}), 422)


def by_body(http, url, scene, text):
    return problem(http.put(f"/v1/scenes/{scene}/frames/0", content=body(text), headers=FRAMED), 422)


def by_camera(http, url, scene, text):
    return problem(put_camera(http, scene, 0, "c0", picture(), time=text), 422)


def by_camera_body(http, url, scene, text):
    headers = {"Content-Type": FRAME_MEDIA_TYPE}
    return problem(http.put(f"/v1/scenes/{scene}/frames/0/cameras/c0", content=body(text), headers=headers), 422)


def by_batch(http, url, scene, text):
    answer = http.post(f"/v1/scenes/{scene}/frames", content=body(text), headers=FRAMED)
    return answer.json()["answers"][0]["problem"]


def by_form_batch(http, url, scene, text):
    files = {f"0/{name}": (name, data) for name, data in pictures().items()}
    answer = http.post(f"/v1/scenes/{scene}/frames", files=files, data={"0/time": text})
    return answer.json()["answers"][0]["problem"]


def by_socket(http, url, scene, text):
    with connect(f"{url.replace('http', 'ws')}/v1/scenes/{scene}/ingest") as socket:
        socket.send(body(text))
        return json.loads(socket.recv(timeout=HANG_S))["problem"]


DOORS = (by_form, by_body, by_camera, by_camera_body, by_batch, by_form_batch, by_socket)


@pytest.mark.parametrize("door", DOORS)
def test_a_time_out_of_bounds_is_refused_at_every_door_before_the_acknowledgement(http, service, make, door):
    scene = make()
    for text, value in BAD.items():
        document = door(http, service.url, scene, text)
        assert document["field"].rpartition(".")[2] == "time", document
        assert float(document["value"]) == pytest.approx(value, nan_ok=True)
        assert repr(value) in document["detail"]
        assert "seconds" in document["remedy"]
    assert status(http, scene)["next_frame"] == 0


def test_a_time_that_is_no_number_is_named_as_it_was_sent(http, make):
    files = {name: (name, data) for name, data in pictures().items()}
    answer = http.put(f"/v1/scenes/{make()}/frames/0", files=files, data={"time": "abc"})
    assert problem(answer, 422)["detail"].endswith(", not 'abc'")


@pytest.mark.parametrize("fps", [0, 9e-5, 1e300])
def test_a_frame_rate_out_of_bounds_is_refused(http, fps):
    rig = RigModel.of(make_rig()).model_dump(mode="json")
    answer = http.post("/v1/scenes", json={"rig": rig, "frames_per_second": fps})
    assert problem(answer, 422)["field"].endswith("frames_per_second")


def send_all(http, scene, sent, first=0):
    receipts = []
    for index, time in enumerate(sent, first):
        answer = put_framed(http, scene, index, time=time)
        assert answer.status_code == 202, answer.text
        receipts.append(answer.json())
        assert finished(http, scene, index)["state"] == "committed"
    return receipts


REGULAR = [index / 10 for index in range(4)]
CLOCKS = {
    "relative to a trigger": [index / 10 - 0.25 for index in range(5)],
    "set back for good": [*REGULAR, 0.0, 0.1, 0.2],
    "one frame from the near future": [*REGULAR, 500.0, 0.5, 0.6],
    "one frame from the far future": [*REGULAR, 1e18, 0.5, 0.6],
    "nanoseconds since 1970": [1.7643636e18 + index * 1e8 for index in range(4)],
    "extremes": [0.0, 5e-324, 1e-300, 1e10, 1e19, 1e-9, 86_400.0, 1e19, 0.0],
}


@pytest.mark.parametrize("clock", CLOCKS)
def test_no_time_that_is_accepted_ends_a_scene_and_receipts_stay_the_same(tmp_path, clock):
    sent = CLOCKS[clock]
    with serving(tmp_path) as (http, _):
        scene = create(http)
        receipts = send_all(http, scene, sent)
        times = [receipt["time"] for receipt in receipts]
        assert times == sorted(set(times))
        for receipt, time in zip(receipts, sent, strict=True):
            assert (receipt["time"] == time) == (not any("instead of the sent" in text for text in receipt["warnings"]))
        assert [put_framed(http, scene, index, time=time).json() for index, time in enumerate(sent)] == receipts
        assert problem(put_framed(http, scene, 1, time=0.123), 409)["field"] == "n"
        settled(http, scene)
        assert status(http, scene)["warnings"] == receipts[-1]["warnings"]
    with serving(tmp_path) as (http, _):  # the journal keeps the sent times
        assert [put_framed(http, scene, index, time=time).json() for index, time in enumerate(sent)] == receipts
        again = send_all(http, scene, [sent[-1] + 0.1], first=len(sent))
        assert again[0]["time"] == pytest.approx(times[-1] + 0.1, rel=1e-9)


def test_times_are_recovered_without_the_journal(tmp_path):
    sent = [5.0, 1.0, 1.1]
    with serving(tmp_path) as (http, _):
        scene = create(http)
        receipts = send_all(http, scene, sent)
        settled(http, scene)
    next(tmp_path.rglob("journal.log")).unlink()
    with serving(tmp_path) as (http, _):
        assert [put_framed(http, scene, index, time=time).json() for index, time in enumerate(sent)] == receipts
        assert send_all(http, scene, [1.2], first=3)[0]["time"] == pytest.approx(5.3)


def test_a_clock_that_was_set_back_is_named_with_exact_numbers(http, make):
    scene = make()
    sent = [123456.7890123, 123456.8890123, 5.0]
    receipts = send_all(http, scene, sent)
    assert receipts[2]["time"] == 123456.8890123 + 0.1
    [text] = receipts[2]["warnings"]
    assert f"frame 2 has the time {receipts[2]['time']!r} s instead of the sent 5.0 s" in text
    assert "after frame 1 at 123456.8890123 s" in text


def test_milliseconds_are_named_in_the_receipt_and_in_the_status(http, make):
    scene = make()
    receipts = send_all(http, scene, [0.0, 100.0, 200.0])
    assert [receipt["time"] for receipt in receipts] == [0.0, 100.0, 200.0]
    [text] = receipts[2]["warnings"]
    assert text.startswith("the times are probably milliseconds: frame 2 has the time 200.0")
    assert text in status(http, scene)["warnings"]
    send_all(http, scene, [0.3, 0.4], first=3)  # the remedy, followed in the same scene
    assert "divide them by 1000" in text


def test_cameras_that_send_alone_may_have_a_clock_that_is_set_back(http, make):
    scene = make()
    for index, time in enumerate([5.0, 1.0, 1.1]):
        for camera in ("c0", "c1"):
            answer = put_camera(http, scene, index, camera, picture(index), time=time)
            assert answer.status_code == 202, answer.text
        finished(http, scene, index)
        last = answer.json()["frame"]
        assert put_camera(http, scene, index, "c0", picture(index), time=time).json()["frame"] == last
    assert last["time"] == pytest.approx(5.2)
    assert "instead of the sent 1.1" in last["warnings"][0]


def test_frames_numbered_by_the_service_go_on_after_a_clock_was_set_back(http, make):
    scene = make()
    query = {"numbering": "next"}
    for index, time in enumerate([50.0, 50.1, 3.0, 3.1]):
        for _ in range(2):  # repeated frames are known by the sent time
            answer = http.post(f"/v1/scenes/{scene}/frames", content=framed(9, time=time), headers=FRAMED, params=query)
            assert answer.json()["answers"][0]["receipt"]["index"] == index
        finished(http, scene, index)
    assert status(http, scene)["next_frame"] == 4
    again = http.post(
        f"/v1/scenes/{scene}/frames", content=framed(9, pictures(7), time=3.1), headers=FRAMED, params=query
    )
    [answer] = again.json()["answers"]
    assert (answer["status"], answer["problem"]["field"], answer["problem"]["value"]) == (409, "time", "3.1")
    assert "numbering=given" in answer["problem"]["remedy"]
