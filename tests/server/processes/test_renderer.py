"""A reader's answers about scenes in which Gaussians were born and retired."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import imageio.v3 as imageio
import numpy as np
import pytest
from histories import state
from running import make_rig
from scipy.spatial.transform import Rotation

from client.wire import JointsModel
from scas4d_core.engines.choose import WARP_DEVICE
from scas4d_core.engines.renderer import levels
from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History
from server.messages import SceneSpec
from server.processes.part_labels import resize_labels
from server.processes.queries import (
    Answer,
    GaussiansQuery,
    JointsQuery,
    NumberedQuery,
    PartsQuery,
    QueryRefused,
    RenderQuery,
)
from server.processes.reader_process import QueryReader, view_device
from server.storage.layout import SceneFolder


@pytest.fixture
def renderer(tmp_path):
    history = History(tmp_path / "states")
    first = state(0, 40)
    history.append(0, 0.0, first.replace(foreground=np.ones(40, np.float32)))
    history.append(3, 0.1, history.newest.concatenate(history.newest.rows([4, 5])).retire([7]))
    history.append(5, 0.2, history.newest.revive([7]).retire([41]))
    return QueryReader(SceneSpec(SceneFolder(tmp_path), make_rig(), Settings()))


def test_lives(renderer):
    found = renderer.answer(NumberedQuery(1, GaussiansQuery((141, 107, 100))))
    assert isinstance(found, Answer)
    assert json.loads(found.body) == {
        "frame": 5,
        "gaussians": [
            {"id": 141, "born": 3, "retired": [5], "revived": []},
            {"id": 107, "born": 0, "retired": [3], "revived": [5]},
            {"id": 100, "born": 0, "retired": [], "revived": []},
        ],
    }
    refused = renderer.answer(NumberedQuery(2, GaussiansQuery((141, 142))))
    assert isinstance(refused, QueryRefused)
    assert (refused.status, "[142]" in refused.fault, refused.remedy != "") == (404, True, True)


def test_parts_have_a_label_for_each_and_views_of_any_frame_take_them(renderer):
    found = renderer.answer(NumberedQuery(1, PartsQuery(2)))
    assert isinstance(found, Answer), found
    parts = json.loads(found.body)
    assert parts["ids"] == list(range(100, 142))
    assert parts["labels"][41] == -1  # retired
    assert set(parts["labels"][:41]) == {0, 1}
    labels, camera = np.array(parts["labels"], np.int16), make_rig().cameras[0]
    for frame in (0, 3, 5):
        for given in (labels, labels[:40]):
            query = RenderQuery(camera, frame, ("parts",), "npz", (0.0, 0.0, 0.0), parts=2, labels=given)
            assert isinstance(renderer.answer(NumberedQuery(2, query)), Answer)


def test_joints_are_null_while_a_part_is_absent(tmp_path):
    """A leaf that opens about the edge of a static wall is absent in one frame."""
    rng = np.random.default_rng(0)
    wall, leaf = rng.random((400, 3)) * [1, 1, 0.1] + [-1, 0, 2], rng.random((400, 3)) * [1, 1, 0.1] + [0, 0, 2]
    hinge = np.array([0, 0, 2])
    history = History(tmp_path / "states")
    for frame in range(6):
        turn = Rotation.from_rotvec([0, 0.1 * frame, 0])
        means = np.concatenate([wall, turn.apply(leaf - hinge) + hinge])
        state = Gaussians.of_points(means, radius=0.05)
        state = state.replace(foreground=np.ones(800, np.float32))
        state.rotations[400:] = np.roll(turn.as_quat(), 1)
        if frame == 2:
            state = state.retire(np.arange(400, 800))
        history.append(frame, frame / 30, state)
    reader = QueryReader(SceneSpec(SceneFolder(tmp_path), make_rig(), Settings()))
    found = reader.answer(NumberedQuery(1, JointsQuery((1, 2, 3), None)))
    assert isinstance(found, Answer), found
    answer = JointsModel.model_validate_json(found.body)
    assert (answer.frames, answer.times) == ([1, 2, 3], [1 / 30, 2 / 30, 3 / 30])
    (joint,) = answer.joints
    assert (joint.parent, joint.kind) == (-1, "revolute")
    assert [row is None for row in joint.axes] == [row is None for row in joint.centres] == [False, True, False]
    assert joint.values[1] is None
    np.testing.assert_allclose([joint.values[0], joint.values[2]], [0.1, 0.3], atol=0.01)


def test_labels_are_fitted():
    labels = np.array([2, 0, 1], np.int16)
    assert resize_labels(labels, 5).tolist() == [2, 0, 1, -1, -1]
    assert resize_labels(labels, 2).tolist() == [2, 0]
    assert resize_labels(labels, 3).dtype == np.int16


def test_views_are_rendered_by_the_scenes_device(tmp_path, monkeypatch, caplog):
    spec = SceneSpec(SceneFolder(tmp_path), make_rig(), Settings(device="gpu"))
    monkeypatch.setattr("scas4d_core.engines.choose.gpu_fault", lambda: "no NVIDIA driver is installed")
    assert view_device(spec) == "cpu"  # the machine with the GPU may be another one
    assert "no NVIDIA driver" in caplog.text
    monkeypatch.setattr("scas4d_core.engines.choose.gpu_fault", lambda: None)
    assert view_device(spec) == "gpu"
    assert view_device(replace(spec, settings=Settings(device="cpu"))) == "cpu"


def test_a_gpu_and_the_cpu_render_the_same_image(renderer, monkeypatch):
    pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")
    monkeypatch.setenv(WARP_DEVICE, os.environ.get(WARP_DEVICE, "cpu"))
    camera = make_rig().cameras[0]
    for kind in ("colour", "alpha"):
        images = []
        for reader in (renderer, QueryReader(renderer.spec, "gpu")):
            found = reader.answer(NumberedQuery(1, RenderQuery(camera, 3, (kind,), "png", (0.0, 0.3, 0.0))))
            assert isinstance(found, Answer), found
            assert found.headers["X-Frame"] == "3"
            images.append(imageio.imread(found.body).astype(int))
            assert reader.reader._view.device == reader.device
            view = reader.reader.render(camera, 3, background=(0.0, 0.3, 0.0))
            assert np.array_equal(images[-1], levels(getattr(view, kind)))
        assert images[0].std() > {"colour": 5, "alpha": 0}[kind]
        assert np.abs(images[0] - images[1]).max() <= 1
