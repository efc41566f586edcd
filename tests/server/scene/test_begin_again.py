"""A first frame that failed or came out poor is tried again, in the same scene."""

from __future__ import annotations

import threading
import time

import fakes
import httpx
import numpy as np
import pytest
from running import make_rig, pictures, problem
from sending import FRAMED, create, framed, put_form, settled, status, wait_for
from waiting import HANG_S
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from client.ingest import IngestSocket
from client.stream import Stream, finished_frames, scene_changes
from client.wire import RigModel
from client.wire.stream import SCENE_RESTARTS, STREAM_PROTOCOL, FrameMessage
from scas4d_core.captures import InitialPoints
from scas4d_core.storage.history import History

PICKED = {"settings": {"static": {"iterations": fakes.PICKED}}}


@pytest.fixture
def make(http):
    made = []

    def new(**ingest):
        made.append(create(http, **{"queue_frames": 9, **ingest}))
        return made[-1]

    yield new
    for id in made:
        http.delete(f"/v1/scenes/{id}")


def begin(http, id, n, **request):
    return http.put(f"/v1/scenes/{id}/reconstructions/{n}", json=request)


def begun(http, id, n, **request):
    answer = begin(http, id, n, **request)
    assert answer.status_code == 200, answer.text
    return answer.json()


def folder_of(service, id):
    return service.app.state.scenes[id].spec.folder


def bits(service, id):
    """Contents of every committed state, by frame."""
    history = History.load(folder_of(service, id).states)
    return {index: {k: v.tobytes() for k, v in history.gaussians(index).arrays().items()} for index in history.indices}


def reports(http, id):
    return {report["index"]: report for report in http.get(f"/v1/scenes/{id}/frames").json()["frames"]}


def cloud(count):
    return InitialPoints(np.arange(3.0 * count).reshape(count, 3) / 10, np.full((count, 3), 0.5, np.float32))


def test_a_first_frame_that_failed_is_tried_again_with_other_settings(http, sdk, service, make):
    id = make()
    http.post(f"/v1/scenes/{id}/pause")  # the frames arrive before the first one fails
    for index, red in enumerate((fakes.PICKY, 20, 30)):
        put_form(http, id, index, pictures(red))
    http.post(f"/v1/scenes/{id}/resume")
    failed = settled(http, id)
    assert (failed["state"], failed["committed"], failed["failed"]) == ("failed", 0, 3)
    assert f"PUT /v1/scenes/{id}/reconstructions/1" in failed["error"]
    assert "PUT …/reconstructions/1" in problem(put_form(http, id, 3), 409)["remedy"]

    again = begun(http, id, 1, **PICKED)
    assert (again["reconstruction"], again["first_frame"], again["error"]) == (1, 0, None)
    assert again["settings"]["static"]["iterations"] == fakes.PICKED
    assert put_form(http, id, 3, pictures(40)).status_code == 202
    assert sdk.wait(id, 3).state == "committed"
    other = create_with(http, PICKED["settings"])
    try:
        for index, red in enumerate((fakes.PICKY, 20, 30, 40)):
            put_form(http, other, index, pictures(red))
        sdk.wait(other, 3)
        assert bits(service, id) == bits(service, other)
    finally:
        http.delete(f"/v1/scenes/{other}")
    assert [report["state"] for report in reports(http, id).values()] == ["committed"] * 4
    names = sorted(path.name for path in folder_of(service, id).path.glob("states*"))
    assert names == ["states_1"]
    wait_for(lambda: not list((service.app.state.settings.data / "deleted").iterdir()))


def create_with(http, settings):
    body = {"rig": RigModel.of(make_rig()).model_dump(mode="json"), "frames_per_second": 10, "settings": settings}
    return http.post("/v1/scenes", json={**body, "ingest": {"queue_frames": 9}}).json()["id"]


