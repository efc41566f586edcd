"""Frames that say nothing, through the running service with the real method: committed, held, and said why."""

from __future__ import annotations

import io

import httpx
import numpy as np
import pytest
from box_scene import SHIFT, make_box, make_rig, moved, take_frame
from PIL import Image
from running import Running
from scipy.spatial.transform import Rotation
from waiting import HANG_S

from client.sdk import Client
from scas4d_core.captures import InitialPoints
from scas4d_core.storage.history import History
from server.settings import ServerSettings

BOX, RIG = make_box(), make_rig()
SETTINGS = {
    "static": {"iterations": 200, "max_gaussians": 800},
    "update": {"iterations": 20, "clusters": [2, 12], "skip_tolerance": -1},
    "effects": {"rotation": "off"},
}


def png(array):
    file = io.BytesIO()
    Image.fromarray(array).save(file, "PNG")
    return file.getvalue()


def seen(index):
    frame = take_frame(
        index, 0.1 * index, moved(BOX, Rotation.from_rotvec([0, 0.03 * index, 0]), 0.3 * index * SHIFT), RIG
    )
    return {name: png(image) for name, image in frame.images.items()}, {
        name: png(255 * mask) for name, mask in frame.masks.items()
    }


def put(sdk, id, index, dark=()):
    images, masks = seen(index)
    black = png(np.zeros((48, 48, 3), np.uint8))
    sdk.put_frame(id, index, images | {name: black for name in dark}, masks, 0.1 * index)
    return sdk.wait(id, index, seconds=HANG_S)


def metric(sdk, line):
    return next(float(text.split()[-1]) for text in sdk.metrics().splitlines() if text.startswith(line))


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("judged")
    running = Running(ServerSettings(data=folder), core=None)
    try:
        with Client(running.url, busy_timeout=HANG_S) as sdk:
            id = sdk.create_scene(RIG, settings=SETTINGS, frames_per_second=10).id
            sdk.put_points(id, InitialPoints(BOX.means.astype(np.float64), BOX.colours, BOX.foreground))
            for index in range(4):
                assert put(sdk, id, index).state == "committed"
            yield running, sdk, id, folder / "scenes" / id / "states"
    finally:
        running.stop()


def test_a_frame_that_is_met_carries_its_report(served):
    _, sdk, id, _ = served
    report = sdk.frame(id, 3)
    assert (report.degraded, report.dropped_cameras, report.candidate, report.attempts) == (None, {}, "end", ["as set"])
    assert report.errors["end"] < report.errors["previous"]
    assert report.curve[-1].iterations == report.iterations == 20
    assert report.planned == [(0, 20)]
    assert set(report.cameras) == set(RIG.names)
    assert all(0 <= fit.health <= 1 for fit in report.cameras.values())
    assert report.seconds["decode"] > 0
    assert report.write_seconds > 0
    assert not sdk.scene(id).degraded
    assert (report.effects["rotation"].on, report.effects["rotation"].pinned) == (False, True)
    assert report.effects["rigidity"].on
    status = sdk.scene(id).effects
    assert {name: one.on for name, one in status.items()} == {name: one.on for name, one in report.effects.items()}


def test_a_black_frame_is_held_explained_and_over_with_the_next_good_one(served):
    _, sdk, id, states = served
    held = metric(sdk, 'scas4d_degraded_frames_total{how="rejected"}')
    index = sdk.scene(id).next_frame
    report = put(sdk, id, index, RIG.names)
    assert report.state == "committed"
    assert report.degraded.startswith("previous state kept: the images are")
    assert report.used_cameras == []
    history = History.load(states)
    before, after = history.gaussians(index - 1), history.gaussians(index)
    for name, array in before.arrays().items():
        assert np.array_equal(array, after.arrays()[name]), name
    status = sdk.scene(id)
    assert status.degraded
    assert f"frame {index} was rejected; previous state kept" in status.error
    assert metric(sdk, 'scas4d_degraded_frames_total{how="rejected"}') == held + 1
    good = put(sdk, id, index + 1)
    assert good.degraded is None
    assert good.psnr > sdk.frame(id, 3).psnr - 3
    assert not sdk.scene(id).degraded


def test_one_dark_camera_is_left_out_by_name(served):
    _, sdk, id, _ = served
    left_out = metric(sdk, "scas4d_cameras_left_out_total")
    raised = metric(sdk, 'scas4d_alarms_total{kind="camera_left_out"}')
    index = sdk.scene(id).next_frame
    report = put(sdk, id, index, ["c2"])
    assert report.degraded is None
    assert "is dark" in report.dropped_cameras["c2"]
    assert "c2" not in report.used_cameras
    assert len(report.used_cameras) == 5
    assert "c2: its image is dark" in sdk.scene(id).error
    assert metric(sdk, "scas4d_cameras_left_out_total") == left_out + 1
    assert metric(sdk, 'scas4d_alarms_total{kind="camera_left_out"}') == raised + 1
    assert [(alarm.kind.value, alarm.camera) for alarm in report.alarms] == [("camera_left_out", "c2")]
    assert "is dark" in report.alarms[0].evidence
    assert [alarm.kind.value for alarm in sdk.frame(id, 3).alarms] == []


def test_a_budget_and_a_replay_on_the_method_itself(served):
    _, sdk, id, _ = served
    sdk.set_budget(id, iterations=7)
    index = sdk.scene(id).next_frame
    assert put(sdk, id, index).iterations == 7
    sdk.set_budget(id, budget_ms=60_000, stop_gain=0.9)  # all the time in the world, and easily content
    assert put(sdk, id, index + 1).iterations < 4000
    sdk.set_budget(id)
    assert put(sdk, id, index + 2).iterations == 20
    sdk.replay(id, [2, 40], frames=2)
    until = sdk.tradeoff(id)
    while until.replay.state == "running":
        until = sdk.tradeoff(id)
    assert until.replay.state == "done", until.replay.error
    found = {point.iterations: point for point in until.points if point.kind == "replayed"}
    assert set(found) == {20, 2, 40}
    assert found[40].error < found[2].error
    assert all(point.milliseconds > 0 for point in found.values())
    assert {point.iterations for point in until.points if point.kind == "measured"} >= {7, 20}
    assert until.model.per_iteration > 0


def test_what_was_judged_is_known_again_after_a_restart(served):
    running, sdk, id, _ = served
    index = sdk.scene(id).next_frame
    before = put(sdk, id, index, RIG.names)
    running.stop()
    again = Running(running.app.state.settings, core=None)
    try:
        with Client(again.url, busy_timeout=HANG_S) as after, httpx.Client(base_url=again.url, timeout=HANG_S) as http:
            assert before.latency is not None  # only kept in memory
            assert after.frame(id, index) == before.model_copy(update={"latency": None})
            assert after.scene(id).degraded
            assert "previous state kept" in after.scene(id).error
            assert http.get(f"/v1/scenes/{id}/tradeoff").status_code == 200
    finally:
        again.stop()
