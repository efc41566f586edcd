"""Shadows: what stands follows the pictures once a frame, where it looks other than in frame 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from box_scene import make_box, make_rig, take_frame
from numpy.typing import NDArray

from scas4d_core.effects.appearance.shadows import NAME
from scas4d_core.effects.switches import first_switches
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.views import SIDE, CameraArrays
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.update.view_factory import ViewFactory

RIG = make_rig()
BOX = make_box()
MOVES = np.argsort(np.linalg.norm(BOX.means - BOX.means.min(axis=0), axis=1))[:40]
STATE = BOX.replace(foreground=np.isin(np.arange(len(BOX)), MOVES).astype(np.float32))
SHADED = ~STATE.moving & (BOX.means[:, 0] > np.quantile(BOX.means[:, 0], 0.6))


def shaded(by: float) -> Gaussians:
    colours = STATE.colours.copy()
    colours[SHADED] *= 1 - by
    return STATE.replace(colours=colours)


def settings(mode: str, **more: str) -> Settings:
    update = {"clusters": (2, 12), "iterations": 10, "reject_outliers": False, "skip_tolerance": -1}
    return Settings.model_validate({"update": update, "effects": {NAME: mode, "uncovered": "off", **more}})


def followed(mode: str, truth: Gaussians, frames: int = 4, **more: str) -> Reconstruction:
    """A scene after frames that show the truth, the first one apart."""
    first = take_frame(0, 0, STATE, RIG)
    scene = Reconstruction.start(RIG, first, settings(mode, **more), static=StaticResult(STATE, {}, []))
    for index in range(1, frames + 1):
        scene.step(take_frame(index, index / 30, truth, RIG))
    return scene


def error(scene: Reconstruction, truth: Gaussians) -> float:
    return float(np.abs(scene.history.newest.colours - truth.colours)[SHADED].mean())


def test_a_shadow_over_what_stands_is_followed() -> None:
    truth = shaded(0.3)
    off, on = followed("off", truth), followed("auto", truth)
    assert error(on, truth) < 0.4 * error(off, truth)
    switch = on._prepared.carried.switches[NAME]
    assert switch.on
    assert switch.text.endswith("of the static scene looks different from frame 0")


def test_nothing_changes_where_nothing_does() -> None:
    off, on = followed("off", STATE), followed("auto", STATE)
    for name, array in off.history.newest.arrays().items():
        np.testing.assert_array_equal(on.history.newest.arrays()[name], array, err_msg=name)


def test_it_goes_off_where_nothing_changes_and_on_again() -> None:
    scene = followed("auto", STATE, frames=8)
    assert not scene._prepared.carried.switches[NAME].on
    scene.step(take_frame(9, 9 / 30, shaded(0.3), RIG))
    assert scene._prepared.carried.switches[NAME].on


def test_the_blocks_that_moving_gaussians_reach_are_camera_counts_once_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    truth, camera_counts, reached = shaded(0.3), list[int](), CpuRenderer.reached

    def counted(self: CpuRenderer, state: Gaussians, cameras: Sequence[CameraArrays]) -> list[NDArray[np.bool_]]:
        camera_counts.append(len(cameras))
        return reached(self, state, cameras)

    scene = followed("on", truth, frames=1)
    colours = scene.history.newest.colours
    monkeypatch.setattr(CpuRenderer, "reached", counted)
    scene.step(take_frame(2, 2 / 30, truth, RIG))
    assert (scene.history.newest.colours != colours).any()  # both the update and the evidence used the masks
    assert sum(camera_counts) == len(RIG.cameras)


def test_what_moves_keeps_its_own_colours() -> None:
    truth = shaded(0.3)
    held = {"moving_colour": "off", "shading": "off"}
    on, off = followed("on", truth, **held), followed("off", truth, **held)
    for scene in (on, off):
        np.testing.assert_array_equal(scene.history.newest.colours[MOVES], STATE.colours[MOVES])
    assert (on.history.newest.colours[SHADED] != off.history.newest.colours[SHADED]).any()


def test_a_scene_in_which_all_moves_has_none() -> None:
    whole = BOX.replace(foreground=np.ones(len(BOX), np.float32))
    scene = Reconstruction.start(
        RIG, take_frame(0, 0, whole, RIG), settings("auto"), static=StaticResult(whole, {}, [])
    )
    assert not scene._prepared.carried.switches[NAME].on
    scene.step(take_frame(1, 1 / 30, whole, RIG))
    assert not scene._prepared.carried.switches[NAME].on


def test_colours_of_what_stands_follow_in_every_iteration_only_where_that_is_pinned() -> None:
    assert not first_switches(Settings(), 0)["static_colour"].on
    assert first_switches(Settings(effects={"static_colour": "on"}), 0)["static_colour"].on


def test_an_update_that_is_not_kept_teaches_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = shaded(0.3)
    monkeypatch.setattr(
        "scas4d_core.update.best_state.BestState.end", lambda self, iterations, left_out: Candidate.PREVIOUS
    )
    np.testing.assert_array_equal(followed("on", truth, frames=1).history.newest.colours, STATE.colours)


def test_without_masks_it_waits_until_it_is_known_what_stands() -> None:
    bare = STATE.replace(foreground=np.ones(len(BOX), np.float32))
    first = take_frame(0, 0, STATE, RIG, masks=False)
    scene = Reconstruction.start(RIG, first, settings("auto"), static=StaticResult(bare, {}, []))
    assert not scene._prepared.carried.switches[NAME].on
    assert scene._prepared.carried.effects[NAME]["c0"][..., 3].max() == 0  # nothing is known to hide anything
    known = Reconstruction.start(RIG, first, settings("auto"), static=StaticResult(STATE, {}, []))
    assert known._prepared.carried.switches[NAME].on


def test_squares_are_means_of_whole_squares() -> None:
    rng = np.random.default_rng(3)
    view = ViewFactory(RIG).views(take_frame(0, 0, STATE, RIG), {})[0]
    view = replace(view, target=rng.random((4, 21, 35), np.float32))
    expected = view.target[:3, :16, :32].astype(np.float64).reshape(3, 2, SIDE, 4, SIDE).mean(axis=(2, 4))
    np.testing.assert_allclose(view.squares, np.moveaxis(expected, 0, -1), rtol=1e-6)
