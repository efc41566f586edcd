"""Trajectories over HTTP: the npz's layout, long questions in pieces, limits. Single answers: test_service_views."""

from __future__ import annotations

import io
from dataclasses import replace

import fakes
import numpy as np
import pytest
from running import make_rig, pictures, problem
from waiting import HANG_S

from client.sdk import Client
from client.wire import CameraModel
from scas4d_core.storage.history import History
from server.processes import track_answers
from server.processes.queries import TracksQuery
from server.queries import tracks

FRAMES = 6


@pytest.fixture(scope="module")
def finished(service):
    """A scene of six frames."""
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = sdk.create_scene(make_rig(), frames_per_second=10).id
        for index in range(FRAMES):
            sdk.put_frame(id, index, pictures())
            sdk.wait(id, index)
        yield id
        sdk.delete_scene(id)


def ask(http, id, **request):
    return http.post(f"/v1/scenes/{id}/tracks/query", json=request)


def arrays(response):
    assert response.headers["content-type"] == "application/vnd.numpy.npz", response.text
    with np.load(io.BytesIO(response.content), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def test_npz_has_the_world_and_the_layout_of_tapvid3d(http, finished):
    point = [0.5, 0.01, 0.0]
    found = arrays(ask(http, finished, points=[point, [0, 0, 0]], at=2, first=1, project=["c1", "c0"], format="npz"))
    camera = make_rig().cameras[1]
    frames = np.arange(1, FRAMES)
    assert found["frames"].tolist() == frames.tolist()
    np.testing.assert_allclose(found["times"], frames / 10)
    expected = np.array(point) + (frames - 2)[:, None] * [fakes.STEP_M, 0, 0]
    np.testing.assert_allclose(found["tracks_world"][:, 0], expected, atol=1e-6)
    assert found["ids"].shape == (2,)
    assert found["confidence"].shape == (FRAMES - 1, 2)
    # In the first camera's axes; it stands three metres before the world's origin.
    np.testing.assert_allclose(found["tracks_XYZ"], found["tracks_world"] + [0, 0, 3], atol=1e-5)
    assert found["visibility"].shape == (FRAMES - 1, 2)
    assert found["visibility"].dtype == np.bool_
    np.testing.assert_allclose(found["queries_xyt"][:, :2], camera.project(np.array([point, [0, 0, 0]]))[0], atol=1e-4)
    assert found["queries_xyt"][:, 2].tolist() == [1, 1]  # the row of frame 2
    np.testing.assert_allclose(found["fx_fy_cx_cy"], [20, 20, 12, 8])
    assert found["extrinsics_w2c"].shape == (FRAMES - 1, 4, 4)
    for name in ("c0", "c1"):
        assert found[f"pixels.{name}"].shape == (FRAMES - 1, 2, 2)
        assert found[f"visibility.{name}"].shape == (FRAMES - 1, 2)


def test_a_pixel_query_is_laid_out_in_its_own_camera(http, finished):
    uv = [[12.2, 8.3], [1.5, 1.5]]
    found = arrays(ask(http, finished, pixels=uv, camera="c1", at=0, project=["c0"], format="npz"))
    np.testing.assert_allclose(found["queries_xyt"], [[*uv[0], 0], [*uv[1], 0]], atol=1e-5)
    assert "visibility.c1" in found
    assert found["ids"][1] == -1
    assert np.isnan(found["tracks_XYZ"][:, 1]).all()
    assert not found["visibility"][:, 1].any()
    np.testing.assert_allclose(found["pixels.c1"][0, 0], uv[0], atol=1e-3)


@pytest.mark.parametrize("format", ["json", "npz"])
def test_a_long_question_is_asked_in_pieces_and_answered_as_a_whole(http, finished, format, monkeypatch):
    rng = np.random.default_rng(0)
    request = {
        "points": rng.normal(scale=0.2, size=(7, 3)).tolist(),
        "at": 1,
        "project": ["c0", "c1"],
        "format": format,
    }
    whole = ask(http, finished, **request)
    monkeypatch.setattr(track_answers, "PIECE_QUERIES", 3)
    monkeypatch.setattr(track_answers, "PIECE_POINTS", 6)
    in_pieces = ask(http, finished, **request)
    if format == "json":
        assert in_pieces.json() == whole.json()
        assert np.shape(whole.json()["confidence"]) == (7, FRAMES)
    else:
        expected, got = arrays(whole), arrays(in_pieces)
        assert expected.keys() == got.keys()
        for name, array in expected.items():
            np.testing.assert_array_equal(got[name], array, err_msg=name)


def test_pieces_cover_everything_once_within_their_bounds():
    cameras = make_rig(3).cameras
    query = TracksQuery(
        frames=tuple(range(0, 200, 2)), at=0, points=np.arange(15000.0).reshape(5000, 3), project=cameras
    )
    pieces = track_answers.split_query(query)
    assert [len(row[0].points) for row in pieces] == [2048, 2048, 904]
    for row in pieces:
        assert sum((piece.frames for piece in row), ()) == query.frames
        for piece in row:
            assert len(piece.points) * len(piece.frames) <= track_answers.PIECE_POINTS
            assert len(piece.frames) * len(cameras) <= track_answers.PIECE_VIEWS
            assert (piece.at, piece.format, piece.project) == (0, "npz", cameras)
    np.testing.assert_array_equal(np.concatenate([row[0].points for row in pieces]), query.points)
    few = replace(query, points=query.points[:3], frames=(4, 5))
    assert [[piece.frames for piece in row] for row in track_answers.split_query(few)] == [[(4, 5)]]


def test_a_long_history_is_read_a_frame_at_a_time(tmp_path, monkeypatch):
    history = History(tmp_path / "states")
    points = np.array([[0.0, 0, 0], [0.5, 0, 0]])
    for index in range(30):
        history.append(index, index / 10, fakes.state(points, index))
    reads: list[tuple[int, ...]] = []
    stacked = History.stacked

    def noting(self, name, indices=None, rows=None):
        reads.append(tuple(indices))
        return stacked(self, name, indices, rows)

    monkeypatch.setattr(History, "stacked", noting)
    reader = fakes.FakeCommitted(history, make_rig().world_frame(), None)
    query = TracksQuery(frames=tuple(range(30)), at=0, points=points)
    found = track_answers.compute_tracks(reader, history, query)
    assert found["tracks_world"].shape == (30, 2, 3)
    assert max(len(indices) for indices in reads) == 1


@pytest.mark.parametrize(
    ("changes", "field", "remedy"),
    [
        ({"points": [[0, 0, 0]] * 800}, "format", "npz"),
        ({"points": [[0, 0, 0]] * 900, "format": "npz"}, "points", "at most 5000"),
        ({"points": [[0, 0, 0]], "project": ["many"]}, "project", "at most 60"),
        ({"points": [[0, 0, 0]], "project": ["c0", "other c0"]}, "project", "different names"),
    ],
)
def test_what_is_too_much_is_refused_by_name(http, finished, monkeypatch, changes, field, remedy):
    for name, limit in (("MOST_POINTS", 5000), ("MOST_JSON_POINTS", 4000), ("MOST_VIEWS", 60)):
        monkeypatch.setattr(tracks, name, limit)
    mine = CameraModel.of(make_rig().cameras[0]).model_dump()
    named = {"many": [mine | {"name": f"m{i}"} for i in range(11)], "other c0": [mine | {"width": 30}], "c0": ["c0"]}
    if "project" in changes:
        changes = changes | {"project": [camera for name in changes["project"] for camera in named[name]]}
    document = problem(ask(http, finished, **changes), 422)
    assert document["field"] == field
    assert remedy in document["remedy"]
    assert ask(http, finished, ids=[0]).status_code == 200


def test_the_same_camera_may_be_named_twice(http, finished):
    found = ask(http, finished, ids=[0], project=["c0", "c0"]).json()
    assert list(found["pixels"]) == ["c0"]


def test_ids_name_the_same_point_for_the_life_of_the_scene(http, finished):
    carried = ask(http, finished, points=[[0.5, 0.01, 0]], at=0).json()["ids"]
    later = ask(http, finished, points=[[0.5 + 4 * fakes.STEP_M, 0.01, 0]], at=4).json()["ids"]
    assert carried == later == [1]


def test_a_point_beyond_all_numbers_is_refused(http, finished):
    """It was answered with a confidence that is no number."""
    refused = http.post(f"/v1/scenes/{finished}/tracks/query", json={"points": [[0, 0, 0], [0, 1e300, 0]]})
    assert problem(refused, 422)["field"] == "points"
    assert ask(http, finished, points=[[0, -1e15, 0]]).json()["confidence"] == [[0] * FRAMES]
