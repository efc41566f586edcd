from __future__ import annotations

import io

import fakes
import numpy as np
import pytest
from fakes import STEP_M
from PIL import Image
from running import HEIGHT, WIDTH, make_rig, pictures, problem
from typer.testing import CliRunner

from client.cli.main import app
from client.exports import sources
from client.sdk import Client, ServiceError
from client.wire import CameraModel
from scas4d_core.compact import CompactReader
from scas4d_core.query.ply import read_ply
from server.queries import tracks as queries


@pytest.fixture(scope="module")
def finished(service):
    """A scene of three frames."""
    with Client(service.url) as sdk:
        id = sdk.create_scene(make_rig(), frames_per_second=10).id
        for index in range(3):
            sdk.put_frame(id, index, pictures())
        sdk.wait(id, 2)
        yield id
        sdk.delete_scene(id)


def render(http, id, **request):
    return http.post(f"/v1/scenes/{id}/render", json=request)


def test_a_view_of_any_camera_at_any_committed_frame(http, finished):
    camera = CameraModel.of(make_rig().cameras[0]).model_dump() | {"name": "mine", "width": 30, "height": 20}
    for frame in range(3):
        response = render(http, finished, camera=camera, frame=frame, background=[0, 0, 1])
        assert response.headers["content-type"] == "image/png"
        assert response.headers["x-frame"] == str(frame)
        picture = np.array(Image.open(io.BytesIO(response.content)))
        assert picture.shape == (20, 30, 3)
        assert picture[0, 0, 0] == round(255 * frame / 10)
        assert picture[5, 5].tolist() == [0, 0, 255]


def test_a_view_by_address(http, finished):
    response = http.get(f"/v1/scenes/{finished}/render?frame=1&format=jpeg")
    assert response.headers["content-type"] == "image/jpeg"
    assert Image.open(io.BytesIO(response.content)).size == (WIDTH, HEIGHT)


def test_depth_alpha_and_parts(sdk, http, finished):
    arrays = sdk.render_arrays(finished, "c1", 1, kinds=["colour", "depth", "alpha", "parts"], parts=2)
    assert arrays["colour"].dtype == np.float32
    assert np.isnan(arrays["depth"][0, 0])
    assert arrays["depth"][0, 1] == 4
    assert arrays["parts"].max() == 2
    response = render(http, finished, camera="c1", kinds=["depth"])
    levels = np.array(Image.open(io.BytesIO(response.content)))
    near, far = float(response.headers["x-depth-near"]), float(response.headers["x-depth-far"])
    assert (near, far) == (2.0, 4.0)
    assert levels[0, :3].tolist() == [0, 65535, 1]


@pytest.mark.parametrize(
    ("request_", "status", "field"),
    [
        ({"camera": "c7"}, 422, "camera"),
        ({"camera": "c0", "frame": 3}, 404, "frame"),
        ({"camera": "c0", "kinds": ["colour", "depth"]}, 422, "kinds"),
        ({"camera": "c0", "kinds": ["depth"], "format": "jpeg"}, 422, "format"),
        ({"camera": "c0", "kinds": []}, 422, "kinds"),
        ({"camera": "c0", "frame": 10**30}, 404, "frame"),
        (
            {"camera": CameraModel.of(make_rig().cameras[0]).model_dump() | {"width": 9000, "height": 9000}},
            422,
            "camera",
        ),
        ({"camera": CameraModel.of(make_rig().cameras[0]).model_dump() | {"width": 0}}, 422, "camera"),
    ],
)
def test_a_bad_render_is_refused_by_name(http, finished, request_, status, field):
    assert field in problem(render(http, finished, **request_), status)["field"]


def test_nothing_can_be_read_before_the_first_commit(http, quiet_scene):
    for path in ("render", "tracks?ids=0", "parts", "gaussians?ids=0"):
        assert problem(http.get(f"/v1/scenes/{quiet_scene}/{path}"), 409)["state"] == "awaiting_first_frame"
    problem(http.get(f"/v1/scenes/{quiet_scene}/frames/0/splat.ply"), 409)
    problem(http.get(f"/v1/scenes/{quiet_scene}/frames/0"), 404)


def test_tracks_by_id_point_and_pixel(sdk, http, finished):
    tracks = sdk.tracks(finished, ids=[1, 0], project=["c0"])
    assert (tracks.frames, tracks.times, tracks.ids) == ([0, 1, 2], [0.0, 0.1, 0.2], [1, 0])
    steps = np.diff(np.array(tracks.positions[0]), axis=0)
    assert np.allclose(steps, [[fakes.STEP_M, 0, 0]] * 2, atol=1e-6)
    expected = make_rig().cameras[0].project(np.array(tracks.positions[0]))[0]
    assert np.allclose(tracks.pixels["c0"][0], expected)
    assert tracks.visible["c0"][0] == [True, True, True]

    carried = sdk.tracks(finished, points=np.array([[0.5, 0.01, 0]]), at=0, frames=(0, 1))
    assert carried.frames == [0, 1]
    assert carried.ids == [1]
    assert np.allclose(carried.positions[0][1], [0.5 + fakes.STEP_M, 0.01, 0], atol=1e-6)

    missed = sdk.tracks(finished, pixels=np.array([[3.5, 4.5]]), camera="c1", at=2)
    assert (missed.ids, missed.positions) == ([-1], [[None, None, None]])

    addressed = http.get(f"/v1/scenes/{finished}/tracks?point=0.5,0.01,0&at=0&from=0&to=1")
    assert addressed.json() == carried.model_dump(mode="json")
    response = http.get(f"/v1/scenes/{finished}/tracks?ids=0&format=npz")
    with np.load(io.BytesIO(response.content), allow_pickle=False) as file:
        assert file["tracks_XYZ"].shape == (3, 1, 3)


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("", "ids"),
        ("ids=0&point=0,0,0", "ids"),
        ("ids=a", "ids"),
        ("ids=99999999999999999999999", "ids"),
        ("point=0,0", "point"),
        ("point=0,0,nan", "point"),
        ("pixel=1,1", "camera"),
        ("pixel=1,1&camera=c9", "camera"),
        ("ids=0&from=5", "from"),
        ("ids=0&project=c9", "camera"),
        ("ids=0&from=-1", "from"),
    ],
)
def test_a_bad_track_query_is_refused_by_name(http, finished, query, field):
    assert field in problem(http.get(f"/v1/scenes/{finished}/tracks?{query}"), 422)["field"]


