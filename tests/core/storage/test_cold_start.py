"""Without its checkpoint a scene goes on with what its effects had learnt: that is committed with the frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_scene import make_box, make_rig, take_frame

from scas4d_core.effects.appearance import camera_gain, shadows
from scas4d_core.effects.effect import effect
from scas4d_core.effects.presence.entering import NO_NEWBORNS
from scas4d_core.effects.switches import committed_arrays
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians
from scas4d_core.recompute import recompute
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.storage.frame_arrays import pack_effects, unpack_effects
from scas4d_core.storage.history import History
from scas4d_core.storage.npz import read_npz, write_npz

RIG = make_rig()
BOX = make_box()
STANDS = np.linalg.norm(BOX.means - BOX.means.min(axis=0), axis=1).argsort() >= 40
STATE = BOX.replace(foreground=np.float32(~STANDS))
SETTINGS = Settings.model_validate(
    {
        "update": {"clusters": (2, 12), "iterations": 6, "reject_outliers": False, "skip_tolerance": -1},
        "effects": {"camera_gain": "on", "uncovered": "off"},
    }
)


def shown(by: float) -> Gaussians:
    """The state in a light that is so much dimmer on a half of what stands."""
    dimmed = np.where(STANDS & (BOX.means[:, 0] > 0), 1 - by, 1).astype(np.float32)
    return STATE.replace(colours=STATE.colours * dimmed[:, None])


def followed(history: History, frames: int = 3) -> Reconstruction:
    first = take_frame(0, 0, STATE, RIG)
    scene = Reconstruction.start(RIG, first, SETTINGS, history=history, static=StaticResult(STATE, {}, []))
    for index in range(1, frames + 1):
        scene.step(take_frame(index, index / 30, shown(0.1 * index), RIG))
    return scene


def assert_goes_on(again: Reconstruction, scene: Reconstruction) -> None:
    """With the switches and arrays of a scene, and what follows from them."""
    here, there = again._prepared.carried, scene._prepared.carried
    assert here.switches == there.switches
    for name, key in ((shadows.NAME, "c0"), (camera_gain.NAME, "gains")):
        np.testing.assert_array_equal(here.effects[name][key], there.effects[name][key], err_msg=name)
    again.step(take_frame(4, 4 / 30, shown(0.4), RIG))
    assert again._prepared.carried.switches[shadows.NAME].on
    assert again._prepared.carried.switches[shadows.NAME].share > 0.02
    error = [np.abs(state.colours - shown(0.4).colours)[STANDS].mean() for state in (again.history.newest, STATE)]
    assert error[0] < 0.7 * error[1]


def test_a_scene_resumed_without_its_checkpoint_has_them(tmp_path: Path) -> None:
    scene = followed(History(tmp_path))
    for file in tmp_path.glob("checkpoint_*"):
        file.unlink()
    again = Reconstruction.resume(RIG, SETTINGS, History.open(tmp_path))
    assert again.resumed is not None
    assert again.resumed.cold
    assert_goes_on(again, scene)


@pytest.mark.parametrize("on_disk", [True, False])
def test_a_copy_aside_has_them(on_disk: bool, tmp_path: Path) -> None:
    scene = followed(History(tmp_path) if on_disk else History())
    assert_goes_on(Reconstruction.fork(RIG, SETTINGS, scene.history, 3), scene)


def test_a_file_that_is_written_again_has_them(tmp_path: Path) -> None:
    scene = followed(History(tmp_path))
    file = tmp_path / "frame_000003.npz"
    whole = file.read_bytes()
    file.write_bytes(b"")
    assert scene.history.rewrite(3)
    assert file.read_bytes() == whole
    reopened = History.open(tmp_path)
    reopened.gaussians(3), reopened.report(3)  # in memory, and not written by this process
    assert reopened.rewrite(3)
    assert file.read_bytes() == whole
    (tmp_path / "frame_000002.npz").write_bytes(b"")
    history = History.open(tmp_path)
    recompute(RIG, SETTINGS, history, 1, take_frame(2, 2 / 30, shown(0.2), RIG), {})
    assert set(History.load(tmp_path).effects(2)) >= {camera_gain.NAME}


def test_cameras_with_alike_names_keep_their_own_arrays(tmp_path: Path) -> None:
    given = {"shadows": {"cam": np.arange(2), "cam.npy": np.arange(5)}}
    for key, array in unpack_effects(pack_effects(given))["shadows"].items():
        np.testing.assert_array_equal(array, given["shadows"][key])
    write_npz(tmp_path / "a.npz", given["shadows"])
    for key, array in read_npz(tmp_path / "a.npz").items():
        np.testing.assert_array_equal(array, given["shadows"][key])


def test_what_is_damaged_costs_no_state(tmp_path: Path) -> None:
    followed(History(tmp_path))
    file = tmp_path / "frame_000000.npz"
    content = file.read_bytes()
    at = content.index(b"shadows.c3.npy")
    file.write_bytes(content[: at + 200] + bytes(64) + content[at + 264 :])
    (tmp_path / "first.copy.npz").unlink()
    found = History.load(tmp_path)
    assert found.effects(0) == {}
    assert len(found.gaussians(0)) == len(STATE)


def test_a_frame_without_effects_has_none() -> None:
    history = History()
    history.append(0, 0.0, STATE, {})
    assert history.effects(0) == {}


def test_what_is_large_is_not_committed_with_each_frame() -> None:
    left = {"frames": np.zeros(9), "share": np.array(0.3)}
    kept = committed_arrays({"leaving": left, "shadows": {"c0": np.zeros(3)}, "entering": NO_NEWBORNS})
    assert {name: set(own) for name, own in kept.items()} == {"leaving": {"share"}, "entering": set(NO_NEWBORNS)}
    assert effect("shadows").committed_arrays == ()
