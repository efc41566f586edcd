"""What is refused names the field and the value, and the remedy says what to send instead of what was wrong."""

from __future__ import annotations

import httpx
import pytest
from running import make_rig, picture, pictures, problem
from waiting import HANG_S

from client.sdk import Client
from client.wire import RigModel
from scas4d_core.engines.choose import gpu_fault

CUT_JPEG, CUT_PNG = picture(format="JPEG")[:-9], picture()[:-9]


@pytest.fixture(scope="module")
def here(service):
    """A scene of two cameras with one committed frame."""
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = sdk.create_scene(make_rig()).id
        sdk.put_frame(id, 0, pictures())
        sdk.wait(id, 0)
        yield id
        sdk.delete_scene(id)


def body(**changes):
    return {"rig": RigModel.of(make_rig()).model_dump(mode="json"), **changes}


def files(**given):
    return {"files": {name: (name, data) for name, data in given.items()}}


QUERIES = {
    "render?kinds=depth": ("kinds", "depth", "kind, format, width"),
    "render?kind=dept": ("query.kind", "dept", "'depth'"),
    "render?camera=c9": ("camera", "c9", "c0, c1"),
    "render?background=red": ("background", "red", "background=1,1,1"),
    "render?width=99999": ("query.width", "99999", "at most 16384"),
    "tracks?pixels=1,2&camera=c0": ("pixels", "1,2", "'pixel'"),
    "tracks?pixel=99,2&camera=c0": ("pixels", "[99.0, 2.0]", "0 ≤ u < 24"),
    "tracks?pixel=1,2": ("camera", "nothing", "c0, c1"),
    "tracks?ids=99": ("ids", "[99]", "in a response"),
    "tracks?ids=0&from=7": ("from", "7", "0 to 0"),
    "tracks": ("ids", "none", "exactly one of"),
    "parts?cont=3": ("cont", "3", "'count'"),
    "parts?count=900": ("query.count", "900", "at most 254"),
    "parts?count=x": ("query.count", "x", "an integer"),
    "joints?count=33": ("query.count", "33", "at most 32"),
    "joints?from=7": ("from", "7", "0 to 0"),
    "frames?last=3": ("last", "3", "first, limit"),
    "frames/abc": ("path.n", "abc", "an integer"),
    "frames/-1": ("path.n", "-1", "at least 0"),
    "frames/0?x=": ("x", "", "no parameters"),
    "rig?x=1": ("x", "1", "no parameters"),
}


@pytest.mark.parametrize("path", QUERIES)
def test_an_address(http, here, path):
    field, value, remedy = QUERIES[path]
    document = problem(http.get(f"/v1/scenes/{here}/{path}"), 422)
    assert (document["field"], document["value"]) == (field, value)
    assert remedy in document["remedy"]


def test_joints_in_too_many_frames(http, here, monkeypatch):
    monkeypatch.setattr("server.routes.parts.MOST_JOINT_FRAMES", 0)
    document = problem(http.get(f"/v1/scenes/{here}/joints"), 422)
    assert (document["field"], document["value"]) == ("to", "0")
    assert "from=0" in document["remedy"]


DEFINITIONS = {
    "unknown setting": ({"settings": {"update": {"iteration": 3}}}, "settings.update.iteration", "3", "'iterations'"),
    "deeper": (
        {"settings": {"update": {"weights": {"rigid": 1}}}},
        "settings.update.weights.rigid",
        "1",
        "'rigidity'",
    ),
    "out of range": ({"settings": {"update": {"iterations": 0}}}, "settings.update.iterations", "0", "at least 1"),
    "of a union": (
        {"settings": {"scene": {"metres_per_unit": -1}}},
        "settings.scene.metres_per_unit",
        "-1",
        "greater than 0",
    ),
    "no object": ({"settings": {"update": "fast"}}, "settings.update", "fast", "an object"),
    "null": ({"settings": {"scene": {"image_scale": None}}}, "settings.scene.image_scale", "null", "a number"),
    "preset": ({"preset": "best"}, "preset", "best", "rigid, scas4d"),
    "misspelt": ({"presett": "scas4d"}, "body.presett", "scas4d", "'preset'"),
    "missing": ({"rig": {"axes": "opencv"}}, "body.rig.cameras", "nothing", "add 'cameras'"),
    "choice": ({"ingest": {"when_full": "wait"}}, "body.ingest.when_full", "wait", "'refuse' or 'skip'"),
    "ours": ({"ingest": {"keep_frames": {"last": 1, "bytes": 1}}}, "body.ingest.keep_frames", None, "one of them"),
}


