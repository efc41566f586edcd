"""Poses that drift are followed, those that stand keep theirs to the bit, and what all cameras share is the scene's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from box_scene import make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Rig
from scas4d_core.effects.cameras.alignment import (
    Equations,
    adjoint,
    pixel_offset,
    to_camera_twist,
    turn_from_pixels,
    twist_to_matrix,
)
from scas4d_core.effects.cameras.pose_drift import (
    LEAST,
    NAME,
    TURN,
    Poses,
    limit_twist,
    remove_common_motion,
    rig_with_drift,
    step_twists,
)
from scas4d_core.effects.effect import effect
from scas4d_core.effects.switches import IDLE, committed_arrays
from scas4d_core.engines.views import CameraArrays
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History

RIG, BOX = make_rig(), make_box()
LENS = CameraArrays.of(RIG["c0"]).lens
RNG = np.random.default_rng(5)
OFF = {"c2": np.array([0.8, -0.4, 0.0])}
"""Pixels across, down and round by which a camera has been knocked; of 48 pixels 0.96 can be followed."""


def knocked(offsets: dict[str, np.ndarray]) -> Rig:
    """The rig with some cameras turned."""
    twists = {name: np.concatenate([np.zeros(3), turn_from_pixels(LENS) @ offset]) for name, offset in offsets.items()}
    turned = {name: twist_to_matrix(twist) @ RIG[name].world_to_camera for name, twist in twists.items()}
    return Rig(
        tuple(
            replace(camera, world_to_camera=turned.get(camera.name, camera.world_to_camera)) for camera in RIG.cameras
        )
    )


def started(mode: str, history: History | None = None, **more: str) -> Reconstruction:
    effects = {NAME: mode, "camera_gain": "off", "shadows": "off", "uncovered": "off", **more}
    settings = Settings.model_validate({"update": {"clusters": (2, 12), "iterations": 40}, "effects": effects})
    first, known = take_frame(0, 0.0, BOX, RIG), StaticResult(BOX, {}, [])
    return Reconstruction.start(RIG, first, settings, static=known, history=history)


def play(scene: Reconstruction, frames: range, offsets: dict[str, np.ndarray], drift: bool = False) -> Reconstruction:
    """Frames of the box, which turns a little, before a rig of which some cameras are off, or drift until they are."""
    for index in frames:
        box = moved(BOX, Rotation.from_rotvec([0, 0.02 * index, 0]), np.array([0.004 * index, 0, 0]))
        share = index / frames[-1] if drift else 1.0
        rig = knocked({name: share * offset for name, offset in offsets.items()})
        scene.step(take_frame(index, index / 30, box, rig))
    return scene


def arrays(scene: Reconstruction) -> dict[str, Any]:
    return dict(scene._prepared.carried.effects.get(NAME, {}))


def off_by(scene: Reconstruction, name: str) -> np.ndarray:
    """[3] pixels by which a camera is posed otherwise than calibrated."""
    twist = arrays(scene)["twists"][RIG.names.index(name)]
    return pixel_offset(LENS, twist, 1.3)


def same(one: Reconstruction, other: Reconstruction) -> bool:
    here, there = one.history.newest.arrays(), other.history.newest.arrays()
    return all(np.array_equal(here[key], there[key]) for key in here)


def test_a_camera_that_is_knocked_is_found_and_the_others_stay() -> None:
    scene = play(started("auto"), range(1, 15), OFF)
    assert scene._prepared.carried.switches[NAME].on
    assert scene._prepared.carried.switches[NAME].text.startswith("camera c2 is misaligned by 0.")
    np.testing.assert_allclose(off_by(scene, "c2"), OFF["c2"], atol=0.25)  # the box had taken on a part
    rows = np.flatnonzero(arrays(scene)["twists"].any(axis=1))
    assert [RIG.names[row] for row in rows] == ["c2"]
    assert scene._factory.posed["c1"] is scene.rig["c1"]
    assert scene.rig["c2"].world_to_camera == pytest.approx(started("off").rig["c2"].world_to_camera)  # as calibrated


def test_it_is_worth_it_for_what_that_camera_sees() -> None:
    fits = [play(started(mode), range(1, 9), OFF).history.report(8)["cameras"]["c2"]["psnr"] for mode in ("off", "on")]
    assert fits[1] > fits[0] + 2


def out(scene: Reconstruction) -> bool:
    return scene._prepared.carried.past.is_left_out("c2")


def test_a_camera_that_was_set_aside_is_looked_at_and_comes_back() -> None:
    """The outlying camera is left out from the next frame on, as without the effect, until its pose is found."""
    scene, without = (play(play(started(mode), range(1, 4), {}), range(4, 6), OFF) for mode in ("auto", "off"))
    assert out(scene)
    assert out(without)
    for one in (scene, without):
        play(one, range(6, 12), OFF)
    assert not out(scene)
    assert out(without)
    np.testing.assert_allclose(off_by(scene, "c2"), OFF["c2"], atol=0.15)


def test_a_camera_that_was_moved_further_stays_set_aside() -> None:
    scene = play(play(started("auto"), range(1, 4), {}), range(4, 14), {"c2": np.array([2.0, 0, 0])})
    assert out(scene)
    if "twists" in arrays(scene):
        assert np.linalg.norm(off_by(scene, "c2")[:2]) < 1.05 * 0.02 * 48


def test_a_camera_that_is_shifted_is_followed() -> None:
    twist = np.array([0.016, 0, 0, 0, 0, 0])
    there = replace(RIG["c2"], world_to_camera=twist_to_matrix(twist) @ RIG["c2"].world_to_camera)
    rig = Rig(tuple(there if camera.name == "c2" else camera for camera in RIG.cameras))
    scene = started("on")
    for index in range(1, 15):
        box = moved(BOX, Rotation.from_rotvec([0, 0.02 * index, 0]), np.array([0.004 * index, 0, 0]))
        scene.step(take_frame(index, index / 30, box, rig))
    np.testing.assert_allclose(off_by(scene, "c2"), pixel_offset(LENS, twist, 1.3), atol=0.25)


def test_a_drift_is_followed_a_frame_late() -> None:
    scene = play(started("on"), range(1, 13), {"c4": np.array([0.0, 0.9, 0.0])}, drift=True)
    np.testing.assert_allclose(off_by(scene, "c4"), [0, 0.9, 0], atol=0.25)  # 0.075 pixels a frame, half of the way


def test_cameras_that_stand_leave_it_off_and_change_no_bit() -> None:
    auto, off, on = (play(started(mode), range(1, 6), {}) for mode in ("auto", "off", "on"))
    assert not auto._prepared.carried.switches[NAME].on
    assert auto._prepared.carried.switches[NAME].share < effect(NAME).off_below
    assert same(auto, off)
    assert same(on, off)  # nothing was off: no pose is touched
    assert arrays(off) == {}
    assert "twists" not in arrays(on)


def test_the_poses_go_on_with_the_same_bits(tmp_path: Path) -> None:
    whole = play(started("on", History(tmp_path / "whole")), range(1, 7), OFF)
    settings, folder = whole.settings, tmp_path / "half"
    play(started("on", History(folder)), range(1, 5), OFF)
    again = play(Reconstruction.resume(RIG, settings, History.open(folder)), range(5, 7), OFF)
    assert same(whole, again)
    for name, array in arrays(whole).items():
        np.testing.assert_array_equal(arrays(again)[name], array, err_msg=name)
    np.testing.assert_array_equal(whole.history.effects(6)[NAME]["twists"], arrays(whole)["twists"])


def test_twists_alone_are_committed() -> None:
    poses = Poses.of({}, 6)
    assert committed_arrays({NAME: poses.arrays()}) == {}
    poses.twists[1, 4] = 0.01
    assert list(committed_arrays({NAME: poses.arrays()})[NAME]) == ["twists"]


def test_what_all_cameras_share_is_motion_of_the_scene() -> None:
    """The equations of cameras before which the scene has moved ask for no pose."""
    motion, aligned = RNG.normal(size=6) * 0.01, {}
    for row, camera in enumerate(RIG.cameras):
        root = RNG.normal(size=(6, 40)) * 300
        one = Equations(root @ root.T, np.zeros(6), 1.0, 1.3)
        told = one.matrix @ to_camera_twist(one, camera.world_to_camera) @ motion
        aligned[row] = (one._replace(vector=told), camera, LENS)
    alone = step_twists(
        np.zeros((6, 6)), {0: aligned[0]} | {row: aligned[row] for row in range(1, 6)}, np.arange(6) == 0
    )
    assert np.abs(alone).max() < 1e-4
    one, camera, lens = aligned[0]
    more = one._replace(vector=one.vector + one.matrix @ np.array([0, 0, 0, 0, 0.01, 0]))
    found = step_twists(np.zeros((6, 6)), {**aligned, 0: (more, camera, lens)}, np.arange(6) == 0)
    np.testing.assert_allclose(found[0], [0, 0, 0, 0, 0.005, 0], atol=2e-4)  # half of the way
    assert not found[1:].any()


def test_the_median_twist_is_nothing() -> None:
    shared = RNG.normal(size=6) * 0.01
    everywhere = np.array([adjoint(camera.world_to_camera) @ shared for camera in RIG.cameras])
    believed = np.ones(6, np.bool_)
    np.testing.assert_allclose(remove_common_motion(everywhere, RIG, believed), 0, atol=1e-12)
    own = np.zeros((6, 6))
    own[3] = RNG.normal(size=6) * 0.01
    np.testing.assert_allclose(remove_common_motion(everywhere + own, RIG, believed), own, atol=1e-12)
    assert remove_common_motion(own, RIG, believed) is own  # most have none
    drifting = RNG.normal(size=(6, 6)) * 0.01
    after = remove_common_motion(drifting, RIG, believed)
    worlds = [
        np.linalg.solve(adjoint(camera.world_to_camera), twist)
        for camera, twist in zip(RIG.cameras, after, strict=True)
    ]
    np.testing.assert_allclose(np.median(worlds, axis=0), 0, atol=1e-12)


def test_a_pose_is_moved_by_so_much_at_most() -> None:
    far = np.array([0.5, 0, 0, 0, 0.3, 0])
    less = limit_twist(far, LENS, 1.3)
    assert np.linalg.norm(pixel_offset(LENS, less, 1.3)[:2]) == pytest.approx(0.02 * 48)
    assert np.linalg.norm(limit_twist(np.array([0, 0, 0, 0, 0, 1.0]), LENS, 1.3)) == pytest.approx(TURN)
    near = np.array([0, 0, 0, 0, 0.001, 0])
    assert (limit_twist(near, LENS, 1.3) == near).all()


def test_evidence_waits_for_frames_that_agree() -> None:
    poses = Poses.of({}, 6)
    here = Equations(400 * np.eye(3), 400 * np.array([0.8, 0, 0]), 400.0, 1.0)
    there = here._replace(vector=-here.vector)
    for told in (here, there, here, there):  # a thing that swings
        poses.record_offset(2, told)
        assert poses.shares[2] < effect(NAME).off_below
    nothing = here._replace(vector=np.zeros(3))
    for _ in range(4):
        poses.record_offset(4, here)
        for row in (0, 1, 3, 5):
            poses.record_offset(row, nothing)
    assert poses.shares[4] > 0.5
    assert poses.drifted().tolist() == [False] * 4 + [True, False]
    assert np.linalg.norm(poses.offsets[4]) == pytest.approx(0.8, abs=0.01)


def test_where_most_cameras_seem_to_be_off_none_is() -> None:
    poses = Poses.of({}, 6)
    for _ in range(4):
        for row in range(6):
            way = np.array([0.5 + 0.1 * row, 0, 0])
            poses.record_offset(row, Equations(400 * np.eye(3), 400 * way, 400.0, 1.0))
    assert poses.shares.min() > 0.2
    assert not poses.drifted().any()
    seen: Any = SimpleNamespace(result=SimpleNamespace(carried={NAME: poses.arrays()}), rig=RIG, views=[*RIG.names])
    found = effect(NAME).evidence(seen)
    assert found is not None
    assert found.share == 0


def test_residuals_that_are_told_of_a_pose_in_use_count_from_the_calibration() -> None:
    poses = Poses.of({}, 1)
    poses.moved[0] = [1.0, 0, 0]
    nothing_left = Equations(400 * np.eye(3), np.zeros(3), 40.0, 1.0)
    for _ in range(6):
        poses.record_offset(0, nothing_left)
    np.testing.assert_allclose(poses.offsets[0], [1, 0, 0], atol=1e-6)
    assert poses.shares[0] > 0.8  # without the pose there would be ten times as much


def test_the_switch_stays_on_for_a_camera_that_stays_moved_and_goes_off_with_it() -> None:
    scene = play(started("auto"), range(1, 9), OFF)
    assert scene._prepared.carried.switches[NAME].on
    play(scene, range(9, 12), OFF)
    assert scene._prepared.carried.switches[NAME].idle == 0
    play(scene, range(12, 28 + IDLE), {})
    assert not scene._prepared.carried.switches[NAME].on
    assert np.abs(off_by(scene, "c2")).max() < LEAST


def test_evidence_of_nothing() -> None:
    seen: Any = SimpleNamespace(result=SimpleNamespace(carried={}), rig=RIG, views=[*RIG.names])
    assert effect(NAME).evidence(seen) is None
    seen.result.carried[NAME] = Poses.of({}, 6).arrays()
    found = effect(NAME).evidence(seen)
    assert found is not None
    assert (found.share, found.text) == (0.0, "")


def test_poses_that_are_not_known_are_those_of_the_calibration() -> None:
    assert rig_with_drift(RIG, {}) is RIG
    assert rig_with_drift(RIG, {NAME: Poses.of({}, 6).arrays()}) is RIG


def test_a_few_cameras_teach_nothing() -> None:
    seen: Any = SimpleNamespace(views=[1, 2, 3], rig=RIG)
    assert effect(NAME).record(seen, on=True) is None


def test_a_frame_of_few_cameras_is_no_evidence() -> None:
    seen: Any = SimpleNamespace(
        result=SimpleNamespace(carried={NAME: Poses.of({}, len(RIG)).arrays()}), rig=RIG, views=[*RIG.names]
    )
    assert effect(NAME).evidence(seen) is not None
    seen.views = seen.views[:1]
    assert effect(NAME).evidence(seen) is None