def test_many_tracks_and_any_camera(sdk, finished, monkeypatch):
    monkeypatch.setattr(queries, "MOST_POINTS", 5000)
    mine = make_rig().cameras[0].scaled(2)
    tracks = sdk.tracks(finished, points=np.zeros((3000, 3)), frames=(2, 2), project=[mine, "c1"])
    assert np.shape(tracks.positions) == (3000, 1, 3)
    assert sorted(tracks.pixels) == ["c0", "c1"]
    with pytest.raises(ServiceError, match="2000 points over 3 frames"):
        sdk.tracks(finished, points=np.zeros((2000, 3)))


def test_what_only_the_reader_knows_is_refused_too(http, finished):
    assert "99" in problem(http.get(f"/v1/scenes/{finished}/tracks?ids=99"), 422)["detail"]
    assert "outside" in problem(http.get(f"/v1/scenes/{finished}/tracks?pixel=-1,0&camera=c0"), 422)["detail"]


def test_parts_and_ply(sdk, finished):
    parts = sdk.parts(finished, 2)
    assert (parts.count, parts.ids, parts.labels) == (2, [0, 1], [0, 1])
    assert sdk.ply(finished, 1) == b"ply\n1"


def test_states_come_as_compact_files(sdk, http, finished, tmp_path):
    whole, following = sdk.states(finished, parts=True)
    assert following is None
    (tmp_path / "whole.s4d").write_bytes(whole)
    with CompactReader(tmp_path / "whole.s4d") as reader:
        assert reader.frames == [0, 1, 2]
        assert reader.head.rig.names == ("c0", "c1")
        assert reader.parts().tolist() == [0, 1]
        moved = reader.state(2).means - reader.state(0).means
        assert moved[:, 0] == pytest.approx([2 * STEP_M] * 2, abs=0.01)
        one = reader.state(1)
    part, following = sdk.states(finished, first=1, limit=1)
    assert following == 2
    (tmp_path / "part.s4d").write_bytes(part)
    with CompactReader(tmp_path / "part.s4d") as reader:
        assert reader.frames == [1]
        assert reader.parts() is None
        assert np.abs(reader.state(1).means - one.means).max() < 0.01
    for wrong, status in (("first=3", 404), ("limit=121", 422), ("first=-1", 422), ("frame=1", 422)):
        problem(http.get(f"/v1/scenes/{finished}/states.s4d?{wrong}"), status)


def test_a_scene_is_exported_by_the_command(service, finished, tmp_path, monkeypatch):
    def run(*more):
        given = ["export", finished, "--url", service.url, *more]
        return CliRunner().invoke(app, given, env={"COLUMNS": "200"})

    told = run("--format", "ply", "--out", str(tmp_path / "a"), "--frames", "1:")
    assert told.exit_code == 0, told.output
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["frame_000001.ply", "frame_000002.ply"]
    assert len(read_ply(tmp_path / "a" / "frame_000001.ply")) == 2
    monkeypatch.setattr(sources, "MOST", 2)  # two files
    whole = run("--format", "usd", "--out", str(tmp_path / "a.usda"))
    assert whole.exit_code == 0, whole.output
    assert "3 frames in" in whole.output
    assert "timeCodesPerSecond = 10" in (tmp_path / "a.usda").read_text()
    poses = run("--format", "poses", "--out", str(tmp_path / "a.csv"))
    assert poses.exit_code == 0, poses.output
    assert len((tmp_path / "a.csv").read_text().splitlines()) == 1 + 3 * 2
    for wrong, says in (
        (("--format", "obj"), "unknown format"),
        (("--format", "ply", "--frames", "7:9"), "7"),
        (("--format", "ply", "--frames", "x"), "not a valid range"),
        (("--format", "ply", "--id", "3"), "omit --id"),
        (("--format", "usd", "--out", "a.ply"), ".usdc"),
    ):
        failed = run(*wrong)
        assert failed.exit_code != 0
        assert says in str(failed.exception)


def test_lives_of_gaussians(sdk, finished):
    found = sdk.gaussians(finished, [1, 0])
    assert (found.frame, [one.id for one in found.gaussians]) == (2, [1, 0])
    assert {(one.born, tuple(one.retired), tuple(one.revived)) for one in found.gaussians} == {(0, (), ())}


@pytest.mark.parametrize(
    ("ids", "status"), [("99", 404), ("0,99", 404), ("-1", 422), ("a", 422), ("", 422), ("1,", 422)]
)
def test_ids_that_no_gaussian_has_are_refused_by_name(http, finished, ids, status):
    told = problem(http.get(f"/v1/scenes/{finished}/gaussians?ids={ids}"), status)
    assert "ids" in told["field"]
    assert told["remedy"]
    assert status == 422 or ("99" in told["value"] and "[99]" in told["detail"])
