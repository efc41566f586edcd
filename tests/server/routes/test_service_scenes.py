from __future__ import annotations

import io
import time

import numpy as np
import pytest
from running import HEIGHT, WIDTH, make_rig, picture, pictures, problem

from client.calls import put_frame
from client.sdk import ServiceError
from client.wire import RigModel
from scas4d_core.captures import InitialPoints
from server.processes import track_answers
from server.routes import points


def rig_json(count=2):
    return RigModel.of(make_rig(count)).model_dump(mode="json")


def test_health_and_documents(http):
    assert http.get("/health/live").json()["status"] == "live"
    assert http.get("/health/ready").json()["status"] == "ready"
    paths = http.get("/openapi.json").json()["paths"]
    assert "/v1/scenes/{id}/frames/{n}" in paths
    problem(http.get("/v2"), 404)
    problem(http.request("PATCH", "/v1/scenes"), 405)


def test_a_scene_is_created_listed_and_deleted(http, service):
    created = http.post(
        "/v1/scenes", json={"rig": rig_json(), "name": "studio", "settings": {"update": {"iterations": 7}}}
    )
    assert created.status_code == 201
    status = created.json()
    assert (status["state"], status["next_frame"], status["name"]) == ("awaiting_first_frame", 0, "studio")
    assert status["settings"]["update"]["iterations"] == 7
    assert status["settings"]["update"]["views"] == 1  # the preset's
    url = created.headers["Location"]
    assert status["id"] in [scene["id"] for scene in http.get("/v1/scenes").json()["scenes"]]
    scene = service.app.state.scenes[status["id"]]
    processes = [scene.updates._worker._process, scene.readers.views.process._process]
    assert http.delete(url).status_code == 204
    problem(http.get(url), 404)
    assert not scene.spec.folder.path.exists()
    for process in processes:
        with pytest.raises(ValueError, match="closed"):
            process.is_alive()


def test_the_status_has_the_effects_before_any_frame(http):
    settings = {"effects": {"isometry": "off", "rigidity": "on"}}
    created = http.post("/v1/scenes", json={"rig": rig_json(), "settings": settings})
    assert created.status_code == 201
    effects = created.json()["effects"]
    told = {
        name: (effects[name]["on"], effects[name]["pinned"]) for name in ("rigidity", "isometry", "rotation", "floor")
    }
    assert told == {
        "rigidity": (True, True),
        "isometry": (False, True),
        "rotation": (True, False),
        "floor": (False, False),
    }
    assert effects["floor"]["says"].endswith(".")
    http.delete(created.headers["Location"])


def edited(change):
    body = {"rig": rig_json()}
    change(body)
    return body


def set_camera(field, value):
    return lambda body: body["rig"]["cameras"][0].__setitem__(field, value)


def one_camera(body):
    body["rig"]["cameras"] = body["rig"]["cameras"][:1]
    body["settings"] = {"scene": {"metres_per_unit": "auto"}}


