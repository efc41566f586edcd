from __future__ import annotations

import io

import numpy as np
import pytest
from running import HEIGHT, WIDTH, make_rig, picture, pictures, problem
from waiting import wait_for

from client.calls import put_frame
from client.sdk import ServiceError
from client.wire import RigModel
from scas4d_core.captures import InitialPoints
from scas4d_core.storage.npz import read_npz
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
    processes = [scene.updates.worker._process._process, scene.readers.views.process._process]
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
    assert effects["floor"]["description"].endswith(".")
    http.delete(created.headers["Location"])


def edited(change):
    body = {"rig": rig_json()}
    change(body)
    return body


def set_camera(field, value):
    return lambda body: body["rig"]["cameras"][0].__setitem__(field, value)


def set_setting(group, name, value):
    return lambda body: body.__setitem__("settings", {group: {name: value}})


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
    "left-handed": (
        set_camera("world_to_camera", [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]]),
        "rig.cameras.0",
    ),
    "background above 1": (set_setting("scene", "background", [0, 1.5, 0]), "settings.scene.background.1"),
    "background below 0": (set_setting("scene", "background", [0, 0, -0.1]), "settings.scene.background.2"),
    "a few pixels": (set_setting("scene", "image_scale", 0.1), "settings.scene.image_scale"),
    "pixels by the million": (set_camera("width", 100_000), "rig.cameras.0.width"),
    "iterations": (set_setting("update", "iterations", 10**9), "settings.update.iterations"),
    "iterations of frame 0": (set_setting("static", "iterations", 10**9), "settings.static.iterations"),
    "clusters": (set_setting("update", "clusters", [64, 10**9]), "settings.update.clusters.1"),
    "layers": (set_setting("update", "clusters", list(range(1, 18))), "settings.update.clusters"),
    "Gaussians": (set_setting("static", "max_gaussians", 10**9), "settings.static.max_gaussians"),
    "milliseconds": (set_setting("update", "budget_ms", 1e12), "settings.update.budget_ms"),
    "max rejected frames": (set_setting("update", "max_rejected_frames", 10**9), "settings.update.max_rejected_frames"),
    "unit": (set_setting("scene", "metres_per_unit", 1e-30), "settings.scene.metres_per_unit"),
    "short focal length": (set_camera("intrinsics", [[1.0, 0, 12], [0, 20, 8], [0, 0, 1]]), "rig.cameras.0.intrinsics"),
    "long focal length": (set_camera("intrinsics", [[20, 0, 12], [0, 1e6, 8], [0, 0, 1]]), "rig.cameras.0.intrinsics"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_scene_is_refused_by_name(http, name):
    change, field = BAD[name]
    scenes = len(http.get("/v1/scenes").json()["scenes"])
    document = problem(http.post("/v1/scenes", json=edited(change)), 422)
    assert field in document["field"]
    assert document["remedy"]
    assert document["value"]
    assert len(http.get("/v1/scenes").json()["scenes"]) == scenes


def test_labels_of_nodes_need_a_cluster(http):
    found = problem(http.post("/v1/scenes", json={"rig": rig_json(), "nodes": {"rig": "stage-a"}}), 422)
    assert (found["field"], found["value"]) == ("nodes", "{'rig': 'stage-a'}")
    assert found["remedy"] == "omit it, or run the service on a cluster: scas4d serve --placement ray"
    bad = problem(http.post("/v1/scenes", json={"rig": rig_json(), "nodes": {"rig": "stage a"}}), 422)
    assert (bad["field"], bad["detail"]) == (
        "body.nodes",
        "body.nodes: 'stage a' is not a valid value for a node label",
    )


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
    with pytest.raises(ServiceError, match="already started without these points"):
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


def test_a_left_handed_rig_is_told_the_way_out(http):
    change, _ = BAD["left-handed"]
    document = problem(http.post("/v1/scenes", json=edited(change)), 422)
    assert "determinant -1 (left-handed)" in document["detail"]
    assert "flip one axis" in document["remedy"]


def beside_one_another(count):
    """A rig whose cameras look along the world's z axis."""
    return RigModel.of(make_rig(count)).model_dump(mode="json")


@pytest.mark.parametrize("columns", [6, 7])
def test_a_cloud_of_dynamic3dgs_is_taken_as_it_is(http, sdk, scene, service, columns):
    data = np.array([[0, 0, 1, 0.1, 0.2, 0.3, 1], [0, 0, 2, 0.4, 0.5, 0.6, 0], [0, 0, 3, 0, 0, 1, 0.5]])[:, :columns]
    file = io.BytesIO()
    np.savez(file, data=data)
    answer = http.put(f"/v1/scenes/{scene}/points", content=file.getvalue())
    assert (answer.status_code, answer.json()["points"]) == (200, 3)
    stored = read_npz(service.app.state.scenes[scene].spec.folder.points)
    np.testing.assert_array_equal(stored["positions"], data[:, :3])
    np.testing.assert_array_equal(stored["colours"], data[:, 3:6].astype(np.float32))
    assert ("foreground" in stored) == (columns == 7)


@pytest.mark.parametrize("shape", [(3, 5), (3,), (0, 7)])
def test_a_cloud_of_another_shape_is_refused(http, quiet_scene, shape):
    file = io.BytesIO()
    np.savez(file, data=np.zeros(shape))
    refused = problem(http.put(f"/v1/scenes/{quiet_scene}/points", content=file.getvalue()), 422)
    assert refused["field"] in ("data", "positions")


@pytest.mark.parametrize("parts", [False, True])
def test_cameras_at_one_place_need_points(http, sdk, parts):
    body = {"rig": beside_one_another(2)}
    for camera in body["rig"]["cameras"]:
        camera["world_to_camera"] = np.eye(4).tolist()
    id = http.post("/v1/scenes", json=body).json()["id"]
    try:
        if parts:
            answer = http.put(
                f"/v1/scenes/{id}/frames/0/cameras/c0", content=picture(), headers={"Content-Type": "image/png"}
            )
        else:
            answer = http.put(f"/v1/scenes/{id}/frames/0", **put_frame(id, 0, pictures()).arguments)
        document = problem(answer, 422)
        assert (document["field"], document["value"]) == ("points", "nothing")
        assert "all 2 cameras are at the same position" in document["detail"]
        assert sdk.scene(id).next_frame == 0
        sdk.put_points(id, InitialPoints(np.array([[0, 0, 2.0]]), np.zeros((1, 3), np.float32)))
        sdk.put_frame(id, 0, pictures())
        assert sdk.wait(id, 0).gaussians == 1
    finally:
        sdk.delete_scene(id)


def test_points_behind_all_cameras_are_refused(http, quiet_scene):
    body = npz(positions=np.array([[0, 0, -9.0], [0, 1, -7]]), colours=C[:2])
    document = problem(http.put(f"/v1/scenes/{quiet_scene}/points", content=body), 422)
    assert (document["field"], document["value"]) == ("points", "2 points")
    assert "behind all cameras" in document["detail"]


def test_poses_the_wrong_way_round_are_a_warning(http, sdk):
    """FrameObservation from the right way round: two cameras left and right of z, 3 away, looking at the origin."""
    body = {"rig": rig_json()}
    for camera, angle in zip(body["rig"]["cameras"], (0.5, -0.5), strict=True):
        c, s = np.cos(angle), np.sin(angle)
        right = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 3], [0, 0, 0, 1]])
        camera["world_to_camera"] = np.linalg.inv(right @ turned_over(angle)).tolist()
    id = http.post("/v1/scenes", json=body).json()["id"]
    try:
        assert sdk.scene(id).warnings == []  # two cameras say too little
        cloud = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
        sdk.put_points(id, InitialPoints(cloud, np.zeros((50, 3), np.float32)))
        (said,) = sdk.scene(id).warnings
        assert "the poses seem to be inverted" in said
    finally:
        sdk.delete_scene(id)


def turned_over(angle):
    """The world turned by a quarter about x: inverted poses look past its origin then."""
    return np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


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
    views = service.app.state.scenes[scene].readers.views
    killed = views.process
    killed._process.kill()
    wait_for(lambda: views.process is not killed)
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