@pytest.mark.parametrize("name", DEFINITIONS)
def test_a_definition(http, name):
    changes, field, value, remedy = DEFINITIONS[name]
    document = problem(http.post("/v1/scenes", json=body(**changes)), 422)
    assert document["field"] == field
    assert value is None or document["value"] == value
    assert remedy in document["remedy"]
    assert document["remedy"] not in document["detail"]


def test_broken_json_is_shown_where_it_breaks(http):
    text = '{"name": "studio", "rig": {"axes": "opencv",}}'
    answer = http.post("/v1/scenes", content=text, headers={"Content-Type": "application/json"})
    document = problem(answer, 422)
    assert document["field"] == "body"
    assert '"opencv",}' in document["value"]
    assert "well-formed" in document["remedy"]


PICTURES = {
    "missing": ({"c0": picture()}, "c1", "nothing", "add it"),
    "cut": ({"c0": picture(), "c1": CUT_JPEG}, "c1", f"{len(CUT_JPEG)} bytes", "original file"),
    "cut PNG": ({"c0": picture(), "c1": CUT_PNG}, "c1", f"{len(CUT_PNG)} bytes", "original file"),
    "empty": ({"c0": picture(), "c1": b""}, "c1", "0 bytes", "as JPEG, PNG, WebP, BMP, PPM or PGM"),
    "another kind": ({"c0": picture(), "c1": b"GIF89a" + bytes(60)}, "c1", "66 bytes", "encode"),
}


@pytest.mark.parametrize("name", PICTURES)
def test_a_frame(http, quiet_scene, name):
    given, field, value, remedy = PICTURES[name]
    document = problem(http.put(f"/v1/scenes/{quiet_scene}/frames/0", **files(**given)), 422)
    assert (document["field"], document["value"]) == (field, value)
    assert remedy in document["remedy"]
    assert document["remedy"] not in document["detail"]


def test_one_camera_is_no_cameras(http, quiet_scene):
    detail = problem(http.put(f"/v1/scenes/{quiet_scene}/frames/0", **files(c0=picture())), 422)["detail"]
    assert "1 camera:" in detail


def test_a_device_without_an_engine_is_refused_with_the_reason(http):
    before = http.get("/v1/scenes").json()
    document = problem(http.post("/v1/scenes", json=body(settings={"device": "cuda"})), 422)
    assert (document["field"], document["value"]) == ("settings.device", "cuda")
    assert "is not supported" in document["detail"]
    assert document["remedy"] == "choose 'auto', 'cpu' or 'gpu'"
    assert http.get("/v1/scenes").json() == before


@pytest.mark.skipif(gpu_fault() is None, reason="this machine has a GPU")
def test_a_gpu_that_is_not_there_is_refused_with_the_reason(http):
    before = http.get("/v1/scenes").json()
    document = problem(http.post("/v1/scenes", json=body(settings={"device": "gpu"})), 422)
    assert (document["field"], document["value"]) == ("settings.device", "gpu")
    assert document["detail"] == f"no usable GPU: {gpu_fault()}"
    assert document["remedy"] == "use 'auto' or 'cpu', or see docs/gpu.md"
    assert http.get("/v1/scenes").json() == before


def test_addresses_of_the_page_may_have_parameters(service):
    response = httpx.get(f"{service.url}/?from=mail", timeout=HANG_S, follow_redirects=True)
    assert (response.status_code, str(response.url)) == (200, f"{service.url}/viewer/?from=mail")