BAD = {
    "no cameras": (lambda b: b["rig"].__setitem__("cameras", []), "cameras"),
    "axes": (lambda b: b["rig"].__setitem__("axes", "opengl"), "axes"),
    "names twice": (set_camera("name", "c1"), "rig"),
    "name of a path": (set_camera("name", "../c"), "name"),
    "name of another field": (set_camera("name", "time"), "cameras"),
    "singular intrinsics": (set_camera("intrinsics", [[0.0] * 3] * 3), "cameras"),
    "no rotation": (
        set_camera("world_to_camera", [[2.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        "cameras",
    ),
    "short matrix": (set_camera("intrinsics", [[1.0]]), "intrinsics"),
    "too large": (lambda b: [set_camera(s, 10_000)(b) for s in ("width", "height")], "rig.cameras"),
    "preset": (lambda b: b.__setitem__("preset", "best"), "preset"),
    "unknown setting": (
        lambda b: b.__setitem__("settings", {"update": {"iterationz": 1}}),
        "settings.update.iterationz",
    ),
    "setting out of range": (lambda b: b.__setitem__("settings", {"update": {"iterations": 0}}), "iterations"),
    "setting of another kind": (lambda b: b.__setitem__("settings", {"update": 3}), "settings.update"),
    "unit of one camera": (one_camera, "settings.scene.metres_per_unit"),
    "unknown effect": (lambda b: b.__setitem__("settings", {"effects": {"flor": "on"}}), "settings.effects"),
    "effect of another mode": (
        lambda b: b.__setitem__("settings", {"effects": {"floor": "maybe"}}),
        "settings.effects.floor",
    ),
    "effect that the settings contradict": (
        lambda b: b.__setitem__("settings", {"effects": {"floor": "on"}}),
        "settings.effects.floor",
    ),
    "misspelt": (lambda b: b.__setitem__("rigg", 1), "rigg"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_scene_is_refused_by_name(http, name):
    change, field = BAD[name]
    document = problem(http.post("/v1/scenes", json=edited(change)), 422)
    assert field in document["field"]
    assert document["remedy"]


def test_numbers_that_are_none_are_refused(http):
    text = '{"rig": {"axes": "opencv", "cameras": [{"name": "a", "intrinsics": [[NaN,0,1],[0,1,1],[0,0,1]], '
    text += '"world_to_camera": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]], "width": 4, "height": 4}]}}'
    for body in (text, text.replace("NaN", "Infinity"), "{", "[]", '"\\ud800"', text.replace('"a"', '"\\ud800"')):
        problem(http.post("/v1/scenes", content=body, headers={"Content-Type": "application/json"}), 422)


def test_more_scenes_than_the_limit_are_refused(sdk, http):
    made = []
    try:
        while len(sdk.scenes()) < 4:
            made.append(sdk.create_scene(make_rig()).id)
        assert problem(http.post("/v1/scenes", json={"rig": rig_json()}), 429)["value"] == "4"
    finally:
        for id in made:
            sdk.delete_scene(id)


def npz(**arrays):
    return track_answers.npz(arrays)


def test_points_come_before_the_first_frame(http, sdk, scene):
    points = InitialPoints(np.array([[0, 0, 1.0], [0, 0, 2], [0, 0, 3]]), np.zeros((3, 3), np.float32))
    receipt = sdk.put_points(scene, points)
    assert receipt.points == 3
    sdk.put_frame(scene, 0, pictures())
    assert sdk.wait(scene, 0).gaussians == 3  # the fake starts one Gaussian a point
    assert sdk.put_points(scene, points) == receipt
    with pytest.raises(ServiceError, match="started without these points"):
        sdk.put_points(scene, InitialPoints(points.positions + 1, points.colours))


P, C = np.zeros((4, 3)), np.zeros((4, 3), np.float32)
BAD_POINTS = {
    "nothing": (b"", "points"),
    "no zip": (b"PK\3\4 and then nothing", "points"),
    "pickle": (npz(positions=P, colours=C)[:-40], "points"),
    "no colours": (npz(positions=P), "colours"),
    "shape": (npz(positions=P[:, :2], colours=C), "positions"),
    "scalar": (npz(positions=np.float64(3), colours=C), "positions"),
    "other number": (npz(positions=P, colours=C[:2]), "colours"),
    "nan": (npz(positions=P * np.nan, colours=C), "positions"),
    "range": (npz(positions=P, colours=C + 255), "colours"),
    "text": (npz(positions=np.full((4, 3), "a"), colours=C), "positions"),
    "too many": (npz(positions=np.zeros((1001, 3)), colours=np.zeros((1001, 3))), "positions"),
    "empty": (npz(positions=P[:0], colours=C[:0]), "positions"),
}


@pytest.mark.parametrize("name", BAD_POINTS)
def test_bad_points_are_refused_by_name(http, quiet_scene, monkeypatch, name):
    monkeypatch.setattr(points, "MOST_POINTS", 1000)
    body, field = BAD_POINTS[name]
    assert problem(http.put(f"/v1/scenes/{quiet_scene}/points", content=body), 422)["field"] == field


def test_nothing_is_unpickled(http, quiet_scene, tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    body = io.BytesIO()
    np.savez(body, positions=np.array([Trap()], dtype=object), colours=C)
    assert problem(http.put(f"/v1/scenes/{quiet_scene}/points", content=body.getvalue()), 422)["field"] == "points"
    assert not (tmp_path / "sprung").exists()


def test_a_cloud_that_unpacks_to_gigabytes_is_refused_unread(http, quiet_scene, monkeypatch):
    monkeypatch.setattr(points, "MOST_POINTS", 1000)
    body = io.BytesIO()
    np.savez_compressed(body, positions=np.zeros((100_000, 3)), colours=C)
    problem(http.put(f"/v1/scenes/{quiet_scene}/points", content=body.getvalue()), 413)


def test_a_reader_that_dies_is_replaced(sdk, scene, service):
    sdk.put_frame(scene, 0, pictures())
    sdk.wait(scene, 0)
    sdk.render(scene, "c0")
    service.app.state.scenes[scene].readers.views.process._process.kill()
    time.sleep(0.2)
    assert sdk.render(scene, "c0").shape == (HEIGHT, WIDTH, 3)


def test_progress_ends_with_the_first_frame(sdk, scene):
    sdk.put_frame(scene, 0, {"c0": picture(), "c1": picture()})
    sdk.wait(scene, 0)
    assert sdk.scene(scene).progress is None


@pytest.mark.parametrize("address", ["frames/0", "frames/0/cameras/c0"])
def test_a_frame_whose_scene_is_deleted_while_it_comes_in_is_not_found(sdk, http, address):
    id = sdk.create_scene(make_rig()).id
    whole = put_frame(id, 0, pictures()).arguments
    body, headers = (pictures()["c0"], {"Content-Type": "image/png"}) if "cameras" in address else whole.values()

    def chunks():
        yield body[:-1]
        sdk.delete_scene(id)
        yield body[-1:]

    answer = http.put(f"/v1/scenes/{id}/{address}", content=chunks(), headers=headers)
    assert problem(answer, 404)["field"] == "id"
