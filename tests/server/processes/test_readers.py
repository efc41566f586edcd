"""The processes that answer: views ahead of all that takes long, questions taken back, processes that end."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import io
import threading
import time
from unittest import mock

import fakes
import httpx
import numpy as np
import pytest
from PIL import Image
from running import HEIGHT, WIDTH, Running, fake_settings, make_rig, pictures, problem
from waiting import HANG_S, wait_for

from client.sdk import Client
from client.wire import CameraModel, part_colour
from server.processes import query_executor, reader_process
from server.processes.placement import ProcessExit
from server.processes.queries import Answer


@pytest.fixture(scope="module")
def impatient(tmp_path_factory):
    """A service that soon gives up waiting for an answer; long enough for a process to start on a busy machine."""
    with mock.patch.object(query_executor, "ANSWER_SECONDS", 15.0):
        running = Running(fake_settings(tmp_path_factory.mktemp("data")))
        yield running
        running.stop()


@contextlib.contextmanager
def two_frames(impatient):
    """A scene of two frames: id, its readers, and a client."""
    with (
        Client(impatient.url, busy_timeout=HANG_S) as sdk,
        httpx.Client(base_url=impatient.url, timeout=HANG_S) as http,
    ):
        id = sdk.create_scene(make_rig(), frames_per_second=10).id
        for index in range(2):
            sdk.put_frame(id, index, pictures())
        sdk.wait(id, 1)
        yield id, impatient.app.state.scenes[id].readers, http
        sdk.delete_scene(id)


@pytest.fixture
def scene(impatient):
    """One that a test may do anything with."""
    with two_frames(impatient) as made:
        yield made


@pytest.fixture(scope="module")
def still(impatient):
    """One for the tests that only look at it."""
    with two_frames(impatient) as made:
        yield made


def in_the_background(function):
    result = concurrent.futures.Future()

    def run():
        with contextlib.suppress(httpx.HTTPError):  # it hangs up, or its scene ends
            result.set_result(function())

    threading.Thread(target=run, daemon=True).start()
    return result


def test_views_do_not_wait_for_a_query_that_never_ends(scene):
    id, readers, http = scene
    hanging = in_the_background(lambda: http.get(f"/v1/scenes/{id}/tracks?ids={fakes.HANGS}"))
    wait_for(lambda: readers.bulk._at_work is not None)
    for frame in (0, 1):
        assert http.get(f"/v1/scenes/{id}/render?frame={frame}").status_code == 200
    assert not hanging.done()


def test_what_nobody_waits_for_does_not_keep_the_reader(scene):
    """The query that timed out never ends; the next one is answered all the same."""
    id, readers, http = scene
    refused = http.get(f"/v1/scenes/{id}/tracks?ids={fakes.HANGS}")
    assert problem(refused, 503)["detail"] == "no answer within 15 s"
    assert http.get(f"/v1/scenes/{id}/tracks?ids=0").json()["ids"] == [0]
    assert readers.bulk._at_work is None


def test_one_who_hangs_up_takes_the_question_back(scene):
    id, readers, http = scene
    with pytest.raises(httpx.ReadTimeout):
        http.get(f"/v1/scenes/{id}/tracks?ids={fakes.HANGS}", timeout=1.0)
    wait_for(lambda: readers.bulk._at_work is None)
    assert http.get(f"/v1/scenes/{id}/tracks?ids=1").status_code == 200


@pytest.mark.parametrize("question", [f"tracks?ids={fakes.KILLS}", "parts", "frames/1/splat.ply"])
def test_a_question_that_waits_and_is_given_up_is_never_begun(scene, question):
    id, readers, http = scene
    hanging = in_the_background(lambda: http.get(f"/v1/scenes/{id}/tracks?ids={fakes.HANGS}"))
    wait_for(lambda: readers.bulk._at_work is not None)
    asked = readers.bulk._asked
    with pytest.raises(httpx.ReadTimeout):
        http.get(f"/v1/scenes/{id}/{question}", timeout=0.5)
    wait_for(lambda: not readers.bulk._waiting)
    assert readers.bulk._asked == asked + 1
    assert not hanging.done()


def test_a_reader_that_ends_is_started_again_after_a_pause(scene):
    id, readers, http = scene
    for failures in (1, 2):
        document = problem(http.get(f"/v1/scenes/{id}/tracks?ids={fakes.KILLS}"), 500)
        assert "exit code 9" in document["detail"]
        assert readers.bulk._failures == failures
    assert http.get(f"/v1/scenes/{id}/tracks?ids=0").status_code == 200
    assert readers.bulk._failures == 0


def test_the_process_for_bulk_starts_with_the_first_question_and_yields_to_the_others(scene):
    id, readers, http = scene
    assert readers.bulk.process is None
    http.get(f"/v1/scenes/{id}/render")
    assert readers.bulk.process is None
    http.get(f"/v1/scenes/{id}/tracks?ids=0")

    def nice(process):
        with open(f"/proc/{process.pid}/stat") as file:
            return int(file.read().rsplit(")", 1)[1].split()[16])

    assert nice(readers.bulk.process) == min(19, nice(readers.views.process) + 10)


def test_too_many_questions_are_refused(scene, monkeypatch):
    id, readers, http = scene
    monkeypatch.setattr(query_executor, "MOST_WAITING", 1)
    hanging = in_the_background(lambda: http.get(f"/v1/scenes/{id}/tracks?ids={fakes.HANGS}"))
    wait_for(lambda: readers.bulk._at_work is not None)
    in_the_background(lambda: http.get(f"/v1/scenes/{id}/tracks?ids=0"))
    wait_for(lambda: readers.bulk._waiting)
    refused = http.get(f"/v1/scenes/{id}/parts")
    assert problem(refused, 503)["detail"] == "this scene already has 1 waiting request"
    assert refused.headers["retry-after"] == "1"
    assert not hanging.done()


def test_deleting_a_scene_answers_whoever_waits(service):
    with Client(service.url, busy_timeout=HANG_S) as sdk, httpx.Client(base_url=service.url, timeout=HANG_S) as http:
        id = sdk.create_scene(make_rig()).id
        sdk.put_frame(id, 0, pictures())
        sdk.wait(id, 0)
        readers = service.app.state.scenes[id].readers
        hanging = in_the_background(lambda: http.get(f"/v1/scenes/{id}/tracks?ids={fakes.HANGS}"))
        wait_for(lambda: readers.bulk._at_work is not None)
        processes = [readers.views.process._process, readers.bulk.process._process]
        sdk.delete_scene(id)
        assert "closed" in problem(hanging.result(HANG_S), 503)["detail"]
        for process in processes:
            with pytest.raises(ValueError, match="closed"):
                process.is_alive()


def test_new_frames_are_seen_without_a_new_process(scene):
    id, readers, http = scene
    assert http.get(f"/v1/scenes/{id}/tracks?ids=0").json()["frames"] == [0, 1]
    before = readers.views.process.pid, readers.bulk.process.pid
    with Client(str(http.base_url), busy_timeout=HANG_S) as sdk:
        for index in (2, 3):
            sdk.put_frame(id, index, pictures())
            sdk.wait(id, index)
            assert http.get(f"/v1/scenes/{id}/render").headers["x-frame"] == str(index)
    assert http.get(f"/v1/scenes/{id}/tracks?ids=0").json()["frames"] == [0, 1, 2, 3]
    assert (readers.views.process.pid, readers.bulk.process.pid) == before


def test_views_of_parts_never_wait_for_parts_but_the_first_time(scene):
    id, readers, http = scene
    address = f"/v1/scenes/{id}/render?kind=parts&parts=2"
    assert http.get(address).headers["x-parts-frame"] == "1"
    with Client(str(http.base_url), busy_timeout=HANG_S) as sdk:
        sdk.put_frame(id, 2, pictures())
        sdk.wait(id, 2)
    in_the_background(lambda: http.get(f"/v1/scenes/{id}/tracks?ids={fakes.HANGS}", timeout=2.0))
    wait_for(lambda: readers.bulk._at_work is not None)
    seen = http.get(address)
    assert (seen.headers["x-frame"], seen.headers["x-parts-frame"]) == ("2", "1")
    wait_for(lambda: http.get(address).headers["x-parts-frame"] == "2")


def mine():
    return CameraModel.of(make_rig().cameras[0]).model_dump()


def test_pictures_of_every_format(still):
    id, _, http = still
    for format in ("png", "jpeg", "webp"):
        response = http.get(f"/v1/scenes/{id}/render?format={format}&background=0,1,0.5&camera=c1")
        assert response.headers["content-type"] == f"image/{format}"
        picture = Image.open(io.BytesIO(response.content))
        assert picture.format == format.upper()
        assert picture.size == (WIDTH, HEIGHT)
        assert np.abs(np.array(picture.convert("RGB"))[8, 8].astype(int) - [0, 255, 128]).max() < 12
        alpha = http.get(f"/v1/scenes/{id}/render?format={format}&kind=alpha")
        assert np.array(Image.open(io.BytesIO(alpha.content)).convert("L"))[8, 8] == 255
    best, worst = (
        http.post(f"/v1/scenes/{id}/render", json={"camera": "c0", "format": "jpeg", "quality": quality}).content
        for quality in (100, 5)
    )
    assert len(worst) < len(best)


def test_the_width_scales_the_camera(still):
    id, _, http = still
    response = http.get(f"/v1/scenes/{id}/render?width=48")
    assert Image.open(io.BytesIO(response.content)).size == (48, round(48 * HEIGHT / WIDTH))
    response = http.post(f"/v1/scenes/{id}/render", json={"camera": mine(), "width": 12})
    assert Image.open(io.BytesIO(response.content)).size == (12, 8)
    assert problem(http.get(f"/v1/scenes/{id}/render?width=16000"), 422)["field"] == "width"


def test_raw_floats_have_their_shape_in_the_headers(still):
    id, _, http = still
    request = {"camera": "c0", "format": "float32", "kinds": ["depth", "colour", "alpha", "parts"], "parts": 2}
    response = http.post(f"/v1/scenes/{id}/render", json=request)
    assert response.headers["x-channels"] == "depth,red,green,blue,alpha,parts"
    assert response.headers["x-dtype"] == "<f4"
    shape = tuple(int(side) for side in response.headers["x-shape"].split(","))
    assert shape == (HEIGHT, WIDTH, 6)
    array = np.frombuffer(response.content, "<f4").reshape(shape)
    assert np.isnan(array[0, 0, 0])
    assert array[0, 1, 0] == 4
    assert array[5, 5].tolist() == [2, 0, 0, 0, 1, 2]
    assert array[0, 0, 1] == pytest.approx(0.1)  # frame 1
    one = http.get(f"/v1/scenes/{id}/render?format=float32&kind=alpha")
    assert one.headers["x-shape"] == f"{HEIGHT},{WIDTH},1"


def test_parts_are_labels_with_colours_that_stay(still):
    id, _, http = still
    picture = Image.open(io.BytesIO(http.get(f"/v1/scenes/{id}/render?kind=parts&parts=2").content))
    assert picture.mode == "P"
    assert np.array(picture)[3, 3] == 2
    palette = np.array(reader_process.part_colours()).reshape(256, 3)
    assert palette[0].tolist() == [0, 0, 0]
    assert tuple(palette[2]) == part_colour(1)
    assert picture.convert("RGB").getpixel((3, 3)) == tuple(palette[2])


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("background=1,1", "background"),
        ("background=red", "background"),
        ("background=0,0,nan", "background"),
        ("background=0,0,2", "background"),
        ("kind=depth&format=webp", "format"),
        ("kind=parts&format=jpeg", "format"),
        ("quality=0", "quality"),
        ("width=0", "width"),
        ("format=gif", "format"),
    ],
)
def test_what_is_wrong_with_an_address_is_named(still, query, field):
    id, _, http = still
    assert field in problem(http.get(f"/v1/scenes/{id}/render?{query}"), 422)["field"]


def test_only_what_stays_may_be_kept_by_a_browser(still):
    id, _, http = still
    assert http.get(f"/v1/scenes/{id}/render").headers["cache-control"] == "no-store"
    named = http.get(f"/v1/scenes/{id}/render?frame=0")
    assert named.headers["cache-control"] == "private, no-cache"
    again = http.get(f"/v1/scenes/{id}/render?frame=0", headers={"If-None-Match": named.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert http.get(f"/v1/scenes/{id}/render?frame=0&kind=parts").headers["cache-control"] == "no-store"


def test_a_state_that_went_missing_is_answered_from_a_copy_or_asked_for_later(scene, impatient):
    id, _, http = scene
    states = impatient.app.state.scenes[id].spec.folder.states
    (states / "frame_000000.npz").unlink()
    assert http.get(f"/v1/scenes/{id}/render?frame=0").status_code == 200
    (states / "frame_000001.npz").unlink()
    answer = http.get(f"/v1/scenes/{id}/render?frame=1")
    assert "frame 1" in problem(answer, answer.status_code)["detail"]
    assert answer.status_code in (404, 503)
    until = time.monotonic() + HANG_S
    while http.get(f"/v1/scenes/{id}/render?frame=1").status_code != 200:
        assert time.monotonic() < until
        time.sleep(0.05)


class FakeProcess:
    """A reader that keeps what it is asked."""

    pid = None

    def __init__(self, on_message, on_end):
        self.on_message, self.on_end, self.asked = on_message, on_end, []

    def send(self, message):
        self.asked.append(message)

    async def stop(self, seconds=0.0):
        pass


class FakePlacement:
    """Starts such readers."""

    def __init__(self):
        self.started = []

    def start(self, entry, spec, on_message, on_end):
        self.started.append(FakeProcess(on_message, on_end))
        return self.started[-1]


@pytest.mark.parametrize(("lost", "times", "status"), [(True, 1, None), (True, 2, 503), (False, 1, 500)])
def test_a_query_whose_reader_is_lost_with_its_machine_goes_to_the_next(monkeypatch, lost, times, status):
    """A machine that is lost is no fault of the query; one that two of them are lost with may be."""
    monkeypatch.setattr(query_executor, "FIRST_PAUSE_S", 0.01)
    placement = FakePlacement()
    spec = mock.Mock()
    spec.folder.name = "scene"

    async def asks():
        queue = query_executor.QueryExecutor(None, spec, placement, grace=1.0, damaged=lambda files: None)
        asking = asyncio.ensure_future(queue.ask(mock.Mock(kind="render")))
        for number in range(1, times + 1):
            while len(placement.started) < number or not placement.started[-1].asked:
                await asyncio.sleep(0.005)
            placement.started[-1].on_end(ProcessExit(None, "the node of the reader process was lost", lost=lost))
        if status is None:
            while len(placement.started) < 2 or not placement.started[-1].asked:
                await asyncio.sleep(0.005)
            (again,) = placement.started[1].asked
            placement.started[1].on_message(Answer(again.number, b"", "image/png"))
        answer = await asyncio.wait_for(asking, HANG_S)
        await queue.stop(0)
        return answer

    answer = asyncio.run(asks())
    assert isinstance(answer, Answer) if status is None else answer.status == status