def test_the_number_makes_a_request_that_is_sent_twice_begin_once(http, sdk, make):
    id = make()
    put_form(http, id, 0)
    sdk.wait(id, 0)
    assert problem(begin(http, id, 2), 409)["expected"] == 1
    problem(begin(http, id, 0), 422)
    begun(http, id, 1, **PICKED)
    put_form(http, id, 1)
    sdk.wait(id, 1)
    before = status(http, id)
    assert begun(http, id, 1, **PICKED) == before  # nothing is dropped
    assert problem(begin(http, id, 1), 409)["expected"] == 2
    # Settings are those of the reconstruction before with the changes, not those of the scene's creation.
    again = begun(http, id, 2, settings={"update": {"iterations": 7}}, discard=True)
    assert again["settings"]["static"]["iterations"] == fakes.PICKED
    assert again["settings"]["update"]["iterations"] == 7


def test_of_two_senders_one_begins(http, sdk, service, make):
    id = make()
    put_form(http, id, 0)
    sdk.wait(id, 0)
    answers = []

    def send(iterations):
        with httpx.Client(base_url=service.url, timeout=HANG_S) as mine:
            while (answer := begin(mine, id, 1, settings={"update": {"iterations": iterations}})).status_code == 503:
                time.sleep(0.05)
            answers.append((answer.status_code, iterations))

    threads = [threading.Thread(target=send, args=(iterations,)) for iterations in (5, 6, 7)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(HANG_S)
    assert sorted(code for code, _ in answers) == [200, 409, 409]
    (winner,) = (iterations for code, iterations in answers if code == 200)
    assert status(http, id)["settings"]["update"]["iterations"] == winner
    assert sdk.wait(id, 0).state == "committed"


def test_committed_frames_are_dropped_only_if_the_request_says_so(http, sdk, make):
    id = make()
    for index in range(4):
        put_form(http, id, index, pictures(10 * index))
    sdk.wait(id, 3)
    before = status(http, id)
    refused = problem(begin(http, id, 1, frame=2), 409)
    assert (refused["field"], refused["committed"]) == ("discard", 4)
    assert status(http, id) == before
    begun(http, id, 1, frame=2, discard=True)
    assert sdk.wait(id, 3).state == "committed"
    found = reports(http, id)
    assert [found[index]["state"] for index in range(4)] == ["failed", "failed", "committed", "committed"]
    assert found[0]["error"] == found[1]["error"] == "the reconstruction starts with frame 2"
    after = settled(http, id)
    assert (after["first_frame"], after["first_committed"], after["committed"]) == (2, 2, 2)
    assert (after["state"], after["degraded"]) == ("ready", False)
    problem(http.get(f"/v1/scenes/{id}/render?frame=1"), 404)
    assert sdk.render(id, "c0", 2)[0, 0, 0] == round(255 * 0.2)
    tracks = sdk.tracks(id, ids=[0])
    assert len(tracks.positions[0]) == 2
    # A frame keeps its number and its receipt.
    assert put_form(http, id, 0, pictures(0)).status_code == 202
    assert put_form(http, id, 4).status_code == 202
    sdk.wait(id, 4)


def test_it_may_begin_with_a_frame_still_to_come(http, sdk, make):
    id = make()
    put_form(http, id, 0, pictures(fakes.RAISES))
    sdk.wait(id, 0)
    waiting = begun(http, id, 1, frame=3)
    assert (waiting["state"], waiting["queued"], waiting["error"]) == ("awaiting_first_frame", 0, None)
    for index in (1, 2):
        put_form(http, id, index, pictures(fakes.RAISES))
        assert sdk.frame(id, index).error == "the reconstruction starts with frame 3"
    assert status(http, id)["state"] == "awaiting_first_frame"
    put_form(http, id, 3)
    assert sdk.wait(id, 3).state == "committed"


def test_frames_that_never_came_cannot_be_begun_with(http, sdk, make):
    id = make()
    http.post(f"/v1/scenes/{id}/frames/0/missing")
    put_form(http, id, 1)
    sdk.wait(id, 1)
    refused = problem(begin(http, id, 1, frame=0), 409)
    assert (refused["detail"], refused["expected"]) == ("frame 0 is missing", 1)
    assert begun(http, id, 1)["first_frame"] == 1
    assert sdk.wait(id, 1).state == "committed"
    assert sdk.frame(id, 0).state == "missing"


def test_pictures_that_are_deleted_cannot_be_begun_with(http, sdk, make):
    id = make(keep_frames={"last": 2})
    for index in range(6):
        put_form(http, id, index)
        sdk.wait(id, index)
    wait_for(lambda: status(http, id)["frames_kept"] == 2)
    refused = problem(begin(http, id, 1, discard=True), 409)
    assert (refused["detail"], refused["expected"]) == ("the images of frame 0 were deleted", 4)
    assert "start with frame 4" in refused["remedy"]
    begun(http, id, 1, discard=True, frame=4)
    sdk.wait(id, 5)
    assert settled(http, id)["committed"] == 2
    put_form(http, id, 6)
    assert sdk.wait(id, 6).state == "committed"


def test_wrong_settings_are_refused_as_when_a_scene_is_made(http, sdk, make):
    id = make()
    put_form(http, id, 0)
    sdk.wait(id, 0)
    rig = RigModel.of(make_rig()).model_dump(mode="json")
    wrong = [{"update": {"iteration": 5}}, {"scene": {"image_scale": 0.1}}, {"scene": {"background": [2, 0, 0]}}]
    for settings in [*wrong, {"device": "tpu"}, {"static": {"max_gaussians": 10**12}}]:
        made = problem(http.post("/v1/scenes", json={"rig": rig, "settings": settings}), 422)
        again = problem(begin(http, id, 1, settings=settings), 422)
        assert {**again, "instance": None} == {**made, "instance": None}
    problem(begin(http, id, 1, setting={}), 422)
    assert status(http, id)["reconstruction"] == 0
    assert sdk.render(id, "c0", 0).shape


def test_points_of_the_next_reconstruction(http, sdk, service, make):
    id = make()
    put_form(http, id, 0)
    sdk.wait(id, 0)
    with pytest.raises(Exception, match=r"send them with \?reconstruction=1"):
        sdk.put_points(id, cloud(5))
    with pytest.raises(Exception, match="is not the next one"):
        sdk.put_points(id, cloud(5), reconstruction=2)
    receipt = sdk.put_points(id, cloud(5), reconstruction=1)
    assert (receipt.points, receipt.reconstruction) == (5, 1)
    assert sdk.put_points(id, cloud(5), reconstruction=1) == receipt
    assert not status(http, id)["has_points"]
    sdk.begin_again(id, 1)
    sdk.wait(id, 0)
    assert (settled(http, id)["gaussians"], status(http, id)["has_points"]) == (5, True)
    sdk.begin_again(id, 2)  # from the same ones
    sdk.wait(id, 0)
    assert settled(http, id)["gaussians"] == 5
    sdk.put_points(id, cloud(7), reconstruction=3)
    sdk.begin_again(id, 3, points=False)
    sdk.wait(id, 0)
    assert (settled(http, id)["gaussians"], status(http, id)["has_points"]) == (2, False)
    assert list(folder_of(service, id).path.glob("points*")) == []
    with pytest.raises(Exception, match=r"send them with \?reconstruction=4"):
        sdk.put_points(id, cloud(7))


def test_a_first_frame_at_work_is_stopped(http, sdk, make):
    id = make()
    put_form(http, id, 0, pictures(fakes.SLOW_RAISES))
    wait_for(lambda: status(http, id)["state"] == "initialising")
    put_form(http, id, 1)
    begun(http, id, 1, frame=1)
    assert sdk.wait(id, 1).state == "committed"
    assert sdk.frame(id, 0).state == "failed"
    assert status(http, id)["worker_deaths"] == 0


def test_a_pause_and_a_budget_stay(http, sdk, make):
    id = make()
    put_form(http, id, 0)
    sdk.wait(id, 0)
    http.put(f"/v1/scenes/{id}/budget", json={"iterations": 9})
    http.post(f"/v1/scenes/{id}/pause")
    put_form(http, id, 1)
    again = begun(http, id, 1)
    assert (again["paused"], again["queued"], again["budget"]["iterations"]) == (True, 2, 9)
    http.post(f"/v1/scenes/{id}/resume")
    assert sdk.wait(id, 1).iterations == 9


def test_a_frame_asked_for_is_not_skipped(http, sdk, make):
    id = make(queue_frames=2, when_full="skip")
    put_form(http, id, 0, pictures(fakes.RAISES))
    sdk.wait(id, 0)
    http.post(f"/v1/scenes/{id}/pause")
    begun(http, id, 1, frame=1)
    for index in range(1, 5):
        assert put_form(http, id, index).status_code == 202
    http.post(f"/v1/scenes/{id}/resume")
    sdk.wait(id, 4)
    assert [sdk.frame(id, index).state for index in range(1, 5)] == ["committed", "skipped", "skipped", "committed"]


def test_streams_and_sockets_go_on(http, sdk, service, make):
    id = make()
    address = f"ws{service.url.removeprefix('http')}/v1/scenes/{id}/stream"
    with (
        Stream(service.url, id) as stream,
        IngestSocket(sdk, id) as socket,
        connect(address, subprotocols=[STREAM_PROTOCOL]) as raw,
    ):
        stream.subscribe("f", finished_frames())
        stream.subscribe("s", scene_changes())
        socket.put_frame(0, pictures(fakes.PICKY))
        sdk.wait(id, 0)
        begun(http, id, 1, **PICKED)
        socket.put_frame(1, pictures())
        seen = []
        while not seen or seen[-1].index < 1:
            event = stream.receive(HANG_S)
            if isinstance(event, FrameMessage):
                seen.append(event.report)
        assert (seen[-1].index, seen[-1].state) == (1, "committed")
        assert stream.receive(HANG_S).status.reconstruction == 1
        assert '"hello"' in raw.recv(timeout=HANG_S)
        with pytest.raises(ConnectionClosed) as closed:
            raw.recv(timeout=HANG_S)
        assert closed.value.rcvd.code == SCENE_RESTARTS


def test_a_view_that_a_browser_kept_is_not_shown_for_another_one(http, sdk, make):
    id = make()
    put_form(http, id, 0)
    sdk.wait(id, 0)
    address = f"/v1/scenes/{id}/render?frame=0"
    kept = {"If-None-Match": http.get(address).headers["etag"]}
    assert http.get(address, headers=kept).status_code == 304
    begun(http, id, 1)
    sdk.wait(id, 0)
    assert http.get(address, headers=kept).status_code == 200


ADDRESSES = {
    "": [""],
    "/rig": ["/rig"],
    "/budget": ["/budget"],
    "/tradeoff": ["/tradeoff"],
    "/frames": ["/frames"],
    "/frames/{n}": ["/frames/0"],
    "/frames/{n}/cameras/{c}": ["/frames/0/cameras/c0"],
    "/frames/{n}/splat.ply": ["/frames/0/splat.ply"],
    "/states.s4d": ["/states.s4d", "/states.s4d?limit=1&parts=true"],
    "/gaussians": ["/gaussians?ids=0"],
    "/exports": ["/exports"],
    "/exports/{export}": [],  # of the reconstruction before they are gone (test_exports.py)
    "/exports/{export}/file": [],
    "/parts": ["/parts", "/parts?count=2"],
    "/joints": ["/joints", "/joints?count=2&from=0&to=0"],
    "/render": [
        "/render",
        "/render?frame=0",
        "/render?frame=0&kind=depth&format=npz",
        "/render?frame=0&kind=alpha&width=8&camera=c1",
        "/render?frame=0&kind=parts",
    ],
    "/tracks": ["/tracks?ids=0&from=0&to=0", "/tracks?point=0,0,0&format=npz"],
}
"""All addresses of a scene that are read, by route."""


def test_no_answer_that_a_cache_kept_is_shown_for_another_reconstruction(http, sdk, make):
    """A cache shows what it may keep again, unasked or where its tag still holds."""
    paths = http.get("/openapi.json").json()["paths"]
    read = [path for path, verbs in paths.items() if path.startswith("/v1/scenes/{id}") and "get" in verbs]
    routes = {path.removeprefix("/v1/scenes/{id}") for path in read}
    assert routes == ADDRESSES.keys()  # a new one is looked at here, too
    id = make()
    put_form(http, id, 0)
    sdk.wait(id, 0)
    kept = {}
    for address in (one for addresses in ADDRESSES.values() for one in addresses):
        answer = http.get(f"/v1/scenes/{id}{address}")
        assert answer.status_code == 200, address
        allowed = {word.strip() for word in answer.headers.get("cache-control", "").split(",")}
        assert allowed & {"no-store", "no-cache"}, address
        if "no-store" not in allowed:
            kept[address] = answer
    assert len(kept) == 7
    for number in (1, 2):
        begun(http, id, number)
        sdk.wait(id, 0)
        for address, before in kept.items():
            tag = before.headers["etag"]
            answer = http.get(f"/v1/scenes/{id}{address}", headers={"If-None-Match": tag})
            now = kept[address] = http.get(f"/v1/scenes/{id}{address}")
            # A weak tag names the reconstruction; a strong one the bytes, which may be the same.
            same = not tag.startswith("W/") and now.content == before.content
            assert answer.status_code == (304 if same else 200), address
            assert (now.headers["etag"] == tag) == same, address


def test_replays_work_on_the_new_states(http, sdk, make):
    id = make()
    for index in range(4):
        put_form(http, id, index)
    sdk.wait(id, 3)
    begun(http, id, 1, frame=1, discard=True)
    sdk.wait(id, 3)
    sdk.replay(id, [50], frames=1)
    wait_for(lambda: sdk.tradeoff(id).replay.state != "running")
    assert sdk.tradeoff(id).replay.state == "done", sdk.tradeoff(id).replay.error


def test_an_upload_that_is_under_way_is_asked_for_again(http, sdk, service, make):
    id = make()
    put_form(http, id, 0)
    sdk.wait(id, 0)
    go_on = threading.Event()
    answers = []

    def send():
        body = framed(1, pictures(3))

        def pieces():
            yield body[:200]
            go_on.wait(HANG_S)
            yield body[200:]

        headers = {**FRAMED, "Content-Length": str(len(body))}
        with httpx.Client(base_url=service.url, timeout=HANG_S) as mine:
            answers.append(mine.put(f"/v1/scenes/{id}/frames/1", content=pieces(), headers=headers))

    thread = threading.Thread(target=send)
    thread.start()
    wait_for(lambda: service.app.state.scenes[id].ingest.is_receiving(1))
    begun(http, id, 1)
    go_on.set()
    thread.join(HANG_S)
    assert problem(answers[0], 503)
    assert status(http, id)["next_frame"] == 1
    wait_for(lambda: len(list(folder_of(service, id).frames.iterdir())) == 1)
    put_form(http, id, 1)
    assert sdk.wait(id, 1).state == "committed"


def test_settings_change_before_the_first_frame(http, sdk, make):
    id = make()
    again = begun(http, id, 1, settings={"update": {"iterations": 3}})
    assert (again["state"], again["next_frame"]) == ("awaiting_first_frame", 0)
    put_form(http, id, 0)
    assert sdk.wait(id, 0).state == "committed"
